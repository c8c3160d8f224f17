"""A beam clamped at its left end falls under its own weight and swings back, undamped.

4 x 1 x 1 m on 12 x 3 x 3 nodes (220 tets), stable neo-Hookean, E = 1 MPa, nu = 0.3, 1000 kg/m^3, g = 9.8 m/s^2.

`check` compares with an integration of the same equations (this mesh, lumped mass) that is exact in time: Runge-Kutta
of order 8, SciPy's DOP853, at a relative tolerance of 1e-10. The mesh itself is coarse: at rest its tip hangs 16 % less
deep than that of a converged one, which `hanging_beam_fine` comes closer to.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "velocity_verlet", "dt": 1 / 960, "seconds": 2.0, "fps": 30.0}

TIP = (2.0, 0.0, 0.0)  # [m] at rest
TIP_END = (1.68729062555, -1.53957261726, 0.0)  # [m] at 2 s
ENERGIES = {  # time [s]: kinetic, elastic, gravity [J]
    0.5: (17653.1801606, 8123.98232762, -25777.1624882),
    1.0: (7471.81682963, 52674.2106408, -60146.0274704),
    1.5: (8671.76066664, 49704.7006972, -58376.4613639),
    2.0: (17815.2156588, 7007.81580867, -24823.0314675),
}


def build() -> ts.Scene:
    """The clamped beam; it starts straight and at rest."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    mesh = ts.box_mesh(cells=(11, 2, 2), size=(4.0, 1.0, 1.0))
    rubber = ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.3, density=1000.0)
    beam = scene.add_body(mesh, rubber, name="beam")
    beam.fix(lambda X: X[:, 0] < -1.99)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """Tip and energies against the exact path, and the sum of energies, which starts at 0 and must stay there."""
    tip = np.linalg.norm(sim.scene.body("beam").rest_positions - TIP, axis=1).argmin()
    miss = np.linalg.norm(sim.positions("beam")[tip] - TIP_END)
    assert miss < 2e-4, f"the tip is {miss:.2e} m from its place at {sim.time:g} s"  # 3.4e-5 m measured

    reports = {round(report.time, 6): report for report in result.step_reports}
    for time, wanted in ENERGIES.items():
        found = (reports[time].kinetic, reports[time].elastic, reports[time].gravity)
        assert np.allclose(found, wanted, rtol=0.0, atol=1.0), f"energies at {time:g} s: {found} J, not {wanted} J"
    drift = max(abs(report.kinetic + report.elastic + report.gravity) for report in result.step_reports)
    assert drift < 0.5, f"the energy, 0 J at the start, drifts by {drift:.3g} J"  # 0.06 J measured; 60 kJ swing about
