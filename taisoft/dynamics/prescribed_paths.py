"""Check that the functions which move obstacles and nodes depend on time alone.

A step moves them from the values at its start to those at its end. A function of a present command, of the state or of chance
gives another value for the same time in the next step: what it moves jumps between two steps, and no contact sees it. So each
function is evaluated for the end of a step when that begins, and for the same time again before the next one.
"""

from collections.abc import Callable

import numpy as np

from taisoft.errors import SceneError, SimulationError
from taisoft.scene import checks
from taisoft.scene.body import Constraint
from taisoft.scene.connections import CarriedPath
from taisoft.scene.key_frames import NodePath, ShapePath
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.scene import Scene

DATA = (NodePath, ShapePath, CarriedPath)  # no functions of a user; the last follows an obstacle, which is checked
SAME = 1e-12  # of the largest entry, and of 1 m: times that differ by rounding give such differences
FAILED = object()


class PrescribedPaths:
    """The functions of time of a scene's obstacles and moved nodes."""

    def __init__(self, scene: Scene):
        self._paths = [(f"obstacle {o.name!r}", _pose(o)) for o in scene.obstacles if _is_function(o.path)]
        moved = [(body, c) for body in scene.bodies for c in scene.constraints(body) if _is_function(c.path)]
        self._paths += [(f"body {body.name!r}: moved nodes", _displacement(c)) for body, c in moved]
        self._time, self._values = 0.0, []

    def remember(self, time: float) -> None:
        """Keep the values at a time [s]."""
        self._time, self._values = time, [_value(path, time) for _, path in self._paths]

    def check(self) -> None:
        """Raise SimulationError if a function now gives another value at the time of the kept ones."""
        for (name, path), before in zip(self._paths, self._values):
            now = _value(path, self._time)
            if before is FAILED or now is FAILED:  # the step says why
                continue
            if (before is None) != (now is None) or not (now is None or _are_same(before, now)):
                raise SimulationError(
                    f"{name}: the path gives another value at t = {self._time:.6g} s than before: it must be a function of time "
                    "alone; one that follows commands leads from the last one to the new one within the next step"
                )


def _is_function(path: Callable | None) -> bool:
    return path is not None and not isinstance(path, DATA)


def _pose(obstacle: Obstacle) -> Callable[[float], np.ndarray]:
    return lambda t: np.concatenate([part.ravel() for part in obstacle.pose(t)])


def _displacement(constraint: Constraint) -> Callable[[float], np.ndarray | None]:
    shapes = ((3,), (len(constraint.nodes), 3))
    return lambda t: checks.path_value(constraint.path, t, "moved nodes", "displacement", shapes)


def _value(path: Callable, time: float) -> np.ndarray | None | object:
    """Return a path's value at a time [s], or FAILED."""
    try:
        return path(time)
    except SceneError:
        return FAILED


def _are_same(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.abs(a - b).max() <= SAME * max(1.0, np.abs(a).max(), np.abs(b).max()))
