"""Contact reduction: merge contacts of one pair of bodies that are within a tolerance, with one normal (report, section 3.1.3).

In the order of kind, feature and position in the buffer, a contact is kept unless an earlier kept one is within the tolerance:
the result of two nested loops. Here each contact is compared only with those in the cells around it, so the cost is linear. Cells
hash into buckets. A cell is wider than twice the tolerance, and every cell within the tolerance is searched, so the result does
not depend on the placement of the cells. Rounds are repeated until all contacts are decided: a contact is kept once all its
earlier neighbours are dropped, and dropped once an earlier neighbour is kept.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.contacts import ContactFields
from taisoft.collision.surface import ivec

SAME_NORMAL = 0.996  # cosine of 5 degrees
UNKNOWN, KEPT, DROPPED = 0, 1, 2
FOUND, LEFT, UNDECIDED, MASK = 0, 1, 2, 3  # indices into the count; LEFT: kept contacts; MASK: buckets in use, minus one


@dataclass(frozen=True, eq=False)
class ReductionFields:
    """Workspace. The first count[LEFT] entries of `kept` are the kept contacts' indices in the buffer, ascending."""

    buckets: Count  # a power of two; the number in use grows with the number of contacts
    chunks: int
    serial: bool
    spread: int  # as of the surface
    place: Any  # (capacity) i32: buffer index of the i-th contact found
    bucket: Any  # (capacity) i32: bucket of the i-th contact
    bucket_start: Any  # (buckets) i32: range of its entries in `member`
    bucket_end: Any
    member: Any  # (capacity) i32: buffer indices, by bucket
    state: Any  # (capacity) i32: state of the contact at each buffer index
    kept: Any  # (capacity) i32
    count: Any  # (4) i32
    first: Any  # (chunks) i32: number of the first contact of each part


def reduction_fields(arena: FieldArena, capacity: int, chunks: int, serial: bool, spread: int = 1) -> ReductionFields:
    """Allocate the workspace for `capacity` contacts in `chunks` parts."""
    buckets = 1 << max(capacity - 1, 63).bit_length()

    def ints(name: str, n: int):
        return arena.field(f"reduction_{name}", ti.i32, n)

    return ReductionFields(
        buckets,
        chunks,
        serial,
        spread,
        ints("place", capacity),
        ints("bucket", capacity),
        ints("bucket_start", buckets),
        ints("bucket_end", buckets),
        ints("member", capacity),
        ints("state", capacity),
        ints("kept", capacity),
        ints("count", 4),
        ints("first", chunks),
    )


@ti.func
def _cell(p, inverse):
    """Cell of a point, wrapped to small indices."""
    cell = ivec(0)
    for q in ti.static(range(3)):
        k = ti.floor(p[q] * inverse)
        cell[q] = ti.cast(k - 1048576.0 * ti.floor(k / 1048576.0), ti.i32)
    return cell


@ti.func
def _bucket(r: ti.template(), cell):
    x, y, z = ti.cast(cell[0], ti.i64), ti.cast(cell[1], ti.i64), ti.cast(cell[2], ti.i64)
    h = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)  # Teschner et al. 2003
    return ti.cast((h ^ (h >> 15)) & r.count[MASK], ti.i32)


