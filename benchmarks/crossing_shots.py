"""Shots: bodies that one implicit step may carry far beyond what they meet; a number reproduces each of them exactly.

Something flies along x, from at most 5 cm away, at a wall, rod, sheet or ring about x = 0; or a ball is driven at a sheet, or
the legs of a strip into each other. Speed, place, direction, tilt and settings are random.

A state after a step that went through may be free of crossings. So each kind has a test of sides. Walls are held at their rims:
a point behind one has passed it. Lines held at their ends, or closed, are judged by their crossings seen along x.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import taisoft as ts

N_SHOTS, STEPS = 20, 4  # of each kind, and of a run
MATERIAL = ts.Material(young=1e6, poisson=0.3, density=1000.0, friction=0.2)
INTEGRATORS = ("implicit_euler", "bdf2", "linearly_implicit_euler")
SOFT, BOX, MESH, THIN = WALLS = ("soft", "box", "mesh", "thin mesh")
RIM = 1e-6  # [m] width of a wall's rim
Passed = Callable[[ts.Simulator], bool]


@dataclass(frozen=True)
class Shot:
    """A scene, arguments of its Simulator, and whether anything has got through. velocities: (n,3) at the start [m/s], if not
    those of whole bodies."""

    scene: ts.Scene
    settings: dict[str, Any]
    passed: Passed
    velocities: np.ndarray | None = None


def names(count: int = N_SHOTS) -> list[str]:
    """The names of the first `count` shots of each kind."""
    return [f"{kind} {number:02d}" for kind in KINDS for number in range(count)]


def make_shot(name: str) -> Shot:
    """The shot of this name, a kind and a number."""
    kind, _, number = name.rpartition(" ")
    rng, scene = np.random.default_rng([int(number), *kind.encode()]), ts.Scene(gravity=(0, 0, 0))
    settings = {"dt": 1.0 / int(rng.integers(120, 241)), "integrator": str(rng.choice(INTEGRATORS, p=(0.7, 0.2, 0.1)))}
    settings |= {"precision": "f64" if rng.random() < 0.25 else "f32", "self_collision": kind == STRIP}
    found = KINDS[kind](scene, rng, settings["dt"], int(number))
    return Shot(scene, settings, *(found if isinstance(found, tuple) else (found,)))


def speed(rng: np.random.Generator) -> float:
    """30 to 100 m/s."""
    return float(rng.uniform(30.0, 100.0))


def tilted(rng: np.random.Generator, most: float) -> np.ndarray:
    """A rotation (3,3) by up to `most` [rad] about each axis."""
    return Rotation.from_rotvec(rng.uniform(-most, most, 3)).as_matrix()


def shoot(
    scene: ts.Scene, rng: np.random.Generator, mesh: ts.TetMesh, v: float, front: float, aside: float = 0.05, tilt: float = 0.2
) -> None:
    """Add a body "shot" that flies at v [m/s], its foremost point up to 5 cm before x = front, up to `aside` [m] off the axis."""
    x = (mesh.vertices - mesh.vertices.mean(axis=0)) @ tilted(rng, tilt).T
    x += (front - rng.uniform(0.002, 0.05) - x[:, 0].max(), *rng.uniform(-aside, aside, 2))
    scene.add_body(ts.TetMesh(x, mesh.tets), MATERIAL, name="shot", velocity=(v, *rng.uniform(-0.1 * v, 0.1 * v, 2)))


def grid(sim: ts.Simulator, name: str, *cells: int) -> np.ndarray:
    """The positions (nx+1,ny+1,nz+1,3) [m] of a body whose mesh is a box of these cells."""
    return sim.positions(name).reshape(*(n + 1 for n in cells), 3)


def add_wall(scene: ts.Scene, what: str, half: float, thickness: float) -> Callable[[ts.Simulator], np.ndarray]:
    """Add a square wall across x, soft ones held at their rims. Returns the corners (n,3,3) [m] of its front in a simulator."""
    mesh = ts.box_mesh((1, 10, 10), (thickness, 2.0 * half, 2.0 * half))
    front = mesh.surface[(mesh.vertices[mesh.surface, 0] < 0.0).all(axis=1)]
    if what == SOFT:
        scene.add_body(mesh, MATERIAL, name="wall").fix(lambda X: np.abs(X[:, 1:]).max(axis=1) > half - RIM)
        return lambda sim: sim.positions("wall")[front]
    shape = ts.Box((0, 0, 0), (0.5 * thickness, half, half)) if what == BOX else ts.MeshObstacle(mesh.vertices, mesh.surface)
    scene.add_obstacle(shape, name="wall")
    return lambda _: mesh.vertices[front]


def behind(points: np.ndarray, front: np.ndarray, half: float) -> bool:
    """Whether any of some points (k,3) [m] is behind a wall's front (n,3,3), and none beside the wall: rays from points before it
    along x meet it once more against its normals than along them."""
    a, b, c = (corner[:, 1:] for corner in np.moveaxis(front, 1, 0))
    to_a, to_b, to_c = (corner - points[:, None, 1:] for corner in (a, b, c))
    parts, area = np.stack([across(to_b, to_c), across(to_c, to_a), across(to_a, to_b)], axis=2), across(b - a, c - a)
    flat = area == 0.0
    x = (parts * front[:, :, 0]).sum(axis=2) / np.where(flat, 1.0, area)
    met = (parts * np.sign(area)[:, None] > 0.0).all(axis=2) & (x > points[:, :1])
    before = -(met * np.sign(area)).sum(axis=1)
    return bool((np.abs(points[:, 1:]) < half).all() and (before <= 0.0).any())


def across(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Cross products of vectors (...,2)."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def overlaps(p: np.ndarray, q: np.ndarray) -> tuple[int, int]:
    """Signed numbers of crossings, seen along x, of the lines through the points p (n,3) and q (m,3) at which q is before p, and
    behind it. The first is the linking number of closed lines, that of Gauss's integral."""
    u, v, d = np.diff(p, axis=0)[:, None], np.diff(q, axis=0)[None], q[None, :-1] - p[:-1, None]
    det = across(u[..., 1:], v[..., 1:])
    safe = np.where(det == 0.0, np.inf, det)
    s, t = across(d[..., 1:], v[..., 1:]) / safe, across(d[..., 1:], u[..., 1:]) / safe
    beyond = d[..., 0] + t * v[..., 0] - s * u[..., 0]
    sign = np.sign(det) * ((s >= 0.0) & (s < 1.0) & (t >= 0.0) & (t < 1.0))
    return int(sign[beyond < 0.0].sum()), int(sign[beyond > 0.0].sum())


