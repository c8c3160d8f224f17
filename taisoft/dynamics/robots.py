"""Robots that run beside a simulation, and the exchange of motion and forces with MuJoCo, once a step or until both agree.

A step from t to t + dt: MuJoCo advances each robot under the wrenches of its links, in steps of its own that divide dt; the
obstacles that are its shapes are commanded to where they then are, and bodies take their step; contact forces on the shapes, and
forces of what is attached to them, give the wrenches, means over the step. With one iteration (weak coupling) these act in the
next step: an error of first order in dt, and unstable where touching bodies are heavier than a free link. With more, the step is
repeated from its start under wrenches that are relaxed by Aitken's rule (Irons and Tuck 1969), until they change by less than
TOLERANCE.
"""

from typing import Protocol

import numpy as np

from taisoft.dynamics.running_robot import Bodies, RunningRobot
from taisoft.errors import SimulationError
from taisoft.records import StepReport
from taisoft.scene.rigid import Pose
from taisoft.scene.scene import Scene

TOLERANCE = 1e-4  # of iterations: change of the wrenches over the largest one, or the robots' weight
FIRST_RELAXATION, RELAXATIONS = 0.5, (0.02, 1.0)  # of the change of the wrenches, at first; bounds of a step's first one
MAX_RELAXATION = 2.0  # in either direction


class Simulation(Bodies, Protocol):
    """What robots run with: the simulation of bodies, which they move and whose steps they repeat."""

    dt: float
    is_open: bool

    def command_poses(self, poses: dict[str, Pose]) -> None:
        """Let obstacles, by name, move to poses in the next step."""

    def take_steps(self, n: int) -> StepReport:
        """Take up to n steps of dt, of bodies alone."""

    def snapshot(self) -> dict:
        """Return everything the next step depends on, robots too."""

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""


class Robots:
    """All robots of a scene."""

    def __init__(self, scene: Scene):
        self.running = {placed.name: RunningRobot(placed, scene) for placed in scene.robots}
        self._iterations = max((placed.iterations for placed in scene.robots), default=1)
        self._relaxation = FIRST_RELAXATION  # in the last iteration of the last step

    def __bool__(self) -> bool:
        return bool(self.running)

    def restart(self) -> None:
        """Return all to their starts."""
        self._relaxation = FIRST_RELAXATION
        for robot in self.running.values():
            robot.restart()

    def snapshot(self) -> dict:
        """Return what the next step depends on."""
        return {"relaxation": self._relaxation, "running": {name: robot.snapshot() for name, robot in self.running.items()}}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self._relaxation = float(kept["relaxation"])
        for name, robot in self.running.items():
            robot.restore(kept["running"][name])

    def step(self, bodies: Simulation) -> StepReport:
        """Take one step of the simulation and of the robots. Raises SimulationError; both are then as before."""
        before, start = self.snapshot(), bodies.snapshot() if self._iterations > 1 else {}
        try:
            report = self._take(bodies)
            exchange = Exchange(list(self.running.values()), self._relaxation)
            for _ in range(self._iterations - 1):
                if exchange.agrees():
                    break
                wrenches = exchange.relaxed()
                bodies.restore(start)
                exchange.apply(wrenches)
                report = _sum(report, self._take(bodies))
            if self._iterations > 1 and not exchange.agrees():
                report.converged = False
                report.problems.append(
                    f"step {bodies.state.step_count}: forces and motion of {', '.join(self.running)} do not agree after "
                    f"{self._iterations} iterations: wrenches still change by {exchange.change:.2g} of their size"
                )
        except BaseException:  # Ctrl-C, too
            if start and bodies.is_open:
                bodies.restore(start)
            self.restore(before)
            raise
        exchange.apply(exchange.felt())
        self._relaxation = min(max(abs(exchange.relaxation), RELAXATIONS[0]), RELAXATIONS[1])
        return report

    def _take(self, bodies: Simulation) -> StepReport:
        """Let the robots move, and the bodies take their step against them."""
        poses, dt = {}, bodies.dt
        try:
            for robot in self.running.values():
                poses |= robot.advance(dt, bodies.state.time + dt)
        except SimulationError as error:
            raise SimulationError(f"step {bodies.state.step_count + 1}: {error}") from None
        bodies.command_poses(poses)
        report = bodies.take_steps(1)
        for robot in self.running.values():
            robot.feel(bodies)
        return report


class Exchange:
    """Wrenches of robots in the iterations of one step, with Aitken's relaxation."""

    def __init__(self, robots: list[RunningRobot], relaxation: float):
        self._robots, self.relaxation = robots, relaxation
        self._applied = np.concatenate([robot.applied for robot in robots])
        self._lengths = np.concatenate([robot.sizes() for robot in robots])
        self._last: np.ndarray | None = None  # change at the last relaxation
        self._weight = sum(float(np.linalg.norm(one.model.opt.gravity) * one.model.body_mass.sum()) for one in robots)

    def felt(self) -> np.ndarray:
        """The wrenches of the last iteration, those of all robots one below the other."""
        return np.concatenate([robot.wrenches for robot in self._robots])

    def apply(self, wrenches: np.ndarray) -> None:
        """Let wrenches act in the next iteration, or the next step."""
        self._applied, first = wrenches, 0
        for robot in self._robots:
            robot.applied[:] = wrenches[first : first + len(robot.applied)]
            first += len(robot.applied)

    @property
    def change(self) -> float:
        """How much the bodies' answer to the applied wrenches differs from these, over the largest of both and the weight."""
        largest = max(self._weight, *(np.abs(self._as_forces(wrenches)).max() for wrenches in (self.felt(), self._applied)))
        return float(np.abs(self._as_forces(self.felt() - self._applied)).max() / largest) if largest > 0.0 else 0.0

    def agrees(self) -> bool:
        """Whether it is within TOLERANCE."""
        return self.change <= TOLERANCE

    def relaxed(self) -> np.ndarray:
        """Return the wrenches of the next iteration."""
        change = self._as_forces(self.felt() - self._applied).ravel()
        if self._last is not None:
            turn = change - self._last
            if square := float(turn @ turn):
                self.relaxation *= -float(self._last @ turn) / square
                self.relaxation = min(max(self.relaxation, -MAX_RELAXATION), MAX_RELAXATION) or FIRST_RELAXATION
        self._last = change
        return self._applied + self.relaxation * (self.felt() - self._applied)

    def _as_forces(self, wrenches: np.ndarray) -> np.ndarray:
        return np.concatenate([wrenches[:, :3], wrenches[:, 3:] / self._lengths], axis=1)


def _sum(first: StepReport, last: StepReport) -> StepReport:
    """The report of a step's last iteration, with the work of all."""
    for name in ("newton_iterations", "linear_iterations", "contact_iterations"):
        setattr(last, name, getattr(first, name) + getattr(last, name))
    return last
