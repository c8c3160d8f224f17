"""Contacts by proximity of deformed surfaces: of vertices (`vertex_face`), then of two crossing edges.

Edges: contacts lie at the nearest points of their lines, along the normal n perpendicular to both.

n must lie in the normal cones of both edges. Penetrating edges have shifted along each other, so they may cross slightly beyond
an end. Skip an edge pair when an endpoint's vertex contact already separates it. Pairs that do not cross are tested again at
their positions at the end of the step, with the face normals of its start. Weak: if faces turn far within a step, the side may
be wrong.
"""

from dataclasses import dataclass

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.candidates import EDGES, Visitor, sum_parts, visit_near
from taisoft.collision.contacts import EDGE_EDGE, write_contact
from taisoft.collision.features import (
    BY_FACES,
    EDGE_SLACK,
    closest_lines,
    corner,
    edge_in_normal_cone,
    edge_normal,
    in_normal_cone,
    mark_sharp_edges,
    unit,
)
from taisoft.collision.surface import INSIDE_BITS, dvec, ivec, sum_pairs
from taisoft.collision.vertex_face import max_self_depth, vertex_contacts

# Penetrating edges have shifted along each other and may cross beyond an end, by at most MAX_MISS depths and MAX_OVERHANG lengths
# of the edge; the surfaces are elsewhere farther out
MAX_MISS, MAX_OVERHANG = 2.0, 0.05
MIN_MOTION = 1e-3  # of the shorter edge: relative motion in a step below which no new crossing counts
CROSSING = 0.02  # sine below which two edges count as parallel
END_RANGE = 10.0  # depths from an end within which the end's own contact covers a crossing
FREED = 0.1  # of a crossing's depth: a smaller remaining depth does not count once the end is out
SHALLOW = 0.2  # of the crossed edge's length: a deeper crossing is probably a false one across a groove
# Of an edge's length: an end this little before the faces counts as behind them. Where a vertex passes a sharp edge, its edges on
# both sides cross that edge slightly beyond their ends, each along its own normal
END_SLACK = 5e-4
TINY = 1e-9  # of lengths: rounding


@ti.func
def _height(s: ti.template(), p, u, m):
    """Height [m] of point p over the higher of the faces at edge m of triangle u."""
    d = p - corner(s, u, m)
    height = d.dot(s.normal[u])
    if s.neighbour[u, m] >= 0:
        height = ti.max(height, d.dot(s.normal[s.neighbour[u, m]]))
    return height


@ti.func
def _is_behind(s: ti.template(), i, length, u, m, fraction):
    """1 if vertex i, of an edge of the given length, lies behind both faces at edge m of triangle u, or before them by at most
    the given fraction of the length."""
    slack = fraction * length + ti.cast(TINY, ti.f64) * (length + (s.x[i] - corner(s, u, m)).norm())
    return int(_height(s, s.x[i], u, m) <= slack)


@ti.func
def _is_past_end(s: ti.template(), t, k, position, length, gap, q):
    """1 if edge k of triangle t is crossed so near an end that point q of the other edge, below it, is outside the body again:
    in front of a face at that end that the edge lies behind."""
    past = 0
    for e in range(2):
        if ti.select(e == 0, position, length - position) < -gap:
            i, j = s.triangle[t, (k + e) % 3], s.triangle[t, (k + 1 - e) % 3]
            r = s.ring_start[i]
            while past == 0 and r < s.ring_start[i + 1]:
                n = s.normal[s.ring[r]]
                past = int((s.x[j] - s.x[i]).dot(n) < -ti.cast(EDGE_SLACK, ti.f64) * length) & int((q - s.x[i]).dot(n) > 0.0)
                r += 1
    return past


@ti.func
def _is_freed(s: ti.template(), p, i, u, m, gap):
    """1 if the exit displacement of vertex i also frees point p of its edge, `gap` < 0 deep below edge m of triangle u: the depth
    left is below FREED of that. A point deeper than SHALLOW counts as freed: it is far from where i entered."""
    depth = -_height(s, p + s.exit_direction[i], u, m)
    shallow = ti.cast(SHALLOW, ti.f64) * (corner(s, u, m + 1) - corner(s, u, m)).norm()
    return int(depth < -ti.cast(FREED, ti.f64) * gap) | int(-gap > shallow)


