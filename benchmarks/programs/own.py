"""taisoft on the works."""

import warnings
from time import perf_counter

import numpy as np

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.scene.scene import Scene
from taisoft.study.stretch import Stretch, advance, warm_up

from ..exact_path import DENSITY, POISSON, SAMPLE
from ..works.references import MUJOCO, TAISOFT, Model
from ..works.scenes import Work
from .session import Setting

NAME, MODEL = "taisoft", TAISOFT
LAWS = {"SNH": "stable_neo_hookean", "SVK": "st_venant_kirchhoff"}
IMPLICIT = ("bdf2", "implicit_midpoint", "implicit_euler")
FINER = (1, 2, 4, 12)  # explicit steps of W1: errors of second order down to 1e-5


def problem() -> str:
    """Nothing: it is here."""
    return ""


def make_scene(work: Work, model: Model = TAISOFT) -> Scene:
    """The work as a scene."""
    scene = ts.Scene(gravity=(0.0, -work.gravity, 0.0))
    for body in work.bodies:
        numbers = {"young": body.young, "poisson": POISSON, "density": DENSITY, "friction": work.friction, "restitution": 0.0}
        made = scene.add_body(body.mesh, ts.Material(law=LAWS[model.law], **numbers), name=body.name)
        if body.fixed.any():
            made.fix(np.flatnonzero(body.fixed))
    if work.ground:
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=work.friction)
    return scene


def settings(work: Work, arch: str = "cpu") -> list[Setting]:
    """Explicit steps at the largest dt that lasts and finer, implicit ones of 10 ms; W1 with the law that MuJoCo has too."""
    model = MUJOCO if work.key.startswith("W1") else TAISOFT
    least = lasting_steps(work, model, arch)
    f32, f64 = {"precision": "f32", "arch": arch}, {"precision": "f64", "arch": arch}
    finer = FINER if work.key.startswith("W1") else FINER[:3] if work.kind == "path" else FINER[:1]
    explicit = [Setting(NAME, model, "velocity_verlet", k * least, f32 if k < 8 else f64) for k in finer]
    kinds = [kind for kind in IMPLICIT if kind != "implicit_midpoint" or not work.touches]
    stiff = max(body.young for body in work.bodies) > 1e7
    implicit = [Setting(NAME, model, kind, 1, f64 if stiff else f32) for kind in kinds]
    if work.touches:
        implicit.append(Setting(NAME, model, "implicit_euler", 2, f32))
    return explicit + implicit


def lasting_steps(work: Work, model: Model, arch: str) -> int:
    """Smallest number of explicit steps within SAMPLE, from 0.9 of the limit at rest on, that lasts the work.

    A law may stiffen where it is squeezed. Raises SimulationError where even a quarter of the limit does not do.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        made = ts.Simulator(make_scene(work, model), dt=1e-6, integrator="velocity_verlet", arch=arch)
    with made as sim:
        least = int(np.ceil(SAMPLE / (0.9 * sim.stable_dt)))
        for steps in range(least, 4 * least):
            sim.dt = SAMPLE / steps
            sim.reset()
            try:
                if advance(sim, steps * round(work.seconds / SAMPLE)).inverted == 0 or model.law == "SVK":
                    return steps
            except SimulationError:
                continue
    raise SimulationError(f"{work.key}: no explicit step down to a quarter of the limit lasts")


class Run:
    """A Session."""

    def __init__(self, work: Work, setting: Setting) -> None:
        self.work, self.setting, self.unconverged = work, setting, 0
        start = perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that a body is soft for its weight: it shall be
            self.sim = ts.Simulator(
                make_scene(work, setting.model), dt=setting.dt, integrator=setting.method, **setting.options
            )
        warm_up(self.sim)
        self.build_seconds = perf_counter() - start

    def run(self, follow: bool) -> tuple[np.ndarray | None, float]:
        self.sim.reset()
        samples = round(self.work.seconds / SAMPLE)
        if not follow:
            return None, advance(self.sim, samples * self.setting.steps).seconds
        positions, whole = [self._positions()], Stretch()
        for _ in range(samples):
            whole += advance(self.sim, self.setting.steps)
            positions.append(self._positions())
        self.unconverged = whole.unconverged
        return np.array(positions), whole.seconds

    def _positions(self) -> np.ndarray:
        return np.concatenate([self.sim.positions(body.name) for body in self.work.bodies])

    def close(self) -> None:
        self.sim.close()


def start(work: Work, setting: Setting) -> Run:
    """Ready to run. Raises SimulationError, or SceneError where the program refuses the setting."""
    return Run(work, setting)
