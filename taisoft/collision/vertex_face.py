"""Contacts of a vertex with a face, an edge or a corner of another surface, both as they are deformed.

Every vertex looks at the triangles of one other collider near its way (`near.py`). Outside, each local minimum of the distance
is a contact: above a groove there are two, across a flat edge between two triangles there is one. Inside, each face that the
vertex can leave by is one; faces that meet in a ridge or a tip are left together, by way of that ridge or tip. Faces count only
where the vertex's own surface sticks out along their normal, or, if it sticks out along none, looks at them: so the vertex under
a block never takes the far side of a thin sheet for its way out.
"""

import taichi as ti

from taisoft.collision.contacts import VERTEX_FACE, write_contact
from taisoft.collision.features import (
    ROUNDING,
    corner,
    edge_normal,
    in_normal_cone,
    moved,
    nearest_of_ring,
    opposite,
    ring_normal,
    unit,
    vertices_of,
)
from taisoft.collision.surface import INSIDE_BITS, dvec, ivec
from taisoft.collision.triangles import CORNER, EDGE, closest_on_triangle

TOGETHER = 2.0  # depths behind two faces of a ridge that differ by less are left together
GROOVE = 10.0  # depths behind a groove's wall, beyond the margin, that there may be behind its other one
SAME = 0.999  # cosine above which two faces count as one plane
KEPT = 16  # faces near a vertex that are remembered between passes
FACES = 8  # of a tip that are told apart
FACING = -0.5  # cosine between normals below which a vertex looks at a face
SLIGHTER = 0.25  # of the depth behind the face that it sticks out to: less behind one that it looks at goes before
SLIGHT = 1e-6  # of a triangle's size: a vertex so little outside a side is not yet outside; wider than what `edge_edge` allows
THROUGH = 0.5  # of their distance at rest: so far apart or farther, parts of one body count as near by at rest too
TINY = 1e-9  # of a triangle's size: nearer, a direction comes from normals

NONE, OUTSIDE, INSIDE, BESIDE = 0, 1, 2, 3


@ti.func
def through(s: ti.template(), body, apart):
    """How deep [m] parts of a body that are `apart` [m] at rest can be in each other: deeper, the body is squeezed between them.
    Parts less than an edge apart cannot: a thin body that is squeezed to half would be taken for one that meets itself."""
    return ti.select(apart > s.edge[body], ti.cast(THROUGH, ti.f64) * apart, ti.cast(0.0, ti.f64))


@ti.func
def relate(s: ti.template(), i, u):
    """How vertex i lies to triangle u: (state, normal, height over its plane, distance, weights of the nearest point, own).

    OUTSIDE: at the nearest point of the surface near by; the normal then leads from it. INSIDE: behind it; BESIDE: behind its
    plane, the foot beside it, as of the walls of a groove that is pierced at its bottom. NONE: anything else.
    own: 1 where it is part of the vertex's own body that is near by at rest too; behind such a face no vertex is inside.
    """
    p = s.x[i]
    size = ti.sqrt(s.area[u])
    n = 1.0 * s.normal[u]
    a, b, c = corner(s, u, 0), corner(s, u, 1), corner(s, u, 2)
    w, region = closest_on_triangle(p, a, b, c)
    d = p - (w[0] * a + w[1] * b + w[2] * c)
    distance = d.norm()
    h = (p - a).dot(n)
    state = NONE
    if size > 0.0 and h >= 0.0:
        state = OUTSIDE
        if region >= CORNER:
            k = region - CORNER
            state = NONE
            if (s.owns[u] >> k) & 1:
                if nearest_of_ring(s, s.triangle[u, k], d) == 1:
                    state = OUTSIDE
            if distance > ti.cast(TINY, ti.f64) * size:
                n = d / distance
            else:
                n = ring_normal(s, s.triangle[u, k])
        elif region >= EDGE:
            k = region - EDGE
            v = s.neighbour[u, k]
            if (s.owns[u] >> (3 + k)) & 1 == 0:
                state = NONE
            elif v >= 0:
                e = s.x[opposite(s, v, s.triangle[u, k], s.triangle[u, (k + 1) % 3])] - s.x[s.triangle[u, k]]
                if d.dot(e) > ti.cast(ROUNDING, ti.f64) * distance * e.norm():
                    state = NONE
            if distance > ti.cast(TINY, ti.f64) * size:
                n = d / distance
            else:
                n = unit(edge_normal(s, u, k))
    elif size > 0.0:
        state = INSIDE
        if distance * distance - h * h > ti.cast(TINY, ti.f64) * s.area[u]:
            state = BESIDE
    own = 0
    if s.body[u] == s.body[s.ring[s.ring_start[i]]]:
        c0, c1, c2 = s.rest[s.triangle[u, 0]], s.rest[s.triangle[u, 1]], s.rest[s.triangle[u, 2]]
        apart = s.rest[i] - (w[0] * c0 + w[1] * c1 + w[2] * c2)
        own = int(distance > ti.cast(THROUGH, ti.f64) * apart.norm())
        if h < 0.0 and (s.rest[i] - c0).dot((c1 - c0).cross(c2 - c0)) < 0.0:  # not across a slot, where it lies before the face
            own = int(distance > through(s, s.body[u], apart.norm()))
        if state == BESIDE or (own == 1 and state == INSIDE):
            state = NONE
    return state, n, h, distance, w, own


