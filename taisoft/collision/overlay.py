"""Overlay of two surfaces that face each other: integration points on both, for mean gaps (`mortar`).

A triangle of the slave is projected on the plane of one of the master, along whose normal gaps are measured: so a slave that
slides does not change them. Three points with the centroid and covariance of the intersection integrate exactly to degree 2.
A face of second order is four triangles; points have coordinates in the whole face. They count less from half the margin on and
not at all beyond it, nor where they are too deep. Where no surfaces cross, both sides must have been in front of each other at
the start, so that no far side of a flattened body counts.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.collision.candidates import Visitor
from taisoft.collision.features import BY_FACES, ROUNDING, choose, corner, unit
from taisoft.collision.surface import dvec
from taisoft.collision.vertex_face import max_self_depth

FACING = -0.9  # cosine between normals of triangles that face each other
MAX_DEPTH = 0.1  # of an overlay's width: deeper surfaces meet elsewhere first
TINY = 1e-7  # of a triangle's area: smaller overlays are rounding
BEHIND = 0.3  # of the slip: how far sides that meet in front of each other may have been behind each other at the start
MAX_CORNERS = 8  # of an intersection, which has six at most but for rounding

dvec2 = ti.types.vector(2, ti.f64)


@dataclass(frozen=True, eq=False)
class Points:
    """Buffer of integration points, for kernels."""

    triangle: Any  # i32: of the master
    area: Any  # f64: integration weight [m^2],
    share: Any  # f64: and the part of it that counts
    normal: Any  # 3-vectors f64: of the master
    slave: Any  # 3-vectors f64: barycentric coordinates in the slave face,
    master: Any  # 3-vectors f64: and in the master face
    hat: Any  # 3-vectors f64: hat functions of the corners of the slave face, see `mortar`
    nearest: Any  # f64: least gap in the step, at an iterate the gap there [m]
    apart: Any  # 3-vectors f64: from the point of the master to that of the slave [m]


def overlay_points(arena: FieldArena, capacity: int) -> Points:
    """Allocate a buffer."""
    fields = {name: arena.field(f"overlay_{name}", ti.f64, capacity) for name in ("area", "share", "nearest")}
    fields |= {name: arena.vectors(f"overlay_{name}", ti.f64, capacity) for name in ("normal", "slave", "master", "hat", "apart")}
    return Points(arena.field("overlay_triangle", ti.i32, capacity), **fields)


@dataclass(frozen=True, eq=False)
class Overlay(Visitor):
    """Fields beside those of the surface, for kernels; writes integration points, those of each slave triangle together."""

    start: Any  # (n_verts) 3-vectors f64: positions at the start of the step [m]
    behind: Any  # (1) f64: how far the surfaces may be behind each other there [m]
    spacing: Any  # (n_bodies) f64: mean distance of corner nodes [m], inf for obstacles
    quarter: Any  # (n_triangles) i32: place among the four triangles of a face of second order, -1 for a face of first order
    first: Any  # (n_triangles) i32: first integration point of each slave triangle,
    count: Any  # (n_triangles) i32: and their number
    is_near: Any  # (n_verts) i32: 1 for vertices of contacts of points: slave triangles have one at least
    is_slave: Any  # (n_verts) i32: 1 for corner nodes of faces with integration points
    coverage: Any  # (n_verts) f64: part of the faces around a slave node that is covered, those without any point left out
    contacts: Any  # (n_verts) 2-vectors i32: first mortar contact of each slave node in the buffer filled last, and their number

    @ti.func
    def asks(self, surface: ti.template(), t, q):
        """See Visitor."""
        return ti.max(
            self.is_near[surface.triangle[t, 0]], self.is_near[surface.triangle[t, 1]], self.is_near[surface.triangle[t, 2]]
        )

    @ti.func
    def meets(self, surface: ti.template(), own, other):
        """See Visitor: `own` is the slave, whose corner nodes are closer."""
        a, b = self.spacing[own], self.spacing[other]
        by_faces = int(surface.mode[own] == BY_FACES) & int(surface.mode[other] == BY_FACES)
        return by_faces & int(a < b or (a == b and own <= other))

    @ti.func
    def visit(self, surface: ti.template(), t, q, entry: ti.template(), first, last, out: ti.template(), start, end):
        """See Visitor."""
        at = start
        for e in range(first, last):
            u = entry[e]
            if surface.body[u] != surface.body[t] or u > t:
                if surface.normal[t].dot(surface.normal[u]) < ti.cast(FACING, ti.f64):
                    at = _integrate(surface, self, t, u, out, at, end)
        if self.count[t] == 0:
            self.first[t] = start
        self.count[t] += at - start
        return at


def build_overlay(arena: FieldArena, start: Any, edges: np.ndarray, first: np.ndarray, quadratic: np.ndarray) -> Overlay:
    """Allocate and fill the fields. start: as of Overlay; edges [m]: mean surface edge of each collider; first: its first
    triangle; quadratic: whether its faces are of second order."""
    quarter, n = np.full(max(first[-1], 1), -1), start.shape[0]
    for begin, end in zip(first[:-1][quadratic], first[1:][quadratic]):
        quarter[begin:end] = np.arange(end - begin) % 4
    return Overlay(
        start,
        arena.field("overlay_behind", ti.f64, 1, np.array([np.inf])),
        arena.field("overlay_spacing", ti.f64, len(edges), np.where(quadratic, 2.0, 1.0) * edges),
        arena.field("overlay_quarter", ti.i32, len(quarter), quarter.astype(np.int32)),
        *(arena.field(f"overlay_{name}", ti.i32, len(quarter)) for name in ("first", "count")),
        *(arena.field(f"overlay_{name}", ti.i32, n) for name in ("is_near", "is_slave")),
        arena.field("overlay_coverage", ti.f64, n),
        arena.vectors("overlay_contacts", ti.i32, n, n=2),
    )


# --- faces: three corners, of second order three middles too ----------------------------------------------------------


@ti.func
def n_face(overlay: ti.template(), t):
    """Number of nodes of the face of triangle t."""
    return ti.select(overlay.quarter[t] < 0, 3, 6)


@ti.func
def face_vertex(s: ti.template(), overlay: ti.template(), t, k):
    """Vertex k of the face of triangle t: corners, then the middles of the edges 01, 12 and 20."""
    row = t
    if overlay.quarter[t] >= 0:
        row = t - overlay.quarter[t] + ti.min(k, 3)
    return s.triangle[row, k % 3]


@ti.func
def shapes(overlay: ti.template(), t, b):
    """Shape functions (6,) of the nodes of the face of triangle t at barycentric coordinates b (3,), 0 where there is none."""
    result = ti.Vector.zero(ti.f64, 6)
    for k in ti.static(range(3)):
        result[k] = b[k]
    if overlay.quarter[t] >= 0:
        for k in ti.static(range(3)):
            result[k], result[k + 3] = b[k] * (2.0 * b[k] - 1.0), 4.0 * b[k] * b[(k + 1) % 3]
    return result


@ti.func
def _in_face(overlay: ti.template(), t, b):
    """Barycentric coordinates (3,) in the face of triangle t, from those in the triangle."""
    k = overlay.quarter[t]
    inner = 0.5 * dvec(1.0 - b[1], 1.0 - b[2], 1.0 - b[0])
    at_corner = 0.5 * (b + dvec(ti.select(k == 0, 1.0, 0.0), ti.select(k == 1, 1.0, 0.0), ti.select(k == 2, 1.0, 0.0)))
    return ti.select(k < 0, b, ti.select(k == 3, inner, at_corner))


@ti.func
def on_face(s: ti.template(), overlay: ti.template(), t, weights, x: ti.template()):
    """Value (3,) of a field of vertices at a point of the face of triangle t with these `shapes`."""
    total = dvec(0.0)
    for k in range(n_face(overlay, t)):
        total += weights[k] * x[face_vertex(s, overlay, t, k)]
    return total


@ti.func
def _apart(s: ti.template(), overlay: ti.template(), t, u, slave, master, x: ti.template()):
    """Difference (3,) of a field of vertices between points on the faces of triangles t and u with these `shapes`."""
    return on_face(s, overlay, t, slave, x) - on_face(s, overlay, u, master, x)


@ti.func
def _flat_apart(s: ti.template(), t, u, on_t, on_u, x: ti.template()):
    """The same between points on triangles t and u themselves, whose paths are checked: faces of second order that are bent may
    overlap a little."""
    total = dvec(0.0)
    for k in ti.static(range(3)):
        total += on_t[k] * x[s.triangle[t, k]] - on_u[k] * x[s.triangle[u, k]]
    return total


# --- integration points -----------------------------------------------------------------------------------------------


@ti.func
def _barycentric(x, a, b, c):
    """Barycentric coordinates (3,) of x in a triangle of the plane, (2,) each."""
    whole = (b - a).cross(c - a)
    v, w = (x - a).cross(c - a) / whole, (b - a).cross(x - a) / whole
    return dvec(1.0 - v - w, v, w)


@ti.func
def _is_outside(a0, a1, a2, b0, b1, b2):
    """Whether all corners of triangle b lie clearly outside one side of the clockwise triangle a, (2,) each."""
    found = False
    for side in range(3):
        p, d = choose(side, a0, a1, a2), choose(side, a1 - a0, a2 - a1, a0 - a2)
        h = ti.max((b0 - p).cross(d), (b1 - p).cross(d), (b2 - p).cross(d))  # positive inside
        found = found or h < -ti.cast(ROUNDING, ti.f64) * d.dot(d)
    return found


@ti.func
def _intersection(a0, a1, a2, b0, b1, b2):
    """Intersection of the clockwise triangle a and the anticlockwise triangle b, (2,) each: area, centroid (2,) and covariance
    (xx, xy, yy)."""
    x, y = ti.Matrix.zero(ti.f64, MAX_CORNERS, 2), ti.Matrix.zero(ti.f64, MAX_CORNERS, 2)
    for q in ti.static(range(2)):
        x[0, q], x[1, q], x[2, q] = b0[q], b1[q], b2[q]
    n = 3
    for side in range(3):  # Sutherland and Hodgman 1974
        p, q = choose(side, a0, a1, a2), choose(side, a1, a2, a0)
        m = 0
        for i in range(n):
            j = ti.select(i + 1 < n, i + 1, 0)
            u, v = dvec2(x[i, 0], x[i, 1]), dvec2(x[j, 0], x[j, 1])
            h, k = (u - p).cross(q - p), (v - p).cross(q - p)  # positive inside
            if h >= 0.0 and m < MAX_CORNERS:
                y[m, 0], y[m, 1] = u[0], u[1]
                m += 1
            if (h >= 0.0) != (k >= 0.0) and m < MAX_CORNERS:
                cut = u + h / (h - k) * (v - u)
                y[m, 0], y[m, 1] = cut[0], cut[1]
                m += 1
        n = m
        for i in range(n):
            x[i, 0], x[i, 1] = y[i, 0], y[i, 1]
    area, first, second, origin = ti.cast(0.0, ti.f64), dvec2(0.0), dvec(0.0), dvec2(x[0, 0], x[0, 1])
    for i in range(1, n - 1):
        u, v = dvec2(x[i, 0], x[i, 1]) - origin, dvec2(x[i + 1, 0], x[i + 1, 1]) - origin
        part, w = 0.5 * u.cross(v), u + v
        area += part
        first += part / 3.0 * w
        for q in ti.static(range(3)):
            k, l = ti.static(((0, 0), (0, 1), (1, 1))[q])
            second[q] += part / 12.0 * (u[k] * u[l] + v[k] * v[l] + w[k] * w[l])
    m = first / area
    return area, origin + m, second / area - dvec(m[0] * m[0], m[0] * m[1], m[1] * m[1])


@ti.func
def _rest_normal(s: ti.template(), t):
    a = s.rest[s.triangle[t, 0]]
    return unit((s.rest[s.triangle[t, 1]] - a).cross(s.rest[s.triangle[t, 2]] - a))


@ti.func
def _max_depth(s: ti.template(), overlay: ti.template(), t, u, slave, master, width):
    """How deep [m] points of two faces, with these `shapes` and an overlay of a width, may be; deeper ones are on the far sides
    of thin bodies, or of tips."""
    a, b = s.body[t], s.body[u]
    depth = ti.min(0.5 * ti.min(s.thickness[a], s.thickness[b]), MAX_DEPTH * width)
    if a == b:
        rest, n = _apart(s, overlay, t, u, slave, master, s.rest), _rest_normal(s, u)
        depth = ti.min(depth, max_self_depth(s, a, rest.norm()))
        # what is near at rest counts only across a slot
        if rest.norm() <= s.edge[a] and (rest.dot(n) <= 0.0 or n.dot(_rest_normal(s, t)) > ti.cast(FACING, ti.f64)):
            depth = -ti.math.inf
    return depth


@ti.func
def _integrate(s: ti.template(), overlay: ti.template(), t, u, out: ti.template(), start, end):
    """Write the integration points of slave triangle t on master triangle u to out[start:end]. Return the new count."""
    at, n, origin = start, 1.0 * s.normal[u], corner(s, t, 0)
    side = corner(s, t, 1) - origin
    e = unit(side - side.dot(n) * n)
    E = ti.Matrix.rows([e, n.cross(e)])
    a1, a2, b0 = E @ (corner(s, t, 1) - origin), E @ (corner(s, t, 2) - origin), E @ (corner(s, u, 0) - origin)
    a0, b1, b2 = dvec2(0.0), E @ (corner(s, u, 1) - origin), E @ (corner(s, u, 2) - origin)
    area, middle, covariance = ti.cast(0.0, ti.f64), dvec2(0.0), dvec(0.0)
    if not (_is_outside(a0, a1, a2, b0, b1, b2) or _is_outside(b0, b2, b1, a0, a1, a2)):
        area, middle, covariance = _intersection(a0, a1, a2, b0, b1, b2)
    if area > ti.cast(TINY, ti.f64) * ti.max(s.area[t], s.area[u]):
        l0 = ti.sqrt(covariance[0])  # of its Cholesky factor
        l1 = covariance[1] / l0
        l2 = ti.sqrt(ti.max(covariance[2] - l1 * l1, 0.0))
        width = ti.sqrt(12.0) * l0 * l2 / dvec(l0, l1, l2).norm()
        for k in range(3):
            c = ti.sqrt(ti.cast(2.0, ti.f64)) * ti.select(k == 0, 1.0, -0.5)
            d = ti.sqrt(ti.cast(1.5, ti.f64)) * ti.select(k == 0, 0.0, ti.select(k == 1, 1.0, -1.0))
            x = middle + dvec2(l0 * c, l1 * c + l2 * d)
            on_t, on_u = _barycentric(x, a0, a1, a2), _barycentric(x, b0, b1, b2)
            slave, master = _in_face(overlay, t, on_t), _in_face(overlay, u, on_u)
            of_t, of_u = shapes(overlay, t, slave), shapes(overlay, u, master)
            apart, before = _apart(s, overlay, t, u, of_t, of_u, s.x), _flat_apart(s, t, u, on_t, on_u, overlay.start)
            closing, gap = -_apart(s, overlay, t, u, of_t, of_u, s.move).dot(n), apart.dot(n)
            motion = _flat_apart(s, t, u, on_t, on_u, s.x) - before
            behind = overlay.behind[0] + ti.cast(BEHIND, ti.f64) * (motion - motion.dot(n) * n).norm()
            nearest = gap - ti.max(closing, 0.0)
            share = ti.min(2.0 - 2.0 * nearest / s.margin[0], 1.0)
            if share > 0.0 and before.dot(n) >= -behind and gap > -_max_depth(s, overlay, t, u, of_t, of_u, width):
                if at < end:
                    out.triangle[at], out.area[at], out.share[at], out.nearest[at] = u, area / 3.0, share, nearest
                    out.normal[at], out.slave[at], out.master[at], out.apart[at] = n, slave, master, apart
                at += 1
        if at > start:
            for k in range(3):
                overlay.is_slave[face_vertex(s, overlay, t, k)] = 1
    return at
