"""Signed distances of the analytic obstacles in their own frames, negative inside, and their gradients.

Half-space: y. Sphere: |p| - r. Box: half extents h; outside the distance to its surface, inside the largest p_i - h_i. Capsule: a
segment along x of half length h, radius r. If the gradient is not unique (at a centre, on a segment, on a box's diagonal planes),
one of the possible unit vectors is returned.
"""

import taichi as ti

from taisoft.collision.surface import dvec

HALF_SPACE, SPHERE, BOX, CAPSULE = 0, 1, 2, 3


@ti.func
def _from_core(d, r):
    """Distance to a sphere or capsule and its gradient; d: offset from its centre or segment."""
    length = d.norm()
    g = dvec(0.0, 1.0, 0.0)
    if length > 0.0:
        g = d / length
    return length - r, g


@ti.func
def _box_distance(p, h):
    q = ti.abs(p) - h
    sign = dvec(1.0)
    for k in ti.static(range(3)):
        if p[k] < 0.0:
            sign[k] = -1.0
    phi, g = q.max(), dvec(0.0)
    if phi > 0.0:
        out = ti.max(q, 0.0)
        phi = out.norm()
        g = sign * out / phi
    else:
        for k in ti.static(range(3)):
            if q[k] == phi and g.dot(g) == 0.0:
                g[k] = sign[k]
    return phi, g


@ti.func
def distance(kind, size, p):
    """Signed distance [m] and unit gradient (3,) of a shape of that kind and size (3,) [m] at p (3,) [m], in its frame."""
    phi, g = p[1], dvec(0.0, 1.0, 0.0)
    if kind == SPHERE:
        phi, g = _from_core(p, size[0])
    elif kind == BOX:
        phi, g = _box_distance(p, size)
    elif kind == CAPSULE:
        x = ti.min(ti.max(p[0], -size[0]), size[0])
        phi, g = _from_core(p - dvec(x, 0.0, 0.0), size[1])
    return phi, g
