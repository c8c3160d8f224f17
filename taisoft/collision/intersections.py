"""Triangles that cross at their present positions, within a body and between bodies: how deeply, and which intersect.

Contact detection alone cannot measure this: it finds only faces and edges that have passed each other by less than its depth. The
crossing depth of two triangles is the smallest separating translation along one of their normals or along the cross product of
an edge of each (separating axis test; Gottschalk, Lin, Manocha 1996). Triangles that only touch have depth 0.

Intersection is decided by distances: of an edge's crossing of the other triangle's plane from that triangle (the test of
Moeller and Trumbore 1997, whose barycentric coordinates are noise where edge and plane are nearly parallel), then of corners
and edges.

Triangles that share a vertex always touch, so they are not tested. A fold is still found through their neighbours.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.candidates import Pairs, Visitor, sum_parts, visit_near
from taisoft.collision.features import closest_lines, closest_on_segment, closest_on_triangle, corner
from taisoft.collision.surface import dvec

COMMON_NORMAL = 1e-6  # sine below which two edges have no common normal
CROSSED = 1e-3  # of the finer side's mean surface edge: depth below which crossings do not count; about the contact accuracy
CROSSING_DEPTH, DEPTH_OVER_EDGE, CROSSINGS = range(3)  # indices in the result of `find_crossings`
TOUCHING = 1e-10  # of the longest edge: distance at which triangles touch
ROUNDING = 1e-14  # bounds the relative error of a volume (six times a tetrahedron's) formed in f64


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
        if length > ti.cast(COMMON_NORMAL, ti.f64) * first.norm() * second.norm():
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


class Crossings(Visitor):
    """The deepest crossings in each chunk, and their number: in the first entry of its part."""

    @ti.func
    def visit(self, surface: ti.template(), t, q, entry: ti.template(), first, last, out: ti.template(), start, end):
        """See Visitor."""
        worst = 1.0 * out[start]
        for e in range(first, last):
            if entry[e] > t:
                depth = crossing_depth(surface, t, entry[e])
                relative = depth / ti.min(surface.edge[surface.body[t]], surface.edge[surface.body[entry[e]]])
                worst = ti.max(worst, dvec(depth, relative, 0.0))
                worst[CROSSINGS] += ti.cast(relative > CROSSED, ti.f64)
        out[start] = worst
        return start


CROSSINGS_OF = Crossings()


@kernel
def find_crossings(surface: ti.template(), near: ti.template(), row: ti.template(), visitor: ti.template(), out: ti.template()):
    """Write out.data[0]: the deepest crossing [m]; the deepest relative to the finer side's mean surface edge; the number of
    triangle pairs that cross by more than CROSSED of that edge.

    visitor: CROSSINGS_OF; out: parts of one 3-vector f64 each; near, row: as in the last search.
    """
    ti.loop_config(serialize=surface.on_cpu)
    for c in range(out.chunks):
        out.data[c] = dvec(0.0)
    visit_near(surface, near, row, visitor, out, 0)
    sum_parts(surface.team, row)
    (team,) = ti.static((surface.team,))
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        worst, crossings = dvec(0.0), ti.cast(0.0, ti.f64)
        for j in range(team.share(t, out.chunks)):
            c = team.entry(t, j, out.chunks)
            worst = ti.max(worst, out.data[c])
            crossings += out.data[c][CROSSINGS]
        depth, relative = team.largest(t, worst[CROSSING_DEPTH]), team.largest(t, worst[DEPTH_OVER_EDGE])
        total = team.total(t, crossings)
        if t == 0:
            out.data[0] = dvec(depth, relative, total)


@ti.func
def row_of(corners, k):
    """Row k of a matrix of points."""
    return dvec(corners[k, 0], corners[k, 1], corners[k, 2])


@ti.func
def closest_segments(p0, p1, q0, q1):
    """Parameters (s, t) in [0, 1] of the nearest points of two segments p0 p1 and q0 q1, and whether they are parallel.

    All (3,) f64 [m]. For overlapping parallel segments, an end of one of them is returned; the third value is then 1.
    """
    ends = ti.Matrix.rows([p0, p1, q0, q1])
    s, t, parallel = closest_lines(p0, p1, q0, q1)
    nearest = ti.cast(ti.math.inf, ti.f64)
    if parallel == 0 and 0.0 < s < 1.0 and 0.0 < t < 1.0:
        offset = p0 + s * (p1 - p0) - (q0 + t * (q1 - q0))
        nearest = offset.dot(offset)
    for k in range(4):  # the two ends of p against q, then those of q against p
        other = 2 - 2 * (k // 2)
        e, a, b = row_of(ends, k), row_of(ends, other), row_of(ends, other + 1)
        at = ti.cast(k % 2, ti.f64)
        r = closest_on_segment(e, a, b)
        offset = e - (a + r * (b - a))
        if offset.dot(offset) < nearest:
            nearest = offset.dot(offset)
            s, t = at, r
            if k >= 2:
                s, t = r, at
    return s, t, parallel


@ti.func
def _is_clear_of_plane(corners, first, size):
    """Whether one triangle (rows from `first` on) lies strictly on one side of the other's plane."""
    other = 3 - first
    a = row_of(corners, other)
    n = (row_of(corners, other + 1) - a).cross(row_of(corners, other + 2) - a)
    above, below = 0, 0
    for k in range(3):
        r = row_of(corners, first + k) - a
        d = r.dot(n)
        clear = ti.cast(TOUCHING, ti.f64) * size * n.norm() + ti.cast(ROUNDING, ti.f64) * size * size * r.norm()
        above += ti.cast(d > clear, ti.i32)
        below += ti.cast(d < -clear, ti.i32)
    return above == 3 or below == 3


