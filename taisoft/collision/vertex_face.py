"""Contacts of a vertex with a face, an edge or a corner of another surface, both deformed.

Each vertex is tested against the triangles of one other collider near its swept path. Outside, each local minimum of the
distance is a contact: two above a groove, one across a flat edge between two triangles. Inside, each face through which the
vertex can exit is a contact; faces that meet in a ridge or a tip share one exit direction, over that ridge or tip. A face
counts only if its normal lies in the vertex's normal cone or, if no face's normal does, if the vertex normal opposes it. So a
vertex under a block never exits through the far side of a thin sheet.
"""

import taichi as ti

from taisoft.collision.contacts import VERTEX_FACE, write_contact
from taisoft.collision.features import (
    CORNER,
    EDGE,
    ROUNDING,
    closest_on_triangle,
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

RIDGE_DEPTH_RATIO = 2.0  # largest ratio of the depths behind the faces of a ridge that share an exit direction
GROOVE_DEPTH_RATIO = 10.0  # largest depth behind a groove's second wall, beyond the margin, in depths behind the first
COPLANAR = 0.999  # cosine above which two faces count as one plane
MAX_STORED = 16  # faces near a vertex that are stored between passes
MAX_TIP_FACES = 8  # distinct faces of a tip
FACING = -0.5  # cosine between normals below which a vertex faces a triangle
FACING_DEPTH_RATIO = 0.25  # of the depth behind the face in the normal cone: a facing triangle less deep takes precedence
OUTSIDE_SLACK = 1e-6  # of a triangle's size: a vertex at most this far before a face is not outside; wider than in `edge_edge`
MAX_REST_RATIO = 0.5  # of the rest distance: parts of one body at least this far apart are neighbours at rest too
TINY = 1e-9  # of a triangle's size: below this distance, directions come from normals

NONE, OUTSIDE, INSIDE, BESIDE = 0, 1, 2, 3


@ti.func
def max_self_depth(s: ti.template(), body, rest_distance):
    """Largest possible self-penetration [m] of parts of a body `rest_distance` [m] apart; if deeper, the body is compressed.

    It is 0 for parts less than an edge apart: a thin body compressed to half would otherwise count as touching itself."""
    return ti.select(rest_distance > s.edge[body], ti.cast(MAX_REST_RATIO, ti.f64) * rest_distance, ti.cast(0.0, ti.f64))


@ti.func
def classify(s: ti.template(), i, u):
    """Classify vertex i against triangle u: (state, normal, height over its plane, distance, weights of the nearest point, own).

    OUTSIDE: u holds the locally nearest point of its surface, and the normal points from it to i. INSIDE: i is behind u. BESIDE:
    i is behind u's plane and projects beside u, as at the walls of a groove pierced at its bottom. NONE: anything else.
    own: 1 if u belongs to the vertex's body and is near the vertex at rest, too; no vertex is inside behind such a face.
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
        rest_distance = s.rest[i] - (w[0] * c0 + w[1] * c1 + w[2] * c2)
        own = int(distance > ti.cast(MAX_REST_RATIO, ti.f64) * rest_distance.norm())
        if h < 0.0 and (s.rest[i] - c0).dot((c1 - c0).cross(c2 - c0)) < 0.0:  # not across a slot, where i lies before the face
            own = int(distance > max_self_depth(s, s.body[u], rest_distance.norm()))
        if state == BESIDE or (own == 1 and state == INSIDE):
            state = NONE
    return state, n, h, distance, w, own


@ti.func
def may_have_contact(s: ti.template(), i, u, margin):
    """Whether `vertex_contacts` may accept triangle u for vertex i: it is near on the outer side, or i may count as behind it.

    This is known without a nearest point. margin [m]: as there.
    """
    a, b, c = corner(s, u, 0), corner(s, u, 1), corner(s, u, 2)
    d, e, f = s.x[i] - a, b - a, c - a
    h, n, own = d.dot(s.normal[u]), e.cross(f), s.body[u] == s.body[s.ring[s.ring_start[i]]]
    nn, far = n.dot(n), 1.0 * margin
    if h >= 0.0:  # no point of u closes faster than its fastest corner
        for k in ti.static(range(3)):
            far = ti.max(far, margin + (s.move[i] - s.move[s.triangle[u, k]]).norm())
    else:  # within one body, only the foot of the perpendicular counts
        far = ti.sqrt(4.0 * ti.cast(TINY, ti.f64) * s.area[u])
    v, w = f.cross(-d).dot(n), e.cross(d).dot(n)
    beyond = dvec(v + w - nn, -v, -w)  # heights over the edges' lines, times their lengths and the root of nn
    lengths = dvec((f - e).dot(f - e), f.dot(f), e.dot(e))
    far *= 1.0 + ti.cast(TINY, ti.f64)
    is_far = ti.max(beyond, 0.0) ** 2 > far * far * nn * lengths
    found = nn > 0.0 and not (h > far or is_far.any())
    if h < 0.0 and not own:
        found = True
    elif h < 0.0 and found:
        r, r1, r2 = s.rest[i] - s.rest[s.triangle[u, 0]], s.rest[s.triangle[u, 1]], s.rest[s.triangle[u, 2]]
        r1, r2 = r1 - s.rest[s.triangle[u, 0]], r2 - s.rest[s.triangle[u, 0]]
        # where i was as near behind u at rest, the body is only as thick as that
        found = r.dot(r1.cross(r2)) >= 0.0 or (r - (v * r1 + w * r2) / nn).norm() > 0.99 * s.edge[s.body[u]]
    return found


@ti.func
def _form_ridge(s: ti.template(), p, u, n_u, v, n_v, slack):
    """Whether triangles u and v form a ridge for p behind both: the projection of p onto each plane lies behind the other."""
    h_u, h_v = (p - corner(s, u, 0)).dot(n_u), (p - corner(s, v, 0)).dot(n_v)
    foot_u, foot_v = p - h_u * n_u, p - h_v * n_v
    return int((foot_u - corner(s, v, 0)).dot(n_v) <= slack) & int((foot_v - corner(s, u, 0)).dot(n_u) <= slack)


@ti.func
def vertex_contacts(s: ti.template(), entry: ti.template(), first, last, i, own, margin, out: ti.template(), start, end):
    """Write contacts of vertex i of collider `own` with triangles entry[first:last], all of one collider. Return the new count.

    Contacts go to out[start:end]. margin [m]: largest gap at the closest time of the step. Passes share one loop, so that their
    callees are compiled once: classify the vertex, and write its contacts as if it were outside; if it is inside, collect the
    faces of a common exit direction, and write the contacts instead.
    """
    at = start
    p = s.x[i]
    other = s.body[entry[first]]
    inf = ti.cast(ti.math.inf, ti.f64)
    one_plus = 1.0 + ti.cast(TINY, ti.f64)
    state, nearest, best, min_depth = NONE, inf, -1, inf
    # BESIDE triangles count only at the overall nearest point, and only if no face there has the vertex outside
    min_distance, outside, nearest_beside, best_beside, min_depth_beside = inf, 0, inf, -1, inf
    best_facing, min_depth_facing = -1, inf  # of faces opposed by the vertex normal, though a neighbour lies deeper
    slack, n_best, total, exit_direction, depth = inf, dvec(0.0), dvec(0.0), dvec(0.0), inf
    normals = ti.Matrix.zero(ti.f64, MAX_TIP_FACES, 3)
    count = 0
    # faces that i is behind, for the later passes; if there are too many, those passes use the whole row
    stored = ti.Vector.zero(ti.i32, MAX_STORED)
    n_stored = 0
    phase, q, size = 4, first, last - first
    while q < last and phase == 4:
        if may_have_contact(s, i, entry[q], margin):
            phase = 0
        q += 1
    q = 0
    while phase <= 3:
        if q == size:  # later passes depend on the results of the first
            if phase == 0:
                if outside == 1 and state == INSIDE:
                    state = NONE
                if outside == 0 and nearest_beside < nearest:
                    state = INSIDE
                if outside == 0 and min_depth_beside < min_depth:
                    min_depth, best = min_depth_beside, best_beside
                if outside == 0 and best_facing >= 0:
                    # a neighbour may be out on the far side already; a slight penetration never exits through the far side
                    if state == NONE or (state == INSIDE and min_depth_facing < ti.cast(FACING_DEPTH_RATIO, ti.f64) * min_depth):
                        state, min_depth, best = INSIDE, min_depth_facing, best_facing
                if state != OUTSIDE:
                    at = start
                if state == INSIDE:
                    n_best = 1.0 * s.normal[best]
                    slack = ti.cast(1e-6, ti.f64) * min_depth
                    for c in ti.static(range(3)):
                        normals[0, c] = n_best[c]
                    total += n_best
                    count = 1
                else:
                    phase = 3
                if n_stored <= MAX_STORED:
                    size = n_stored
            elif phase == 1:
                exit_direction, depth = n_best, min_depth
                if count > 1 and total.norm() > 0.05:
                    exit_direction, depth = unit(total), inf  # along it the vertex exits through the first face it reaches
            elif phase == 2:
                size = 1
            phase += 1
            q = 0
            if phase == 4 or size == 0:
                break
        u = best
        if phase < 3:
            u = entry[first + q]
            if phase > 0 and n_stored <= MAX_STORED:
                u = stored[q]
        q += 1
        relation, n, h, distance, w, own_near = classify(s, i, u)
        near = distance - ti.max(-(s.move[i] - moved(s, u, w)).dot(n), 0.0) <= margin
        accepted = 0
        if phase == 0:
            if own_near == 0 and distance <= min_distance * one_plus:
                if distance * one_plus < min_distance:
                    outside, nearest_beside, best_beside, min_depth_beside = 0, inf, -1, inf
                min_distance = ti.min(min_distance, distance)
                if h > ti.cast(OUTSIDE_SLACK, ti.f64) * ti.sqrt(s.area[u]):
                    outside = 1
            pierced = relation == BESIDE and distance <= min_distance * one_plus
            accepted = int(relation == INSIDE or pierced or (relation == OUTSIDE and near))
            if accepted == 1 and relation != OUTSIDE:
                if n_stored < MAX_STORED:
                    stored[n_stored] = u
                n_stored += 1
        elif phase < 3 and (relation == INSIDE or (relation == BESIDE and outside == 0 and distance <= min_distance * one_plus)):
            ridge = 0
            if relation == INSIDE:
                ridge = _form_ridge(s, p, best, n_best, u, n, slack)
            duplicate = 0
            for k in range(count):
                if n.dot(dvec(normals[k, 0], normals[k, 1], normals[k, 2])) > ti.cast(COPLANAR, ti.f64):
                    duplicate = 1
            if phase == 1:
                accepted = int(
                    ridge == 1 and duplicate == 0 and count < MAX_TIP_FACES and -h <= RIDGE_DEPTH_RATIO * min_depth + slack
                )
            elif duplicate == 1 or ridge == 1:
                if count > 1 and n.dot(exit_direction) > 0.0:
                    depth = ti.min(depth, -h / n.dot(exit_direction))
            else:
                # a groove's other wall; the sides of a warped plate are deeper
                accepted = int(n.dot(n_best) > -0.5) & int(-h <= ti.cast(GROOVE_DEPTH_RATIO, ti.f64) * min_depth + margin)
        if accepted == 1:
            accepted = in_normal_cone(s, i, n)
            if phase == 0 and accepted == 0 and relation == INSIDE and -h < min_depth_facing:
                if n.dot(ring_normal(s, i)) < ti.cast(FACING, ti.f64):
                    min_depth_facing, best_facing = -h, u
        gap = h
        if phase == 0 and accepted == 1:
            if relation == BESIDE:
                nearest_beside = ti.min(nearest_beside, distance)
                if -h < min_depth_beside:
                    min_depth_beside, best_beside = -h, u
            else:
                gap = ti.select(relation == OUTSIDE, distance, h)
                if distance < nearest:
                    nearest, state = distance, relation
                if relation == INSIDE and -h < min_depth:
                    min_depth, best = -h, u
        elif phase == 1 and accepted == 1:
            for c in ti.static(range(3)):
                normals[count, c] = n[c]
            count += 1
            total += n
        elif phase == 3:
            accepted, gap = 1, -depth
            n = 1.0 * exit_direction
        if accepted == 1 and (phase >= 2 or (phase == 0 and relation == OUTSIDE)):
            if phase >= 2:
                s.inside[i] |= 1 << (other % INSIDE_BITS)
                s.exit_direction[i] -= gap * n
            feature, vertex, alone = ivec(VERTEX_FACE, i, u), ivec(i, -1, -1), dvec(1.0, 0.0, 0.0)
            write_contact(out, at, end, own, other, feature, p, n, gap, vertex, alone, vertices_of(s, u), w)
            at += 1
    return at