@ti.func
def _covered_by_end(s: ti.template(), t, k, p, position, length, gap, u, m, n, by_faces):
    """1 if edge k of triangle t crosses at p so near an end that the end's own contact covers it: the end is inside, behind both
    faces at edge m of triangle u, n is in its normal cone, and moving it out removes the crossing too.

    by_faces: whether vertices find contacts with u's collider by faces; only then `inside` shows if the end has a contact.
    """
    covered, end_range = 0, -ti.cast(END_RANGE, ti.f64) * gap
    if gap < 0.0:
        for e in range(2):
            i = s.triangle[t, (k + e) % 3]
            valid = int(ti.select(e == 0, position, length - position) <= end_range)
            if valid == 1 and by_faces == 1:
                valid = (s.inside[i] >> (s.body[u] % INSIDE_BITS)) & 1
                if valid == 1:
                    valid = _is_freed(s, p, i, u, m, gap)
            if valid == 1:
                valid = _is_behind(s, i, length, u, m, ti.cast(0.0, ti.f64))
            if valid == 1:
                covered = covered | in_normal_cone(s, i, n)
    return covered


@ti.func
def _within(s: ti.template(), t, k, position, length, overhang, u, m):
    """1 if edge k of triangle t is crossed between its ends, or at most `overhang` beyond an end that lies inside.

    Edges of two bodies side by side also cross beyond their ends, one below the other, without penetration.
    """
    beyond = ti.min(overhang, ti.cast(MAX_OVERHANG, ti.f64) * length)
    valid = int(-beyond <= position <= length + beyond)
    if valid == 1 and (position < 0.0 or position > length):
        e = int(position > length)
        valid = _is_behind(s, s.triangle[t, (k + e) % 3], length, u, m, ti.cast(END_SLACK, ti.f64))
    return valid


@ti.func
def _move(s: ti.template(), t, k, f):
    """Displacement (3,) [m] in the step of the point at parameter f of edge k of triangle t."""
    return (1.0 - f) * s.move[s.triangle[t, k]] + f * s.move[s.triangle[t, (k + 1) % 3]]


@ti.func
def _moves_enough(s: ti.template(), t, k, u, m):
    """1 if two edges move relative to each other by more than MIN_MOTION in the step; skips the second test for edges at rest."""
    max_motion = ti.cast(0.0, ti.f64)
    for i in range(2):
        for j in range(2):
            max_motion = ti.max(max_motion, (_move(s, t, k, ti.cast(i, ti.f64)) - _move(s, u, m, ti.cast(j, ti.f64))).norm())
    shorter = ti.min((corner(s, t, k + 1) - corner(s, t, k)).norm(), (corner(s, u, m + 1) - corner(s, u, m)).norm())
    return int(max_motion > ti.cast(MIN_MOTION, ti.f64) * shorter)


@ti.func
def _max_depth(s: ti.template(), t, k, u, m, f, g, la, lb):
    """Largest depth [m] of a true crossing: edges on the far sides of thin bodies side by side cross too, as deep as both are
    thick."""
    deepest = ti.cast(0.5, ti.f64) * ti.min(la, lb, s.thickness[s.body[t]], s.thickness[s.body[u]])
    if s.body[t] == s.body[u]:  # deeper crossings are the body's own compressed thickness
        rest = (1.0 - f) * s.rest[s.triangle[t, k]] + f * s.rest[s.triangle[t, (k + 1) % 3]]
        rest -= (1.0 - g) * s.rest[s.triangle[u, m]] + g * s.rest[s.triangle[u, (m + 1) % 3]]
        deepest = ti.min(deepest, max_self_depth(s, s.body[t], rest.norm()))
    return deepest


