"""What lies near a corner of a triangle, or near the whole of it: found by a walk down a tree, or in the rows of a broad phase.

A corner's way during the step, grown by half the reach, is held against the grown boxes of the triangles. This is a small box:
of the triangles near its triangle, few are near it, and none must be stored for longer than it is looked at.
"""

import taichi as ti

from taisoft.collision.bvh import nodes_below, slabs_of
from taisoft.collision.candidates import sort_row
from taisoft.collision.surface import may_touch

EDGES, WHOLE = 3, 4  # in place of a corner's number: what has edges that those of a triangle may meet, and all that is near


@ti.func
def _box_of(s: ti.template(), t, q, half):
    """Corner q of triangle t at both ends of the step, or all of t, grown by half [m]: a box."""
    lo, hi = s.lo[t], s.hi[t]
    if q < 3 and lo[0] <= hi[0]:
        i = s.triangle[t, q]
        a, b = s.x[i], s.x[i] + s.move[i]
        lo, hi = ti.min(a, b) - half, ti.max(a, b) + half
    return lo, hi


@ti.func
def query_box(s: ti.template(), near: ti.template(), t, q, half):
    """What `list_triangles` asks for: as many slabs as trees have, a box for rows. half: of the reach [m]."""
    if ti.static(near.walked):
        return slabs_of(s, near, t, q, half)
    else:
        return _box_of(s, t, q, half)


@ti.func
def _is_wanted(s: ti.template(), sharp: ti.template(), t, q, u):
    """1 where t may touch triangle u, and where q is EDGES their edges may meet. t has a sharp edge then; of two that both have
    one, the first finds the other."""
    wanted = 1
    if q == EDGES:
        wanted = int(sharp[u] != 0) & int(u > t or sharp[u] & 7 == 0)
    if wanted == 1 and s.body[t] == s.body[u]:
        wanted = may_touch(s, t, u)
    return wanted


@ti.func
def _walk(s: ti.template(), b: ti.template(), sharp: ti.template(), other, t, q, lo, hi, entry: ti.template(), begin, last):
    """Append the leaves below the root of collider `other` that meet the slabs; returns where the next one goes."""
    at, node = begin, b.root[other]
    end = node + nodes_below(b, node)
    while node < end:
        below = b.link[node]
        step = ti.max(below, 1)
        if (lo <= b.hi[node]).all() and (b.lo[node] <= hi).all():
            step = 1  # to the first child, or past the leaf
            if below < 0:
                if _is_wanted(s, sharp, t, q, -1 - below) == 1:
                    if at < last:
                        entry[at] = -1 - below
                    at += 1
        node += step
    return at


@ti.func
def _pick(s: ti.template(), c: ti.template(), sharp: ti.template(), other, t, q, lo, hi, entry: ti.template(), begin, last):
    """Append the triangles of collider `other` in the row of t that meet the box; returns where the next one goes."""
    at = begin
    for e in range(c.start[t], c.end[t]):
        u = c.entry[e]
        if s.body[u] == other:
            if _is_wanted(s, sharp, t, q, u) == 1:
                if (lo <= s.hi[u]).all() and (s.lo[u] <= hi).all():
                    if at < last:
                        entry[at] = u
                    at += 1
    return at


@ti.func
def list_triangles(
    s: ti.template(), near: ti.template(), sharp: ti.template(), other, t, q, lo, hi, entry: ti.template(), begin, last
):
    """List the triangles of collider `other` near corner q of triangle t, or near all of it where q is EDGES or WHOLE.

    near: trees or rows; sharp: of `mark_sharp_edges`; lo, hi: of `query_box`. They go to entry[begin:last],
    ascending. Returns their number, which may be more than fit.
    """
    at = begin
    if ti.static(near.walked):
        at = _walk(s, near, sharp, other, t, q, lo, hi, entry, begin, last)
        if at <= last:
            sort_row(entry, begin, at)
    else:
        at = _pick(s, near, sharp, other, t, q, lo, hi, entry, begin, last)
    return at - begin
