"""Buffers that grow, and candidates of a broad phase: for every triangle, the row of triangles whose boxes overlap its own.

Rows hold both directions of a pair and ascend, so that results do not depend on threads or on the order of cells or trees. A
buffer has one part of equal size per chunk of the work. If a part is too small, the search still counts to its end, the buffer
grows to the required size, and the search is repeated: a truncated list is never used.

The contact search does not read whole rows: it asks for the triangles near one corner, or near one triangle, by `bounds` and
`list_triangles`, which rows (`Candidates`) and trees (`taisoft.collision.bvh.Trees`) both have. The box swept by a corner during
the step, padded by half the reach, is small, and the list is needed only while one query is processed.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Array, Count, FieldArena, download
from taisoft.backend.lists import part_first
from taisoft.backend.reader import read_each
from taisoft.backend.runtime import kernel
from taisoft.collision.surface import ACTIVE, Surface, ivec, list_near, may_touch
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
        self.growths, self.total = 0, 0  # the latter: entries of all parts at the last look
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

    @property
    def counts(self) -> list[Array]:
        """What `grow_if_full` looks at."""
        return [self.count]

    def grow_if_full(self, counts: list[list[int]] | None = None) -> bool:
        """Grow if the last search did not fit. Return True if it has grown, so that the search must be repeated.

        counts: the numbers of `counts`, None to read them. Raise SimulationError if max_capacity does not allow it.
        """
        ((needed, self.total),) = counts or read_each([self.count])
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


def fill(
    search: Callable[[], None],
    *buffers: Buffer,
    read: Callable[[list[Array]], list[list]] = read_each,
    also: Callable[[], list[Array]] = list,
) -> list[list]:
    """Run a search, again and again until all that it finds fits into its buffers.

    read: of small arrays; also: further ones that the search sets. Return the numbers of these.
    """
    while True:
        search()
        counts = [buffer.counts for buffer in buffers]
        found = iter(read([*itertools.chain(*counts), *also()]))
        if not sum([buffer.grow_if_full([next(found) for _ in own]) for buffer, own in zip(buffers, counts)]):  # each of them
            return list(found)


@ti.func
def sum_parts(team: ti.template(), parts: ti.template()):
    """Set `count` of a buffer: the entries of the largest part, and of all parts. A top-level loop of a kernel."""
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        largest, total = 0, 0
        for j in range(team.share(t, parts.chunks)):
            used = parts.used[team.entry(t, j, parts.chunks)]
            largest = ti.max(largest, used)
            total += used
        _, total = team.count(t, total)
        largest = ti.cast(team.largest(t, ti.cast(largest, ti.f64)), ti.i32)
        if t == 0:
            parts.count[NEEDED] = largest
            parts.count[TOTAL] = total


@ti.func
def is_candidate(s: ti.template(), t, q, u):
    """1 if t may touch triangle u and, if q is EDGES, their edges may cross. t has a sharp edge in that case; if both have one,
    only t < u is accepted, as of two triangles of one collider if q is WHOLE."""
    accepted = 1
    if q == EDGES:
        accepted = int(s.sharp[u] != 0) & int(u > t or s.sharp[u] & 7 == 0)
    if s.body[t] == s.body[u]:
        accepted &= may_touch(s, t, u) & int(q != WHOLE or u > t)
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


@dataclass(frozen=True, eq=False)
class Visitor:
    """What `visit_near` asks of the active triangles, and what it does with the triangles that it finds.

    Each of the queries from first_query to last_query - 1 (corners, EDGES or WHOLE) is asked of each triangle that `asks`
    accepts, for each near collider that `meets` accepts: by default each pair of triangles once, by its first triangle.
    visit(surface, t, q, entry, first, last, out, start, end) writes what query q of triangle t finds among entry[first:last], all
    of one collider, to out[start:end]. It returns the new start, which may be more than fits.
    """

    first_query, last_query = WHOLE, WHOLE + 1

    @ti.func
    def asks(self, surface: ti.template(), t, q):
        """Whether query q is asked of triangle t."""
        return 1

    @ti.func
    def meets(self, surface: ti.template(), own, other):
        """Whether triangles of collider `own` are tested against those of `other`."""
        return int(other >= own)


class Pairs(Visitor):
    """The pairs t < u of near triangles that `accepts` accepts, as (t, u, 0): in ascending order within each part and over the
    parts."""

    @ti.func
    def accepts(self, surface: ti.template(), t, u):
        """Whether a pair is written."""
        return 1

    @ti.func
    def visit(self, surface: ti.template(), t, q, entry: ti.template(), first, last, out: ti.template(), start, end):
        """See Visitor."""
        at = start
        for e in range(first, last):
            if entry[e] > t:
                if self.accepts(surface, t, entry[e]) == 1:
                    if at < end:
                        out[at] = ivec(t, entry[e], 0)
                    at += 1
        return at


@ti.func
def visit_near(
    surface: ti.template(), near: ti.template(), row: ti.template(), visitor: ti.template(), out: ti.template(), append
):
    """Visit the triangles near each active one. A top-level loop of a kernel; each chunk fills its own part of `out`.

    near: trees or rows of a broad phase; row: buffer of the triangles near one query; append: 1 if what the same search has found
    before is kept, else 0.
    """
    ti.loop_config(serialize=surface.serial)
    for task in range(surface.chunks * surface.spread):
        if task % surface.spread == 0:
            c, n = task // surface.spread, surface.count[ACTIVE]
            at, end, begin = c * out.part + append * out.used[c], (c + 1) * out.part, c * row.part
            own, n_near, max_row, n_pairs = -1, 0, append * row.used[c], append * surface.part[c]
            for j in range(part_first(c, n, surface.chunks), part_first(c + 1, n, surface.chunks)):
                t = surface.active[j]
                if surface.body[t] != own:
                    own = surface.body[t]
                    n_near = list_near(surface, c, own)
                for q in range(visitor.first_query, visitor.last_query):
                    if visitor.asks(surface, t, q) == 1:
                        lo, hi = near.bounds(surface, t, q, surface.padding[0])
                        for k in range(n_near):
                            other = surface.near[c * surface.n_bodies + k]
                            if visitor.meets(surface, own, other) == 1:
                                found = near.list_triangles(surface, other, t, q, lo, hi, row.data, begin, begin + row.part)
                                max_row, n_pairs = ti.max(max_row, found), n_pairs + found
                                if 0 < found <= row.part:
                                    at = visitor.visit(surface, t, q, row.data, begin, begin + found, out.data, at, end)
            out.used[c], row.used[c], surface.part[c] = at - c * out.part, max_row, n_pairs


@kernel(cse=False)
def list_pairs(surface: ti.template(), near: ti.template(), row: ti.template(), visitor: ti.template(), out: ti.template()):
    """Write the pairs of a visitor, see `visit_near`."""
    visit_near(surface, near, row, visitor, out, 0)
    sum_parts(surface.team, out)
    sum_parts(surface.team, row)


def pair_entries(arena: FieldArena, capacity: int):
    """Allocate a field of entries for `list_pairs`."""
    return arena.vectors("pair", ti.i32, capacity)


def pairs_of(surface: Surface, near: Any, row: Buffer, visitor: Pairs, out: Buffer) -> np.ndarray:
    """Return the pairs (k,2) of a visitor, ascending. Raise SimulationError if a buffer would outgrow its limit."""
    fill(lambda: list_pairs(surface, near, row.parts, visitor, out.parts), row, out)
    data, used = download([out.data, out.used])
    return data[out.filled(used)][:, :2]