def got_behind(p: np.ndarray, q: np.ndarray) -> bool:
    """Whether the line q, once before p and across it, is only behind it; not where its ends have swung around p."""
    before, after = overlaps(p, q)
    return before == 0 and after != 0


def at_wall(what: str, mesh: ts.TetMesh, scene, rng, thickness: float = 0.02, tilt: float = 0.2) -> Passed:
    """A mesh flies at a wall."""
    front = add_wall(scene, what, 0.5, thickness)
    shoot(scene, rng, mesh, speed(rng), -0.5 * thickness, tilt=tilt)
    return lambda sim: behind(sim.positions("shot"), front(sim), 0.5)


def sheet_and_plate(scene, rng, dt, number) -> Passed:
    """A sheet flies at a soft plate, or a static one."""
    return at_wall(SOFT if number % 3 else BOX, ts.box_mesh((1, 6, 6), (0.01, 0.4, 0.4)), scene, rng)


def cube_and_wall(scene, rng, dt, number) -> Passed:
    """A cube flies at each kind of wall in turn."""
    what = WALLS[number % len(WALLS)]
    return at_wall(what, ts.box_mesh((2, 2, 2), (0.05,) * 3), scene, rng, 0.002 if what == THIN else 0.02)


def needle_and_plate(scene, rng, dt, number) -> Passed:
    """A needle flies along its axis at a soft plate."""
    return at_wall(SOFT, ts.box_mesh((20, 1, 1), (0.3, 0.004, 0.004)), scene, rng, tilt=0.05)


