"""Measure how deeply the triangles of surfaces cross at their present positions.

Contact detection alone cannot measure this: it finds only faces and edges that have passed each other by less than its depth. The
crossing depth of two triangles is the smallest separating translation along one of their normals or along the cross product of
an edge of each (separating axis test; Gottschalk, Lin, Manocha 1996). Triangles that only touch have depth 0.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.boxes import list_near
from taisoft.collision.candidates import sum_parts
from taisoft.collision.features import corner
from taisoft.collision.queries import WHOLE, list_triangles, query_box
from taisoft.collision.surface import ACTIVE, dvec, part_first

PARALLEL = 1e-6  # sine below which two edges have no common normal
CROSSED = 1e-3  # of the finer side's mean surface edge: depth below which crossings do not count; about the contact accuracy
CROSSING_DEPTH, DEPTH_OVER_EDGE, CROSSINGS = range(3)  # indices in the result of `find_crossings`


@ti.func
def _edge(s: ti.template(), t, k):
    """Edge k of triangle t (3,) [m]."""
    return corner(s, t, k + 1) - corner(s, t, k)


@ti.func
def crossing_depth(s: ti.template(), t, u):
    """Smallest separating translation [m] of triangles t and u; 0 if they are separate or one has no area."""
    inf = ti.cast(ti.math.inf, ti.f64)
    depth, k = inf, 0
    while k < 11 and depth > 0.0:  # two normals, nine pairs of edges; the first axis separates most
        i, j = (k - 2) // 3, (k - 2) % 3
        first, second = _edge(s, t, ti.max(i, 0)), _edge(s, u, ti.max(j, 0))
        if k < 2:
            one = ti.select(k == 0, t, u)
            first, second = _edge(s, one, 0), _edge(s, one, 1)
        axis = first.cross(second)
        length = axis.norm()
        if length > ti.cast(PARALLEL, ti.f64) * first.norm() * second.norm():
            axis /= length
            lo_t, hi_t, lo_u, hi_u = inf, -inf, inf, -inf
            for c in range(3):
                at_t, at_u = (corner(s, t, c) - corner(s, u, 0)).dot(axis), (corner(s, u, c) - corner(s, u, 0)).dot(axis)
                lo_t, hi_t, lo_u, hi_u = ti.min(lo_t, at_t), ti.max(hi_t, at_t), ti.min(lo_u, at_u), ti.max(hi_u, at_u)
            depth = ti.min(depth, hi_t - lo_u, hi_u - lo_t)
        elif k < 2:
            depth = 0.0
        k += 1
    return ti.max(depth, 0.0)


@kernel
def find_crossings(
    s: ti.template(),
    near: ti.template(),
    sharp: ti.template(),
    row: ti.template(),
    longest: ti.template(),
    needed: ti.template(),
    capacity: ti.i32,
    padding: ti.f64,
    part: ti.template(),
    depths: ti.types.ndarray(),
):
    """Write depths (3,): the deepest crossing [m]; the deepest relative to the finer side's mean surface edge; the number of
    triangle pairs that cross by more than CROSSED of that edge.

    near, sharp, row, longest, needed, capacity, padding: as in the last search. part: (chunks) 3-vectors f64.
    """
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            begin, own, n_near, max_row, worst = c * capacity, -1, 0, 0, dvec(0.0)
            for j in range(part_first(c, s.count[ACTIVE], s.chunks), part_first(c + 1, s.count[ACTIVE], s.chunks)):
                t = s.active[j]
                if s.body[t] != own:
                    own = s.body[t]
                    n_near = list_near(s, c, own)
                lo, hi = query_box(s, near, t, WHOLE, padding)
                for k in range(n_near):
                    other = s.near[c * s.n_bodies + k]
                    if other >= own:  # each pair is found once, by its first triangle
                        n = list_triangles(s, near, sharp, other, t, WHOLE, lo, hi, row, begin, begin + capacity)
                        max_row = ti.max(max_row, n)
                        if n <= capacity:
                            for e in range(begin, begin + n):
                                if row[e] > t:
                                    d = crossing_depth(s, t, row[e])
                                    relative = d / ti.min(s.edge[own], s.edge[other])
                                    worst = ti.max(worst, dvec(d, relative, 0.0))
                                    worst[CROSSINGS] += ti.cast(relative > CROSSED, ti.f64)
            part[c], longest[c] = worst, max_row
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(longest, needed, s.chunks)
        for i in range(3):
            depths[i] = 0.0
        for c in range(s.chunks):
            depths[CROSSING_DEPTH] = ti.max(depths[CROSSING_DEPTH], part[c][CROSSING_DEPTH])
            depths[DEPTH_OVER_EDGE] = ti.max(depths[DEPTH_OVER_EDGE], part[c][DEPTH_OVER_EDGE])
            depths[CROSSINGS] += part[c][CROSSINGS]
