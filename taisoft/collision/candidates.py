"""Candidates: for every triangle the others whose boxes it meets, as rows, whichever broad phase found them.

Rows hold both directions of a pair and ascend, so that what is done with them does not depend on threads, and on neither
the order of the cells nor that of the tree. Buffers are parts of equal size, one for each part of the work; a part
that is too small is counted to its end, the buffer grows to what was needed, and the search is done again: a list that was
cut short is never used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.collision.surface import Surface
from taisoft.errors import SimulationError
from taisoft.fields import FieldArena
from taisoft.runtime import kernel

SLACK = 1.5  # a buffer grows to this times what was needed
NEEDED, TOTAL = 0, 1  # places in a buffer's count


@dataclass(frozen=True, eq=False)
class Candidates:
    """Row of triangle t: entry[start[t]:end[t]], the triangles that it may touch and whose boxes overlap its own, ascending."""

    start: Any  # (n_triangles) i32
    end: Any  # (n_triangles) i32
    entry: Any  # i32
    walked: bool = False  # unlike trees


class Buffer:
    """A field of entries in `chunks` equal parts that grows when one was too small.

    make(arena, capacity) allocates what is kept in it. count: (2) i32, what the largest part needed, and all parts together;
    used: (chunks) i32, entries of each part.
    """

    def __init__(self, name: str, make: Callable, capacity: int, most: int | None, chunks: int, arena: FieldArena):
        self.name, self._make, self.most, self.chunks = name, make, most, chunks
        self.count = arena.field(f"{name}_count", ti.i32, 2)
        self.used = arena.field(f"{name}_used", ti.i32, chunks)
        self.growths = 0
        self._arena: FieldArena | None = None
        self._allocate(capacity)

    def _allocate(self, capacity: int) -> None:
        part = max(-(-capacity // self.chunks), 1)
        if self.most is not None:
            part = max(min(part, self.most // self.chunks), 1)
        arena = FieldArena()
        data = self._make(arena, part * self.chunks)  # may fail for want of memory: what was there then stays
        if self._arena is not None:
            self._arena.release()
        self._arena, self.data, self.part = arena, data, part

    @property
    def capacity(self) -> int:
        """Entries that fit."""
        return self.part * self.chunks

    @property
    def bytes(self) -> int:
        """Memory of the entries."""
        return sum(self._arena.bytes.values())

    def grow_if_full(self) -> bool:
        """Grow where the last search did not fit; True where it has grown, so that the search must be done again.

        Raises SimulationError where it may not grow that far.
        """
        needed = self.count[NEEDED]
        if needed <= self.part:
            return False
        wanted = needed * self.chunks
        if self.most is not None and wanted > self.most:
            raise SimulationError(
                f"{self.name}: {wanted} entries are needed ({self.chunks} parts of {needed}), and max_capacity allows {self.most}"
            )
        self.growths += 1
        self._allocate(int(SLACK * wanted))
        return True

    def clear(self) -> None:
        """Empty every part."""
        self.used.fill(0)

    def sum_up(self) -> None:
        """Set `count` from `used`."""
        sum_used(self.used, self.count, self.chunks)

    def release(self) -> None:
        """Give the memory back."""
        self._arena.release()


def entries(arena: FieldArena, capacity: int):
    """A field of row entries."""
    return arena.field("entry", ti.i32, capacity)


def pairs(arena: FieldArena, capacity: int):
    """A field of pairs."""
    return arena.vectors("pair", ti.i32, capacity, n=2)


@ti.func
def sum_parts(used: ti.template(), count: ti.template(), chunks: ti.template()):
    """What the largest part needed, and all of them."""
    most, total = 0, 0
    for c in range(chunks):
        most = ti.max(most, used[c])
        total += used[c]
    count[NEEDED] = most
    count[TOTAL] = total


@kernel
def sum_used(used: ti.template(), count: ti.template(), chunks: ti.template()):
    """`sum_parts` on its own."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(used, count, chunks)


@ti.func
def sort_row(entry: ti.template(), first, last):
    """Sort entry[first:last] in place (Shell's sort: rows are short mostly, but not always)."""
    step = 1
    while step < (last - first) // 9:
        step = 3 * step + 1
    while step > 0:
        for i in range(first + step, last):
            value = entry[i]
            j = i - step
            going = 1
            while going == 1:
                if j >= first:
                    if entry[j] > value:
                        entry[j + step] = entry[j]
                        j -= step
                    else:
                        going = 0
                else:
                    going = 0
            entry[j + step] = value
        step //= 3


@kernel
def pair_rows(
    s: ti.template(), pair: ti.template(), used: ti.template(), part: ti.i32, chunks: ti.template(), serial: ti.template(),
    start: ti.template(), end: ti.template(), count: ti.template(),
):  # fmt: skip
    """Lengths and places of the rows that pairs give in both directions; count[NEEDED] is the sum of the lengths."""
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
    s: ti.template(), pair: ti.template(), used: ti.template(), part: ti.i32, chunks: ti.template(), serial: ti.template(),
    start: ti.template(), end: ti.template(), entry: ti.template(),
):  # fmt: skip
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
    """Turns a buffer of pairs, each once, into rows."""

    def __init__(self, surface: Surface, arena: FieldArena, capacity: int, most: int | None):
        n = max(surface.n_triangles, 1)
        self.surface = surface
        self.start, self.end = arena.field("pair_rows_start", ti.i32, n), arena.field("pair_rows_end", ti.i32, n)
        self.rows = Buffer("candidate_rows", entries, capacity, most, 1, arena)

    def from_pairs(self, found: Buffer) -> Candidates:
        """Rows of the pairs in a buffer, both directions, ascending."""
        s = self.surface
        where = (found.data, found.used, found.part, found.chunks, s.serial, self.start, self.end)
        pair_rows(s, *where, self.rows.count)
        self.rows.grow_if_full()
        fill_rows(s, *where, self.rows.data)
        return Candidates(self.start, self.end, self.rows.data)

    def release(self) -> None:
        """Give the memory back."""
        self.rows.release()
