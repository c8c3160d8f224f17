"""A bunny lands on a rigid plank that lies over a log, and throws a rigid cube from its other end.

The bunny is a skin that rides in large quadratic tets and is touched in their place. Plank and cube are rigid bodies.

`check` asserts that the cube flies, on the parabola of the time steps, that rigid bodies stay rigid, that no energy appears, and
that the skin follows its tets.
"""

from pathlib import Path

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 240, "seconds": 0.6, "fps": 60.0}

BUNNY = Path(__file__).parents[1] / "assets" / "bunny.msh"
CELLS = (4, 6, 4)  # of the box from which the tets around the bunny are taken
PLANK, LOG, CUBE = (2.4, 0.06, 0.5), 0.15, 0.16  # [m]: sides, radius, side
G = 9.81  # [m/s^2]
TOP = 2 * LOG + PLANK[1]  # of the plank, when it lies level [m]


def bunny() -> tuple[ts.TetMesh, ts.SurfaceMesh]:
    """Large tets around the bunny, and its surface, 0.6 m high and standing on y = 0."""
    fine = ts.read_mesh(BUNNY)
    low, high = fine.vertices.min(axis=0), fine.vertices.max(axis=0)
    scale = 0.6 / (high[1] - low[1])
    x = scale * (fine.vertices - [0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])])
    used, triangles = np.unique(fine.surface, return_inverse=True)
    skin = ts.SurfaceMesh(x[used], triangles.reshape(-1, 3))
    margin = 0.02
    size = x.max(axis=0) - x.min(axis=0) + 2 * margin
    block = ts.box_mesh(CELLS, size, center=0.5 * (x.max(axis=0) + x.min(axis=0)))
    corners = block.vertices[block.tets]
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    points = np.concatenate([x, x[fine.tets].mean(axis=1)])
    upper = np.einsum("tij,tpj->tpi", inverse, points[None] - corners[:, :1])
    holds = ((upper >= -1e-9).all(axis=2) & (upper.sum(axis=2) <= 1 + 1e-9)).any(axis=1)
    vertices, tets = np.unique(block.tets[holds], return_inverse=True)
    return ts.TetMesh(block.vertices[vertices], tets.reshape(-1, 4)), skin


def build() -> ts.Scene:
    """The plank on its log, tilted towards the cube, and the falling bunny."""
    scene = ts.Scene(gravity=(0.0, -G, 0.0))
    tets, skin = bunny()
    soft = ts.Material(young=6e4, poisson=0.3, density=400.0, stiffness_damping=2e-3)
    body = scene.add_body(tets, soft, name="bunny", position=(0.85, 0.6, 0.0), velocity=(0.0, -5.0, 0.0), order=2)
    body.embed(skin, contact=True)
    level = (0.0, TOP - PLANK[1] / 2 + 1e-3, 0.0)
    scene.add_rigid_body(ts.box_mesh((12, 1, 2), PLANK), density=200.0, name="plank", position=level)
    place = (-1.0, TOP + CUBE / 2 + 2e-3, 0.0)
    scene.add_rigid_body(ts.box_mesh((2, 2, 2), (CUBE,) * 3), density=400.0, name="cube", position=place)
    scene.add_obstacle(ts.Capsule((0.0, LOG, -0.4), (0.0, LOG, 0.4), LOG), name="log", friction=0.8)
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground")
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The cube flies as it must, rigid bodies are rigid, no energy has appeared, and the skin follows its tets."""
    start, speed, t = sim.pose("cube").translation[1], sim.twist("cube").velocity[1], 0.05
    apex = sim.scene.body("cube").position[1] + start + speed * abs(speed) / (2 * G)
    assert 1.0 < apex < 1.8, f"the cube would fly to {apex:.2f} m"
    sim.run(seconds=t)
    flown, exact = sim.pose("cube").translation[1] - start, speed * t - 0.5 * G * t * (t + sim.dt)  # of implicit Euler steps
    assert abs(flown - exact) < 1e-5, f"the cube rises by {flown:.6f} m within {t} s of flight, not by {exact:.6f} m"
    for name in ("plank", "cube"):
        strain = sim.rigid_strain(name)
        assert strain < 1e-4, f"the {name} is strained by {strain:.1e}"
    energy = [r.kinetic + r.elastic + r.gravity for r in result.step_reports]
    assert max(energy) <= energy[0] + 1e-3 * abs(energy[0]), "energy appeared"
    body = sim.scene.body("bunny")
    x = sim.positions("bunny")
    n = body.nodes.n_elastic
    assert np.abs(x[n:] - body.skin.weights @ x[:n]).max() < 1e-6, "the skin does not follow its tets"
    assert not sim.intersecting_triangles(), "surfaces cross"
