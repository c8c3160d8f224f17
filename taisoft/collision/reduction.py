"""Reduction of contacts: those that are near each other are merged into one.

Merged are contacts of one pair of bodies that are within a tolerance, with one normal (report, section 3.1.3). In the
order of kind, feature and position in the buffer, a contact is kept unless an earlier kept one is within the tolerance: the
result of two nested loops. Here each contact is compared only with those in the cells around it, so the cost is linear. Cells
hash into buckets. A cell is wider than twice the tolerance, and every cell within the tolerance is searched, so the result does
not depend on the placement of the cells. Rounds are repeated until all contacts are decided: a contact is kept once all its
earlier neighbours are dropped, and dropped once an earlier neighbour is kept.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.lists import (
    Lists,
    add_up_counts,
    bucket_of,
    clear_counts,
    count_entry,
    make_lists,
    part_first,
    place_of_entry,
    sum_before,
)
from taisoft.backend.runtime import kernel
from taisoft.backend.team import Team, make_team
from taisoft.collision.candidates import NEEDED, TOTAL, Buffer
from taisoft.collision.contacts import EDGE_EDGE, FACE_FACE, MORTAR, VERTEX_FACE
from taisoft.collision.surface import Surface, cell_of, ivec

SAME_NORMAL = 0.996  # cosine of 5 degrees
UNKNOWN, KEPT, DROPPED = 0, 1, 2
PERIOD = (2**20,) * 3  # cells along each axis after which their indices repeat
FOUND, LEFT, UNDECIDED, MASK = 0, 1, 2, 3  # indices into the count; LEFT: kept contacts; MASK: buckets in use, minus one


@dataclass(frozen=True, eq=False)
class ReductionFields:
    """Workspace of the reduction. The first count[LEFT] entries of `kept` are the kept contacts' buffer indices, ascending."""

    serial: bool
    spread: int  # as of the surface
    place: Any  # (capacity) i32: buffer index of the i-th contact found
    bucket: Any  # (capacity) i32: bucket of the i-th contact
    team: Team
    lists: Lists  # of the buckets, in `member`
    member: Any  # (capacity) i32: buffer indices, by bucket
    state: Any  # (capacity) i32: state of the contact at each buffer index
    kept: Any  # (capacity) i32
    count: Any  # (4) i32

    @ti.func
    def n_kept(self):
        """Number of kept contacts."""
        return self.count[LEFT]


def reduction_fields(arena: FieldArena, capacity: int, serial: bool, spread: int = 1) -> ReductionFields:
    """Allocate the workspace for `capacity` contacts."""
    buckets = 1 << max(capacity - 1, 63).bit_length()  # the number in use grows with the number of contacts
    sizes = dict.fromkeys(("place", "bucket", "member", "state", "kept"), capacity) | {"count": 4}
    fields = {name: arena.field(f"reduction_{name}", ti.i32, size) for name, size in sizes.items()}
    team, lists = make_team(arena, "reduction"), make_lists(arena, "reduction", buckets, serial)
    return ReductionFields(serial, spread, team=team, lists=lists, **fields)


@ti.func
def _bucket(work: ti.template(), cell):
    return bucket_of(cell[0], cell[1], cell[2], work.count[MASK])


