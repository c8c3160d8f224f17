"""Random heaps of soft bodies, and a strip that is folded; a number reproduces each of them exactly.

A heap: 5 to 20 bodies of six kinds, 0.1 to 0.4 m long, of 20 to 150 tets, with a random material each, fly at each other and at
the ground at up to 5 m/s. The ground is a half-space or a box of five blocks, in half of the heaps with a ball, a bar or a wedge
on it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

import taisoft as ts

from .hard_cases.contact import regular_tet
from .hard_cases.shapes import COR, DOWN, SNH, SVK, G, one_body, split, voxels

STEPS = (1 / 480, 1 / 240, 1 / 120, 1 / 60, 1 / 30)  # [s] of implicit integrators
IMPLICIT = ("implicit_euler", "bdf2", "linearly_implicit_euler")
EXPLICIT = ("symplectic_euler", "velocity_verlet")
OF_STABLE_DT = 0.5  # dt of explicit heaps over the largest stable one
MIN_STEPS, MAX_STEPS, EXPLICIT_STEPS = 60, 240, 400
LARGEST_SPEED = 5.0  # [m/s]
WIDTH = 0.6  # [m] from the middle to each wall of the box
GAP = 0.01  # [m] least distance between the spheres around bodies at the start


@dataclass(frozen=True)
class Heap:
    """A scene, arguments of its Simulator, steps of a run, and the kinds of its bodies in order."""

    scene: ts.Scene
    settings: dict[str, Any]
    steps: int
    kinds: list[str]


def make_heap(number: int) -> Heap:
    """Heap of this number: even ones in single precision, every fifth, from number 4 on, with an explicit integrator."""
    rng = np.random.default_rng([number, 20])
    scene, kinds = ts.Scene(gravity=DOWN), []
    lowest = add_ground(scene, rng)
    placed: list[tuple[np.ndarray, float]] = []
    for k in range(int(rng.integers(5, 21))):
        kind = str(rng.choice(list(KINDS)))
        mesh = turned_at_random(KINDS[kind](rng), rng)
        place = free_place(placed, np.linalg.norm(mesh.vertices, axis=1).max(), lowest, rng)
        aim = np.array([0.0, 0.5 * place[1], 0.0]) - place + rng.normal(scale=0.3, size=3)
        velocity = rng.uniform(0.0, LARGEST_SPEED) * aim / np.linalg.norm(aim)
        scene.add_body(mesh, random_material(rng), name=f"{kind} {k}", position=place, velocity=velocity)
        kinds.append(kind)
    settings = {"precision": "f64" if number % 2 else "f32"}
    if number % 5 == 4:
        settings["integrator"] = str(rng.choice(EXPLICIT))
        settings["dt"] = OF_STABLE_DT * stable_dt(scene, settings["integrator"])
        return Heap(scene, settings, EXPLICIT_STEPS, kinds)
    settings["integrator"] = str(rng.choice(IMPLICIT, p=(0.5, 0.35, 0.15)))
    settings["dt"] = float(rng.choice(STEPS))
    return Heap(scene, settings, int(np.clip(round(1.0 / settings["dt"]), MIN_STEPS, MAX_STEPS)), kinds)


def stable_dt(scene: ts.Scene, integrator: str) -> float:
    """The largest stable dt [s] of an explicit integrator about the rest shapes."""
    with ts.Simulator(scene.snapshot(), dt=1e-9, integrator=integrator) as sim:
        return sim.stable_dt


def add_ground(scene: ts.Scene, rng: np.random.Generator) -> float:
    """Add a half-space or a box without a lid, and in half of the cases something that lies on it. Returns a free height [m]."""

    def friction() -> float:
        return float(rng.uniform(0.0, 1.0))

    if rng.random() < 0.5:
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=friction())
    else:
        scene.add_obstacle(ts.Box((0, -0.1, 0), (WIDTH + 0.2, 0.1, WIDTH + 0.2)), name="floor", friction=friction())
        for axis, side in ((0, 1), (0, -1), (2, 1), (2, -1)):
            center, half = np.array([0.0, 2.0, 0.0]), np.full(3, WIDTH + 0.2)
            center[axis], half[axis], half[1] = side * (WIDTH + 0.1), 0.1, 2.1
            scene.add_obstacle(ts.Box(center, half), name=f"wall {'xyz'[axis]}{side:+d}", friction=friction())
    x, z = rng.uniform(-0.2, 0.2, 2)
    shape = rng.choice(["", "", "", "ball", "bar", "wedge"])
    if shape == "ball":
        scene.add_obstacle(ts.Sphere((x, 0.1, z), 0.12), name="ball", friction=friction())
    elif shape == "bar":
        end = np.array([0.25 * np.cos(4.0 * x), 0.05, 0.25 * np.sin(4.0 * x)])
        scene.add_obstacle(ts.Capsule((x, 0.1, z) - end, (x, 0.1, z) + end, 0.06), name="bar", friction=friction())
    elif shape == "wedge":
        wedge = turned_at_random(regular_tet(0.3), rng)
        place = np.array([x, 0.05, z]) - wedge.vertices.mean(axis=0)
        scene.add_obstacle(ts.MeshObstacle(wedge.vertices + place, wedge.surface), name="wedge", friction=friction())
    return 0.35 if shape else GAP


def free_place(placed: list[tuple[np.ndarray, float]], radius: float, lowest: float, rng: np.random.Generator) -> np.ndarray:
    """The lowest of a few random centers (3,) [m] at which a sphere around a body is free, above `lowest`; adds it to those
    placed."""
    room = max(0.0, WIDTH - GAP - radius)
    best = None
    for x, z in rng.uniform(-room, room, (8, 2)):
        y, blocked = lowest + radius, True
        while blocked:
            blocked = [p for p, r in placed if np.linalg.norm(p - (x, y, z)) < r + radius + GAP]
            y += 0.02 if blocked else 0.0
        if best is None or y < best[1]:
            best = np.array([x, y, z])
    placed.append((best, radius))
    return best


def random_material(rng: np.random.Generator) -> ts.Material:
    """A law, 10 kPa to 1 MPa, 500 to 2000 kg/m^3, friction 0 to 1."""
    return ts.Material(
        law=str(rng.choice([COR, SNH, SVK])),
        young=float(10.0 ** rng.uniform(4.0, 6.0)),
        poisson=float(rng.uniform(0.1, 0.45)),
        density=float(rng.uniform(500.0, 2000.0)),
        friction=float(rng.uniform(0.0, 1.0)),
    )


def turned_at_random(mesh: ts.TetMesh, rng: np.random.Generator) -> ts.TetMesh:
    """The mesh about its mean vertex, turned by a random rotation, all equally likely."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    turn = q * np.sign(np.diag(r))
    turn[:, 0] *= np.linalg.det(turn)
    return ts.TetMesh((mesh.vertices - mesh.vertices.mean(axis=0)) @ turn.T, mesh.tets)


