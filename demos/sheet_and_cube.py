"""A cube lands on a thin sheet that is held at two ends, and both come to rest in its sag.

A sheet of 4 x 0.05 x 4 m on 19 x 1 x 9 cells (855 tets, E = 1 MPa) and a cube of 1 m (135 tets, E = 0.1 MPa, 300 kg/m^3),
stable neo-Hookean, nu = 0.3, friction 0.5; demonstration 3 of the report.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 60, "seconds": 4.0, "fps": 30.0}

WEIGHTS = {"sheet": 800.0 * 9.81, "cube": 300.0 * 9.81}  # [N]
ENERGY = 1308.5  # [J] elastic, at rest


def build() -> ts.Scene:
    """The flat sheet, and the cube 0.1 m above it and a little aside."""
    scene = ts.Scene(gravity=(0.0, -9.81, 0.0))
    cloth = ts.Material(young=1e6, poisson=0.3, density=1000.0, friction=0.5, mass_damping=4.0)
    sheet = scene.add_body(ts.sheet_mesh((19, 9), (4.0, 0.05, 4.0)), cloth, name="sheet")
    sheet.fix(lambda X: np.abs(X[:, 0]) > 1.99)
    foam = ts.Material(young=1e5, poisson=0.3, density=300.0, friction=0.5, mass_damping=4.0)
    scene.add_body(ts.box_mesh((3, 3, 3), (1.0, 1.0, 1.0)), foam, name="cube", position=(0.03, 0.625, 0.05))
    return scene


def check(sim: ts.Simulator, result) -> None:
    """Both are at rest; the sheet bears the cube, the two ends bear both; and it sags as deep as it must."""
    last = result.step_reports[-1]
    assert last.kinetic < 1e-3, f"kinetic energy is left: {last.kinetic:.3g} J"  # 4e-5 measured
    force, held = sim.contact_force("cube")[1], sim.reactions("sheet")[:, 1].sum()
    assert abs(force / WEIGHTS["cube"] - 1.0) < 0.01, f"the sheet bears the cube with {force:.0f} N, not {WEIGHTS['cube']} N"
    assert abs(held / sum(WEIGHTS.values()) - 1.0) < 0.01, f"the ends bear {held:.0f} N, not {sum(WEIGHTS.values())} N"
    assert abs(last.elastic / ENERGY - 1.0) < 0.002, f"the energy is {last.elastic:.2f} J, not {ENERGY} J"
    assert abs(sim.positions("cube").mean(axis=0)[0]) < 0.05, "the cube has slid along the sheet"
    deepest = max(report.max_penetration for report in result.step_reports)
    assert deepest < 1e-3, f"the cube was {deepest:.2e} m in the sheet"
