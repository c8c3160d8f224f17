"""The scenes of `taisoft bench error`: smooth motion, impacts and friction, in both element orders and all kinds of steps."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

import taisoft as ts

from .reference_cases.record import face

SMOOTH, CONTACT = "smooth", "contact"  # kinds of motion, in time
COMMON = {"poisson": 0.3, "density": 1000.0}
G = 9.81  # m/s^2


def path_of(scene: ts.Scene, dt: float, integrator: str, seconds: float, fps: float, **settings) -> tuple[np.ndarray, list]:
    """Positions (k,n,3) [m] at the frames of a run, and name and number of nodes of each body."""
    path = []
    with ts.Simulator(scene, dt=dt, integrator=integrator, **settings) as sim:
        sim.run(seconds, on_frame=lambda sim, *_: path.append(sim.positions()), fps=fps)
        return np.array(path), [[b.name, b.n_nodes] for b in sim.scene.bodies]


def estimate_columns(kind: str, unit: str, text: Callable[[float], str]) -> list[tuple]:
    """Columns of a table: estimate, truth and ratio of a kind of error, of rows with `estimated`, `true` and `ratio`."""

    def known(value: float | None) -> str:
        return text(value) if value is not None and math.isfinite(value) else "unknown"

    return [
        (f"{kind} [{unit}]", lambda row: known(row.estimated[kind])),
        ("true", lambda row: known(row.true[kind])),
        ("ratio", lambda row: f"{row.ratio(kind):.2f}" if math.isfinite(row.ratio(kind)) else "-"),
    ]


@dataclass(frozen=True)
class Case:
    """A scene with the settings of its run.

    kind: of its motion; dt: None for nine tenths of the stable step; seconds: simulated [s].
    """

    name: str
    kind: str
    build: Callable[[], ts.Scene] = field(repr=False)
    integrator: str
    dt: float | None
    seconds: float


def _scene(gravity: float = G) -> ts.Scene:
    return ts.Scene(gravity=(0.0, -gravity, 0.0))


def _rubber(young: float, **more) -> ts.Material:
    return ts.Material(young=young, **COMMON | more)


def beam(cells: tuple[int, int, int], order: int = 1, damping: float = 0.0) -> ts.Scene:
    """A beam of 4 x 1 x 1 m, clamped at its left end: damped, it comes to rest, else it falls and swings back."""
    scene = _scene(9.8)
    rubber = _rubber(1e6, mass_damping=damping)
    scene.add_body(ts.box_mesh(cells, (4.0, 1.0, 1.0)), rubber, name="beam", order=order).fix(face(0, -2.0))
    return scene


def spin() -> ts.Scene:
    """A free plate that spins, and stretches by it."""
    mesh = ts.box_mesh((6, 4, 2), (1.0, 0.6, 0.3))
    scene, velocity = _scene(0.0), np.cross((0.0, 0.0, 6.0), mesh.vertices)
    scene.add_body(mesh, _rubber(1e5), name="plate", velocity=velocity)
    return scene


def twisting_bar() -> ts.Scene:
    """A bar twisted by half a turn, held, and turned back in part."""
    scene = _scene(0.0)
    bar = scene.add_body(ts.box_mesh((8, 2, 2), (4.0, 1.0, 1.0)), _rubber(1e6, mass_damping=10.0), name="bar")
    bar.fix(face(0, -2.0))
    turns = [(angle, 0.0, 0.0) for angle in (0.0, np.pi, np.pi, np.pi / 2)]
    bar.move(face(0, 2.0), ts.KeyFrames((0.0, 0.8, 1.2, 2.0), rotations=turns, pivot=(2.0, 0.0, 0.0), smooth=True))
    return scene


def bar_impact() -> ts.Scene:
    """An elastic bar that meets a wall end-on and rebounds."""
    scene = _scene(0.0)
    scene.add_obstacle(ts.HalfSpace((-0.51, 0.0, 0.0), (1.0, 0.0, 0.0)), name="wall", friction=0.0, restitution=0.0)
    mesh = ts.box_mesh((20, 2, 2), (1.0, 0.1, 0.1))
    scene.add_body(mesh, _rubber(1e6, poisson=0.0, friction=0.0, restitution=0.0), name="bar", velocity=(-1.0, 0.0, 0.0))
    return scene


def midpoint_traction() -> ts.Scene:
    """A beam clamped at both ends, lifted at its middle."""
    scene = _scene(0.0)
    mesh = ts.box_mesh((40, 2, 2), (4.0, 0.1, 0.1))
    beam = scene.add_body(mesh, _rubber(1e6, mass_damping=4.0), name="beam")
    beam.fix(lambda X: np.abs(X[:, 0]) > 2.0 - 1e-6)
    beam.add_traction(lambda c: (c[:, 1] < -0.05 + 1e-6) & (np.abs(c[:, 0]) < 0.11), (0.0, 500.0, 0.0))
    return scene


def ears() -> ts.Scene:
    """Two rods on a block, bent apart and released: the ears of the bunny on a mesh that can be refined twice."""
    scene = _scene()
    for name, side in (("left", -1.0), ("right", 1.0)):
        ear = ts.box_mesh((1, 6, 1), (0.1, 0.6, 0.1))
        body = scene.add_body(ear, _rubber(1e5, poisson=0.4, stiffness_damping=0.01), name=name, position=(side * 0.3, 0.0, 0.0))
        body.fix(face(1, -0.3))
        bend = ts.KeyFrames([0.0, 0.3], [(0.0, 0.0, 0.0), (side * 0.1, 0.0, 0.0)], smooth=True, release=True)
        body.move(face(1, 0.3), bend)
    return scene


def dropped_cube() -> ts.Scene:
    """A soft cube that falls on the ground and rebounds."""
    scene = _scene()
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground", friction=0.5)
    scene.add_body(ts.box_mesh((4, 4, 4), (1.0, 1.0, 1.0)), _rubber(1e5, friction=0.5), name="cube", position=(0.0, 1.0, 0.0))
    return scene


def incline() -> ts.Scene:
    """A cube that slides down a slope of 26.565 degrees at mu = 0.3."""
    angle = np.arctan(0.5)
    c, s = np.cos(angle), np.sin(angle)
    scene, upright = _scene(), ts.box_mesh((3, 3, 3), (0.1, 0.1, 0.1), pattern="six")
    cube = ts.TetMesh(upright.vertices @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), upright.tets)
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (s, c, 0.0)), name="slope", friction=0.3)
    scene.add_body(cube, _rubber(1e6, friction=0.3), name="cube", position=(0.05 * s, 0.05 * c, 0.0))
    return scene


def stack() -> ts.Scene:
    """Three soft cubes that fall on each other, and on the ground."""
    scene = _scene()
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground", friction=0.5)
    for k in range(3):
        mesh = ts.box_mesh((2, 2, 2), (1.0, 1.0, 1.0))
        scene.add_body(mesh, _rubber(1e5, friction=0.5), name=f"cube {k}", position=(0.0, 0.501 + 1.001 * k, 0.0))
    return scene


def cube_on_sheet() -> ts.Scene:
    """A cube dropped on a sheet that is clamped at two sides."""
    scene = _scene()
    sheet = scene.add_body(ts.box_mesh((12, 1, 6), (4.0, 0.05, 4.0)), _rubber(1e6, friction=0.5), name="sheet")
    sheet.fix(lambda X: np.abs(X[:, 0]) > 1.9)
    cube = ts.box_mesh((2, 2, 2), (0.5, 0.5, 0.5))
    scene.add_body(cube, _rubber(1e5, friction=0.5), name="cube", position=(0.0, 0.525, 0.0))
    return scene


def squeezed_ball() -> ts.Scene:
    """A quadratic ball between two plates that close and open."""
    scene = _scene(0.0)
    rubber = _rubber(1e5, poisson=0.4, friction=0.5, mass_damping=5.0)
    scene.add_body(ts.ball_mesh(0.2, 2), rubber, name="ball", order=2)
    for name, side in (("upper", 1.0), ("lower", -1.0)):
        displacements = [(0.0, 0.0, 0.0), (0.0, -side * 0.06, 0.0), (0.0, -side * 0.06, 0.0), (0.0, 0.0, 0.0)]
        path = ts.KeyFrames([0.0, 0.5, 0.75, 1.25], displacements, smooth=True)
        scene.add_obstacle(ts.Box((0.0, side * 0.26, 0.0), (0.4, 0.05, 0.4)), name=name, friction=0.5, path=path)
    return scene


CASES = (
    Case("hanging beam", SMOOTH, partial(beam, (8, 2, 2), damping=3.0), "bdf2", 1 / 60, 2.0),
    Case("falling beam", SMOOTH, partial(beam, (4, 1, 1), order=2), "implicit_midpoint", 1 / 120, 1.5),
    Case("spin", SMOOTH, spin, "implicit_midpoint", 1 / 120, 1.0),
    Case("twisting bar", SMOOTH, twisting_bar, "implicit_euler", 1 / 60, 2.0),
    Case("bar impact", CONTACT, bar_impact, "velocity_verlet", None, 0.12),
    Case("midpoint traction", SMOOTH, midpoint_traction, "bdf2", 1 / 60, 2.0),
    Case("ears", SMOOTH, ears, "bdf2", 1 / 120, 1.0),
    Case("cube drop", CONTACT, dropped_cube, "bdf2", 1 / 240, 1.0),
    Case("incline", CONTACT, incline, "implicit_euler", 1 / 100, 1.0),
    Case("stack", CONTACT, stack, "bdf2", 1 / 240, 1.0),
    Case("cube on sheet", CONTACT, cube_on_sheet, "implicit_euler", 1 / 120, 1.0),
    Case("ball squeezed", CONTACT, squeezed_ball, "implicit_euler", 1 / 100, 1.5),
)
