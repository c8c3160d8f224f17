"""Contacts with soft bodies by their signed distance at rest, mapped by the deformation (report, section 2.3.2).

A point near body B maps to B's material space through the tet behind the nearest of B's surface triangles near it:
X = X0 + F^-1 (x - x0). There phi is interpolated on a grid. In the world the normal is F^-T grad phi, normalised (a covector),
and the gap phi / |F^-T grad phi|. Vertices of A are contacts if the normal lies in their normal cone. A triangle adds its deepest
point if that is deeper than its corners: one Frank-Wolfe solve per (triangle, body), skipped if phi at the corners excludes it.
Weak: a grid rounds edges (crossing sharp edges are left to `edge_edge`), and far from rest phi is no longer a distance.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import Runtime, kernel
from taisoft.collision.candidates import Visitor, sum_parts, visit_near
from taisoft.collision.contacts import write_point_contact
from taisoft.collision.deepest_point import MIN_EXTRA_DEPTH, deepest_point, is_surface_minimum
from taisoft.collision.features import choose, closest_on_triangle, corner, in_normal_cone, moved, unit, vertices_of
from taisoft.collision.surface import dvec, ivec, sum_pairs
from taisoft.mesh.sdf import SdfGrid
from taisoft.scene.body import Body

MIN_DET_F = 1e-3  # det F below which a tet is not used for the mapping


@dataclass(frozen=True, eq=False)
class DistanceFields(Visitor):
    """Signed distance grids of the bodies, and the tets behind all surface triangles."""

    of_body: Any  # (n_bodies) i32: field of each collider, -1 for none
    origin: Any  # (fields) 3-vectors f64 [m]
    spacing: Any  # (fields) 3-vectors f64 [m]
    points: Any  # (fields) 3-vectors i32: grid points along each axis
    first: Any  # (fields) i32: index of each field's first value in phi
    phi: Any  # [m]
    x: Any  # the model's nodes
    behind: Any  # (n_triangles) 4-vectors i32: nodes of the tet behind each triangle
    corner: Any  # (n_triangles) 3-vectors f64: its first node at rest [m]
    inverse: Any  # (n_triangles, 3) 3-vectors f64 by rows: inverse of its rest edges [1/m]
    unmapped: Any  # (1) i32: pairs of a triangle and a body of the last search that no tet maps

    @ti.func
    def meets(self, surface: ti.template(), own, other):
        """See Visitor."""
        return int(self.of_body[other] >= 0) & int(other != own)

    @ti.func
    def visit(self, surface: ti.template(), t, q, entry: ti.template(), first, last, out: ti.template(), start, end):
        """See Visitor."""
        at, failed = _field_contacts(surface, self, entry, first, last, t, surface.margin[0], out, start, end)
        if failed > 0:  # rarely: atomics on one address wait for each other
            ti.atomic_add(self.unmapped[0], failed)
        return at

    @ti.func
    def sample(self, k, p):
        """phi [m] and its gradient at material point p (3,) of field k: trilinear, plus the distance to the grid beyond it."""
        cell, fraction = ivec(0), dvec(0.0)  # indexed by static numbers only
        outside = ti.cast(0.0, ti.f64)
        for q in ti.static(range(3)):
            last = ti.cast(self.points[k][q] - 1, ti.f64)
            at = (p[q] - self.origin[k][q]) / self.spacing[k][q]
            inside = ti.min(ti.max(at, 0.0), last)
            outside += ((at - inside) * self.spacing[k][q]) ** 2
            cell[q] = ti.min(ti.cast(inside, ti.i32), self.points[k][q] - 2)
            fraction[q] = inside - ti.cast(cell[q], ti.f64)
        n = self.points[k]
        base = self.first[k] + (cell[0] * n[1] + cell[1]) * n[2] + cell[2]
        value, g = ti.cast(0.0, ti.f64), dvec(0.0)
        for c in range(8):
            i, j, m = c >> 2, (c >> 1) & 1, c & 1
            f = ti.cast(self.phi[base + (i * n[1] + j) * n[2] + m], ti.f64)
            a, da = ti.select(i == 1, fraction[0], 1.0 - fraction[0]), 2.0 * ti.cast(i, ti.f64) - 1.0
            b, db = ti.select(j == 1, fraction[1], 1.0 - fraction[1]), 2.0 * ti.cast(j, ti.f64) - 1.0
            d, dd = ti.select(m == 1, fraction[2], 1.0 - fraction[2]), 2.0 * ti.cast(m, ti.f64) - 1.0
            value += a * b * d * f
            g += dvec(da * b * d, a * db * d, a * b * dd) * f
        return value + ti.sqrt(outside), g / self.spacing[k]

    @ti.func
    def gradient(self, k, p):
        """Gradient at p by central differences over one cell: continuous across cells, exact for linear phi."""
        g = dvec(0.0)
        for q in range(3):
            e = dvec(ti.cast(q == 0, ti.f64), ti.cast(q == 1, ti.f64), ti.cast(q == 2, ti.f64))
            step = 0.5 * choose(q, self.spacing[k][0], self.spacing[k][1], self.spacing[k][2])
            above, _ = self.sample(k, p + step * e)
            below, _ = self.sample(k, p - step * e)
            g += (above - below) / (2.0 * step) * e
        return g


def build_fields(
    bodies: list[Body],
    grids: list[SdfGrid | None],
    x: Any,
    first: np.ndarray,
    node_start: np.ndarray,
    runtime: Runtime,
    arena: FieldArena,
) -> DistanceFields:
    """Upload the grids, at least one (None for colliders without), and the tets behind the bodies' triangles."""
    used = [g for g in grids if g is not None]
    has_grid = np.array([g is not None for g in grids])
    n, count = max(int(first[-1]), 1), len(used)
    behind, tet_corner, inverse = np.zeros((n, 4), dtype=np.int32), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for k, body in enumerate(bodies):
        rows, tets = slice(first[k], first[k + 1]), body.nodes.boundary_tets
        rest = body.nodes.positions[tets]
        behind[rows], tet_corner[rows] = tets + node_start[k], rest[:, 0]
        inverse[rows] = np.linalg.inv((rest[:, 1:] - rest[:, :1]).transpose(0, 2, 1))
    phi = np.concatenate([g.phi.reshape(-1) for g in used])
    starts = np.cumsum([0, *(g.phi.size for g in used[:-1])]).astype(np.int32)
    return DistanceFields(
        arena.field("field_of_body", ti.i32, len(grids), np.where(has_grid, np.cumsum(has_grid) - 1, -1)),
        arena.vectors("field_origin", ti.f64, count, np.array([g.origin for g in used])),
        arena.vectors("field_spacing", ti.f64, count, np.array([g.spacing for g in used])),
        arena.vectors("field_points", ti.i32, count, np.array([g.phi.shape for g in used], dtype=np.int32)),
        arena.field("field_first", ti.i32, count, starts),
        arena.field("field_phi", runtime.real, len(phi), phi.astype(runtime.np_real)),
        x,
        arena.vectors("field_behind", ti.i32, n, behind, n=4),
        arena.vectors("field_corner", ti.f64, n, tet_corner),
        arena.vectors("field_inverse", ti.f64, 3 * n, inverse.reshape(-1, 3)),
        arena.field("unmapped", ti.i32, 1),
    )