def random_block(rng: np.random.Generator) -> ts.TetMesh:
    """A box of random proportions: 40 to 135 tets."""
    cells = rng.choice([(2, 2, 2), (3, 2, 2), (3, 3, 2), (3, 3, 3)])
    return ts.box_mesh(cells.tolist(), rng.uniform(0.08, 0.3, 3))


def random_plate(rng: np.random.Generator) -> ts.TetMesh:
    """A thin plate: 80 tets."""
    return ts.box_mesh((4, 1, 4), (rng.uniform(0.2, 0.3), rng.uniform(0.008, 0.02), rng.uniform(0.2, 0.3)))


def random_ball(rng: np.random.Generator) -> ts.TetMesh:
    """A coarse ball: 48 tets."""
    return ts.ball_mesh(rng.uniform(0.06, 0.13), 2)


def random_tet(rng: np.random.Generator) -> ts.TetMesh:
    """A regular tetrahedron with sharp corners: 64 tets."""
    return split(regular_tet(rng.uniform(0.12, 0.3)))


def random_angle(rng: np.random.Generator) -> ts.TetMesh:
    """An L of five or ten cells: 30 or 60 tets."""
    filled = np.zeros((3, 3, int(rng.integers(1, 3))), dtype=bool)
    filled[0], filled[:, 0] = True, True
    return voxels(filled, rng.uniform(0.04, 0.09))


def random_jack(_: np.random.Generator) -> ts.TetMesh:
    """Three crossed bars: 42 tets."""
    filled = np.zeros((3, 3, 3), dtype=bool)
    filled[:, 1, 1] = filled[1, :, 1] = filled[1, 1, :] = True
    return voxels(filled, 0.07)


KINDS = {
    "block": random_block,
    "plate": random_plate,
    "ball": random_ball,
    "tetrahedron": random_tet,
    "angle": random_angle,
    "jack": random_jack,
}


def folded_strip() -> ts.Scene:
    """A strip of 1 x 0.1 x 0.01 m on the ground; one end is turned onto the other by 178 degrees about the middle within 2 s, and
    its own weight lays the layers on each other."""
    mesh = ts.box_mesh((40, 4, 1), (1.0, 0.1, 0.01))
    scene, body = one_body("strip", mesh, (0.0, 0.0, -G), young=1e5, poisson=0.3)
    scene.add_obstacle(ts.HalfSpace((0, 0, -0.006), (0, 0, 1)), name="ground")
    body.fix(lambda X: X[:, 0] < -0.499)
    end = mesh.vertices[mesh.vertices[:, 0] > 0.499]

    def turned(t: float) -> np.ndarray:
        angle = np.radians(178.0) * min(0.5 * t, 1.0)
        c, s = np.cos(angle), np.sin(angle)
        return end @ np.array([(c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)]) - end

    body.move(lambda X: X[:, 0] > 0.499, turned)
    return scene
