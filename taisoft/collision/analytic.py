"""Contacts of the soft bodies' vertices and triangles with analytic obstacles, by exact signed distance phi.

A vertex near the obstacle is a contact if the normal lies in its normal cone. A vertex that is below a half-space, or gets below
it in the step, always is, even if its surface is inside out. A triangle adds its deepest point if that lies deeper than its
corners, as under a ball. A triangle is skipped if phi at its centre, minus its radius and its motion in the step, exceeds the
margin, since |grad phi| <= 1; first, which is cheaper, the sphere around its box.

phi and its gradient in a shape's own frame, phi negative inside: half-space: y. Sphere: |p| - r. Box: half extents h; outside the
distance to its surface, inside the largest p_i - h_i. Capsule: a segment along x of half length h, radius r. If the gradient is
not unique (at a centre, on a segment, on a box's diagonal planes), one of the possible unit vectors is returned.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, upload
from taisoft.backend.lists import part_first
from taisoft.backend.runtime import kernel
from taisoft.collision.candidates import sum_parts
from taisoft.collision.contacts import write_point_contact
from taisoft.collision.deepest_point import MIN_EXTRA_DEPTH, deepest_point, is_surface_minimum
from taisoft.collision.features import corner, in_normal_cone
from taisoft.collision.surface import dvec, ivec
from taisoft.scene.obstacles import Obstacle

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
def distance(kinds: ti.template(), kind, size, p):
    """Signed distance [m] and unit gradient (3,) of a shape of that kind, one of `kinds`, and size (3,) [m] at p (3,) [m], in its
    frame."""
    phi, g = p[1], dvec(0.0, 1.0, 0.0)
    if ti.static(SPHERE in kinds):
        if kind == SPHERE:
            phi, g = _from_core(p, size[0])
    if ti.static(BOX in kinds):
        if kind == BOX:
            phi, g = _box_distance(p, size)
    if ti.static(CAPSULE in kinds):
        if kind == CAPSULE:
            x = ti.min(ti.max(p[0], -size[0]), size[0])
            phi, g = _from_core(p - dvec(x, 0.0, 0.0), size[1])
    return phi, g


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
    kinds: tuple[int, ...] = ()  # that occur, ascending: kernels contain no others

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return self.body is not None

    @property
    def has_round(self) -> bool:
        """Whether spheres or capsules are among them."""
        return SPHERE in self.kinds or CAPSULE in self.kinds

    @ti.func
    def sample(self, k, p):
        """phi [m] and its gradient at p in the frame of obstacle k."""
        return distance(self.kinds, self.kind[k], self.size[k], p)


NO_SHAPES = AnalyticObstacles(0, *[None] * 7)


def build_analytic(obstacles: list[tuple[int, Obstacle]], arena: FieldArena) -> AnalyticObstacles:
    """Allocate the fields of these obstacles, given with their colliders, and upload all but their frames."""
    shapes, n = [o.shape for _, o in obstacles], len(obstacles)
    bodies, kinds = np.array([k for k, _ in obstacles], dtype=np.int32), np.array([x.kind for x in shapes], dtype=np.int32)
    rows = {"origin": n, "rotation": 3 * n, "next_origin": n, "next_rotation": 3 * n}
    return AnalyticObstacles(
        n,
        arena.field("obstacle_body", ti.i32, n, bodies),
        arena.field("obstacle_kind", ti.i32, n, kinds),
        arena.vectors("obstacle_size", ti.f64, n, np.array([x.size() for x in shapes])),
        *(arena.vectors(f"obstacle_{name}", ti.f64, count) for name, count in rows.items()),
        tuple(sorted({shape.kind for shape in shapes})),
    )


def obstacle_frame(obstacle: Obstacle, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return origin (3,) [m] and rotation (3,3) of an obstacle's own frame at time t [s]."""
    translation, rotation = obstacle.pose(t)
    return obstacle.shape.pivot + translation, rotation @ obstacle.shape.frame()


class AnalyticFrames:
    """Where analytic obstacles are, now and at the end of the step, on the host. obstacles: as for `build_analytic`."""

    def __init__(self, fields: AnalyticObstacles, obstacles: list[tuple[int, Obstacle]]):
        self._fields, self._obstacles = fields, obstacles
        self._frames = np.zeros((2, len(obstacles), 4, 3))  # each an origin (3,) [m] and a rotation (3,3) by rows

    def place(self, rows: Iterable[int], time: float, dt: float) -> None:
        """Update the frames of the obstacles in these rows, if any, to a time [s] and to the end of the step, and upload them."""
        for row in (rows := list(rows)):
            for frame, t in zip(self._frames[:, row], (time, time + dt)):
                frame[0], frame[1:] = obstacle_frame(self._obstacles[row][1], t)
        if rows:
            f = self._fields
            places = ((f.origin, f.rotation), (f.next_origin, f.next_rotation))
            pairs = [((x, own[:, 0]), (r, own[:, 1:].reshape(-1, 3))) for own, (x, r) in zip(self._frames, places)]
            upload([pair for both in pairs for pair in both])


