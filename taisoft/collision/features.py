"""Corners and edges of the deformed surface: nearest points, which of them are contact features, and their normal cones.

A contact is a local minimum of the distance, which can be tested on each side separately: along the normal n, which points from b
to a, no neighbour of a's feature may lie further towards b, and none of b's further towards a (Gauss map test). The SLACK
constants are sines of the tolerated angle: surfaces at rest on each other are never quite flat.

Nearest points are in f64, without NaN for any finite input. A convex quadratic over a triangle, or over the square of two
segments' parameters, has its minimum inside or on the boundary. So each function takes the interior solution if it is feasible,
else the boundary (point against segment), and keeps the nearest point actually computed: degenerate triangles and segments then
need no special cases. Interior solutions come from cross products, whose relative error grows with 1/sin of the smallest angle
and not with its square. Weak: farther from a triangle than 1e8 of its size, the region is decided by rounding.

Source of the problem statements: Ericson, Real-Time Collision Detection, 2005, sections 5.1.5 and 5.1.9.
"""

import taichi as ti

from taisoft.collision.surface import ACTIVE, dvec, ivec

BY_FIELD, BY_FACES, BY_EDGES = 0, 1, 2  # contact mode of a collider; boxes use their edges and their analytic distance
CORNER_SLACK, EDGE_SLACK = 0.25, 0.05  # sines
PARALLEL = 1e-8  # sine below which two lines count as parallel
SHARP_COSINE = 0.99985  # cosine of 1 degree: flatter edges are blunt, meet sharp ones only, and sink by < 0.5 % of an edge
FLAT_COSINE = 0.9998  # cosine of 1 degree: concave edges that turn by less count as flat
ROUNDING = 1e-9  # cosine below which an edge counts as perpendicular to a direction; common in mirrored bodies
FIELD_SHARP_COSINE = 0.5  # cosine of 60 degrees: SHARP_COSINE for bodies with a distance field, which handles blunt edges itself

FACE, EDGE, CORNER = 0, 1, 4  # regions of a triangle; edge k leads from corner k to the next


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
def corner(s: ti.template(), t, k):
    """Position (3,) [m] of corner k % 3 of triangle t."""
    return s.x[s.triangle[t, k % 3]]


@ti.func
def vertices_of(s: ti.template(), t):
    """Vertices (3,) i32 of triangle t."""
    return ivec(s.triangle[t, 0], s.triangle[t, 1], s.triangle[t, 2])


@ti.func
def moved(s: ti.template(), t, w):
    """Displacement (3,) [m] in the step of the point of triangle t with weights w (3,)."""
    return w[0] * s.move[s.triangle[t, 0]] + w[1] * s.move[s.triangle[t, 1]] + w[2] * s.move[s.triangle[t, 2]]


@ti.func
def unit(v):
    """Normalise v; 0 if its length is 0."""
    length = v.norm()
    result = dvec(0.0)
    if length > 0.0:
        result = v / length
    return result


@ti.func
def opposite(s: ti.template(), t, i, j):
    """Return the vertex of triangle t that is neither i nor j."""
    found = s.triangle[t, 0]
    for k in range(1, 3):
        if found == i or found == j:
            found = s.triangle[t, k]
    return found


@ti.func
def in_normal_cone(s: ti.template(), i, n):
    """1 if vertex i is locally its surface's extreme point along -n, and some adjacent face has a normal opposing n."""
    x = s.x[i]
    valid = 1
    k = s.around_start[i]
    while valid == 1 and k < s.around_start[i + 1]:
        e = s.x[s.around[k]] - x
        h = e.dot(n)
        if h < 0.0 and h * h > ti.cast(CORNER_SLACK**2, ti.f64) * e.dot(e):
            valid = 0
        k += 1
    facing = 0
    r = s.ring_start[i]
    while valid == 1 and facing == 0 and r < s.ring_start[i + 1]:
        facing = int(s.normal[s.ring[r]].dot(n) < 0.0)
        r += 1
    return facing


@ti.func
def nearest_of_ring(s: ti.template(), i, d):
    """1 if vertex i is locally the nearest point of its surface to the point at offset d (3,) [m] from it."""
    x = s.x[i]
    valid = 1
    k = s.around_start[i]
    while valid == 1 and k < s.around_start[i + 1]:
        e = s.x[s.around[k]] - x
        if e.dot(d) > ti.cast(ROUNDING, ti.f64) * e.norm() * d.norm():
            valid = 0
        k += 1
    return valid


@ti.func
def ring_normal(s: ti.template(), i):
    """Unit normal of the surface at vertex i: angle-weighted mean of its triangles' normals."""
    total = dvec(0.0)
    for r in range(s.ring_start[i], s.ring_start[i + 1]):
        t = s.ring[r]
        for k in range(3):
            if s.triangle[t, k] == i:
                e, f = unit(corner(s, t, k + 1) - s.x[i]), unit(corner(s, t, k + 2) - s.x[i])
                total += ti.acos(ti.min(ti.max(e.dot(f), -1.0), 1.0)) * s.normal[t]
    return unit(total)


@ti.func
def edge_normal(s: ti.template(), t, k):
    """Sum of the unit normals of the triangles at edge k of triangle t."""
    total = s.normal[t]
    if s.neighbour[t, k] >= 0:
        total += s.normal[s.neighbour[t, k]]
    return total


@ti.func
def edge_in_normal_cone(s: ti.template(), t, k, n):
    """1 if the triangles at edge k of triangle t lie on the -n side of it, within EDGE_SLACK."""
    i, j = s.triangle[t, k], s.triangle[t, (k + 1) % 3]
    d = unit(s.x[j] - s.x[i])
    valid = 1
    for side in range(2):
        w = t
        if side == 1:
            w = s.neighbour[t, k]
        if w >= 0:
            e = s.x[opposite(s, w, i, j)] - s.x[i]
            e -= e.dot(d) * d
            h = e.dot(n)
            if h > 0.0 and h * h > ti.cast(EDGE_SLACK**2, ti.f64) * e.dot(e):
                valid = 0
    return valid


@ti.func
def mark_sharp_edges(s: ti.template()):
    """Write the edge bits of each active triangle. Bits 0-2: owned edges that are convex and sharp, or open; 3-5: those and flat
    ones. Also clear `inside` and `exit_direction` of their vertices."""
    ti.loop_config(serialize=s.serial_cheap)
    for c in range(s.count[ACTIVE]):
        t = s.active[c]
        bits = 0
        by_field = s.mode[s.body[t]] == BY_FIELD
        sharp_cosine = ti.cast(SHARP_COSINE, ti.f64)
        if by_field:
            sharp_cosine = FIELD_SHARP_COSINE
        for k in range(3):
            s.inside[s.triangle[t, k]] = 0
            s.exit_direction[s.triangle[t, k]] = dvec(0.0)
            if (s.owns[t] >> (3 + k)) & 1:
                w = s.neighbour[t, k]
                if w < 0:
                    bits |= 9 << k
                else:
                    i, j = s.triangle[t, k], s.triangle[t, (k + 1) % 3]
                    n = s.normal[t]
                    cosine = n.dot(s.normal[w])
                    out = (s.x[opposite(s, w, i, j)] - s.x[i]).dot(n) < 0.0
                    if out and cosine < sharp_cosine:
                        bits |= 9 << k
                    elif not by_field:
                        if cosine > ti.cast(FLAT_COSINE, ti.f64):  # flat: it may bend over a rim, unless it is rigid
                            if s.soft[s.body[t]] == 1:
                                bits |= 8 << k
                        elif out:
                            bits |= 8 << k
        s.sharp[t] = bits