@ti.func
def _fill_cells(work: ti.template(), out: ti.template(), inverse, lowest_gap):
    """Number the contacts over all parts, drop those between surfaces whose gap is lower, and enter the others into the cells."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        found, mask = out.count[TOTAL], 63
        if out.count[NEEDED] > out.part:  # a truncated list is never used
            found = 0
        while mask + 1 < found:
            mask = 2 * mask + 1
        work.count[FOUND], work.count[MASK] = found, mask
    clear_counts(work.lists, work.count[MASK] + 1)
    ti.loop_config(serialize=work.serial)
    for task in range(out.chunks * work.spread):
        if task % work.spread == 0 and work.count[FOUND] > 0:
            c = task // work.spread
            first = sum_before(out.used, c)
            for k in range(out.used[c]):
                i, at = first + k, c * out.part + k
                work.place[i] = at
                by_surfaces = out.data.feature[at][0] == VERTEX_FACE or out.data.feature[at][0] == EDGE_EDGE
                work.state[at] = ti.select(by_surfaces and out.data.gap[at] < lowest_gap, DROPPED, UNKNOWN)
                work.bucket[i] = _bucket(work, cell_of(out.data.point[at], inverse, PERIOD))
                count_entry(work.lists, work.bucket[i])
    add_up_counts(work.lists, work.count[MASK] + 1)
    ti.loop_config(serialize=work.serial)
    for i in range(work.count[FOUND]):
        work.member[place_of_entry(work.lists, work.bucket[i])] = work.place[i]


@ti.func
def is_same(out: ti.template(), a, b, tolerance):
    """Whether the contacts at a and b are to be merged."""
    result = False
    if (out.body[a] == out.body[b]).all():
        d = out.point[a] - out.point[b]
        result = d.dot(d) <= tolerance * tolerance and out.normal[a].dot(out.normal[b]) >= ti.cast(SAME_NORMAL, ti.f64)
        # a passage that was found in spite of another contact must not be lost to that one, nor a mean over surfaces to a point
        for k in ti.static((FACE_FACE, MORTAR)):
            result = result and out.feature[a][0] != k and out.feature[b][0] != k
    return result


@ti.func
def is_earlier(out: ti.template(), a, b):
    """1 if the contact at a precedes that at b: by kind, exact ones first, then by feature, then by buffer index."""
    result = int(a < b)
    for q in ti.static((2, 1, 0)):
        if out.feature[a][q] != out.feature[b][q]:
            result = int(out.feature[a][q] < out.feature[b][q])
    return result


@ti.func
def _decide(work: ti.template(), out: ti.template(), at, inverse, tolerance):
    """State of the contact at a buffer index, from the states of the earlier ones near it."""
    p = out.point[at]
    lo, hi = cell_of(p - tolerance, inverse, PERIOD), cell_of(p + tolerance, inverse, PERIOD)
    n = ti.select(lo == hi, 1, 2)
    state = KEPT
    k = 0
    while state != DROPPED and k < n[0] * n[1] * n[2]:
        z, y, x = k % n[2], (k // n[2]) % n[1], k // (n[2] * n[1])
        cell = ivec(ti.select(x == 0, lo[0], hi[0]), ti.select(y == 0, lo[1], hi[1]), ti.select(z == 0, lo[2], hi[2]))
        b = _bucket(work, cell)
        for m in range(work.lists.start[b], work.lists.start[b + 1]):
            other = work.member[m]
            d = p - out.point[other]
            if d.dot(d) <= tolerance * tolerance:  # this test rejects most
                if is_earlier(out, other, at) == 1:
                    other_state = work.state[other]
                    if other_state != DROPPED and is_same(out, at, other, tolerance):
                        if other_state == KEPT:
                            state = DROPPED
                        elif state == KEPT:
                            state = UNKNOWN
        k += 1
    return state


@ti.func
def _try(work: ti.template(), out: ti.template(), at, inverse, tolerance):
    """Decide the contact at a buffer index, if it is undecided and can be decided. Return 1 if it stays undecided."""
    undecided = 0
    if work.state[at] == UNKNOWN:
        state = _decide(work, out, at, inverse, tolerance)
        if state == UNKNOWN:
            undecided = 1
        else:
            work.state[at] = state
    return undecided


@ti.func
def _decide_rest(work: ti.template(), out: ti.template(), inverse, tolerance, t):
    """Run further rounds until all contacts are decided, by all threads t of the team."""
    (team,) = ti.static((work.team,))
    n, left = work.count[FOUND], ti.cast(work.count[UNDECIDED], ti.f64)
    while left > 0.0:
        left = 0.0
        for j in range(team.share(t, n)):
            left += ti.cast(_try(work, out, work.place[team.entry(t, j, n)], inverse, tolerance), ti.f64)
        left = team.total(t, left)
    if t == 0:
        work.count[UNDECIDED] = 0


@ti.func
def _list_kept(work: ti.template(), t):
    """List the kept contacts in order, by all threads t of the team."""
    threads = ti.static(work.team.threads)
    first, last, n = part_first(t, work.count[FOUND], threads), part_first(t + 1, work.count[FOUND], threads), 0
    if ti.static(not work.team.alone):
        for i in range(first, last):
            n += int(work.state[work.place[i]] == KEPT)
        n, _total = work.team.count(t, n)
    for i in range(first, last):
        if work.state[work.place[i]] == KEPT:
            work.kept[n] = work.place[i]
            n += 1
    if t == threads - 1:
        work.count[LEFT] = n


@ti.func
def reduce_all(work: ti.template(), out: ti.template(), inverse, tolerance, lowest_gap):
    """Enter the contacts into the cells, decide which are kept, and list these, as top-level loops of a kernel.

    inverse: of the cells' edge [1/m]; tolerance, lowest_gap [m].
    """
    _fill_cells(work, out, inverse, lowest_gap)
    work.count[UNDECIDED] = 0
    ti.loop_config(serialize=work.serial)
    for i in range(work.count[FOUND]):
        if _try(work, out.data, work.place[i], inverse, tolerance) == 1:
            ti.atomic_add(work.count[UNDECIDED], 1)
    ti.loop_config(serialize=work.team.alone, block_dim=work.team.threads)
    for t in range(work.team.threads):
        _decide_rest(work, out.data, inverse, tolerance, t)
        _list_kept(work, t)


@kernel
def run_reduction(work: ti.template(), out: ti.template(), inverse: ti.f64, tolerance: ti.f64, lowest_gap: ti.f64):
    """Fill work.kept and work.count for a buffer of contacts, see `reduce_all`."""
    reduce_all(work, out, inverse, tolerance, lowest_gap)


def inverse_cell(tolerance: float, cell: float) -> float:
    """Inverse of the edge of the cells [1/m], which is at least 2.5 tolerances."""
    return 1.0 / max(cell, 2.5 * tolerance)


class Reduction:
    """The reduction of one buffer of contacts, whose workspace grows with it. tolerance [m]; cell [m]: edge of the cells."""

    n_found = n_kept = 0  # contacts before and after it

    def __init__(self, surface: Surface, buffer: Buffer, tolerance: float, cell: float):
        self._surface, self._buffer, self._lengths = surface, buffer, (tolerance, cell)
        self._arena, self.work = FieldArena(), None

    def launch(self, lowest_gap: float) -> None:
        """Reduce the contacts in the buffer, if they fit. lowest_gap [m]: of surfaces that do not cross."""
        run_reduction(self.prepare(), self._buffer.parts, *self.scales, lowest_gap)

    @property
    def scales(self) -> tuple[float, float]:
        """Inverse edge of the cells [1/m] and tolerance [m], for kernels."""
        tolerance, cell = self._lengths
        return inverse_cell(tolerance, cell), tolerance

    def prepare(self) -> ReductionFields:
        """Return the workspace, with room for all contacts that fit into the buffer."""
        surface, buffer = self._surface, self._buffer
        if self.work is None or self.work.place.shape[0] != buffer.capacity:
            arena = FieldArena()
            self.work = reduction_fields(arena, buffer.capacity, surface.serial_cheap, surface.cheap_spread)
            self._arena.release()
            self._arena = arena
        return self.work

    def read(self, count: list[int]) -> None:
        """Take the numbers of contacts from the workspace's count."""
        self.n_found, self.n_kept = count[:2]

    @property
    def bytes(self) -> dict[str, int]:
        """Bytes of the workspace by name."""
        return self._arena.bytes

    def release(self) -> None:
        """Free the memory."""
        self._arena.release()