def rods(scene, rng, dt, number) -> Passed:
    """A rod flies at one across it that is held at its ends."""
    wall = scene.add_body(ts.box_mesh((1, 8, 1), (0.02, 0.6, 0.02)), MATERIAL, name="wall")
    wall.fix(lambda X: np.abs(X[:, 1]) > 0.3 - RIM)
    shoot(scene, rng, ts.box_mesh((1, 1, 8), (0.02, 0.02, 0.6)), speed(rng), -0.01)
    return lambda sim: got_behind(grid(sim, "wall", 1, 8, 1).mean(axis=(0, 2)), grid(sim, "shot", 1, 1, 8).mean(axis=(0, 1)))


def edges(scene, rng, dt, number) -> Passed:
    """The edge of a tet flies at one across it."""
    x = np.array([(0.0, -0.1, 0.0), (0.0, 0.1, 0.0), (0.1, 0.0, -0.1), (0.1, 0.0, 0.1)])
    tets = np.array([(0, 1, 3, 2)])
    scene.add_body(ts.TetMesh(x, tets), MATERIAL, name="wall").fix(lambda X: X[:, 0] > 0.1 - RIM)
    shoot(scene, rng, ts.TetMesh(x[:, [0, 2, 1]] * (-1.0, 1.0, 1.0), tets), speed(rng), 0.0, aside=0.03)
    return lambda sim: got_behind(sim.positions("wall")[:2], sim.positions("shot")[:2])


def edge_on(scene, rng, dt, number) -> Passed:
    """A sheet flies edge on at another one's edge: across it, or in its plane, where it may also slide over it."""
    wall = scene.add_body(ts.box_mesh((6, 1, 6), (0.4, 0.01, 0.4)), MATERIAL, name="wall", position=(0.2, 0.0, 0.0))
    wall.fix(lambda X: X[:, 0] > 0.2 - RIM)
    if number % 2:
        shoot(scene, rng, ts.box_mesh((6, 1, 6), (0.4, 0.01, 0.4)), speed(rng), 0.0, aside=0.004, tilt=0.02)
        return lambda sim: sim.positions("shot")[:, 0].min() > 0.4 and abs(sim.positions("shot")[:, 1].mean()) < 0.005
    shoot(scene, rng, ts.box_mesh((6, 6, 1), (0.4, 0.4, 0.01)), speed(rng), 0.0, tilt=0.1)
    return lambda sim: got_behind(grid(sim, "wall", 6, 1, 6)[0].mean(axis=0), grid(sim, "shot", 6, 6, 1)[-1].mean(axis=1))


def corner_and_ridge(scene, rng, dt, number) -> Passed:
    """A corner of a cube flies at a ridge, up to 2 cm below its top; it may get over it, so there are no sides."""
    b, h = 0.3 * np.tan(rng.uniform(0.3, 0.8)), 0.3
    x = np.array([(-b, -h, -h), (b, -h, -h), (0, 0, -h), (-b, -h, h), (b, -h, h), (0, 0, h)])
    t = np.array([(0, 2, 1), (3, 4, 5), (0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)])
    scene.add_obstacle(ts.MeshObstacle(x, t), name="ridge")
    on_corner = np.array([(1, -1, 0), (1, 1, 1), (-1, -1, 2)]) / np.sqrt([[2.0], [3.0], [6.0]])
    turn = tilted(rng, 0.2) @ Rotation.from_rotvec((0.0, rng.uniform(0.0, 2.0 * np.pi), 0.0)).as_matrix() @ on_corner
    mesh, v = ts.box_mesh((1, 1, 1), (0.1,) * 3), speed(rng)
    x = mesh.vertices @ turn.T
    start = (-v * dt * rng.uniform(0.3, 0.7), -(10.0 ** rng.uniform(-6.0, np.log10(0.02))), rng.uniform(-0.05, 0.05))
    scene.add_body(ts.TetMesh(x - x[x[:, 1].argmin()] + start, mesh.tets), MATERIAL, name="shot", velocity=(v, 0.0, 0.0))
    return lambda _: False


