"""A simulator of nodes on springs of their own: tests of error estimates and trials run hundreds of its steps in milliseconds.

Each node vibrates about its place at rest, x'' = -w^2 (x - X) - d x' + g (1 + c h^2), in steps of the package's integrators. h is
a mesh width, and c makes an error of the mesh. A stiff floor pushes nodes up. The stand-in has what `taisoft.running`,
`taisoft.energy_check` and `taisoft.estimation` use of a Simulator, with the private methods that they call.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np

import taisoft as ts
from taisoft import queries
from taisoft.estimation.estimator import ErrorEstimator
from taisoft.records import Energies, StepReport
from taisoft.settings import Settings
from tests.dynamics.scenes import cube, rubber

VERLET, BDF2, EULER = "velocity_verlet", "bdf2", "implicit_euler"
FLOOR = 60.0  # [rad/s] frequency of a node on the floor


def block(touching: bool = False, young: float = 1e5, cells=(1, 1, 1), **material) -> ts.Scene:
    """A block, above a ground if touching."""
    scene = ts.Scene(gravity=(0.0, -10.0, 0.0))
    scene.add_body(cube(cells=cells), rubber(young=young, **material), name="block")
    if touching:
        scene.add_obstacle(ts.HalfSpace((0.0, -9.0, 0.0), (0.0, 1.0, 0.0)), name="ground", friction=0.5)
    return scene


class StandIn:
    """Like `ts.Simulator(scene, ...)`. Class attributes are those of the motion, see `motion`.

    frequency: w [rad/s]; damping: d [1/s]; width_error: c; floor: its height [m]; newton: iterations of a step;
    offset: (sim) -> what is added to positions [m]; before_step: (sim), called before each step; unconverged: (sim) -> whether.
    made: all stand-ins of this kind.
    """

    frequency, damping, width_error, floor, newton, stable_dt = 5.0, 0.0, 0.0, -np.inf, 2, 0.03
    commands = ()  # none are followed
    offset, before_step, unconverged = (staticmethod(f) for f in (lambda sim: 0.0, lambda sim: None, lambda sim: False))
    dragged, is_driven, compile_seconds, contact = None, False, 0.0, SimpleNamespace(contact_offset=0.01)
    made: list["StandIn"] = []

    def __init__(self, scene, dt=1 / 64, integrator=EULER, precision="f64", **settings):
        self.scene, self.dt = scene, dt
        self.settings = Settings(dt=dt, integrator=integrator, precision=precision, **settings)
        self.touches = scene.pushes(False)
        self.rest = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
        widths = [np.full(body.n_nodes, body.mesh.n_tets ** (-1.0 / 3.0) / body.order) for body in scene.bodies]
        self.pull = np.asarray(scene.gravity) * (1.0 + self.width_error * np.concatenate(widths)[:, None] ** 2)
        self.x, self.v = self.rest.copy(), np.concatenate([np.broadcast_to(b.velocity, (b.n_nodes, 3)) for b in scene.bodies])
        self.time, self.step_count, self.changes, self.past, self.closed = 0.0, 0, 0, None, False
        self.made.append(self)
        self._dynamics, self._estimator, self._may_soften = self, None, False
        self.state = SimpleNamespace(state=lambda: (self.positions(), self.v), velocities=lambda: self.v)

    def advance(self, n: int) -> StepReport:
        n, hits = (n if self.settings.explicit else 1), 0
        for _ in range(n):
            self.before_step(self)
            hits += self._step(self.dt)
            self.time, self.step_count = self.time + self.dt, self.step_count + 1
        count = 0 if self.settings.explicit else self.newton
        counts = {"newton_iterations": count, "linear_iterations": 2 * count, "n_contacts": hits}
        return StepReport(self.time, n, **counts, converged=not self.unconverged(self))

    def _step(self, dt: float) -> int:
        d, x, v, below = self.damping, self.x, self.v, self.x[:, 1] < self.floor
        if self.settings.explicit:
            half = v + 0.5 * dt * (self._force(x, below) - d * v)
            self.x = x + dt * half
            self.v = (half + 0.5 * dt * self._force(self.x, self.x[:, 1] < self.floor)) / (1.0 + 0.5 * dt * d)
        else:
            x_hat, v_hat, h = x, v, dt
            if self.settings.integrator == BDF2 and self.past is not None:
                x_hat, v_hat, h = (4.0 * x - self.past[0]) / 3.0, (4.0 * v - self.past[1]) / 3.0, 2.0 * dt / 3.0
            stiffness = self.frequency**2 + np.where(below[:, None], (0.0, FLOOR**2, 0.0), 0.0)
            self.v = (v_hat + h * self._force(x_hat, below)) / (1.0 + h * d + h * h * stiffness)
            self.x, self.past = x_hat + h * self.v, (x, v)
        return int(below.sum())

    def _force(self, x: np.ndarray, below: np.ndarray) -> np.ndarray:
        force = self.pull - self.frequency**2 * (x - self.rest)
        force[below, 1] += FLOOR**2 * (self.floor - x[below, 1])
        return force

    def positions(self, body=None) -> np.ndarray:
        return self.x + self.offset(self)

    def velocities(self, body=None) -> np.ndarray:
        return self.v.copy()

    def energies(self) -> Energies:
        return Energies(0.0, 0.0, -float((self.x @ self.scene.gravity).sum()))

    error_so_far = property(queries.error_so_far)
    nodal_errors = queries.nodal_errors

    def overlaps(self) -> list:
        return []

    def snapshot(self) -> dict:
        return {"x": self.x, "v": self.v, "past": self.past, "time": self.time, "step_count": self.step_count, "dt": self.dt}

    def restore(self, state: dict) -> None:
        vars(self).update(state | {"x": state["x"].copy(), "v": state["v"].copy()})

    def _arguments(self) -> dict:
        return dataclasses.asdict(self.settings) | {"dt": self.dt}

    def _copy(self, **settings) -> "StandIn":
        made = type(self)(self.scene, **self._arguments() | settings)
        made.restore(self.snapshot() | {"dt": made.dt, "past": None})
        return made

    def _replace(self, **settings) -> None:
        self.settings, self.past = dataclasses.replace(self.settings, **settings), None
        self.dt = self.settings.dt

    def _host(self) -> "StandIn":
        return self

    def _take_compile_seconds(self) -> float:
        return 0.0

    def _begin_estimate(self, steps, mesh, measured):
        self._estimator = ErrorEstimator(self, steps, mesh, measured)
        return self._estimator

    def _end_estimate(self) -> None:
        self._estimator.close()
        self._estimator = None

    def close(self) -> None:
        self.closed = True


def motion(**attributes) -> type[StandIn]:
    """A kind of stand-in with other numbers of its motion."""
    hooks = {name: staticmethod(value) if callable(value) else value for name, value in attributes.items()}
    return type("Moving", (StandIn,), hooks | {"made": []})
