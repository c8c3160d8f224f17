"""Corners and edges of the deformed surface: which are contact features, and their normal cones.

A contact is a local minimum of the distance, which can be tested on each side separately: along the normal n, which points from b
to a, no neighbour of a's feature may lie further towards b, and none of b's further towards a (Gauss map test). The SLACK
constants are sines of the tolerated angle: surfaces at rest on each other are never quite flat.
"""

import taichi as ti

from taisoft.collision.surface import ACTIVE, dvec, ivec

BY_FIELD, BY_FACES, BY_EDGES = 0, 1, 2  # contact mode of a collider; boxes use their edges and their analytic distance
CORNER_SLACK, EDGE_SLACK = 0.25, 0.05  # sines
SHARP_COSINE = 0.99985  # cosine of 1 degree: flatter edges are blunt, meet sharp ones only, and sink by < 0.5 % of an edge
FLAT_COSINE = 0.9998  # cosine of 1 degree: concave edges that turn by less count as flat
ROUNDING = 1e-9  # cosine below which an edge counts as perpendicular to a direction; common in mirrored bodies
FIELD_SHARP_COSINE = 0.5  # cosine of 60 degrees: SHARP_COSINE for bodies with a distance field, which handles blunt edges itself


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
def mark_sharp_edges(s: ti.template(), mode: ti.template(), sharp: ti.template()):
    """Write the edge bits of each active triangle. Bits 0-2: owned edges that are convex and sharp, or open; 3-5: those and flat
    ones. Also clear `inside` and `exit_direction` of their vertices.

    mode: (n_bodies) i32, BY_FIELD for bodies with a distance field.
    """
    ti.loop_config(serialize=s.serial_cheap)
    for c in range(s.count[ACTIVE]):
        t = s.active[c]
        bits = 0
        sharp_cosine = ti.cast(SHARP_COSINE, ti.f64)
        if mode[s.body[t]] == BY_FIELD:
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
                    elif cosine > ti.cast(FLAT_COSINE, ti.f64):  # flat: it may bend over a rim, unless it is rigid
                        if mode[s.body[t]] != BY_FIELD and s.soft[s.body[t]] == 1:
                            bits |= 8 << k
                    elif out:
                        if mode[s.body[t]] != BY_FIELD:
                            bits |= 8 << k
        sharp[t] = bits