@ti.func
def _fill_cells(r: ti.template(), out: ti.template(), used: ti.template(), part, inverse):
    """Number the contacts over all parts and enter them into the cells."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for k in range(r.chunks):
            r.first[k] = total
            total += used[k]
        r.count[FOUND] = total
        mask = 63
        while mask + 1 < total:
            mask = 2 * mask + 1
        r.count[MASK] = mask
    ti.loop_config(serialize=r.serial)
    for b in range(r.count[MASK] + 1):
        r.bucket_end[b] = 0
    ti.loop_config(serialize=r.serial)
    for task in range(r.chunks * r.spread):
        if task % r.spread == 0:
            c = task // r.spread
            for k in range(used[c]):
                i, at = r.first[c] + k, c * part + k
                r.place[i] = at
                r.state[at] = UNKNOWN
                b = _bucket(r, _cell(out.point[at], inverse))
                r.bucket[i] = b
                ti.atomic_add(r.bucket_end[b], 1)
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = 0
        for b in range(r.count[MASK] + 1):
            r.bucket_start[b] = total
            total += r.bucket_end[b]
            r.bucket_end[b] = r.bucket_start[b]
    ti.loop_config(serialize=r.serial)
    for i in range(r.count[FOUND]):
        r.member[ti.atomic_add(r.bucket_end[r.bucket[i]], 1)] = r.place[i]


@ti.func
def is_same(out: ti.template(), a, b, tolerance):
    """Whether the contacts at a and b are to be merged."""
    result = False
    if (out.body[a] == out.body[b]).all():
        d = out.point[a] - out.point[b]
        result = d.dot(d) <= tolerance * tolerance and out.normal[a].dot(out.normal[b]) >= ti.cast(SAME_NORMAL, ti.f64)
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
def _decide(r: ti.template(), out: ti.template(), at, inverse, tolerance):
    """State of the contact at a buffer index, from the states of the earlier ones near it."""
    p = out.point[at]
    lo, hi = _cell(p - tolerance, inverse), _cell(p + tolerance, inverse)
    n = ti.select(lo == hi, 1, 2)
    state = KEPT
    k = 0
    while state != DROPPED and k < n[0] * n[1] * n[2]:
        z, y, x = k % n[2], (k // n[2]) % n[1], k // (n[2] * n[1])
        cell = ivec(ti.select(x == 0, lo[0], hi[0]), ti.select(y == 0, lo[1], hi[1]), ti.select(z == 0, lo[2], hi[2]))
        b = _bucket(r, cell)
        for m in range(r.bucket_start[b], r.bucket_end[b]):
            other = r.member[m]
            d = p - out.point[other]
            if d.dot(d) <= tolerance * tolerance:  # this test rejects most
                if is_earlier(out, other, at) == 1:
                    other_state = r.state[other]
                    if other_state != DROPPED and is_same(out, at, other, tolerance):
                        if other_state == KEPT:
                            state = DROPPED
                        elif state == KEPT:
                            state = UNKNOWN
        k += 1
    return state


@ti.func
def _decide_all(r: ti.template(), out: ti.template(), inverse, tolerance):
    """Run one round: decide every contact that can be decided."""
    r.count[UNDECIDED] = 0
    ti.loop_config(serialize=r.serial)
    for i in range(r.count[FOUND]):
        at = r.place[i]
        if r.state[at] == UNKNOWN:
            state = _decide(r, out, at, inverse, tolerance)
            if state == UNKNOWN:
                ti.atomic_add(r.count[UNDECIDED], 1)
            else:
                r.state[at] = state


@ti.func
def _list_kept(r: ti.template()):
    """List the kept contacts in order, once all are decided."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        n = 0
        if r.count[UNDECIDED] == 0:
            for i in range(r.count[FOUND]):
                if r.state[r.place[i]] == KEPT:
                    r.kept[n] = r.place[i]
                    n += 1
        r.count[LEFT] = n


@kernel
def begin_reduction(r: ti.template(), out: ti.template(), used: ti.template(), part: ti.i32, inverse: ti.f64, tolerance: ti.f64):
    """Enter the contacts into the cells and run the first round; more are needed only while contacts are undecided."""
    _fill_cells(r, out, used, part, inverse)
    _decide_all(r, out, inverse, tolerance)
    _list_kept(r)


@kernel
def decide(r: ti.template(), out: ti.template(), inverse: ti.f64, tolerance: ti.f64):
    """Run a further round."""
    _decide_all(r, out, inverse, tolerance)
    _list_kept(r)


def reduce_contacts(r: ReductionFields, out: ContactFields, used: Any, part: int, tolerance: float, cell: float) -> None:
    """Fill r.kept and r.count. tolerance [m]; cell: edge of the cells [m], at least 2.5 times the tolerance."""
    inverse = 1.0 / max(cell, 2.5 * tolerance)
    begin_reduction(r, out, used, part, inverse, tolerance)
    while r.count[UNDECIDED] > 0:
        decide(r, out, inverse, tolerance)