def rings(scene, rng, dt, number) -> Passed:
    """A ring flies at another one across it, so far that the step would link them."""
    n, x = 16, ts.box_mesh((16, 1, 1), (2.0 * np.pi, 0.01, 0.01)).vertices[:-4]
    tets = ts.box_mesh((n, 1, 1), (1.0, 0.01, 0.01)).tets % len(x)  # the ends are one
    r = 0.2 - x[:, 1]
    x = np.stack([r * np.cos(x[:, 0]), r * np.sin(x[:, 0]), x[:, 2]], axis=1)
    scene.add_body(ts.TetMesh(x, tets), MATERIAL, name="wall").fix(lambda X: X[:, 0] > 0.19)
    turned = ts.TetMesh(x @ np.array([(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)]), tets)
    shoot(scene, rng, turned, rng.uniform(0.1, 0.35) / dt, -0.205)

    def line(sim: ts.Simulator, name: str) -> np.ndarray:
        return np.pad(sim.positions(name).reshape(n, 4, 3).mean(axis=1), ((0, 1), (0, 0)), mode="wrap")

    return lambda sim: overlaps(line(sim, "wall"), line(sim, "shot"))[0] != 0


def ball_and_sheet(scene, rng, dt, number) -> Passed:
    """A sphere or capsule is driven 0.05 to 0.3 m far at a sheet that is held at its rim."""
    front, r, v = add_wall(scene, SOFT, 0.3, 0.01), rng.uniform(0.005, 0.03), rng.uniform(10.0, 60.0)
    middle = np.array([-0.005 - r - rng.uniform(0.002, 0.02), *rng.uniform(-0.05, 0.05, 2)])
    ends = middle + tilted(rng, 0.2)[2] * rng.uniform(0.05, 0.15) * np.array([[-1.0], [1.0]])
    ends -= (max(0.0, ends[:, 0].max() - middle[0]), 0.0, 0.0)
    shape = ts.Capsule(*ends, r) if number % 2 else ts.Sphere(middle, r)
    seconds, way = rng.uniform(0.05, 0.3) / v, np.array([v, *rng.uniform(-0.1 * v, 0.1 * v, 2)])
    ball = scene.add_obstacle(shape, name="ball", path=lambda t: (way * min(t, seconds), np.eye(3)))
    points = ends if number % 2 else middle[None]
    return lambda sim: behind(ball.points_at(sim.time, points), front(sim), 0.3)


def strip(scene, rng, dt, number) -> tuple[Passed, np.ndarray]:
    """The legs of a U are driven into each other."""
    r, leg = 0.035, 0.3
    mesh = ts.box_mesh((40, 1, 1), (2.0 * leg + np.pi * r, 0.01, 0.05))
    s, n, z = mesh.vertices.T
    angle = np.clip(s / r, -0.5 * np.pi, 0.5 * np.pi)
    out = np.abs(s - r * angle)
    x = np.stack([(r - n) * np.cos(angle) - out, (r - n) * np.sin(angle), z], axis=1)
    scene.add_body(ts.TetMesh(x, mesh.tets), MATERIAL, name="strip")
    end = out > 0.3 * leg
    upper, lower = end & (s > 0.0), end & (s < 0.0)
    v = np.where(upper, -rng.uniform(10.0, 50.0), lower * rng.uniform(0.0, 50.0))[:, None] * (rng.uniform(-0.1, 0.1), 1.0, 0.0)
    return lambda sim: sim.positions("strip")[upper, 1].mean() < sim.positions("strip")[lower, 1].mean(), v


STRIP = "strip onto itself"
KINDS: dict[str, Callable] = {
    "sheet through plate": sheet_and_plate,
    "cube through wall": cube_and_wall,
    "crossed rods": rods,
    "edge on edge": edges,
    "sheets edge on": edge_on,
    "corner over ridge": corner_and_ridge,
    "needle through plate": needle_and_plate,
    "linked rings": rings,
    "ball through sheet": ball_and_sheet,
    STRIP: strip,
}
