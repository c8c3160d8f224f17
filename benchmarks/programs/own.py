"""taisoft on the works."""

import numpy as np

import taisoft as ts
from taisoft.scene.scene import Scene

from ..beam import lasting_steps
from ..exact_path import DENSITY, POISSON, SAMPLE
from ..runner import warm_up, without_warnings
from ..timed_run import TimedRun, advance
from ..works.references import MUJOCO, TAISOFT, Model
from ..works.scenes import Work
from .session import Session, Setting

NAME, MODEL = "taisoft", TAISOFT
LAWS = {"SNH": "stable_neo_hookean", "SVK": "st_venant_kirchhoff"}
IMPLICIT = ("bdf2", "implicit_midpoint", "implicit_euler")
FINER = (1, 2, 4, 11)  # explicit steps of W1: errors of second order down to 1e-5; the last in f64 too


def load():
    """The package."""
    return ts


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
    """Explicit steps at the largest stable dt and finer, implicit ones of 10 ms; W1 also with MuJoCo's law."""
    model = MUJOCO if work.cells is not None else TAISOFT
    with without_warnings():
        least = lasting_steps(make_scene(work, model), "velocity_verlet", arch, work.seconds)
    f32, f64 = {"precision": "f32", "arch": arch}, {"precision": "f64", "arch": arch}
    finer = FINER if work.cells is not None else FINER[:3] if work.kind == "path" else FINER[:1]
    explicit = [Setting(NAME, model, "velocity_verlet", k * least, f32) for k in finer]
    if work.cells is not None:
        explicit.append(Setting(NAME, model, "velocity_verlet", finer[-1] * least, f64))
        explicit += [Setting(NAME, TAISOFT, "velocity_verlet", k * least, f32) for k in finer[:2]]
    kinds = [kind for kind in IMPLICIT if kind != "implicit_midpoint" or not work.touches]
    implicit = [Setting(NAME, model, kind, 1, f64 if work.stiff else f32) for kind in kinds]
    if work.touches:
        implicit.append(Setting(NAME, model, "implicit_euler", 2, f32))
    return explicit + implicit


class Run(Session):
    """Steps run in the largest batches of the Simulator."""

    def build(self) -> None:
        work, setting = self.work, self.setting
        with without_warnings():
            self.sim = ts.Simulator(make_scene(work, setting.model), dt=setting.dt, integrator=setting.method, **setting.options)
        warm_up(self.sim)

    def run(self, follow: bool) -> tuple[np.ndarray | None, float]:
        self.sim.reset()
        samples = round(self.work.seconds / SAMPLE)
        if not follow:
            return None, advance(self.sim, samples * self.setting.steps).seconds
        positions, whole = [self.positions()], TimedRun()
        for _ in range(samples):
            whole += advance(self.sim, self.setting.steps)
            positions.append(self.positions())
        self.unconverged = whole.unconverged
        return np.array(positions), whole.seconds

    def positions(self) -> np.ndarray:
        return np.concatenate([self.sim.positions(body.name) for body in self.work.bodies])

    def close(self) -> None:
        self.sim.close()