@ti.func
def _nearest(s: ti.template(), f: ti.template(), entry: ti.template(), first, last, p):
    """Return the triangle of entry[first:last] nearest to p whose tet is not inverted, -1 if there is none."""
    found, min_squared = -1, ti.cast(ti.math.inf, ti.f64)
    for e in range(first, last):
        u = entry[e]
        outside = ti.max(s.lo[u] - p, p - s.hi[u], 0.0)  # distance to its box, a lower bound of that to the triangle
        if outside.dot(outside) < min_squared:
            a, b, c = corner(s, u, 0), corner(s, u, 1), corner(s, u, 2)
            w, _ = closest_on_triangle(p, a, b, c)
            d = p - (w[0] * a + w[1] * b + w[2] * c)
            if d.dot(d) < min_squared:
                if _gradient_of(f, u).determinant() > ti.cast(MIN_DET_F, ti.f64):
                    min_squared = d.dot(d)
                    found = u
    return found


@ti.func
def _gradient_of(f: ti.template(), u):
    """Deformation gradient of the tet behind triangle u."""
    x = f.x[f.behind[u][0]]
    D = ti.Matrix.cols([f.x[f.behind[u][1]] - x, f.x[f.behind[u][2]] - x, f.x[f.behind[u][3]] - x])
    return D @ ti.Matrix.rows([f.inverse[3 * u], f.inverse[3 * u + 1], f.inverse[3 * u + 2]])