@ti.func
def edge_contact(s: ti.template(), t, k, u, m, times, margin, out: ti.template(), start, end):
    """Write the contact of edge k of triangle t with edge m of triangle u if they cross now, or cross and penetrate at the end of
    the step, as a fold that slides over an edge does. The gap is that of the same points at the start. Return the new count.

    times: which of both is tested, as `possible_crossings` returns it."""
    at = start
    for at_end in range(2):
        valid = int(at == start) & (times >> at_end)
        if at_end == 1 and valid == 1:
            valid = _moves_enough(s, t, k, u, m)
        if valid == 1:
            shift, closing = ti.cast(at_end, ti.f64), ti.cast(0.0, ti.f64)
            a0, a1 = corner(s, t, k) + shift * _move(s, t, k, 0.0), corner(s, t, k + 1) + shift * _move(s, t, k, 1.0)
            b0, b1 = corner(s, u, m) + shift * _move(s, u, m, 0.0), corner(s, u, m + 1) + shift * _move(s, u, m, 1.0)
            da, db = a1 - a0, b1 - b0
            c = da.cross(db)
            la, lb = da.norm(), db.norm()
            if c.norm() > ti.cast(CROSSING, ti.f64) * la * lb:
                n = unit(c)
                f, g, _ = closest_lines(a0, a1, b0, b1)
                gap = (a0 - b0).dot(n)
                overhang = (1.0 - shift) * ti.cast(MAX_MISS, ti.f64) * ti.abs(gap)  # 0 at the end of the step
                # cheap test first: most pairs do not cross, whichever is above
                valid = int(-overhang <= f * la <= la + overhang) & int(-overhang <= g * lb <= lb + overhang)
                if valid == 1:
                    n_t, n_u = edge_normal(s, t, k), edge_normal(s, u, m)
                    if n.dot(n_u - n_t) < 0.0:
                        n, gap = -n, -gap
                    closing = -(_move(s, t, k, f) - _move(s, u, m, g)).dot(n)
                    overhang = ti.cast(MAX_MISS, ti.f64) * ti.max(-gap, 0.0)
                    in_range = gap - ti.max(closing, 0.0) <= margin and gap >= -_max_depth(s, t, k, u, m, f, g, la, lb)
                    if at_end == 1:  # if they come from farther away, other features are nearest by then
                        min_gap = -ti.cast(MIN_MOTION, ti.f64) * ti.min(la, lb)  # passed by less: still above
                        in_range = in_range and gap < 0.0 and gap + closing > min_gap and gap + closing <= margin
                    # both signs of n lie in the normal cone of a nearly flat edge: take the sides that face each other
                    valid = int(in_range) & int(n.dot(n_u) > 0.0) & int(n.dot(n_t) < 0.0)
                for side in range(2):  # one edge, then the other, so that callees are compiled once
                    t1, k1, t2, k2 = ti.select(side, u, t), ti.select(side, m, k), ti.select(side, t, u), ti.select(side, k, m)
                    position, length, along = ti.select(side, g * lb, f * la), ti.select(side, lb, la), ti.select(side, -n, n)
                    if valid == 1:
                        valid = edge_in_normal_cone(s, t2, k2, along)
                    if valid == 1 and at_end == 0:
                        valid = _within(s, t1, k1, position, length, overhang, t2, k2)
                    if valid == 1 and at_end == 0:
                        valid = 1 - _is_past_end(s, t1, k1, position, length, gap, ti.select(side, a0 + f * da, b0 + g * db))
                    if valid == 1 and at_end == 0:
                        by_faces = int(s.mode[s.body[t2]] == BY_FACES) | int(s.body[t1] == s.body[t2])
                        p = ti.select(side, b0 + g * db, a0 + f * da)
                        valid = 1 - _covered_by_end(s, t1, k1, p, position, length, gap, t2, k2, along, by_faces)
                if valid == 1:
                    gap += shift * closing
                    # if a parameter was clamped, the contact is at that end
                    f_in, g_in = ti.min(ti.max(f, 0.0), 1.0), ti.min(ti.max(g, 0.0), 1.0)
                    middle = a0 + f_in * da - shift * _move(s, t, k, f) - 0.5 * gap * n
                    if g_in != g:
                        middle = b0 + g_in * db + 0.5 * gap * n
                    f, g = f_in, g_in
                    feature = ivec(EDGE_EDGE, 3 * t + k, 3 * u + m)
                    nodes_t = ivec(s.triangle[t, k], s.triangle[t, (k + 1) % 3], -1)
                    nodes_u = ivec(s.triangle[u, m], s.triangle[u, (m + 1) % 3], -1)
                    w_t, w_u, point = dvec(1.0 - f, f, 0.0), dvec(1.0 - g, g, 0.0), middle + 0.5 * gap * n
                    write_contact(out, at, end, s.body[t], s.body[u], feature, point, n, gap, nodes_t, w_t, nodes_u, w_u)
                    at += 1
    return at


@ti.func
def crossable(a, b):
    """Which edges k and m of two triangles can cross, in bits 3 k + m: one is sharp, the other sharp or flat. a, b: bits of
    `mark_sharp_edges`."""
    pairs = 0
    for k in ti.static(range(3)):
        pairs |= (ti.select((a >> k) & 1, b >> 3, 0) & 7 | ti.select((a >> k) & 8, b, 0) & 7) << 3 * k
    return pairs


@ti.func
def _pass_between_ends(p, q, w, slack):
    """1 if two lines, not nearly parallel, are nearest between the ends of their edges p and q, or beyond by `slack` of the edge.
    w: from the start of p to that of q."""
    pp, pq, qq, pw, qw = p.dot(p), p.dot(q), q.dot(q), p.dot(w), q.dot(w)
    square = pp * qq - pq * pq
    f, g = qq * pw - pq * qw, pq * pw - pp * qw  # times the square
    most = (1.0 + 2.0 * slack) * square
    inner = int(ti.abs(2.0 * f - square) <= most) & int(ti.abs(2.0 * g - square) <= most)
    return inner & int(square > ti.cast(0.9 * CROSSING**2, ti.f64) * pp * qq)


