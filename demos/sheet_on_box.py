"""A soft sheet falls onto a box and drapes over it.

A sheet of 2 x 0.05 x 2 m on 16 x 1 x 16 cells (1,280 tets), stable neo-Hookean, E = 0.1 MPa, nu = 0.3, 1000 kg/m^3, and a
rigid box of 1 m; friction 0.5. Figure 1 of the report.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 60, "seconds": 3.0, "fps": 30.0}

TURN = np.radians(20.0)
WEIGHT = 2.0 * 0.05 * 2.0 * 1000.0 * 9.81  # [N]
ENERGY, CORNER = 112.29, 0.2968  # [J] elastic, [m] height of the lowest corner, at rest


def build() -> ts.Scene:
    """The flat sheet 0.1 m above the box."""
    scene = ts.Scene(gravity=(0.0, -9.81, 0.0))
    cloth = ts.Material(young=1e5, poisson=0.3, density=1000.0, friction=0.5, mass_damping=3.0)
    flat, (c, s) = ts.sheet_mesh((16, 16), (2.0, 0.05, 2.0)), (np.cos(TURN), np.sin(TURN))
    turned = ts.TetMesh(flat.vertices @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]), flat.tets)
    scene.add_body(turned, cloth, name="sheet", position=(0.0, 1.125, 0.0))
    scene.add_obstacle(ts.Box((0.0, 0.5, 0.0), (0.5, 0.5, 0.5)), name="box", friction=0.5)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The sheet hangs still, the box bears its weight, and nothing has slid: it is its own image under a half turn."""
    last = result.step_reports[-1]
    assert last.kinetic < 0.1, f"kinetic energy is left: {last.kinetic:.3g} J"  # it swings a little: 0.02 J at most, measured
    force = sim.contact_force("sheet")
    assert np.abs(force - (0.0, WEIGHT, 0.0)).max() < 0.01 * WEIGHT, f"the box bears the sheet with {force} N"  # 2.1e-3
    assert abs(last.elastic / ENERGY - 1.0) < 0.003, f"the energy is {last.elastic:.2f} J, not {ENERGY} J"  # 2e-4 measured
    x = sim.positions("sheet")
    # 2e-5 m measured; 1.7e-3 m for each hundredth of stiffness
    assert abs(x[:, 1].min() - CORNER) < 8e-4, f"the corners hang at {x[:, 1].min():.4f} m, not at {CORNER} m"
    assert np.abs(x.mean(axis=0)[[0, 2]]).max() < 1e-3, f"the sheet has slid to {x.mean(axis=0)} m"
    deepest = max(report.max_penetration for report in result.step_reports)
    assert deepest < 1e-3, f"the sheet was {deepest:.2e} m in the box"
