"""A soft cube drops onto a soft box and comes to rest on it.

A cube of 1 m on 3 x 3 x 3 cells (135 tets) and a box of 2 x 0.5 x 2 m on 4 x 1 x 4 cells (80 tets) whose bottom is held,
stable neo-Hookean, E = 0.1 MPa, nu = 0.3, 1000 kg/m^3, friction 0.5. Figure 20 of the report.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 60, "seconds": 3.0, "fps": 30.0}

WEIGHT = 9810.0  # [N]
ENERGY = 361.7  # [J] elastic, at rest


def build() -> ts.Scene:
    """The cube 0.1 m above the box, and a little aside."""
    scene = ts.Scene(gravity=(0.0, -9.81, 0.0))
    foam = ts.Material(young=1e5, poisson=0.3, density=1000.0, friction=0.5, mass_damping=2.0)
    box = scene.add_body(ts.box_mesh((4, 1, 4), (2.0, 0.5, 2.0)), foam, name="box", position=(0.0, 0.25, 0.0))
    box.fix(lambda X: X[:, 1] < -0.24)
    scene.add_body(ts.box_mesh((3, 3, 3), (1.0, 1.0, 1.0)), foam, name="cube", position=(0.03, 1.1, 0.02))
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The cube is at rest, the box bears its weight, and both are pressed as far as statics says."""
    last = result.step_reports[-1]
    assert last.kinetic < 0.01, f"kinetic energy is left: {last.kinetic:.3g} J"  # 4e-4 measured
    force = sim.contact_force("cube")
    assert np.abs(force - (0.0, WEIGHT, 0.0)).max() < 0.005 * WEIGHT, f"the box bears the cube with {force} N"  # 1.6e-3
    assert abs(last.elastic / ENERGY - 1.0) < 0.004, f"the energy is {last.elastic:.2f} J, not {ENERGY} J"  # 1e-3 measured
    deepest = max(report.max_penetration for report in result.step_reports)
    assert deepest < 2e-3, f"the cube was {deepest:.2e} m in the box"
