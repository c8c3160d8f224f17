"""Closest points of triangles and segments, and triangle-triangle intersection, in f64; no NaN for any finite input.

A convex quadratic over a triangle, or over the square of two segments' parameters, has its minimum inside or on the boundary. So
each function takes the interior solution if it is feasible, else the boundary (point against segment), and keeps the nearest
point actually computed: degenerate triangles and segments then need no special cases. Interior solutions come from cross
products, whose relative error grows with 1/sin of the smallest angle and not with its square. Weak: farther from a triangle than
1e8 of its size, the region is decided by rounding.

Intersection is decided by distances: of an edge's crossing of the other triangle's plane from that triangle (the test of
Moeller and Trumbore 1997, whose barycentric coordinates are noise where edge and plane are nearly parallel), then of corners
and edges.

Source of the problem statements: Ericson, Real-Time Collision Detection, 2005, sections 5.1.5 and 5.1.9.
"""

import taichi as ti

from taisoft.collision.surface import dvec

TOUCHING = 1e-10  # of the longest edge: distance at which triangles touch
PARALLEL = 1e-8  # sine below which two segments count as parallel
ROUNDING = 1e-14  # bounds the relative error of a volume (six times a tetrahedron's) formed in f64

FACE, EDGE, CORNER = 0, 1, 4  # regions of a triangle; edge k leads from corner k to the next


@ti.func
def _corner(corners, k):
    """Row k of a matrix of points."""
    return dvec(corners[k, 0], corners[k, 1], corners[k, 2])


@ti.func
def closest_on_segment(p, a, b):
    """Parameter t in [0, 1] of the point a + t (b - a) nearest to p; 0 if a = b. All (3,) [m]."""
    d = b - a
    dd = d.dot(d)
    t = ti.cast(0.0, ti.f64)
    if dd > 0.0:
        t = ti.min(ti.max((p - a).dot(d) / dd, 0.0), 1.0)
    return t


@ti.func
def choose(k, a, b, c):
    """Return a, b or c for k = 0, 1 or 2. A matrix indexed by k would fail to compile when passed on to a function."""
    return ti.select(k == 0, a, ti.select(k == 1, b, c))


@ti.func
def closest_on_triangle(p, a, b, c):
    """Point of a triangle nearest to p: its barycentric coordinates (3,), which sum to 1, and its region.

    p, a, b, c: (3,) f64 [m]. region k: 0 face, 1..3 interior of edge k - 1 (from corner k - 1 to the next), 4..6 corner k - 4.
    A degenerate triangle is treated as its edges.
    """
    n = (b - a).cross(c - a)
    nn = n.dot(n)
    beta, gamma = ti.cast(-1.0, ti.f64), ti.cast(-1.0, ti.f64)
    height = ti.cast(ti.math.inf, ti.f64)
    if nn > 0.0:
        beta, gamma = (c - a).cross(a - p).dot(n) / nn, (b - a).cross(p - a).dot(n) / nn
        offset = p - a - beta * (b - a) - gamma * (c - a)
        height = offset.dot(offset)
    alpha = 1.0 - beta - gamma
    region = FACE
    if not (alpha > 0.0 and beta > 0.0 and gamma > 0.0 and height < ti.math.inf):
        nearest = ti.cast(ti.math.inf, ti.f64)
        edge, along = 0, ti.cast(0.0, ti.f64)
        for k in range(3):
            u, v = choose(k, a, b, c), choose(k, b, c, a)
            t = closest_on_segment(p, u, v)
            offset = p - (u + t * (v - u))
            if offset.dot(offset) < nearest:
                nearest, edge, along = offset.dot(offset), k, t
        region = EDGE + edge
        if along == 0.0:
            region = CORNER + edge
        elif along == 1.0:
            region = CORNER + (edge + 1) % 3
        rest = 1.0 - along
        zero = ti.cast(0.0, ti.f64)
        alpha, beta, gamma = choose(edge, rest, zero, along), choose(edge, along, rest, zero), choose(edge, zero, along, rest)
    return dvec(alpha, beta, gamma), region


@ti.func
def closest_lines(p0, p1, q0, q1):
    """Unclamped parameters (s, t) of the nearest points of the lines p0 + s (p1 - p0) and q0 + t (q1 - q0), and 1 if the
    lines are parallel or either is a point (then s = t = 0), else 0. All (3,) f64 [m]."""
    u, v, w = p1 - p0, q1 - q0, q0 - p0
    n = u.cross(v)
    nn = n.dot(n)
    s, t = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    parallel = 1
    if nn > ti.cast(PARALLEL, ti.f64) ** 2 * u.dot(u) * v.dot(v):
        s, t = w.cross(v).dot(n) / nn, w.cross(u).dot(n) / nn
        parallel = 0
    return s, t, parallel


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
        e, a, b = _corner(ends, k), _corner(ends, other), _corner(ends, other + 1)
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
def _crossing(p, q, a, b, c):
    """Intersect segment p q with the plane of a triangle: 1 and the parameter in [0, 1], or 0 and 0."""
    n = (b - a).cross(c - a)
    above, below = (p - a).dot(n), (q - a).dot(n)
    crosses, s = 0, ti.cast(0.0, ti.f64)
    if (above > 0.0 and below < 0.0) or (above < 0.0 and below > 0.0):
        crosses, s = 1, above / (above - below)
    return crosses, s


@ti.func
def _is_clear_of_plane(corners, first, size):
    """Whether one triangle (rows from `first` on) lies strictly on one side of the other's plane."""
    other = 3 - first
    a = _corner(corners, other)
    n = (_corner(corners, other + 1) - a).cross(_corner(corners, other + 2) - a)
    above, below = 0, 0
    for k in range(3):
        r = _corner(corners, first + k) - a
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
        e = _corner(corners, k) - _corner(corners, k // 3 * 3 + (k + 1) % 3)
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
            p = _corner(corners, k % 6)
            a, b, c = _corner(corners, 3 - first), _corner(corners, 4 - first), _corner(corners, 5 - first)
            test = 1
            if k < 6:
                q = _corner(corners, first + (k + 1) % 3)
                crosses, s = _crossing(p, q, a, b, c)
                test = crosses
                p += s * (q - p)
            if test == 1:
                w, _ = closest_on_triangle(p, a, b, c)
                offset = p - (w[0] * a + w[1] * b + w[2] * c)
        else:
            i, j = (k - 12) // 3, (k - 12) % 3
            p0, p1 = _corner(corners, i), _corner(corners, (i + 1) % 3)
            q0, q1 = _corner(corners, 3 + j), _corner(corners, 3 + (j + 1) % 3)
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
