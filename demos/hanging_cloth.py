"""A soft cloth hangs from two corners.

A sheet of 1 x 0.02 x 1 m on 10 x 1 x 10 cells (500 tets of second order: those of first order lock in bending), stable
neo-Hookean, E = 20 kPa, nu = 0.3, 300 kg/m^3, with mass damping; it is let go flat, swings down, and sags between the
corners that are held. Figure 1 of the report.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 60, "seconds": 4.0, "fps": 30.0}

WEIGHT = 1.0 * 0.02 * 1.0 * 300.0 * 9.81  # [N]
CORNER = 0.08  # [m]: nodes nearer than this to a corner of one edge are held
ENERGY, LOWEST = 4.68233, -1.11228  # [J], [m]: of `solve_static`


def build() -> ts.Scene:
    """The flat cloth."""
    scene = ts.Scene(gravity=(0.0, -9.81, 0.0))
    cotton = ts.Material(young=2e4, poisson=0.3, density=300.0, mass_damping=2.0)
    flat = ts.sheet_mesh((10, 10), (1.0, 0.02, 1.0))
    cloth = scene.add_body(flat, cotton, name="cloth", order=2)
    cloth.fix(lambda X: (X[:, 2] < -0.5 + CORNER) & (np.abs(X[:, 0]) > 0.5 - CORNER))
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The cloth hangs almost still, as statics have it, and its corners bear its weight."""
    last, x = result.step_reports[-1], sim.positions("cloth")
    assert last.kinetic < 1e-3, f"kinetic energy is left: {last.kinetic:.3g} J"  # 6e-5 measured
    assert abs(last.elastic / ENERGY - 1.0) < 0.006, f"the energy is {last.elastic:.4f} J, not {ENERGY} J"  # 2.9e-3
    # 3e-4 m measured; 1.7e-3 m for each hundredth of stiffness
    assert abs(x[:, 1].min() - LOWEST) < 1e-3, f"the lower edge hangs at {x[:, 1].min():.4f} m, not at {LOWEST} m"
    force = sim.reactions("cloth").sum(axis=0)
    assert abs(force[1] / WEIGHT - 1.0) < 2e-3, f"the corners bear {force[1]:.2f} N, not {WEIGHT:.2f} N"
