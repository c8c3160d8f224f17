"""Contacts of the soft bodies' vertices and triangles with analytic obstacles, by exact signed distance phi.

A vertex near the obstacle is a contact if the normal lies in its normal cone. A vertex that is below a half-space, or gets below
it in the step, always is, even if its surface is inside out. A triangle adds its deepest point if that lies deeper than its
corners, as under a ball. A triangle is skipped if phi at its centre, minus its radius and its motion in the step, exceeds the
margin, since |grad phi| <= 1.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Count
from taisoft.backend.runtime import kernel
from taisoft.collision import shapes
from taisoft.collision.candidates import sum_parts
from taisoft.collision.contacts import FACE_FIELD, VERTEX_FIELD, write_contact
from taisoft.collision.features import corner, in_normal_cone, opposite, unit, vertices_of
from taisoft.collision.frank_wolfe import deepest_point
from taisoft.collision.surface import dvec, ivec, part_first

ALIGNMENT_SINE = 0.26  # sine of 15 degrees: tolerance of grad phi in the conditions of a minimum
MIN_EXTRA_DEPTH = 1e-5  # of a triangle's size: depth below its corners from which its deepest point is a contact


@dataclass(frozen=True, eq=False)
class AnalyticObstacles:
    """Shapes and frames of the analytic obstacles: world = rotation @ local + origin."""

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
        """Whether there are any."""
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
def is_surface_minimum(s: ti.template(), t, w, n, x):
    """1 if the deepest point x of triangle t, weights w, is also a local minimum of the whole surface that faces n.

    To within ALIGNMENT_SINE, n must oppose the triangle's normal at an interior point and be perpendicular to the edge at a point
    on an edge: at a kink of phi, as in the middle of a box, no gradient gives the exit direction. On an edge, the neighbour must
    not lie deeper, and only the triangle that owns the edge accepts.
    """
    facing = s.normal[t]
    valid = 1
    zero_corner = -1
    for j in ti.static(range(3)):
        if w[j] <= 0.0:
            zero_corner = j
    if zero_corner >= 0:
        k = (zero_corner + 1) % 3  # the edge opposite the corner of zero weight
        valid = (s.owns[t] >> (3 + k)) & 1
        along = unit(corner(s, t, k + 1) - corner(s, t, k))
        if ti.abs(along.dot(n)) > ALIGNMENT_SINE:
            valid = 0
        v = s.neighbour[t, k]
        if v >= 0:
            facing += s.normal[v]
            e = s.x[opposite(s, v, s.triangle[t, k], s.triangle[t, (k + 1) % 3])] - x
            if e.dot(n) < -0.05 * e.norm():
                valid = 0
        if facing.dot(n) >= 0.0:
            valid = 0
    elif facing.cross(n).norm() > ALIGNMENT_SINE or facing.dot(n) > 0.0:
        valid = 0
    return valid


@ti.func
def _local(s: ti.template(), o: ti.template(), t, j, k, R, R1):
    """Corner j of triangle t in the frame of obstacle k, and its displacement there in the step."""
    x = corner(s, t, j)
    p = R.transpose() @ (x - o.origin[k])
    return p, R1.transpose() @ (x + s.move[s.triangle[t, j]] - o.next_origin[k]) - p


@ti.func
def _obstacle_contacts(s: ti.template(), o: ti.template(), t, k, margin, out: ti.template(), start, end):
    """Write contacts of triangle t with obstacle k. Return the new count."""
    at = start
    R, R1 = _rows(o.rotation, k), _rows(o.next_rotation, k)
    # corners and their displacements in the obstacle's frame
    A, a = _local(s, o, t, 0, k, R, R1)
    B, b = _local(s, o, t, 1, k, R, R1)
    C, c = _local(s, o, t, 2, k, R, R1)
    centre = (A + B + C) / 3.0
    reach = ti.max((A - centre).norm(), (B - centre).norm(), (C - centre).norm())
    motion = ti.max(a.norm(), b.norm(), c.norm())
    kind = o.kind[k]
    middle, _ = o.sample(k, centre)
    if middle - reach - motion <= margin:
        phi = dvec(0.0)
        for j in range(4):  # the corners, then the deepest point between them
            w = dvec(ti.cast(j == 0, ti.f64), ti.cast(j == 1, ti.f64), ti.cast(j == 2, ti.f64))
            accepted = 0
            if j < 3:
                accepted = (s.owns[t] >> j) & 1
            elif kind != shapes.HALF_SPACE:
                v, value = deepest_point(o, k, A, B, C, phi)
                for i in ti.static(range(3)):
                    w[i] = v[i]
                accepted = int(value < phi.min() - ti.cast(MIN_EXTRA_DEPTH, ti.f64) * reach and w.max() < 1.0 - 1e-6)
            p, move = w[0] * A + w[1] * B + w[2] * C, w[0] * a + w[1] * b + w[2] * c
            value, g = o.sample(k, p)
            for i in ti.static(range(3)):
                if i == j:
                    phi[i] = value
            if accepted == 1 and value + ti.min(move.dot(g), 0.0) <= margin:
                n = R @ g
                x = R @ p + o.origin[k]
                valid = 0
                if j < 3:
                    valid = in_normal_cone(s, s.triangle[t, j], n)
                    if kind == shapes.HALF_SPACE and value + ti.min(move.dot(g), 0.0) < 0.0:
                        valid = 1
                else:
                    valid = is_surface_minimum(s, t, w, n, x)
                if valid == 1 and j < 3:
                    i = s.triangle[t, j]
                    write_contact(
                        out,
                        at,
                        end,
                        s.body[t],
                        o.body[k],
                        ivec(VERTEX_FIELD, i, o.body[k]),
                        x,
                        n,
                        value,
                        ivec(i, -1, -1),
                        dvec(1.0, 0.0, 0.0),
                        ivec(-1),
                        dvec(0.0),
                    )
                    at += 1
                elif valid == 1:
                    face = vertices_of(s, t)
                    write_contact(
                        out,
                        at,
                        end,
                        s.body[t],
                        o.body[k],
                        ivec(FACE_FIELD, t, o.body[k]),
                        x,
                        n,
                        value,
                        face,
                        w,
                        ivec(-1),
                        dvec(0.0),
                    )
                    at += 1
    return at


@kernel(cse=False)
def find_analytic(
    s: ti.template(),
    o: ti.template(),
    margin: ti.f64,
    out: ti.template(),
    used: ti.template(),
    count: ti.template(),
    part: ti.i32,
    append: ti.i32,
):
    """Write contacts of the soft bodies' triangles with all analytic obstacles; they are appended if `append` is 1."""
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, end = c * part + append * used[c], (c + 1) * part
            for t in range(part_first(c, s.n_triangles, s.chunks), part_first(c + 1, s.n_triangles, s.chunks)):
                if s.soft[s.body[t]] == 1 and (s.lo[t] <= s.hi[t]).all():
                    for k in range(o.count):
                        at = _obstacle_contacts(s, o, t, k, margin, out, at, end)
            used[c] = at - c * part
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(used, count, s.chunks)
