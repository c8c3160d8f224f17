"""Check that the functions which move obstacles and nodes depend on time alone, and do not jump.

A step moves them from the values at its start to those at its end. A function of a present command, of the state or of chance
gives another value for the same time in the next step: what it moves jumps between two steps, and no contact sees it. So each
function is evaluated for the end of a step when that begins, and for the same time again before the next one. A jump within a
step is halved until it is distinguished from fast motion: contacts see it as motion at the speed of the jump over the step.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taisoft.dynamics.dirichlet import DirichletConditions, MovedNodes
from taisoft.errors import SceneError, SimulationError
from taisoft.scene import checks
from taisoft.scene.commands import Command
from taisoft.scene.connections import CarriedPath
from taisoft.scene.key_frames import NodePath, ShapePath
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.rigid import PosePath, RigidBody
from taisoft.scene.scene import Scene

DATA = (NodePath, ShapePath, CarriedPath, Command)  # no functions of a user; the third follows an obstacle, which is checked
SAME = 1e-12  # of the largest entry, and of 1 m: times that differ by rounding give such differences
SMALL = 1e-6  # likewise, of jumps that do not matter, such as those of single precision
FAILED = object()


@dataclass
class _Function:
    name: str
    call: str  # the method that commands what it moves
    mover: Obstacle | MovedNodes
    path: Callable  # of the mover, when it was evaluated
    value: Callable[[float], np.ndarray | None]
    kept: np.ndarray | None | object = None


class PrescribedPaths:
    """The functions of time of a scene's obstacles and moved nodes."""

    def __init__(self, scene: Scene, dirichlet: DirichletConditions):
        given = [_Function(f"obstacle {o.name!r}", "set_pose", o, o.path, _pose(o)) for o in scene.obstacles]
        for g in dirichlet.groups:
            call = "set_pose" if isinstance(scene.body(g.name), RigidBody) else "set_displacement"
            given.append(_Function(f"body {g.name!r}: moved nodes", call, g, g.path, _displacement(g)))
        self._functions = [one for one in given if _is_function(one.mover.given_path)]
        self._time, self._jumped = 0.0, set()

    def _checked(self) -> list[_Function]:
        """Those that no command has replaced."""
        return [one for one in self._functions if _is_function(one.mover.path)]

    def remember(self, time: float) -> None:
        """Keep the values at a time [s]."""
        self._time = time
        for one in self._checked():
            one.path, one.kept = one.mover.path, _value(one.value, time)

    def begin(self, start: float, dt: float, end: float) -> None:
        """Keep the values at the end of the step of dt from `start`, after `check`; warn of jumps before `end` [s], once each."""
        before = [(one, one.kept if one.path is one.mover.path else _value(one.value, start)) for one in self._checked()]
        self.remember(start + dt)
        for one, first in before:
            last = one.kept if end == self._time else _value(one.value, end)
            if one.name not in self._jumped and (jump := find_jump(one.value, start, first, end, last)) is not None:
                self._jumped.add(one.name)
                warnings.warn(
                    f"{one.name}: the path jumps by {jump[1]:.3g} at t = {jump[0]:.6g} s, which contacts see as motion within "
                    f"one step: lead from one value to the other over several steps, or call sim.{one.call} in a loop",
                    UserWarning,
                    stacklevel=5,
                )

    def check(self) -> None:
        """Raise SimulationError if a function now gives another value at the time of the kept ones."""
        for one in self._checked():
            if one.path is not one.mover.path:
                continue
            before, now = one.kept, _value(one.value, self._time)
            if before is FAILED or now is FAILED:  # the step says why
                continue
            if (before is None) != (now is None) or not (now is None or _distance(before, now) <= SAME):
                raise SimulationError(
                    f"{one.name}: the path gives another value at t = {self._time:.6g} s than before: it must be a function of "
                    f"time alone; sim.{one.call} commands a motion from a loop"
                )


def find_jump(value: Callable[[float], np.ndarray | None], start: float, a, end: float, b) -> tuple[float, float] | None:
    """Return time [s] and size of a function's jump between two times [s] with values a and b; None if it does not jump, fails or
    ends."""
    if any(x is None or x is FAILED for x in (a, b)) or _distance(a, b) <= SMALL:
        return None
    at_first = whole = float(np.abs(a - b).max())
    remains = 0.75  # of a change, at least, in one half of the time if it is a jump: 0.5 of motion at constant velocity
    for _ in range(12):
        middle = 0.5 * (start + end)
        m = _value(value, middle)
        if m is None or m is FAILED:
            return None
        left, right = (float(np.abs(p - q).max()) for p, q in ((a, m), (m, b)))
        if max(left, right) < remains * whole:
            return None
        start, a, end, b, whole = (start, a, middle, m, left) if left > right else (middle, m, end, b, right)
    return (end, whole) if whole > 0.5 * at_first else None


def _is_function(path: Callable | None) -> bool:
    return path is not None and not isinstance(path.path if isinstance(path, PosePath) else path, DATA)


def _pose(obstacle: Obstacle) -> Callable[[float], np.ndarray]:
    return lambda t: np.concatenate([part.ravel() for part in obstacle.pose(t)])


def _displacement(group: MovedNodes) -> Callable[[float], np.ndarray | None]:
    shapes = ((3,), (len(group.nodes), 3))
    return lambda t: checks.path_value(group.path, t, "moved nodes", "displacement", shapes)


def _value(function: Callable, time: float) -> np.ndarray | None | object:
    """Return a function's value at a time [s], or FAILED."""
    try:
        return function(time)
    except SceneError:
        return FAILED


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """The largest difference of two values, over their largest entry or 1 m."""
    return float(np.abs(a - b).max() / max(1.0, np.abs(a).max(), np.abs(b).max()))
