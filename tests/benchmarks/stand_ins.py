"""What takes the place of measurements and simulators in tests of benchmarks."""

import json
from collections.abc import Callable
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import ipc_runs, suite
from benchmarks.document import plain
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.nested import from_json, to_json
from taisoft.records import StepReport

TIME, SPACE, SOLVER = 1.0, 0.4, 1e-5  # of ModelSimulator's errors
STABLE = 1e-3  # [s] its largest stable step


class ModelSimulator:
    """A simulator of errors that are known: at time t all nodes are at t (1 + e) along y from their start.

    e is the sum of TIME dt, SPACE over the number of tets, and SOLVER in single precision; of explicit steps TIME dt^2.
    """

    def __init__(self, scene, dt=1.0 / 240, integrator="bdf2", precision="f32", tolerance=None, **more):
        self.scene, self.dt, self.stable_dt, self.compile_seconds = scene, dt, STABLE, 0.0
        self.touches, self.step_count = scene.pushes(False), 0
        if tolerance is not None:
            self.dt = 1.0 / 60 / 8
        self.settings = SimpleNamespace(integrator=integrator, newton_tolerance=1e-4, contact_tolerance=1e-4, dt=self.dt)
        tets = sum(body.mesh.n_tets for body in scene.bodies)
        self._start = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
        self._space = SPACE / tets
        self._error = TIME * self.dt ** (2 if integrator in EXPLICIT else 1) + self._space + SOLVER * (precision == "f32")
        self.time, self._estimated = 0.0, tolerance

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def reset(self):
        self.time = 0.0

    def positions(self):
        return self._start + np.array([0.0, self.time * (1.0 + self._error), 0.0])

    def step(self):
        self.time += self.dt
        return StepReport(self.time)

    def run(self, seconds, on_frame=None, fps=60.0, error=False, error_mesh=None, on_step=None):
        for k in range(round(seconds * fps) + 1):
            self.time = k / fps
            if on_frame is not None:
                on_frame(self, k, StepReport(self.time))
        estimate = {"time": TIME * self.dt, "space": self._space, "solver": SOLVER}
        estimate = SimpleNamespace(**estimate, order=1.0, wall_seconds=3.0, notes=["a note"])
        known = estimate if error or self._estimated else None
        found = {"status": "ok", "steps": round(seconds / self.dt), "step_reports": [], "problems": [], "interrupted": False}
        return SimpleNamespace(**found, wall_seconds=1.0, trial_seconds=0.5, error_estimate=known)


def answer_here(patch: pytest.MonkeyPatch, answer: Callable[[dict], dict]) -> None:
    """Let requests of suites be answered in this process, with what JSON leaves of the answers."""

    def carry_out(requests, places, done, **_):
        for key, request in requests:
            done(key, {"answer": from_json(to_json(answer(request)))})
        return {}

    patch.setattr(suite, "carry_out", carry_out)


def ipc_answer(request: dict) -> dict:
    """What a child of `taisoft bench ipc` answers."""
    return asdict(ipc_record(ipc_runs.Job(**{key: value for key, value in request.items() if key != suite.UNFINISHED})))


def in_this_process(_what: str, function: Callable, *arguments, **_):
    """Instead of `in_child`: what JSON leaves of the function's result."""
    return json.loads(json.dumps(plain(function(*arguments))))


def ipc_record(job=None, **more) -> ipc_runs.Record:
    """Two steps of a scene."""
    numbers: dict[str, Any] = {"nodes": 800, "tets": 1805, "wanted_steps": 625, "time": 0.08, "compile_seconds": 7.0}
    numbers |= {"newton": [3, 4], "cg": [10, 30], "substeps": [1, 2], "seconds": [0.5, 0.25]}
    record = ipc_runs.Record(job or ipc_runs.Job("twisted_mat", "small", 10.0), **numbers | more)
    record.end()
    return record


WINDOW = {"demo": "cube_on_box", "tets": 1215, "dt": 0.01, "step": 0.002, "longest_step": 0.02, "alone": 3.0, "speed": 1.0}
WINDOW |= {"intervals": [0.04, 0.04, 0.07], "latencies": [0.05, 0.06, 0.09]}
WINDOW |= {"budget": {"speed": 0.99, "step": 2e-3, "longest_step": 8e-3, "ended": 0.25, "residual": 0.03, "latencies": [0.07]}}
SPENT = {"CG and factors": 8e-4, "friction": 6e-4, "assembly and forces": 2e-4, "search": 1e-4, "paths": 0.0, "launches": 1e-4}
WINDOW |= {"alone_step": 0.0021, "kinds": {"seconds": SPENT | {"host": 2e-4}, "launches": {"search": 1100.0, "friction": 134.4}}}