@ti.func
def _may_face(p, q, w, n_t, n_u, square_range):
    """1 if the sides of two such edges to which their normals n_t and n_u point may face each other, with a gap whose square is
    at most `square_range`, or a depth that counts."""
    c = p.cross(q)
    of_t, of_u, below, square = c.dot(n_t), c.dot(n_u), c.dot(w), c.dot(c)
    deepest = ti.cast(0.2501, ti.f64) * ti.min(p.dot(p), q.dot(q))  # see _max_depth
    most = ti.select(below * (of_u - of_t) > 0.0, deepest, square_range)
    return int(of_t * of_u <= ti.cast(TINY, ti.f64) * square) & int(below * below <= most * square)


@ti.func
def possible_crossings(s: ti.template(), t, k, u, m, margin):
    """When `edge_contact` may find a contact, without quotients: bit 0 at the start, bit 1 at the end of the step."""
    a, a1, b, b1 = s.triangle[t, k], s.triangle[t, (k + 1) % 3], s.triangle[u, m], s.triangle[u, (m + 1) % 3]
    p, q, w = s.x[a1] - s.x[a], s.x[b1] - s.x[b], s.x[b] - s.x[a]
    dp, dq, dw = s.move[a1] - s.move[a], s.move[b1] - s.move[b], s.move[b] - s.move[a]
    p1, q1, w1, tiny = p + dp, q + dq, w + dw, ti.cast(1e-6, ti.f64)
    found = _pass_between_ends(p, q, w, MAX_OVERHANG + tiny) | _pass_between_ends(p1, q1, w1, tiny) << 1
    if found != 0:
        n_t, n_u = edge_normal(s, t, k), edge_normal(s, u, m)
        reach = (1.0 + tiny) * margin + dw.norm() + (1.0 + 2.0 * ti.cast(MAX_OVERHANG, ti.f64)) * (dp.norm() + dq.norm())
        now = _may_face(p, q, w, n_t, n_u, reach * reach)
        found &= now | _may_face(p1, q1, w1, n_t, n_u, tiny * tiny * (p.dot(p) + q.dot(q))) << 1
    return found


class Vertices(Visitor):
    """Contacts of the vertices that a triangle owns."""

    first_query, last_query = 0, 3

    @ti.func
    def asks(self, surface: ti.template(), t, q):
        """See Visitor."""
        return (surface.owns[t] >> q) & 1

    @ti.func
    def meets(self, surface: ti.template(), own, other):
        """See Visitor."""
        return int(surface.mode[other] == BY_FACES) | int(other == own)

    @ti.func
    def visit(self, surface: ti.template(), t, q, entry: ti.template(), first, last, out: ti.template(), start, end):
        """See Visitor."""
        i, own = surface.triangle[t, q], surface.body[t]
        return vertex_contacts(surface, entry, first, last, i, own, surface.margin[0], out, start, end)


class Edges(Visitor):
    """Contacts of a triangle's sharp edges. They depend on the vertices found inside."""

    first_query, last_query = EDGES, EDGES + 1

    @ti.func
    def asks(self, surface: ti.template(), t, q):
        """See Visitor."""
        return int(surface.sharp[t] & 7 != 0)

    @ti.func
    def meets(self, surface: ti.template(), own, other):
        """See Visitor."""
        return 1

    @ti.func
    def visit(self, surface: ti.template(), t, q, entry: ti.template(), first, last, out: ti.template(), start, end):
        """See Visitor."""
        at = start
        for e in range(first, last):
            u = entry[e]
            pairs = crossable(surface.sharp[t], surface.sharp[u])
            while pairs != 0:  # from bit to bit, since nobody can predict which are set
                place = ti.math.popcnt((pairs & -pairs) - 1)
                k, m = place // 3, place % 3
                pairs &= pairs - 1
                times = possible_crossings(surface, t, k, u, m, surface.margin[0])
                if times != 0:
                    t1, k1, t2, k2 = t, k, u, m
                    if u < t:
                        t1, k1, t2, k2 = u, m, t, k
                    at = edge_contact(surface, t1, k1, t2, k2, times, surface.margin[0], out, at, end)
        return at


@dataclass(frozen=True, eq=False)
class Proximity:
    """Visitors of `find_proximity`."""

    vertices: Vertices = Vertices()
    edges: Edges = Edges()


PROXIMITY = Proximity()


@kernel(cse=False)
def find_proximity(surface: ti.template(), near: ti.template(), row: ti.template(), visitors: ti.template(), out: ti.template()):
    """Write all contacts by proximity, the first in the buffer `out`. visitors: PROXIMITY; the others as for `visit_near`."""
    mark_sharp_edges(surface)
    visit_near(surface, near, row, visitors.vertices, out, 0)
    visit_near(surface, near, row, visitors.edges, out, 1)
    sum_parts(surface.team, out)
    sum_parts(surface.team, row)
    sum_pairs(surface)
