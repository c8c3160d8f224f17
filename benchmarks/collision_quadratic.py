"""The reduction of contacts by two nested loops over the list, beside the one whose cost grows with their number only."""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.contacts import FOUND, KEPT, LEFT, UNKNOWN, is_same
from taisoft.collision.detector import MERGED, Detection


@kernel
def reduce_by_pairs(
    r: ti.template(), out: ti.template(), order: ti.types.ndarray(), state: ti.template(), kept: ti.template(), tolerance: ti.f64
):
    """Two nested loops over the list that a search has left: a contact is kept unless an earlier kept one is the same."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        n = 0
        for i in range(r.count[FOUND]):
            at = order[i]
            state[i] = KEPT
            j = 0
            while j < n and state[i] == KEPT:
                if is_same(out, at, kept[j], tolerance):
                    state[i] = UNKNOWN
                j += 1
            if state[i] == KEPT:
                kept[n] = at
                n += 1
        state[r.count[FOUND]] = n


class Quadratic:
    """The reduction by two nested loops, of a detection's last search."""

    def __init__(self, detection: Detection):
        self._detection, self._arena = detection, FieldArena()
        self._capacity = n = detection.buffer.capacity
        self._known: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._state, self._kept = (self._arena.field(name, ti.i32, n + 1) for name in ("state", "kept"))

    def fits(self) -> bool:
        """Whether there is room for what the detection may find now."""
        return self._capacity == self._detection.buffer.capacity

    def reduce(self) -> None:
        """Decide every contact anew."""
        d = self._detection
        reduce_by_pairs(d._reduction, d.buffer.data, self._order(), self._state, self._kept, MERGED * d.edge)

    def _order(self) -> np.ndarray:
        """Places of the contacts in the order in which they are kept: by kind and feature, then by place. Made once a search."""
        d = self._detection
        place = d._reduction.place.to_numpy()[: d._reduction.count[FOUND]]
        feature = d.buffer.data.feature.to_numpy()[place]
        known = self._known
        if known is None or not (np.array_equal(known[0], place) and np.array_equal(known[1], feature)):
            order = place[np.lexsort((place, feature[:, 2], feature[:, 1], feature[:, 0]))]
            self._known = known = (place, feature, order.astype(np.int32))
        return known[2]

    def same(self) -> bool:
        """Whether it kept what the detection's own reduction kept."""
        r = self._detection._reduction
        found, left = r.count[FOUND], r.count[LEFT]
        if self._state.to_numpy()[found] != left:
            return False
        return np.array_equal(np.sort(self._kept.to_numpy()[:left]), np.sort(r.kept.to_numpy()[:left]))

    def release(self) -> None:
        """Give the memory back."""
        self._arena.release()
