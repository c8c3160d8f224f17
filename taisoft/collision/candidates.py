"""Buffers that grow, and candidates of a broad phase: for every triangle, the row of triangles whose boxes overlap its own.

Rows hold both directions of a pair and ascend, so that results do not depend on threads or on the order of cells or trees. A
buffer has one part of equal size per chunk of the work. If a part is too small, the search still counts to its end, the buffer
grows to the required size, and the search is repeated: a truncated list is never used.

The contact search does not read whole rows: it asks for the triangles near one corner, or near one triangle, by `bounds` and
`list_triangles`, which rows (`Candidates`) and trees (`taisoft.collision.bvh.Trees`) both have. The box swept by a corner during
the step, padded by half the reach, is small, and the list is needed only while one query is processed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.collision.surface import may_touch
from taisoft.errors import SimulationError

SLACK = 1.5  # a full buffer grows to this times the required size
NEEDED, TOTAL = 0, 1  # indices into a buffer's count
EDGES, WHOLE = 3, 4  # queries for a whole triangle instead of a corner: triangles with matching edges, and all triangles near it


@dataclass(frozen=True, eq=False)
class Parts:
    """A buffer for kernels: part c holds the entries data[c * part : c * part + used[c]]."""

    data: Any  # an array, or a record of arrays
    used: Any  # (chunks) i32
    count: Any  # (2) i32: entries needed by the largest part, and by all parts together
    part: Count  # capacity of each part
    chunks: int


class Buffer:
    """A field of entries in `chunks` equal parts that grows when one is too small. make(arena, capacity) allocates the data."""

    def __init__(self, name: str, make: Callable, capacity: int, max_capacity: int | None, chunks: int, arena: FieldArena):
        self.name, self._make, self.max_capacity, self.chunks = name, make, max_capacity, chunks
        self.count = arena.field(f"{name}_count", ti.i32, 2)
        self.used = arena.field(f"{name}_used", ti.i32, chunks)
        self.growths = 0
        self._arena: FieldArena | None = None
        self._allocate(capacity)

    def _allocate(self, capacity: int) -> None:
        part = max(-(-capacity // self.chunks), 1)
        if self.max_capacity is not None:
            part = max(min(part, self.max_capacity // self.chunks), 1)
        arena = FieldArena()
        data = self._make(arena, part * self.chunks)  # if this runs out of memory, the old data stay
        if self._arena is not None:
            self._arena.release()
        self._arena, self.parts = arena, Parts(data, self.used, self.count, part, self.chunks)

    @property
    def data(self) -> Any:
        """The entries."""
        return self.parts.data

    @property
    def part(self) -> int:
        """Capacity of each part."""
        return self.parts.part

    @property
    def capacity(self) -> int:
        """Number of entries that fit."""
        return self.part * self.chunks

    @property
    def bytes(self) -> int:
        """Memory of the entries [bytes]."""
        return sum(self._arena.bytes.values())

    def filled(self, used: np.ndarray) -> np.ndarray:
        """Which entries the last search has filled, (capacity,) bool. used: downloaded, (chunks,)."""
        return np.arange(self.capacity) % self.part < np.repeat(used, self.part)

    def grow_if_full(self) -> bool:
        """Grow if the last search did not fit. Return True if it has grown, so that the search must be repeated.

        Raise SimulationError if max_capacity does not allow it.
        """
        needed = self.count[NEEDED]
        if needed <= self.part:
            return False
        required = needed * self.chunks
        if self.max_capacity is not None and required > self.max_capacity:
            raise SimulationError(
                f"{self.name}: {required} entries are needed ({self.chunks} parts of {needed}), "
                f"and max_capacity allows {self.max_capacity}"
            )
        self.growths += 1
        self._allocate(int(SLACK * required))
        return True

    def release(self) -> None:
        """Free the memory."""
        self._arena.release()


def entries(arena: FieldArena, capacity: int):
    """Allocate a field of row entries."""
    return arena.field("entry", ti.i32, capacity)


@ti.func
def sum_parts(p: ti.template()):
    """Set `count` of a buffer: the entries of the largest part, and of all parts."""
    largest, total = 0, 0
    for c in range(p.chunks):
        largest = ti.max(largest, p.used[c])
        total += p.used[c]
    p.count[NEEDED] = largest
    p.count[TOTAL] = total


@ti.func
def is_candidate(s: ti.template(), t, q, u):
    """1 if t may touch triangle u and, if q is EDGES, their edges may cross. t has a sharp edge in that case; if both have one,
    only t < u is accepted."""
    accepted = 1
    if q == EDGES:
        accepted = int(s.sharp[u] != 0) & int(u > t or s.sharp[u] & 7 == 0)
    if accepted == 1 and s.body[t] == s.body[u]:
        accepted = may_touch(s, t, u)
    return accepted


@dataclass(frozen=True, eq=False)
class Candidates:
    """Row of triangle t: entry[start[t]:end[t]], the triangles that it may touch and whose boxes overlap its own, ascending."""

    start: Any  # (n_triangles) i32
    end: Any  # (n_triangles) i32
    entry: Any  # i32

    @ti.func
    def bounds(self, s: ti.template(), t, q, padding):
        """Box of corner q of triangle t, or of all of t, at both ends of the step, padded by `padding`: half the reach [m]."""
        lo, hi = s.lo[t], s.hi[t]
        if q < 3 and lo[0] <= hi[0]:
            i = s.triangle[t, q]
            a, b = s.x[i], s.x[i] + s.move[i]
            lo, hi = ti.min(a, b) - padding, ti.max(a, b) + padding
        return lo, hi

    @ti.func
    def list_triangles(self, s: ti.template(), other, t, q, lo, hi, entry: ti.template(), begin, last):
        """List the triangles of collider `other` near corner q of triangle t, or near all of t if q is EDGES or WHOLE.

        lo, hi: of `bounds`. They are written to entry[begin:last] in ascending order. Return their number, which may be more
        than fit.
        """
        at = begin
        for e in range(self.start[t], self.end[t]):
            u = self.entry[e]
            if s.body[u] == other:
                if is_candidate(s, t, q, u) == 1:
                    if (lo <= s.hi[u]).all() and (s.lo[u] <= hi).all():
                        if at < last:
                            entry[at] = u
                        at += 1
        return at - begin
