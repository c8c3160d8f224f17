"""Bounds on a step: on its Newton iterations, in all parts together and in a static solve, and on its wall time.

Iterations of rejected parts count, and of impacts; a linear solve of a linearised contact problem counts as one. At either bound
Newton's method stops where it is and nothing is tried again. Out of iterations, the rest of the step is held back; out of time,
it is taken as one part, whose Newton's method and impact have one iteration each, see `implicit`. The time is looked at after
each iteration and between the linear solves of a frictional problem, or iterations of its augmented Lagrangian. What a step
reaches in it depends on the machine.

MAX_ITERATIONS is about twice the most that a converged step was found to take: 1,193 in case R1 of `taisoft bench hard`
(`most_newton_iterations` in its records), 673 in `taisoft bench ipc`, 872 in heap 053, one of the slowest of `taisoft bench
crossings`.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from taisoft.backend.runtime import compile_clock

MAX_ITERATIONS = 2400

_watch: ContextVar[Callable[[int], None] | None] = ContextVar("watch", default=None)


@contextmanager
def watched(watch: Callable[[int], None]) -> Iterator[None]:
    """Call watch(n) after each iteration, n those of the step so far. What it raises abandons the step: its start is restored."""
    token = _watch.set(watch)
    try:
        yield
    finally:
        _watch.reset(token)


def computing_time() -> float:
    """Wall time without that spent on compiling kernels [s]."""
    return time.perf_counter() - compile_clock()


class NewtonBudget:
    """Newton iterations and wall time of the present step."""

    limit = MAX_ITERATIONS
    clock = staticmethod(computing_time)  # [s]

    def __init__(self) -> None:
        self.begin(None)

    def begin(self, seconds: float | None) -> None:
        """Begin a step, of at most so much wall time [s]."""
        self.used, self.ran_out = 0.0, False  # the latter: whether the time has ended something
        self._end = math.inf if seconds is None else self.clock() + seconds

    def spend(self, n: float = 1.0) -> None:
        """Count n more iterations."""
        self.used += n
        if (watch := _watch.get()) is not None:
            watch(int(self.used))

    @property
    def left(self) -> int:
        """Whole iterations left, but for one that is kept for a projected matrix."""
        return max(0, int(self.limit - 1 - self.used))

    def is_out_of_time(self) -> bool:
        """Return, and set `ran_out` to, whether the wall time is used up."""
        self.ran_out = self.ran_out or (self._end < math.inf and self.clock() >= self._end)
        return self.ran_out
