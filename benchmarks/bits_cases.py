"""Cases of `bits.py`: all demos, twelve hard cases, and ten scenes with contacts in all combinations of kinds of steps.

A case runs on one thread or on two. In the ten scenes something touches within twenty steps, explicit ones too.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import product

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_module, shipped_files
from taisoft.errors import SimulationError

from .crossing_heaps import make_heap
from .hard_cases import VARIANTS
from .hard_cases.case import EXPLICIT, IMPLICIT, Session
from .hard_cases.contact import on_slope
from .hard_cases.geometry import on_knives
from .hard_cases.scale import bin_scene
from .hard_cases.shapes import COR, DOWN, SNH, WEIGHTLESS, cube, one_body
from .ipc_cases.falling import needles
from .ipc_cases.twisted import twist

Open = Callable[..., ts.Simulator]  # (scene, **settings) -> a simulator that ends the case after its last step


@dataclass(frozen=True)
class Case:
    """A run. precision and threads: what it uses; run: opens a simulator and takes steps until that one ends the case."""

    name: str
    precision: str
    threads: int
    run: Callable[[Open], None] = field(repr=False)
    quick: bool = False

    @property
    def key(self) -> str:
        """Unique text."""
        return f"{self.name}, {self.precision}, {self.threads}"


def step_on(build: Callable[[], ts.Scene], settings: dict, make: Open) -> None:
    """Take steps of a scene."""
    with make(build(), **settings) as sim:
        while True:
            sim.step()


def demos() -> list[Case]:
    """All demos with their own settings."""
    found = []
    for name, path in shipped_files("demos").items():
        demo = load_module(path)
        settings = {key: value for key, value in demo.solver.items() if key not in ("seconds", "fps")}
        found.append(Case(f"demo {name}", settings.get("precision", "f32"), 1, partial(step_on, demo.build, settings)))
    return found


HARD = {  # variant -> number of simulators that come before the one whose steps count
    f"M1: mirrored, {COR}, {EXPLICIT}, dt 0.001 s": 0,
    f"M2: random, {SNH}, {IMPLICIT}, dt 0.01 s": 0,
    "T3: implicit": 0,
    f"T4: {SNH}": 0,
    "R1: A": 0,
    "C3: spike": 0,
    "S3: two parts of one": 0,
    f"S4: {SNH}": 0,
    f"G1: s 0.0001, {SNH}, {IMPLICIT}": 0,
    f"X1: {COR}, {IMPLICIT}, f32": 1,  # of 1 um
    "X3: 64, growing, spatial_hash": 0,
    f"L1: {COR}, f64": 0,
}


class PartialSession(Session):
    """A variant of a hard case of which the steps of one simulator count, after `before` others."""

    def __init__(self, case, variant, make: Open, before: int):
        super().__init__(case, variant, "cpu")
        self._make, self._before = make, before

    def simulator(self, scene: ts.Scene, **changes) -> ts.Simulator:
        """See Session."""
        self._before -= 1
        return super().simulator(scene, **changes) if self._before >= 0 else self._make(scene, **self.variant.settings | changes)


def _hard(name: str, before: int, make: Open) -> None:
    session = PartialSession(*VARIANTS[name], make, before)
    session.case.run(session, **session.variant.parameters)
    raise SimulationError("; ".join(session.problems) or "the case took fewer steps")


def hard() -> list[Case]:
    """The chosen hard cases."""
    precisions = {name: VARIANTS[name][1].settings.get("precision", "f32") for name in HARD}
    return [Case(f"hard {name.replace(':', ',')}", precisions[name], 1, partial(_hard, name, HARD[name])) for name in HARD]


# --- ten scenes with contacts -------------------------------------------------------------------------------------------


def moving(scene: ts.Scene, velocity, **places) -> ts.Scene:
    """The scene, its bodies at first with a velocity (3,) [m/s], some of them at other places (3,) [m]."""
    for body in scene.bodies:
        body.velocity = velocity
        body.position = places.get(body.name, body.position)
    return scene


def cloth(height: float) -> ts.Scene:
    """A cloth, 2 mm thick, above a sphere."""
    scene = ts.Scene(gravity=DOWN)
    material = ts.Material(young=1e5, poisson=0.3, density=500.0, friction=0.3)
    scene.add_body(ts.sheet_mesh((20, 20), (0.5, 0.002, 0.5)), material, name="cloth", position=(0, height, 0))
    scene.add_obstacle(ts.Sphere((0, 0, 0), 0.1), name="sphere", friction=0.3)
    return scene


def two_slabs(upper: float, lower: float) -> ts.Scene:
    """A slab falls on another one, turned by 45 degrees; young: of each [Pa]."""
    scene, mesh = ts.Scene(gravity=DOWN), ts.box_mesh((12, 1, 12), (1.0, 0.05, 1.0))
    c = np.sqrt(0.5)
    turned = ts.TetMesh(mesh.vertices @ np.array([[c, 0, c], [0, 1, 0], [-c, 0, c]]).T, mesh.tets)
    for name, one, young, height in (("lower", mesh, lower, 0.0251), ("upper", turned, upper, 0.0752)):
        material = ts.Material(young=young, poisson=0.4, density=1500.0, friction=0.1)
        scene.add_body(one, material, name=name, position=(0, height, 0), velocity=(0, -1, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="plane", friction=0.1)
    return scene


def twisted_mat(cells: int) -> ts.Scene:
    """A mat of two layers, 2 mm apart and moving at each other, whose ends turn in opposite senses."""
    sheet, apart, toward = ts.sheet_mesh((cells, cells), (1.0, 0.02, 1.0)), np.array([0, 0.011, 0]), np.array([0, 0.3, 0])
    n = sheet.n_verts
    layers = np.concatenate([sheet.vertices - apart, sheet.vertices + apart])
    mesh = ts.TetMesh(layers, np.concatenate([sheet.tets, sheet.tets + n]))
    velocity = np.repeat([toward, -toward], n, axis=0)
    scene, mat = one_body("mat", mesh, WEIGHTLESS, velocity=velocity, law=SNH, young=2e4, poisson=0.4, friction=0.3)
    twist(mat)
    return scene


def ball_on_points(cells: int, points: int) -> ts.Scene:
    """A ball of 1 m falls on the tips of points x points needles."""
    scene, _ = one_body("ball", ts.ball_mesh(0.5, cells), DOWN, (0, 0.51, 0), (0, -1, 0), young=1e4, poisson=0.4, friction=0.0)
    scene.add_obstacle(needles(points, points, 0.2, 0.0), "points", friction=0.0)
    return scene


@dataclass(frozen=True)
class Scene:
    """A scene with contacts. dt, explicit_dt: of implicit and explicit steps [s]; settings: of both; quick: whether the quick
    run has it."""

    name: str
    build: Callable[[], ts.Scene]
    dt: float
    explicit_dt: float
    integrator: str = IMPLICIT
    settings: dict = field(default_factory=dict)
    quick: bool = False


RUBBER = ts.Material(young=1e6, poisson=0.3, density=1000.0)
SQUEEZE = shipped_files("demos")["squeeze"]
SCENES = (
    Scene("resting cube", lambda: on_slope(cube(3, 0.1), RUBBER, 0.0, 0.5), 0.01, 5e-4, quick=True),
    Scene("pile", lambda: moving(bin_scene(), (0, -2, 0)), 0.01, 1.2e-3),
    Scene("squeeze", lambda: moving(load_module(SQUEEZE).build(), (0, -0.2, 0)), 0.01, 1.1e-3, quick=True),
    Scene("cloth on sphere", lambda: moving(cloth(0.1011), (0, -1, 0)), 1 / 120, 9e-5, "bdf2"),
    Scene("slabs", lambda: two_slabs(1e6, 1e6), 1 / 120, 8e-4),
    Scene("soft on stiff", lambda: two_slabs(1e4, 1e8), 1 / 120, 8e-5),
    Scene("heap", lambda: make_heap(0).scene, 1 / 120, 5e-4),
    Scene("twisted mat", lambda: twisted_mat(12), 0.06, 2e-3, settings={"self_collision": True}),
    Scene("mat on knives", lambda: moving(on_knives(), (0, -1, 0), mat=(0, 0.02, 0)), 0.01, 2e-3),
    Scene("ball on points", lambda: ball_on_points(6, 6), 0.04, 1e-2),
)


def scenes() -> list[Case]:
    """The ten scenes, each explicit and implicit, in f32 and f64, on one thread and on two."""
    found = []
    for one, precision, threads, kind in product(SCENES, ("f32", "f64"), (1, 2), ("explicit", "implicit")):
        steps = (one.explicit_dt, EXPLICIT) if kind == "explicit" else (one.dt, one.integrator)
        settings = dict(zip(("dt", "integrator"), steps)) | {"precision": precision} | one.settings
        quick = one.quick and (precision, threads) in (("f32", 1), ("f64", 2))
        found.append(Case(f"scene {one.name}, {kind}", precision, threads, partial(step_on, one.build, settings), quick))
    return found


def all_cases() -> list[Case]:
    """All cases in order."""
    return [*demos(), *hard(), *scenes()]
