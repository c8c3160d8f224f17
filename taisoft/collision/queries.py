"""Queries for the triangles near a corner of a triangle or near the whole triangle, by tree traversal or in broad-phase rows.

The box swept by a corner during the step, padded by half the reach, is compared with the padded boxes of the triangles. This box
is small: few of the triangles near its triangle are near the corner, and the list is needed only while one query is processed.
"""

import taichi as ti

from taisoft.collision.bvh import nodes_below, slabs_of
from taisoft.collision.candidates import sort_row
from taisoft.collision.surface import may_touch

EDGES, WHOLE = 3, 4  # queries for a whole triangle instead of a corner: triangles with matching edges, and all triangles near it


@ti.func
def _box_of(s: ti.template(), t, q, padding):
    """Box of corner q of triangle t, or of all of t, at both ends of the step, padded by `padding` [m]."""
    lo, hi = s.lo[t], s.hi[t]
    if q < 3 and lo[0] <= hi[0]:
        i = s.triangle[t, q]
        a, b = s.x[i], s.x[i] + s.move[i]
        lo, hi = ti.min(a, b) - padding, ti.max(a, b) + padding
    return lo, hi


@ti.func
def query_box(s: ti.template(), near: ti.template(), t, q, padding):
    """Query bounds for `list_triangles`: slabs of a k-DOP for trees, a box for rows. padding: half the reach [m]."""
    if ti.static(near.walked):
        return slabs_of(s, near, t, q, padding)
    else:
        return _box_of(s, t, q, padding)


@ti.func
def _is_candidate(s: ti.template(), sharp: ti.template(), t, q, u):
    """1 if t may touch triangle u and, if q is EDGES, their edges may cross. t has a sharp edge in that case; if both have one,
    only t < u is accepted."""
    accepted = 1
    if q == EDGES:
        accepted = int(sharp[u] != 0) & int(u > t or sharp[u] & 7 == 0)
    if accepted == 1 and s.body[t] == s.body[u]:
        accepted = may_touch(s, t, u)
    return accepted


@ti.func
def _walk_tree(s: ti.template(), b: ti.template(), sharp: ti.template(), other, t, q, lo, hi, entry: ti.template(), begin, last):
    """Append the leaves of collider `other` whose slabs overlap the query's. Return the index after the last one."""
    at, node = begin, b.root[other]
    end = node + nodes_below(b, node)
    while node < end:
        size = b.link[node]
        step = ti.max(size, 1)
        if (lo <= b.hi[node]).all() and (b.lo[node] <= hi).all():
            step = 1  # to the first child, or past the leaf
            if size < 0:
                if _is_candidate(s, sharp, t, q, -1 - size) == 1:
                    if at < last:
                        entry[at] = -1 - size
                    at += 1
        node += step
    return at


@ti.func
def _filter_row(s: ti.template(), c: ti.template(), sharp: ti.template(), other, t, q, lo, hi, entry: ti.template(), begin, last):
    """Append the triangles of collider `other` in the row of t that meet the box. Return the index after the last one."""
    at = begin
    for e in range(c.start[t], c.end[t]):
        u = c.entry[e]
        if s.body[u] == other:
            if _is_candidate(s, sharp, t, q, u) == 1:
                if (lo <= s.hi[u]).all() and (s.lo[u] <= hi).all():
                    if at < last:
                        entry[at] = u
                    at += 1
    return at


@ti.func
def list_triangles(
    s: ti.template(), near: ti.template(), sharp: ti.template(), other, t, q, lo, hi, entry: ti.template(), begin, last
):
    """List the triangles of collider `other` near corner q of triangle t, or near all of t if q is EDGES or WHOLE.

    near: trees or rows; sharp: of `mark_sharp_edges`; lo, hi: of `query_box`. They are written to entry[begin:last] in ascending
    order. Return their number, which may be more than fit.
    """
    at = begin
    if ti.static(near.walked):
        at = _walk_tree(s, near, sharp, other, t, q, lo, hi, entry, begin, last)
        if at <= last:
            sort_row(entry, begin, at)
    else:
        at = _filter_row(s, near, sharp, other, t, q, lo, hi, entry, begin, last)
    return at - begin
