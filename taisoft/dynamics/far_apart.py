"""Explicit sub-steps in which nothing can touch, known from one search along straight paths of many of them.

A search along x + t v, t up to many dt, finds no contact, and the box of no triangle meets another collider. The boxes hold the
whole paths and are grown by half the reach, so surfaces stay apart, whatever the times, as long as no vertex leaves its path by
half the reach. MAX_DEVIATION leaves as much again: what a search in a single sub-step would find there carries no impulse. So the
results are the same as with a search in each. Weak: bodies whose boxes meet, and those tested against themselves, gain nothing.
"""

from collections.abc import Callable

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.detector import Detection
from taisoft.collision.near_list import leaving
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.fem.state import DEVIATION

MOST, FEWEST = 64, 4  # sub-steps of a search; where one fails, a quarter as many are tried
PAUSE = 16  # sub-steps after which they are tried again
MAX_DEVIATION = 0.25  # of the reach: how far a vertex may leave its path


@kernel
def find_deviation(m: ti.template(), s: ti.template()):
    """Find how far a vertex has left its searched path. scalars: DEVIATION."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.state.scalars[DEVIATION] = 0.0
    ti.loop_config(serialize=m.on_cpu)
    for k in range(s.n_verts):
        if s.node[k] >= 0:
            square = leaving(m.state.x[s.node[k]] - s.x[k], s.move[k]).norm_sqr()
            if not square <= m.state.scalars[DEVIATION]:  # also if it is not a number
                ti.atomic_max(m.state.scalars[DEVIATION], ti.select(square >= 0.0, square, ti.math.inf))


class FarApart:
    """Searches for many sub-steps. until [s]: how long it is known that nothing can touch; 0: it is not."""

    def __init__(self, simulation: SimulationState, detection: Detection):
        self._simulation, self._detection = simulation, detection
        self._limit = (MAX_DEVIATION * detection.reach) ** 2  # [m^2]
        self.until, self._length, self._pause = 0.0, MOST, 0

    def forget(self) -> None:
        """Discard what is known, after another search or a change of the state."""
        self.until = 0.0

    @property
    def is_known(self) -> bool:
        """Whether nothing touches at the end of the last sub-step."""
        return self.until > 0.0

    def is_due(self) -> bool:
        """Return whether to search now. Called once a sub-step."""
        self._pause = max(self._pause - 1, 0)
        return self._pause == 0

    def skip(self, n: int) -> None:
        """Count n sub-steps that have not asked."""
        self._pause = max(self._pause - n, 0)

    def search(self, time: float, dt: float, finds_nothing: Callable[[float, float, int], bool]) -> None:
        """Search from a time [s] for as many sub-steps of dt as nothing can touch in. finds_nothing: searches for so many."""
        while self._length >= FEWEST:
            if finds_nothing(time, dt, self._length):
                self.until, self._length = time + (self._length + 0.5) * dt, MOST
                return
            self._length //= 4
        self._length, self._pause = MOST, PAUSE

    def snapshot(self) -> dict:
        """Return what is known for a checkpoint."""
        return {"until": self.until, "length": self._length, "pause": self._pause}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`; an empty one, that of a start."""
        self.until = float(kept.get("until", 0.0))
        self._length, self._pause = int(kept.get("length", MOST)), int(kept.get("pause", 0))

    def stays(self) -> bool:
        """Return whether all vertices are near their paths at the end of a sub-step; if not, nothing is known any more."""
        model = self._simulation.model
        find_deviation(model, self._detection.surface)
        if not model.state.scalars[DEVIATION] <= self._limit:
            self.forget()
        return self.is_known
