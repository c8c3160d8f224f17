"""Bound on the Newton iterations of a step, and on those of a static solve, in all parts together.

Those of rejected parts count, and of impacts; a linear solve of a linearised contact problem counts as one. At the bound Newton's
method stops where it is, nothing is tried again, and the rest of the step is held back, see `implicit`.

MAX_ITERATIONS is about twice the most that a converged step was found to take: 1,193 in case R1 of `taisoft bench hard`
(`most_newton_iterations` in its records), 673 in `taisoft bench ipc`, 872 in heap 053, one of the slowest of `taisoft bench
crossings`.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

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


class NewtonBudget:
    """Newton iterations of the present step."""

    limit = MAX_ITERATIONS

    def __init__(self) -> None:
        self.used = 0.0

    def begin(self) -> None:
        """Begin a step."""
        self.used = 0.0

    def spend(self, n: float = 1.0) -> None:
        """Count n more iterations."""
        self.used += n
        if (watch := _watch.get()) is not None:
            watch(int(self.used))

    @property
    def left(self) -> int:
        """Whole iterations left, but for one that is kept for a projected matrix."""
        return max(0, int(self.limit - 1 - self.used))
