"""A slender beam clamped at both ends is pushed up in the middle and comes to rest bent and stretched.

4 x 0.1 x 0.1 m on 80 x 2 x 2 cells (1,600 tets), stable neo-Hookean, E = 1 MPa, nu = 0.3, 1000 kg/m^3, mass damping,
no gravity. A dead traction of 2000 Pa pushes the bottom face up where |x| < 0.05 m, 20 N in all.

`check` compares with the static solution on this same mesh (scikit-fem 12, linear tets, full Newton, direct solver):
the beam's centre rises by 0.197435763374 m; converged in the mesh it would be 0.20906 m. Small-deflection beam theory
says 0.8 m: it knows nothing of the stretching that carries most of the load here.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "bdf2", "dt": 1 / 60, "seconds": 6.0, "fps": 30.0}

HALF_LENGTH, HALF_HEIGHT, HALF_PATCH = 2.0, 0.05, 0.05  # [m]
TRACTION = 2000.0  # [Pa]
FORCE = 20.0  # [N]: the traction over 0.1 x 0.1 m
BENDING = 1e6 * 0.1**4 / 12  # [N m^2]: Young's modulus times the section's second moment of area
CENTRE_Y = 0.197435763374  # [m] in equilibrium


def build() -> ts.Scene:
    """The straight beam; the traction acts from the start on."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    mesh = ts.box_mesh(cells=(80, 2, 2), size=(4.0, 0.1, 0.1))  # cells of 0.05 m: nodes at x = -0.05 and 0.05 m
    rubber = ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.3, density=1000.0, mass_damping=4.0)
    beam = scene.add_body(mesh, rubber, name="beam")
    beam.fix(lambda X: np.abs(X[:, 0]) > HALF_LENGTH - 1e-6)
    beam.add_traction(lambda c: (c[:, 1] < -HALF_HEIGHT + 1e-6) & (np.abs(c[:, 0]) < HALF_PATCH), (0.0, TRACTION, 0.0))
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The end state: still, the centre where statics puts it, the clamps carrying half the load each and the pull."""
    assert result.step_reports[-1].kinetic < 1e-5, f"kinetic energy is left: {result.step_reports[-1].kinetic:.3g} J"

    X = sim.scene.body("beam").rest_positions
    centre = np.linalg.norm(X, axis=1).argmin()
    miss = sim.positions("beam")[centre, 1] - CENTRE_Y
    assert abs(miss) < 4e-5, f"the centre is {miss:.2e} m off the static {CENTRE_Y} m"  # 4e-7 m measured

    force = sim.reactions("beam")
    left, right = force[X[:, 0] < 0.0].sum(axis=0), force[X[:, 0] > 0.0].sum(axis=0)
    assert abs(left[1] + FORCE / 2) < 0.02, f"the left clamp holds {left[1]:.4f} N down, not half of {FORCE} N"
    assert abs(right[1] + FORCE / 2) < 0.02, f"the right clamp holds {right[1]:.4f} N down, not half of {FORCE} N"
    assert abs(left[0] + right[0]) < 0.02, f"the clamps pull with {left[0]:.4f} N and {right[0]:.4f} N"
    # centre of a clamped beam under tension H: F L / (4 H) (1 - tanh(q) / q), q = L/4 sqrt(H / EI)
    q = HALF_LENGTH / 2 * np.sqrt(right[0] / BENDING)
    theory = FORCE * HALF_LENGTH / (2 * right[0]) * (1.0 - np.tanh(q) / q)
    # the mesh, too stiff in bending, rises 11 % less
    assert 1.05 < theory / CENTRE_Y < 1.2, f"with a pull of {right[0]:.3f} N the centre should rise by {theory:.4f} m"
