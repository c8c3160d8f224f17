"""Candidates of either broad phase: for every triangle, the row of triangles whose boxes overlap its own.

Rows hold both directions of a pair and ascend, so that results do not depend on threads or on the order of cells or trees. A
buffer has one part of equal size per chunk of the work. If a part is too small, the search still counts to its end, the buffer
grows to the required size, and the search is repeated: a truncated list is never used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.surface import Surface
from taisoft.errors import SimulationError

SLACK = 1.5  # a full buffer grows to this times the required size
NEEDED, TOTAL = 0, 1  # indices into a buffer's count


@dataclass(frozen=True, eq=False)
class Candidates:
    """Row of triangle t: entry[start[t]:end[t]], the triangles that it may touch and whose boxes overlap its own, ascending."""

    start: Any  # (n_triangles) i32
    end: Any  # (n_triangles) i32
    entry: Any  # i32
    walked: bool = False  # queried by rows, unlike trees


class Buffer:
    """A field of entries in `chunks` equal parts that grows when one is too small.

    make(arena, capacity) allocates the data. count: (2) i32, entries needed by the largest part and by all parts together;
    used: (chunks) i32, entries of each part.
    """

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
        self._arena, self.data, self.part = arena, data, part

    @property
    def capacity(self) -> int:
        """Number of entries that fit."""
        return self.part * self.chunks

    @property
    def bytes(self) -> int:
        """Memory of the entries [bytes]."""
        return sum(self._arena.bytes.values())

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

    def clear(self) -> None:
        """Empty every part."""
        self.used.fill(0)

    def sum_up(self) -> None:
        """Set `count` from `used`."""
        sum_used(self.used, self.count, self.chunks)

    def release(self) -> None:
        """Free the memory."""
        self._arena.release()


def entries(arena: FieldArena, capacity: int):
    """Allocate a field of row entries."""
    return arena.field("entry", ti.i32, capacity)


def pairs(arena: FieldArena, capacity: int):
    """Allocate a field of pairs."""
    return arena.vectors("pair", ti.i32, capacity, n=2)


@ti.func
def sum_parts(used: ti.template(), count: ti.template(), chunks: ti.template()):
    """Set `count`: the entries of the largest part, and of all parts."""
    largest, total = 0, 0
    for c in range(chunks):
        largest = ti.max(largest, used[c])
        total += used[c]
    count[NEEDED] = largest
    count[TOTAL] = total


@kernel
def sum_used(used: ti.template(), count: ti.template(), chunks: ti.template()):
    """`sum_parts` as a kernel."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(used, count, chunks)


@ti.func
def sort_row(entry: ti.template(), first, last):
    """Sort entry[first:last] in place by Shell sort: rows are mostly short, but not always."""
    step = 1
    while step < (last - first) // 9:
        step = 3 * step + 1
    while step > 0:
        for i in range(first + step, last):
            value = entry[i]
            j = i - step
            shifting = 1
            while shifting == 1:
                if j >= first:
                    if entry[j] > value:
                        entry[j + step] = entry[j]
                        j -= step
                    else:
                        shifting = 0
                else:
                    shifting = 0
            entry[j + step] = value
        step //= 3


@kernel
def pair_rows(
    s: ti.template(),
    pair: ti.template(),
    used: ti.template(),
    part: ti.i32,
    chunks: ti.template(),
    serial: ti.template(),
    start: ti.template(),
    end: ti.template(),
    count: ti.template(),
):
    """Compute starts and lengths of the rows of pairs in both directions; count[NEEDED] is the sum of the lengths."""
    ti.loop_config(serialize=serial)
    for t in range(s.n_triangles):
        end[t] = 0
    ti.loop_config(serialize=serial)
    for task in range(chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            for k in range(c * part, c * part + used[c]):
                ti.atomic_add(end[pair[k][0]], 1)
                ti.atomic_add(end[pair[k][1]], 1)
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for t in range(s.n_triangles):
            start[t] = total
            total += end[t]
            end[t] = start[t]
        count[NEEDED] = total
        count[TOTAL] = total


@kernel
def fill_rows(
    s: ti.template(),
    pair: ti.template(),
    used: ti.template(),
    part: ti.i32,
    chunks: ti.template(),
    serial: ti.template(),
    start: ti.template(),
    end: ti.template(),
    entry: ti.template(),
):
    """Write both directions of every pair into its rows and sort them."""
    ti.loop_config(serialize=serial)
    for task in range(chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            for k in range(c * part, c * part + used[c]):
                a, b = pair[k][0], pair[k][1]
                entry[ti.atomic_add(end[a], 1)] = b
                entry[ti.atomic_add(end[b], 1)] = a
    ti.loop_config(serialize=serial)
    for t in range(s.n_triangles):
        sort_row(entry, start[t], end[t])


class PairRows:
    """Convert a buffer of pairs, each listed once, into rows."""

    def __init__(self, surface: Surface, arena: FieldArena, capacity: int, max_capacity: int | None):
        n = max(surface.n_triangles, 1)
        self.surface = surface
        self.start, self.end = arena.field("pair_rows_start", ti.i32, n), arena.field("pair_rows_end", ti.i32, n)
        self.rows = Buffer("candidate_rows", entries, capacity, max_capacity, 1, arena)

    def from_pairs(self, found: Buffer) -> Candidates:
        """Return rows of the pairs in a buffer, both directions, ascending."""
        s = self.surface
        arguments = (found.data, found.used, found.part, found.chunks, s.serial, self.start, self.end)
        pair_rows(s, *arguments, self.rows.count)
        self.rows.grow_if_full()
        fill_rows(s, *arguments, self.rows.data)
        return Candidates(self.start, self.end, self.rows.data)

    def release(self) -> None:
        """Free the memory."""
        self.rows.release()