@ti.func
def _behind_each_other(s: ti.template(), p, u, n_u, v, n_v, slack):
    """Whether triangles u and v meet in a ridge as seen from p behind both: its foot on each lies behind the other."""
    h_u, h_v = (p - corner(s, u, 0)).dot(n_u), (p - corner(s, v, 0)).dot(n_v)
    foot_u, foot_v = p - h_u * n_u, p - h_v * n_v
    return int((foot_u - corner(s, v, 0)).dot(n_v) <= slack) & int((foot_v - corner(s, u, 0)).dot(n_u) <= slack)


@ti.func
def closing(s: ti.template(), i, u, w, n):
    """How much nearer vertex i comes to the point w of triangle u along n during the step [m], 0 where it leaves."""
    return ti.max(-(s.move[i] - moved(s, u, w)).dot(n), 0.0)


@ti.func
def vertex_contacts(
    s: ti.template(), entry: ti.template(), first, last, i, own, margin, out: ti.template(), start, end
):  # fmt: skip
    """Contacts of vertex i of collider `own` with the triangles entry[first:last], all of one collider. Returns the new count.

    out[start:end] is where contacts go; margin [m]: largest gap at the nearest moment of the step. Three passes in one loop, so
    that what they call is compiled once: what the vertex is, which faces it leaves together, and the contacts.
    """
    at = start
    p = s.x[i]
    other = s.body[entry[first]]
    inf = ti.cast(ti.math.inf, ti.f64)
    one = 1.0 + ti.cast(TINY, ti.f64)
    state, nearest, best, least = NONE, inf, -1, inf
    # what it lies beside counts at the nearest point of all, and unless some face there says that it is outside
    any_nearest, clear, nearest_beside, best_beside, least_beside = inf, 0, inf, -1, inf
    best_facing, least_facing = -1, inf  # of the faces that its surface looks at, though a neighbour lies deeper
    slack, n_best, total, way, depth = inf, dvec(0.0), dvec(0.0), dvec(0.0), inf
    normals = ti.Matrix.zero(ti.f64, FACES, 3)
    count = 0
    # faces that the later passes look at again; where they are too many, those go through the whole row
    kept = ti.Vector.zero(ti.i32, KEPT)
    n_kept = 0
    phase, q, size = 0, 0, last - first
    while phase <= 3:
        if q == size:  # the passes that follow rest on what the first found
            if phase == 0:
                if clear == 1 and state == INSIDE:
                    state = NONE
                if clear == 0 and nearest_beside < nearest:
                    state = INSIDE
                if clear == 0 and least_beside < least:
                    least, best = least_beside, best_beside
                if clear == 0 and best_facing >= 0:
                    # the neighbour may be out on the other side already; no far side is the way out of a slight penetration
                    if state == NONE or (state == INSIDE and least_facing < ti.cast(SLIGHTER, ti.f64) * least):
                        state, least, best = INSIDE, least_facing, best_facing
                if state == INSIDE:
                    n_best = 1.0 * s.normal[best]
                    slack = ti.cast(1e-6, ti.f64) * least
                    for c in ti.static(range(3)):
                        normals[0, c] = n_best[c]
                    total += n_best
                    count = 1
                elif state == OUTSIDE:
                    phase = 1
                else:
                    phase = 3
                if n_kept <= KEPT:
                    size = n_kept
            elif phase == 1:
                way, depth = n_best, least
                if count > 1 and total.norm() > 0.05:
                    way, depth = unit(total), inf  # along it the vertex leaves through the first face that it comes to
            elif phase == 2:
                size = 1
                if state == OUTSIDE:
                    phase = 3
            phase += 1
            q = 0
            if phase == 4 or size == 0:
                break
        u = best
        if phase < 3:
            u = entry[first + q]
            if phase > 0 and n_kept <= KEPT:
                u = kept[q]
        q += 1
        a, n, h, distance, w, own_near = relate(s, i, u)
        near = distance - closing(s, i, u, w, n) <= margin
        wanted = 0
        if phase == 0:
            if own_near == 0 and distance <= any_nearest * one:
                if distance * one < any_nearest:
                    clear, nearest_beside, best_beside, least_beside = 0, inf, -1, inf
                any_nearest = ti.min(any_nearest, distance)
                if h > ti.cast(SLIGHT, ti.f64) * ti.sqrt(s.area[u]):
                    clear = 1
            pierced = a == BESIDE and distance <= any_nearest * one
            wanted = int(a == INSIDE or pierced or (a == OUTSIDE and near))
            if wanted == 1:
                if n_kept < KEPT:
                    kept[n_kept] = u
                n_kept += 1
        elif state == OUTSIDE:
            wanted = int(a == OUTSIDE and near)
        elif phase < 3 and (a == INSIDE or (a == BESIDE and clear == 0 and distance <= any_nearest * one)):
            together = 0
            if a == INSIDE:
                together = _behind_each_other(s, p, best, n_best, u, n, slack)
            known = 0
            for k in range(count):
                if n.dot(dvec(normals[k, 0], normals[k, 1], normals[k, 2])) > ti.cast(SAME, ti.f64):
                    known = 1
            if phase == 1:
                wanted = int(together == 1 and known == 0 and count < FACES and -h <= TOGETHER * least + slack)
            elif known == 1 or together == 1:
                if count > 1 and n.dot(way) > 0.0:
                    depth = ti.min(depth, -h / n.dot(way))
            else:
                # a groove's other wall; the sides of a plate that has warped are deeper
                wanted = int(n.dot(n_best) > -0.5) & int(-h <= ti.cast(GROOVE, ti.f64) * least + margin)
        if wanted == 1:
            wanted = in_normal_cone(s, i, n)
            if phase == 0 and wanted == 0 and a == INSIDE and -h < least_facing:
                if n.dot(ring_normal(s, i)) < ti.cast(FACING, ti.f64):
                    least_facing, best_facing = -h, u
        gap = h
        if phase == 0 and wanted == 1:
            if a == BESIDE:
                nearest_beside = ti.min(nearest_beside, distance)
                if -h < least_beside:
                    least_beside, best_beside = -h, u
            else:
                if distance < nearest:
                    nearest, state = distance, a
                if a == INSIDE and -h < least:
                    least, best = -h, u
        elif phase == 1 and wanted == 1:
            for c in ti.static(range(3)):
                normals[count, c] = n[c]
            count += 1
            total += n
        elif phase == 3:
            wanted, gap = 1, -depth
            n = 1.0 * way
        elif state == OUTSIDE:
            gap = distance
        if phase >= 2 and wanted == 1:
            if state == INSIDE:
                s.inside[i] |= 1 << (other % INSIDE_BITS)
                s.exit_direction[i] -= gap * n
            write_contact(
                out, at, end, own, other, ivec(VERTEX_FACE, i, u), p, n, gap,
                ivec(i, -1, -1), dvec(1.0, 0.0, 0.0), vertices_of(s, u), w,
            )  # fmt: skip
            at += 1
    return at