@ti.func
def rotation_rows(f: ti.template(), k):
    """Rotation (3,3) of obstacle k, from a field of rows."""
    return ti.Matrix.rows([f[3 * k], f[3 * k + 1], f[3 * k + 2]])


@ti.func
def _local(s: ti.template(), o: ti.template(), t, j, k, R, R1):
    """Corner j of triangle t in the frame of obstacle k, and its displacement there in the step."""
    x = corner(s, t, j)
    p = R.transpose() @ (x - o.origin[k])
    return p, R1.transpose() @ (x + s.move[s.triangle[t, j]] - o.next_origin[k]) - p


@ti.func
def may_touch(s: ti.template(), o: ti.template(), t, k, margin):
    """Whether the sphere around the box that holds triangle t in the step lets it have contacts with obstacle k.

    In the obstacle's frame its points lie in spheres of this radius at the start and at the end, so none moves by more than the
    distance of these plus two radii; a half-space's phi is linear, and that at the end then bounds it.
    """
    centre, radius = 0.5 * (s.lo[t] + s.hi[t]), 0.5 * (s.hi[t] - s.lo[t]).norm()
    now = rotation_rows(o.rotation, k).transpose() @ (centre - o.origin[k])
    then = rotation_rows(o.next_rotation, k).transpose() @ (centre - o.next_origin[k])
    phi, _ = o.sample(k, now)
    spread = ti.select(o.kind[k] == HALF_SPACE, ti.cast(1.0, ti.f64), ti.cast(3.0, ti.f64))
    return phi - spread * radius - (then - now).norm() <= margin


@ti.func
def _obstacle_contacts(s: ti.template(), o: ti.template(), t, k, margin, out: ti.template(), start, end):
    """Write contacts of triangle t with obstacle k. Return the new count."""
    at = start
    R, R1 = rotation_rows(o.rotation, k), rotation_rows(o.next_rotation, k)
    # corners and their displacements in the obstacle's frame
    A, a = _local(s, o, t, 0, k, R, R1)
    B, b = _local(s, o, t, 1, k, R, R1)
    C, c = _local(s, o, t, 2, k, R, R1)
    centre = (A + B + C) / 3.0
    reach = ti.max((A - centre).norm(), (B - centre).norm(), (C - centre).norm())
    motion = ti.max(a.norm(), b.norm(), c.norm())
    kind = o.kind[k]
    middle, slope = o.sample(k, centre)
    if middle - reach - motion <= margin:
        phi = dvec(0.0)
        has_deepest = ti.static(o.kinds != (HALF_SPACE,))
        for j in range(ti.static(4 if has_deepest else 3)):  # the corners, then the deepest point between them
            w = dvec(ti.cast(j == 0, ti.f64), ti.cast(j == 1, ti.f64), ti.cast(j == 2, ti.f64))
            accepted = 0
            if j < 3:
                accepted = (s.owns[t] >> j) & 1
            elif ti.static(has_deepest):
                if kind != HALF_SPACE:
                    limit = phi.min() - ti.cast(MIN_EXTRA_DEPTH, ti.f64) * reach
                    # phi is convex, so that it lies above its tangent at the centre
                    lowest = middle + ti.min((A - centre).dot(slope), (B - centre).dot(slope), (C - centre).dot(slope))
                    if lowest < limit and lowest - motion <= margin:
                        v, value = deepest_point(o, k, A, B, C, phi)
                        w = 1.0 * v
                        accepted = int(value < limit and w.max() < 1.0 - 1e-6)
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
                    if kind == HALF_SPACE and value + ti.min(move.dot(g), 0.0) < 0.0:
                        valid = 1
                elif ti.static(has_deepest):
                    valid = is_surface_minimum(s, t, w, n, x)
                if valid == 1:
                    write_point_contact(s, out, at, end, t, j, w, o.body[k], x, n, value, ivec(-1), dvec(0.0))
                    at += 1
    return at


@ti.func
def write_analytic(s: ti.template(), o: ti.template(), margin, out: ti.template(), append):
    """See `find_analytic`. Top-level loops of a kernel."""
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, end = c * out.part + append * out.used[c], (c + 1) * out.part
            for t in range(part_first(c, s.n_triangles, s.chunks), part_first(c + 1, s.n_triangles, s.chunks)):
                if s.soft[s.body[t]] == 1 and (s.lo[t] <= s.hi[t]).all():
                    for k in range(o.count):
                        if s.rests[s.body[t]] & s.rests[o.body[k]]:
                            continue
                        if ti.static(s.has_attached):
                            if s.attached[s.body[t] * s.n_bodies + o.body[k]] == 1:
                                continue
                        if may_touch(s, o, t, k, margin):
                            at = _obstacle_contacts(s, o, t, k, margin, out.data, at, end)
            out.used[c] = at - c * out.part
    sum_parts(s.team, out)


@kernel(cse=False)
def find_analytic(s: ti.template(), o: ti.template(), margin: ti.f64, out: ti.template(), append: ti.i32):
    """Write contacts of the soft bodies' triangles with all analytic obstacles that these are not attached to, unless both rest.

    They are appended if `append` is 1.
    """
    write_analytic(s, o, margin, out, append)