@ti.func
def _longest_edge(corners):
    """Length of the longest edge of two triangles [m]."""
    longest = ti.cast(0.0, ti.f64)
    for k in range(6):
        e = row_of(corners, k) - row_of(corners, k // 3 * 3 + (k + 1) % 3)
        longest = ti.max(longest, e.dot(e))
    return ti.sqrt(longest)


@ti.func
def _intersect(corners):
    """Whether the triangles of rows 0 to 2 and 3 to 5 intersect or touch."""
    size = _longest_edge(corners)
    touching = ti.cast(TOUCHING, ti.f64) * size
    possible = 1
    for side in range(2):
        if possible == 1 and _is_clear_of_plane(corners, 3 * side, size):
            possible = 0
    found = 0
    k = 0
    while possible == 1 and found == 0 and k < 21:
        offset = dvec(2.0 * touching)
        if k < 12:
            first = (k % 6) // 3 * 3
            p = row_of(corners, k % 6)
            a, b, c = row_of(corners, 3 - first), row_of(corners, 4 - first), row_of(corners, 5 - first)
            test = 1
            if k < 6:
                q = row_of(corners, first + (k + 1) % 3)
                n = (b - a).cross(c - a)
                above, below = (p - a).dot(n), (q - a).dot(n)
                test = int((above > 0.0 and below < 0.0) or (above < 0.0 and below > 0.0))
                if test == 1:  # the edge crosses the plane
                    p += above / (above - below) * (q - p)
            if test == 1:
                w, _ = closest_on_triangle(p, a, b, c)
                offset = p - (w[0] * a + w[1] * b + w[2] * c)
        else:
            i, j = (k - 12) // 3, (k - 12) % 3
            p0, p1 = row_of(corners, i), row_of(corners, (i + 1) % 3)
            q0, q1 = row_of(corners, 3 + j), row_of(corners, 3 + (j + 1) % 3)
            s, t, _ = closest_segments(p0, p1, q0, q1)
            offset = p0 + s * (p1 - p0) - (q0 + t * (q1 - q0))
        if offset.norm() <= touching:
            found = 1
        k += 1
    return found


@ti.func
def triangles_intersect(a0, a1, a2, b0, b1, b2):
    """1 if two triangles, possibly degenerate, intersect or touch, else 0. Corners (3,) f64 [m].

    They touch if two of their points are nearer than 1e-10 of the longest of the six edges. First tested are the points where an
    edge crosses the other's plane, against that triangle; this decides most cases. Then, for coplanar triangles and cases lost to
    rounding, each corner is tested against the other triangle, and each edge against each edge of the other.
    """
    lo_a, hi_a = ti.min(a0, a1, a2), ti.max(a0, a1, a2)
    lo_b, hi_b = ti.min(b0, b1, b2), ti.max(b0, b1, b2)
    padding = ti.cast(2.0 * TOUCHING, ti.f64) * ti.max(hi_a - lo_a, hi_b - lo_b).max()  # an edge is at most sqrt(3) extents
    result = 0
    if (lo_a <= hi_b + padding).all() and (lo_b <= hi_a + padding).all():
        result = _intersect(ti.Matrix.rows([a0, a1, a2, b0, b1, b2]))
    return result


class Intersecting(Pairs):
    """The pairs that intersect or touch."""

    @ti.func
    def accepts(self, surface: ti.template(), t, u):
        """See Pairs."""
        a, b, c = corner(surface, t, 0), corner(surface, t, 1), corner(surface, t, 2)
        return triangles_intersect(a, b, c, corner(surface, u, 0), corner(surface, u, 1), corner(surface, u, 2))


INTERSECTING = Intersecting()
