"""Three meshes of one hanging beam: coarse linear tets, finer linear tets, coarse quadratic tets.

4 x 1 x 1 m, clamped at the left end, stable neo-Hookean, E = 1 MPa, nu = 0.3, 1000 kg/m^3, g = 9.8 m/s^2, and mass
damping, so that the beams come to rest. From left to right, seen from their free ends: 11 x 2 x 2 cells of first order
(108 nodes), 22 x 4 x 4 cells of first order (575 nodes), 11 x 2 x 2 cells of second order (531 nodes). The free end of a
beam that is converged in the mesh hangs 2.7095 m deep. Linear tets are too stiff in bending: the first beam hangs 16 %
less deep than that, the second 4.9 %, the third 0.7 %.

`check` compares with static solutions on these same meshes: by scikit-fem 12 for the linear tets, and for the quadratic
ones by the dense NumPy solver of `tests/fem/oracle.py`, with the same 4-point quadrature.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 30, "seconds": 5.0, "fps": 30.0}

TIP = (2.0, 0.0, 0.0)  # [m] at rest
BEAMS = {  # name: cells, order, place along z [m], height of the tip in equilibrium [m]
    "coarse": ((11, 2, 2), 1, 1.6, -2.26757962869),
    "fine": ((22, 4, 4), 1, 0.0, -2.57660407879),
    "quadratic": ((11, 2, 2), 2, -1.6, -2.68987508),
}
WEIGHT = 4.0 * 1000.0 * 9.8  # [N]


def build() -> ts.Scene:
    """The clamped beams side by side; they start straight and without speed."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    scene.contact_forces = False  # they hang apart
    # just below twice the slowest angular frequency, about 2 pi / 2.4 s, where a beam comes to rest most quickly
    rubber = ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.3, density=1000.0, mass_damping=4.4)
    for name, (cells, order, z, _) in BEAMS.items():
        mesh = ts.box_mesh(cells, size=(4.0, 1.0, 1.0))
        beam = scene.add_body(mesh, rubber, name=name, position=(0.0, 0.0, z), order=order)
        beam.fix(lambda X: X[:, 0] < -1.99)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The end state: still, every tip where statics puts it, every clamp carrying the weight."""
    assert result.step_reports[-1].kinetic < 0.01, f"kinetic energy is left: {result.step_reports[-1].kinetic:.3g} J"
    for name, (_, _, _, tip_y) in BEAMS.items():
        tip = np.linalg.norm(sim.scene.body(name).rest_positions - TIP, axis=1).argmin()
        miss = sim.positions(name)[tip, 1] - tip_y
        assert abs(miss) < 5e-4, f"the tip of {name} is {miss:.2e} m off the static {tip_y} m"  # 1.4e-4 m measured
        force = sim.reactions(name).sum(axis=0)
        assert np.allclose(force, (0.0, WEIGHT, 0.0), rtol=0.0, atol=5.0), f"{name}: {force} N against {WEIGHT} N"
