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
from taisoft.errors import SimulationError, reworded
from taisoft.records import StepReport
from taisoft.scene.rigid import Pose
from taisoft.scene.scene import Scene

TOLERANCE = 1e-4  # of iterations: change of the wrenches over the largest one, or the weight of the lightest link
FIRST_RELAXATION, RELAXATIONS = 0.5, (0.02, 1.0)  # of the change of the wrenches, at first; bounds of a step's first one
MAX_RELAXATION = 2.0  # in either direction
# weak coupling is unstable if wrenches turn round in so many steps in a row by more than this part of their size
MAX_TURNS, TURN = 4, 0.5


class Simulation(Bodies, Protocol):
    """What robots run with: the simulation of bodies, see `Dynamics`."""

    dt: float
    is_open: bool

    def command_poses(self, poses: dict[str, Pose]) -> None: ...
    def advance(self, n: int) -> StepReport: ...
    def snapshot(self) -> dict: ...
    def restore(self, kept: dict) -> None: ...


class Robots:
    """All robots of a scene."""

    def __init__(self, scene: Scene):
        self.running = {placed.name: RunningRobot(placed, scene) for placed in scene.robots}
        self._iterations = max((placed.iterations for placed in scene.robots), default=1)
        self._forget()

    def __bool__(self) -> bool:
        return bool(self.running)

    def _forget(self) -> None:
        self._relaxation, self._turns = FIRST_RELAXATION, 0
        self._change: np.ndarray | None = None  # of the wrenches in the last step

    def restart(self) -> None:
        """Return all to their starts."""
        self._forget()
        for robot in self.running.values():
            robot.restart()

    def snapshot(self) -> dict:
        """Return what the next step depends on."""
        return {"relaxation": self._relaxation, "running": {name: robot.snapshot() for name, robot in self.running.items()}}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self._forget()
        self._relaxation = float(kept["relaxation"])
        for name, robot in self.running.items():
            robot.restore(kept["running"][name])

    def close(self) -> None:
        """Refuse controls from now on."""
        for robot in self.running.values():
            robot.close()

    def step(self, bodies: Simulation) -> StepReport:
        """Take one step of the simulation and of the robots. Raises SimulationError; both are then as before."""
        count, start = bodies.state.step_count, bodies.snapshot() if self._iterations > 1 else {}
        before = start["robots"] if start else self.snapshot()
        exchange = Exchange(list(self.running.values()), self._relaxation)
        try:
            report = self._take(bodies)
            for _ in range(self._iterations - 1):
                if exchange.change <= TOLERANCE:
                    break
                wrenches = exchange.relaxed()
                bodies.restore(start)
                exchange.apply(wrenches)
                report = _sum(report, self._take(bodies))
        except BaseException:  # Ctrl-C, too
            if start and bodies.is_open:
                bodies.restore(start)
            elif bodies.is_open and bodies.state.step_count > count:  # bodies have taken their step
                self._measure(bodies)
                exchange.apply(exchange.response())
            else:
                self.restore(before)
            raise
        if problem := self._problem(exchange):
            report.converged = False
            report.problems.append(f"step {bodies.state.step_count}: {problem}")
        exchange.apply(exchange.response())
        self._relaxation = min(max(abs(exchange.relaxation), RELAXATIONS[0]), RELAXATIONS[1])
        return report

    def _take(self, bodies: Simulation) -> StepReport:
        """Let the robots move, and the bodies take their step against them."""
        poses, dt = {}, bodies.dt
        with reworded(SimulationError, f"step {bodies.state.step_count + 1}: "):
            for robot in self.running.values():
                poses |= robot.advance(dt, bodies.state.time + dt)
        bodies.command_poses(poses)
        report = bodies.advance(1)
        self._measure(bodies)
        return report

    def _measure(self, bodies: Simulation) -> None:
        for robot in self.running.values():
            robot.measure_wrenches(bodies)

    def _problem(self, exchange: "Exchange") -> str:
        """Say that iterations do not agree, or that weak coupling oscillates; else nothing."""
        names = ", ".join(self.running)
        if self._iterations > 1:
            if exchange.change <= TOLERANCE:
                return ""
            many = f"after {self._iterations} iterations: wrenches still change by {exchange.change:.2g} of their size"
            return f"forces and motion of {names} do not agree {many}"
        change, last = exchange.differences(), self._change
        turned = last is not None and float(change @ last) < -TURN * float(last @ last) < 0.0
        self._turns = self._turns + 1 if turned and exchange.change > TURN else 0
        self._change = change
        return f"forces on {names} oscillate from step to step: couple with iterations=20" if self._turns >= MAX_TURNS else ""


class Exchange:
    """Wrenches on links that forces can move, in the iterations of one step, with Aitken's relaxation."""

    def __init__(self, robots: list[RunningRobot], relaxation: float):
        self._robots, self.relaxation = robots, relaxation
        self._applied = np.concatenate([robot.applied for robot in robots])
        self._lengths, self._yields = (np.concatenate(rows) for rows in zip(*((one.sizes(), one.can_yield) for one in robots)))
        self._last: np.ndarray | None = None  # change at the last relaxation
        weights = [float(np.linalg.norm(one.model.opt.gravity)) * one.lightest for one in robots if np.isfinite(one.lightest)]
        self._weight = min(weights, default=0.0)

    def response(self) -> np.ndarray:
        """The wrenches of the last iteration, those of all robots one below the other."""
        return np.concatenate([robot.wrenches for robot in self._robots])

    def apply(self, wrenches: np.ndarray) -> None:
        """Let wrenches act in the next iteration, or the next step."""
        self._applied, first = wrenches, 0
        for robot in self._robots:
            robot.applied[:] = wrenches[first : first + len(robot.applied)]
            first += len(robot.applied)

    def differences(self) -> np.ndarray:
        """By how much the bodies' response differs from the wrenches applied, as forces [N]."""
        return self._as_forces(self.response() - self._applied)

    @property
    def change(self) -> float:
        """Their largest, over the largest wrench and the weight."""
        sizes = (np.abs(self._as_forces(wrenches)).max(initial=0.0) for wrenches in (self.response(), self._applied))
        largest = max(self._weight, *sizes)
        return float(np.abs(self.differences()).max(initial=0.0) / largest) if largest > 0.0 else 0.0

    def relaxed(self) -> np.ndarray:
        """Return the wrenches of the next iteration."""
        change = self.differences()
        if self._last is not None:
            turn = change - self._last
            if square := float(turn @ turn):
                self.relaxation *= -float(self._last @ turn) / square
                self.relaxation = min(max(self.relaxation, -MAX_RELAXATION), MAX_RELAXATION) or FIRST_RELAXATION
        self._last = change
        return self._applied + self.relaxation * (self.response() - self._applied)

    def _as_forces(self, wrenches: np.ndarray) -> np.ndarray:
        scaled = np.concatenate([wrenches[:, :3], wrenches[:, 3:] / self._lengths], axis=1)
        return scaled[self._yields].ravel()


def _sum(first: StepReport, last: StepReport) -> StepReport:
    """The report of a step's last iteration, with the work of all."""
    for name in ("newton_iterations", "linear_iterations", "contact_iterations"):
        setattr(last, name, getattr(first, name) + getattr(last, name))
    return last
