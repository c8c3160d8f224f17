"""Contacts by proximity of deformed surfaces: vertices first (`vertex_face`), then edges (`edge_edge`)."""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.boxes import list_near, sum_pairs
from taisoft.collision.candidates import sum_parts
from taisoft.collision.edge_edge import edge_contact
from taisoft.collision.features import BY_FACES, mark_sharp_edges
from taisoft.collision.queries import EDGES, list_triangles, query_box
from taisoft.collision.surface import ACTIVE, part_first
from taisoft.collision.vertex_face import vertex_contacts


@ti.func
def can_cross(a, b):
    """1 if two edges can cross: one is sharp, the other sharp or flat. a, b: bits of `mark_sharp_edges`, shifted to the edge."""
    return ((a & (b >> 3)) | ((a >> 3) & b)) & 1


@ti.func
def _vertices(
    s: ti.template(),
    near: ti.template(),
    mode: ti.template(),
    sharp: ti.template(),
    row: ti.template(),
    longest: ti.template(),
    capacity,
    margin,
    padding,
    out: ti.template(),
    used: ti.template(),
    part,
):
    """Write the contacts of vertices, the first in each part of the buffer."""
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, end, begin = c * part, (c + 1) * part, c * capacity
            own, n_near, max_row, pairs = -1, 0, 0, 0
            for j in range(part_first(c, s.count[ACTIVE], s.chunks), part_first(c + 1, s.count[ACTIVE], s.chunks)):
                t = s.active[j]
                if s.body[t] != own:
                    own = s.body[t]
                    n_near = list_near(s, c, own)
                for q in range(3):
                    if (s.owns[t] >> q) & 1:
                        lo, hi = query_box(s, near, t, q, padding)
                        for k in range(n_near):
                            other = s.near[c * s.n_bodies + k]
                            if mode[other] == BY_FACES or other == own:
                                n = list_triangles(s, near, sharp, other, t, q, lo, hi, row, begin, begin + capacity)
                                max_row, pairs = ti.max(max_row, n), pairs + n
                                if 0 < n <= capacity:
                                    i = s.triangle[t, q]
                                    at = vertex_contacts(s, row, begin, begin + n, i, own, margin, out, at, end)
            used[c], longest[c], s.part[c] = at - c * part, max_row, pairs


@ti.func
def _edges(
    s: ti.template(),
    near: ti.template(),
    sharp: ti.template(),
    mode: ti.template(),
    row: ti.template(),
    longest: ti.template(),
    capacity,
    margin,
    padding,
    out: ti.template(),
    used: ti.template(),
    part,
):
    """Append the contacts of edges. They depend on the vertices found inside."""
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, end, begin = c * part + used[c], (c + 1) * part, c * capacity
            own, n_near, max_row, pairs = -1, 0, longest[c], s.part[c]
            for j in range(part_first(c, s.count[ACTIVE], s.chunks), part_first(c + 1, s.count[ACTIVE], s.chunks)):
                t = s.active[j]
                if s.body[t] != own:
                    own = s.body[t]
                    n_near = list_near(s, c, own)
                if sharp[t] & 7 != 0:
                    lo, hi = query_box(s, near, t, EDGES, padding)
                    for k in range(n_near):
                        other = s.near[c * s.n_bodies + k]
                        n = list_triangles(s, near, sharp, other, t, EDGES, lo, hi, row, begin, begin + capacity)
                        max_row, pairs = ti.max(max_row, n), pairs + n
                        if n <= capacity:
                            for e in range(9 * n):
                                u, k_t, k_u = row[begin + e // 9], e % 9 // 3, e % 3
                                if can_cross(sharp[t] >> k_t, sharp[u] >> k_u) == 1:
                                    t1, k1, t2, k2 = t, k_t, u, k_u
                                    if u < t:
                                        t1, k1, t2, k2 = u, k_u, t, k_t
                                    at = edge_contact(s, mode, t1, k1, t2, k2, margin, out, at, end)
            used[c], longest[c], s.part[c] = at - c * part, max_row, pairs


@kernel(cse=False)
def find_proximity(
    s: ti.template(),
    near: ti.template(),
    mode: ti.template(),
    sharp: ti.template(),
    row: ti.template(),
    longest: ti.template(),
    needed: ti.template(),
    capacity: ti.i32,
    margin: ti.f64,
    padding: ti.f64,
    out: ti.template(),
    used: ti.template(),
    count: ti.template(),
    part: ti.i32,
):
    """Write all contacts by proximity, the first in the buffer `out`; `used` and `count` hold their numbers.

    near: trees or rows of a broad phase; mode: (n_bodies) i32, BY_FIELD, BY_FACES or BY_EDGES; sharp: output of
    `mark_sharp_edges`; row, longest, needed, capacity: buffer of the triangles near one query; padding: half the reach [m].
    """
    mark_sharp_edges(s, mode, sharp)
    _vertices(s, near, mode, sharp, row, longest, capacity, margin, padding, out, used, part)
    _edges(s, near, sharp, mode, row, longest, capacity, margin, padding, out, used, part)
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(used, count, s.chunks)
        sum_parts(longest, needed, s.chunks)
        sum_pairs(s, 0)
