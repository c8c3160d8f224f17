"""Normals of contacts at the present positions, from the features that met at the start of a step, or those next to them.

A point is followed from triangle to triangle as long as the next one is nearer, so it finds the nearest point that is connected
with the first one, not one beyond a gap.
"""

import taichi as ti

from taisoft.collision.analytic import BOX, rotation_rows
from taisoft.collision.features import CORNER, EDGE, FLAT_COSINE, closest_on_triangle, corner, edge_normal, ring_normal, unit
from taisoft.collision.intersections import closest_segments
from taisoft.collision.surface import dvec
from taisoft.collision.vertex_face import TINY

MAX_WALK = 32  # triangles over which a point is followed


@ti.func
def _offset(s: ti.template(), t, p):
    """Offset (3,) [m] from the nearest point of triangle t to p, and the region of that point."""
    a, b, c = corner(s, t, 0), corner(s, t, 1), corner(s, t, 2)
    w, region = closest_on_triangle(p, a, b, c)
    return p - (w[0] * a + w[1] * b + w[2] * c), region


@ti.func
def normal_at(s: ti.template(), p, first):
    """Unit normal (3,) from the surface around triangle `first` to the point p (3,), the distance [m], negative inside, and
    whether the nearest point is inside a triangle."""
    t, steps, best = first, 0, -1
    offset, region = _offset(s, t, p)
    while best != t and steps < MAX_WALK:
        t = ti.select(best < 0, t, best)
        best = t
        n_next, start, across = 0, 0, -1
        if region >= CORNER:
            v = s.triangle[t, region - CORNER]
            start, n_next = s.ring_start[v], s.ring_start[v + 1] - s.ring_start[v]
        elif region >= EDGE:
            across = s.neighbour[t, region - EDGE]
            n_next = int(across >= 0)
        for k in range(n_next):
            u = across
            if across < 0:
                u = s.ring[start + k]
            d, own = _offset(s, u, p)
            if d.dot(d) < offset.dot(offset):
                offset, region, best = d, own, u
        steps += 1
    n, distance = 1.0 * s.normal[t], offset.norm()
    if region >= CORNER:
        n = ring_normal(s, s.triangle[t, region - CORNER])
    elif region >= EDGE:
        n = unit(edge_normal(s, t, region - EDGE))
    is_outside = offset.dot(n) >= 0.0  # of a closed surface, by the mean normal (Baerentzen, Aanaes 2005)
    if region >= EDGE and is_outside and distance > ti.cast(TINY, ti.f64) * ti.sqrt(s.area[t]):
        n = offset / distance
    return n, ti.select(is_outside, distance, -distance), region < EDGE


@ti.func
def nearest_of_edges(s: ti.template(), e, f):
    """Nearest points (3,) of edges e and f, each 3 triangle + local edge, their common normal (3,), and whether both are between
    the ends."""
    t, k, u, m = e // 3, e % 3, f // 3, f % 3
    a, b, c, d = corner(s, t, k), corner(s, t, k + 1), corner(s, u, m), corner(s, u, m + 1)
    p, q, _ = closest_segments(a, b, c, d)
    is_inner = p > 0.0 and p < 1.0 and q > 0.0 and q < 1.0
    return a + p * (b - a), c + q * (d - c), unit((b - a).cross(d - c)), is_inner


@ti.func
def normal_on_shape(o: ti.template(), body, x, before):
    """Unit normal (3,) of analytic obstacle `body` at the point x (3,), 0 if it is none; the distance [m], and whether the
    nearest point and that of the normal `before` are on smooth parts."""
    n, phi, is_smooth, was_smooth = dvec(0.0), ti.cast(0.0, ti.f64), True, True
    for k in range(o.count):
        if o.body[k] == body:
            R = rotation_rows(o.rotation, k)
            value, g = o.sample(k, R.transpose() @ (x - o.origin[k]))
            n, phi = R @ g, value
            if ti.static(BOX in o.kinds):
                if o.kind[k] == BOX:
                    is_smooth = ti.abs(g).max() > ti.cast(FLAT_COSINE, ti.f64)
                    was_smooth = ti.abs(R.transpose() @ before).max() > ti.cast(FLAT_COSINE, ti.f64)
    return n, phi, is_smooth, was_smooth
