"""A bar is twisted by a full turn and back to a quarter turn, where it must not remember the rest.

4 x 1 x 1 m on 16 x 4 x 4 cells (1,280 tets), stable neo-Hookean, E = 1 MPa, nu = 0.3, 1000 kg/m^3, mass damping, no
gravity. The left end is fixed, the right end turns about the bar's axis as a rigid face.

`check` compares the torque at a quarter turn with the static solution on this same mesh (scikit-fem 12, linear tets,
full Newton): 27,856.37 N m; converged in the mesh it would be 21,465 N m, so coarse tets are far too stiff in torsion.
The energy there is that of `taisoft.solve_static` in double precision.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 60, "seconds": 4.0, "fps": 30.0}

TWISTED, HELD, BACK = 1.5, 2.0, 3.0  # [s]: the end of the twist, of the hold, of the way back; then it is held again
FULL, QUARTER = 2 * np.pi, np.pi / 2  # [rad]
TORQUE = 27856.3707854  # [N m] at a quarter turn
ENERGY = 21884.3788  # [J] at a quarter turn


def build() -> ts.Scene:
    """The untwisted bar between a fixed and a turning end."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    mesh = ts.box_mesh(cells=(16, 4, 4), size=(4.0, 1.0, 1.0))
    rubber = ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.3, density=1000.0, mass_damping=10.0)
    bar = scene.add_body(mesh, rubber, name="bar")
    bar.fix(lambda X: X[:, 0] < -1.99)
    turns = [(angle, 0.0, 0.0) for angle in (0.0, FULL, FULL, QUARTER)]
    twist = ts.KeyFrames((0.0, TWISTED, HELD, BACK), rotations=turns, pivot=(2.0, 0.0, 0.0), smooth=True)
    bar.move(lambda X: X[:, 0] > 1.99, twist)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The end state: still, with the torque and energy of statics; and the energy held at the full turn."""
    last = result.step_reports[-1]
    assert last.kinetic < 1e-2, f"kinetic energy is left: {last.kinetic:.3g} J"
    assert abs(last.elastic / ENERGY - 1.0) < 1e-5, f"the energy is {last.elastic:.2f} J, not {ENERGY} J"

    X, x, force = sim.scene.body("bar").rest_positions, sim.positions("bar"), sim.reactions("bar")
    torque = np.cross(x, force)[:, 0]
    right, left = torque[X[:, 0] > 1.99].sum(), torque[X[:, 0] < -1.99].sum()
    # 2.5e-4 measured
    assert abs(right / TORQUE - 1.0) < 1e-3, f"the right end turns with {right:.1f} N m, not {TORQUE} N m"
    assert abs(left / TORQUE + 1.0) < 1e-3, f"the left end holds {left:.1f} N m against {TORQUE} N m"
    assert np.abs(force.sum(axis=0)).max() < 5.0, f"the ends push the bar with {force.sum(axis=0)} N at rest"

    # in torsion the energy grows with the angle's square, 16-fold here; 15.8-fold measured
    full = next(report for report in result.step_reports if abs(report.time - HELD) < 1e-9)
    assert 15.0 < full.elastic / ENERGY < 16.5, f"the full turn stores {full.elastic:.0f} J, the quarter {ENERGY} J"
