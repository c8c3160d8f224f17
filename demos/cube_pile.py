"""27 soft cubes fall into a bin and pile up.

Cubes of 0.1 m on 2 x 2 x 2 cells of six tets (1,296 tets in all), stable neo-Hookean, E = 0.1 MPa, nu = 0.3, 1000 kg/m^3,
friction 0.4, in three layers 0.1 m apart, each cube turned a little at random; the bin is 0.4 m wide.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "contact_tolerance": 1e-3, "dt": 1 / 100, "seconds": 2.0, "fps": 50.0}

SIDE, WIDTH = 0.1, 0.4  # [m]
TURN = np.radians(15.0)
WEIGHT = 27 * SIDE**3 * 1000.0 * 9.81  # [N]
BIN = {"left": (1, 0, 0), "right": (-1, 0, 0), "back": (0, 0, 1), "front": (0, 0, -1), "floor": (0, 1, 0)}


def build() -> ts.Scene:
    """Three layers of nine cubes over the bin's floor."""
    scene = ts.Scene(gravity=(0.0, -9.81, 0.0))
    foam = ts.Material(young=1e5, poisson=0.3, density=1000.0, friction=0.4)
    rng, mesh = np.random.default_rng(1), ts.box_mesh((2, 2, 2), (SIDE,) * 3, pattern="six")
    for j, i, k in np.ndindex(3, 3, 3):
        axis, angle = rng.standard_normal(3), rng.uniform(-TURN, TURN)
        x, y, z = axis / np.linalg.norm(axis)
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across
        turned = ts.TetMesh(mesh.vertices @ turn.T, mesh.tets)
        place = (0.13 * (i - 1), SIDE * (1.5 + 2 * j), 0.13 * (k - 1))
        scene.add_body(turned, foam, name=f"cube {j}{i}{k}", position=place)
    for name, normal in BIN.items():
        point = (0, 0, 0) if name == "floor" else -0.5 * WIDTH * np.array(normal)
        scene.add_obstacle(ts.HalfSpace(point, normal), name=name, friction=0.4)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The pile rests in the bin, which bears its weight, and no cube is in another or in a wall."""
    last = result.step_reports[-1]
    assert last.kinetic < 0.02, f"kinetic energy is left: {last.kinetic:.3g} J"  # 3e-3 measured; 23 J at the first impact
    borne = -sum(sim.contact_force(name)[1] for name in BIN)
    assert abs(borne / WEIGHT - 1.0) < 0.005, f"the bin bears {borne:.2f} N, not {WEIGHT:.2f} N"
    deepest = max(report.max_penetration for report in result.step_reports)
    assert deepest < 0.05 * SIDE, f"a cube was {deepest:.2e} m in another or in the bin"  # 5e-4 m measured
    x = sim.positions()
    assert x[:, 1].min() > 0.0 and np.abs(x[:, [0, 2]]).max() < 0.5 * WIDTH, "a cube has left the bin"
    assert x[:, 1].max() < 0.45, f"the pile is {x[:, 1].max():.2f} m high"
