"""Contacts with analytic obstacles: their exact distance, from the vertices and triangles of the soft bodies.

Every vertex near the obstacle is a contact where its surface sticks out towards it, and every one that is below a half-space or
comes below it in the step: nothing may be there, be it turned inside out. A triangle adds its deepest point where that
lies deeper than its corners, as under a ball. A triangle is passed over when phi at its centre, less its radius and its
way in the step, is above the margin: phi grows by at most 1 per metre.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.arrays import Count
from taisoft.collision import shapes
from taisoft.collision.candidates import sum_parts
from taisoft.collision.contacts import FACE_FIELD, VERTEX_FIELD, write_contact
from taisoft.collision.features import corner, in_normal_cone, opposite, unit, vertices_of
from taisoft.collision.frank_wolfe import deepest_point
from taisoft.collision.surface import dvec, ivec, part_first
from taisoft.runtime import kernel

ASKEW = 0.26  # sine of 15 degrees: by so much grad phi may miss what holds at a minimum
DEEPER = 1e-5  # of a triangle's size: by so much its deepest point must lie below its corners to be a contact of its own


@dataclass(frozen=True, eq=False)
class AnalyticObstacles:
    """Where the analytic obstacles are: world = rotation @ local + origin."""

    count: Count
    body: Any  # (count) i32: collider
    kind: Any  # (count) i32
    size: Any  # (count) 3-vectors f64
    origin: Any  # (count) 3-vectors f64: now [m]
    rotation: Any  # (3 count) 3-vectors f64 by rows: now
    next_origin: Any  # at the end of the step
    next_rotation: Any

    @property
    def any(self) -> bool:
        """Whether there are some."""
        return self.body is not None

    @ti.func
    def sample(self, k, p):
        """phi [m] and its gradient at p in the frame of obstacle k."""
        return shapes.distance(self.kind[k], self.size[k], p)


NO_SHAPES = AnalyticObstacles(0, *[None] * 7)


@ti.func
def _rows(f: ti.template(), k):
    return ti.Matrix.rows([f[3 * k], f[3 * k + 1], f[3 * k + 2]])


@ti.func
def deeper_inside(s: ti.template(), t, w, n, x):
    """1 where the deepest point x of triangle t, weights w, is one of the whole surface: n, from the other side, looks at it.

    Inside the triangle n must be opposite to its normal and on an edge across it, to ASKEW: at a kink of phi, as in the
    middle of a box, no gradient tells the way out. On an edge the neighbour must not lie deeper, and of the two triangles the
    owner tells.
    """
    facing = s.normal[t]
    good = 1
    zero = -1
    for j in ti.static(range(3)):
        if w[j] <= 0.0:
            zero = j
    if zero >= 0:
        k = (zero + 1) % 3  # the edge opposite the corner without weight
        good = (s.owns[t] >> (3 + k)) & 1
        along = unit(corner(s, t, k + 1) - corner(s, t, k))
        if ti.abs(along.dot(n)) > ASKEW:
            good = 0
        v = s.neighbour[t, k]
        if v >= 0:
            facing += s.normal[v]
            e = s.x[opposite(s, v, s.triangle[t, k], s.triangle[t, (k + 1) % 3])] - x
            if e.dot(n) < -0.05 * e.norm():
                good = 0
        if facing.dot(n) >= 0.0:
            good = 0
    elif facing.cross(n).norm() > ASKEW or facing.dot(n) > 0.0:
        good = 0
    return good


@ti.func
def _local(s: ti.template(), o: ti.template(), t, j, k, R, R1):
    """Corner j of triangle t in the frame of obstacle k, and how far it goes there in the step."""
    x = corner(s, t, j)
    p = R.transpose() @ (x - o.origin[k])
    return p, R1.transpose() @ (x + s.move[s.triangle[t, j]] - o.next_origin[k]) - p


@ti.func
def _touch(s: ti.template(), o: ti.template(), t, k, margin, out: ti.template(), start, end):
    """Contacts of triangle t with obstacle k. Returns the new count."""
    at = start
    R, R1 = _rows(o.rotation, k), _rows(o.next_rotation, k)
    # corners now and how far they go, in the obstacle's frame
    A, a = _local(s, o, t, 0, k, R, R1)
    B, b = _local(s, o, t, 1, k, R, R1)
    C, c = _local(s, o, t, 2, k, R, R1)
    centre = (A + B + C) / 3.0
    reach = ti.max((A - centre).norm(), (B - centre).norm(), (C - centre).norm())
    way = ti.max(a.norm(), b.norm(), c.norm())
    kind = o.kind[k]
    middle, _ = o.sample(k, centre)
    if middle - reach - way <= margin:
        phi = dvec(0.0)
        for j in range(4):  # the corners, then the deepest point between them
            w = dvec(ti.cast(j == 0, ti.f64), ti.cast(j == 1, ti.f64), ti.cast(j == 2, ti.f64))
            wanted = 0
            if j < 3:
                wanted = (s.owns[t] >> j) & 1
            elif kind != shapes.HALF_SPACE:
                v, value = deepest_point(o, k, A, B, C, phi)
                for i in ti.static(range(3)):
                    w[i] = v[i]
                wanted = int(value < phi.min() - ti.cast(DEEPER, ti.f64) * reach and w.max() < 1.0 - 1e-6)
            p, move = w[0] * A + w[1] * B + w[2] * C, w[0] * a + w[1] * b + w[2] * c
            value, g = o.sample(k, p)
            for i in ti.static(range(3)):
                if i == j:
                    phi[i] = value
            if wanted == 1 and value + ti.min(move.dot(g), 0.0) <= margin:
                n = R @ g
                x = R @ p + o.origin[k]
                good = 0
                if j < 3:
                    good = in_normal_cone(s, s.triangle[t, j], n)
                    if kind == shapes.HALF_SPACE and value + ti.min(move.dot(g), 0.0) < 0.0:
                        good = 1
                else:
                    good = deeper_inside(s, t, w, n, x)
                if good == 1 and j < 3:
                    i = s.triangle[t, j]
                    write_contact(
                        out, at, end, s.body[t], o.body[k], ivec(VERTEX_FIELD, i, o.body[k]), x, n, value,
                        ivec(i, -1, -1), dvec(1.0, 0.0, 0.0), ivec(-1), dvec(0.0),
                    )  # fmt: skip
                    at += 1
                elif good == 1:
                    face = vertices_of(s, t)
                    write_contact(
                        out, at, end, s.body[t], o.body[k], ivec(FACE_FIELD, t, o.body[k]), x, n, value,
                        face, w, ivec(-1), dvec(0.0),
                    )  # fmt: skip
                    at += 1
    return at


@kernel(cse=False)
def find_analytic(
    s: ti.template(), o: ti.template(), margin: ti.f64, out: ti.template(), used: ti.template(), count: ti.template(),
    part: ti.i32, append: ti.i32,
):  # fmt: skip
    """Contacts of the soft bodies' triangles with all analytic obstacles, after those in the buffer where `more` is 1."""
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, end = c * part + append * used[c], (c + 1) * part
            for t in range(part_first(c, s.n_triangles, s.chunks), part_first(c + 1, s.n_triangles, s.chunks)):
                if s.soft[s.body[t]] == 1 and (s.lo[t] <= s.hi[t]).all():
                    for k in range(o.count):
                        at = _touch(s, o, t, k, margin, out, at, end)
            used[c] = at - c * part
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(used, count, s.chunks)
