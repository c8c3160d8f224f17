"""How far surfaces have passed through each other where their triangles are now.

No search for contacts tells that wholly: it sees faces and edges that have passed each other by less than its depth. A pair of
triangles crosses as deep as they must part to be clear of each other, along one of their normals or along what is across an edge
of each (Gottschalk, Lin, Manocha 1996). What only touches crosses 0 deep.
"""

import taichi as ti

from taisoft.collision.boxes import list_near
from taisoft.collision.candidates import sum_parts
from taisoft.collision.features import corner
from taisoft.collision.queries import WHOLE, list_triangles, query_box
from taisoft.collision.surface import ACTIVE, dvec, part_first
from taisoft.runtime import kernel

PARALLEL = 1e-6  # sine below which two edges have no common normal
CROSSED = 1e-3  # of the finer side's mean surface edge: crossings less deep do not count; contacts are solved to about that
CROSSING_DEPTH, DEPTH_OVER_EDGE, CROSSINGS = range(3)  # places in what `find_crossings` tells


@ti.func
def _edge(s: ti.template(), t, k):
    """Edge k of triangle t (3,) [m]."""
    return corner(s, t, k + 1) - corner(s, t, k)


@ti.func
def crossing_depth(s: ti.template(), t, u):
    """How far [m] triangles t and u must part to be clear of each other; 0 where they are, and where one has no area."""
    far = ti.cast(ti.math.inf, ti.f64)
    depth, k = far, 0
    while k < 11 and depth > 0.0:  # two normals, nine pairs of edges; most are clear along the first
        i, j = (k - 2) // 3, (k - 2) % 3
        first, second = _edge(s, t, ti.max(i, 0)), _edge(s, u, ti.max(j, 0))
        if k < 2:
            one = ti.select(k == 0, t, u)
            first, second = _edge(s, one, 0), _edge(s, one, 1)
        axis = first.cross(second)
        length = axis.norm()
        if length > ti.cast(PARALLEL, ti.f64) * first.norm() * second.norm():
            axis /= length
            lo_t, hi_t, lo_u, hi_u = far, -far, far, -far
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
    s: ti.template(), near: ti.template(), sharp: ti.template(), row: ti.template(), longest: ti.template(),
    needed: ti.template(), room: ti.i32, half: ti.f64, part: ti.template(), told: ti.types.ndarray(),
):  # fmt: skip
    """told (3,): the deepest crossing [m]; the deepest over the finer side's mean surface edge; pairs of triangles that cross
    deeper than CROSSED of that.

    near, sharp, row, longest, needed, room, half: as of the search that was made. part: (chunks) 3-vectors f64.
    """
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            begin, own, n_near, most, worst = c * room, -1, 0, 0, dvec(0.0)
            for j in range(part_first(c, s.count[ACTIVE], s.chunks), part_first(c + 1, s.count[ACTIVE], s.chunks)):
                t = s.active[j]
                if s.body[t] != own:
                    own = s.body[t]
                    n_near = list_near(s, c, own)
                lo, hi = query_box(s, near, t, WHOLE, half)
                for k in range(n_near):
                    other = s.near[c * s.n_bodies + k]
                    if other >= own:  # of two triangles the first finds the other
                        n = list_triangles(s, near, sharp, other, t, WHOLE, lo, hi, row, begin, begin + room)
                        most = ti.max(most, n)
                        if n <= room:
                            for e in range(begin, begin + n):
                                if row[e] > t:
                                    d = crossing_depth(s, t, row[e])
                                    over = d / ti.min(s.edge[own], s.edge[other])
                                    worst = ti.max(worst, dvec(d, over, 0.0))
                                    worst[CROSSINGS] += ti.cast(over > CROSSED, ti.f64)
            part[c], longest[c] = worst, most
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(longest, needed, s.chunks)
        for i in range(3):
            told[i] = 0.0
        for c in range(s.chunks):
            told[CROSSING_DEPTH] = ti.max(told[CROSSING_DEPTH], part[c][CROSSING_DEPTH])
            told[DEPTH_OVER_EDGE] = ti.max(told[DEPTH_OVER_EDGE], part[c][DEPTH_OVER_EDGE])
            told[CROSSINGS] += part[c][CROSSINGS]