@ti.func
def _to_material(f: ti.template(), u, p):
    """Map p to material space through the tet behind triangle u: the material point and F^-1."""
    G = _gradient_of(f, u).inverse()
    return f.corner[u] + G @ (p - f.x[f.behind[u][0]]), G


@ti.func
def _field_contacts(
    s: ti.template(), f: ti.template(), entry: ti.template(), first, last, t, margin, out: ti.template(), start, end
):
    """Write contacts of triangle t with the field of the body of entry[first:last]. Return the count, and 1 if no tet maps."""
    at, unmapped = start, 0
    other = s.body[entry[first]]
    k = f.of_body[other]
    A, B, C = dvec(0.0), dvec(0.0), dvec(0.0)  # corners in material space
    phi = dvec(0.0)
    reach, motion = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    j = 0
    while j < 4 and unmapped == 0:  # the corners, then the deepest point between them
        w = dvec(ti.cast(j == 0, ti.f64), ti.cast(j == 1, ti.f64), ti.cast(j == 2, ti.f64))
        accepted = True
        if j == 3:
            reach = ti.max((A - B).norm(), (B - C).norm(), (C - A).norm())
            # |grad phi| <= 1 at rest; world margin and motion are doubled there, which allows compression to half
            accepted = phi.min() - reach <= 2.0 * (margin + motion)
            if accepted:
                v, value = deepest_point(f, k, A, B, C, phi)
                w = 1.0 * v
                accepted = value < phi.min() - ti.cast(MIN_EXTRA_DEPTH, ti.f64) * reach and w.max() < 1.0 - 1e-6
        if accepted:
            x = w[0] * corner(s, t, 0) + w[1] * corner(s, t, 1) + w[2] * corner(s, t, 2)
            u = _nearest(s, f, entry, first, last, x)
            if u < 0:
                unmapped = 1
            else:
                X, G = _to_material(f, u, x)
                value, _ = f.sample(k, X)
                if j < 3:
                    motion = ti.max(motion, (s.move[s.triangle[t, j]] - moved(s, u, dvec(1.0 / 3.0))).norm())
                for i in ti.static(range(3)):
                    if i == j:
                        phi[i] = value
                        accepted = (s.owns[t] >> i) & 1 == 1
                A, B, C = ti.select(j == 0, X, A), ti.select(j == 1, X, B), ti.select(j == 2, X, C)
                if accepted:
                    n = G.transpose() @ f.gradient(k, X)
                    length = n.norm()
                    gap = value / ti.max(length, 1e-30)
                    n = unit(n)
                    a, b, c = corner(s, u, 0), corner(s, u, 1), corner(s, u, 2)
                    v, _ = closest_on_triangle(x - gap * n, a, b, c)
                    approach = (moved(s, t, w) - moved(s, u, v)).dot(n)
                    if length > 0.0 and gap + ti.min(approach, 0.0) <= margin:
                        valid = 0
                        if j < 3:
                            valid = in_normal_cone(s, s.triangle[t, j], n)
                        else:
                            valid = is_surface_minimum(s, t, w, n, x)
                        if valid == 1:
                            write_point_contact(s, out, at, end, t, j, w, other, x, n, gap, vertices_of(s, u), v)
                            at += 1
        j += 1
    return at, unmapped


@kernel(cse=False)
def find_in_fields(
    surface: ti.template(), near: ti.template(), row: ti.template(), fields: ti.template(), out: ti.template(), append: ti.i32
):
    """Write contacts with distance fields, and count in `fields.unmapped`. The others are as for `visit_near`."""
    fields.unmapped[0] = 0
    visit_near(surface, near, row, fields, out, append)
    sum_parts(surface.team, out)
    sum_parts(surface.team, row)
    sum_pairs(surface)
