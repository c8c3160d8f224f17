"""Contacts of two edges that cross: where their lines are nearest, along the normal that is across both.

Both edges must stick out along it. Edges that penetrate have shifted along each other, so they may cross a little beyond an end.
Where an end lies inside the other body and the way out of its own contact frees the edge, that tells already. Edges that do not
cross are looked at again where they will be at the end of the step, with the faces as they stand at its start: where these turn
far within a step, the side may be taken wrongly.
"""

import taichi as ti

from taisoft.collision.contacts import EDGE_EDGE, write_contact
from taisoft.collision.features import BY_FACES, EDGE_SLACK, corner, edge_in_normal_cone, edge_normal, in_normal_cone, unit
from taisoft.collision.surface import INSIDE_BITS, dvec, ivec
from taisoft.collision.triangles import closest_lines
from taisoft.collision.vertex_face import through

# How far beyond the ends of edges that penetrate they may cross, since they have shifted along each other: in depths, and at most
# in lengths of the edge, since farther out the surfaces are elsewhere
MISS, BEYOND = 2.0, 0.05
AHEAD = 1e-3  # of the shorter edge: relative motion in a step below which nothing comes to cross that counts
CROSSING = 0.02  # sine below which two edges count as parallel
END = 10.0  # depths from an end within which it tells of a crossing
FREED = 0.1  # of a crossing's depth: less than that does not count once the end is out
SHALLOW = 0.2  # of the crossed edge's length: deeper, a crossing is likely none but seen across a groove
# Of an edge's length: an end that lies so little before the faces counts as behind them. Where a vertex passes a sharp edge, the
# edges on both sides of it cross that a little beyond it, each along its own normal
NEARLY = 5e-4
TINY = 1e-9  # of lengths: rounding


@ti.func
def _is_behind(s: ti.template(), i, length, u, m, share):
    """1 where vertex i, of an edge of that length, lies behind both faces at edge m of triangle u, or before them by no more than
    a share of the length."""
    d = s.x[i] - corner(s, u, m)
    slack = share * length + ti.cast(TINY, ti.f64) * (length + d.norm())
    behind = int(d.dot(s.normal[u]) <= slack)
    v = s.neighbour[u, m]
    if v >= 0:
        behind &= int(d.dot(s.normal[v]) <= slack)
    return behind


@ti.func
def _is_past_end(s: ti.template(), t, k, place, length, gap, q):
    """1 where edge k of triangle t is crossed so near an end that point q of the other edge, below it, is out of the body again:
    in front of a face at that end that the edge lies behind."""
    past = 0
    for e in range(2):
        if ti.select(e == 0, place, length - place) < -gap:
            i, j = s.triangle[t, (k + e) % 3], s.triangle[t, (k + 1 - e) % 3]
            r = s.ring_start[i]
            while past == 0 and r < s.ring_start[i + 1]:
                n = s.normal[s.ring[r]]
                past = int((s.x[j] - s.x[i]).dot(n) < -ti.cast(EDGE_SLACK, ti.f64) * length) & int((q - s.x[i]).dot(n) > 0.0)
                r += 1
    return past


@ti.func
def _is_freed(s: ti.template(), p, i, u, m, gap):
    """1 where point p of an edge, which lies `gap` < 0 deep below edge m of triangle u, is carried out by what takes vertex i
    out: to less than a tenth of that depth. One that lies deeper than SHALLOW is taken to be far from where i came in."""
    d = p + s.exit_direction[i] - corner(s, u, m)
    depth = -d.dot(s.normal[u])
    v = s.neighbour[u, m]
    if v >= 0:
        depth = ti.min(depth, -d.dot(s.normal[v]))
    shallow = ti.cast(SHALLOW, ti.f64) * (corner(s, u, m + 1) - corner(s, u, m)).norm()
    return int(depth < -ti.cast(FREED, ti.f64) * gap) | int(-gap > shallow)


@ti.func
def _end_tells(s: ti.template(), t, k, p, place, length, gap, u, m, n, by_faces):
    """1 where edge k of triangle t crosses at p so near an end that the end's own contact tells of it: it lies inside, behind
    both faces at edge m of triangle u, sticks out along n, and once it is out the crossing is, too.

    by_faces: whether vertices find their contacts with u's collider by faces, so that it is known whether this one has any.
    """
    told, over = 0, -ti.cast(END, ti.f64) * gap
    if gap < 0.0:
        for e in range(2):
            i = s.triangle[t, (k + e) % 3]
            good = int(ti.select(e == 0, place, length - place) <= over)
            if good == 1 and by_faces == 1:
                good = (s.inside[i] >> (s.body[u] % INSIDE_BITS)) & 1
                if good == 1:
                    good = _is_freed(s, p, i, u, m, gap)
            if good == 1:
                good = _is_behind(s, i, length, u, m, ti.cast(0.0, ti.f64))
            if good == 1:
                told = told | in_normal_cone(s, i, n)
    return told


@ti.func
def _within(s: ti.template(), t, k, place, length, over, u, m):
    """1 where edge k of triangle t is crossed between its ends, or so little beyond one as `over`, if that end lies inside.

    Of two bodies side by side the edges cross beyond their ends, too, one below the other, and nothing penetrates.
    """
    beyond = ti.min(over, ti.cast(BEYOND, ti.f64) * length)
    good = int(-beyond <= place <= length + beyond)
    if good == 1 and (place < 0.0 or place > length):
        e = int(place > length)
        good = _is_behind(s, s.triangle[t, (k + e) % 3], length, u, m, ti.cast(NEARLY, ti.f64))
    return good


@ti.func
def _way(s: ti.template(), t, k, f):
    """How far the point a share f along edge k of triangle t goes in the step (3,) [m]."""
    return (1.0 - f) * s.move[s.triangle[t, k]] + f * s.move[s.triangle[t, (k + 1) % 3]]


@ti.func
def _moves(s: ti.template(), t, k, u, m):
    """Whether two edges move relative to each other by enough to count in the step: where most rest, that saves a look."""
    far = ti.cast(0.0, ti.f64)
    for i in range(2):
        for j in range(2):
            far = ti.max(far, (_way(s, t, k, ti.cast(i, ti.f64)) - _way(s, u, m, ti.cast(j, ti.f64))).norm())
    shorter = ti.min((corner(s, t, k + 1) - corner(s, t, k)).norm(), (corner(s, u, m + 1) - corner(s, u, m)).norm())
    return int(far > ti.cast(AHEAD, ti.f64) * shorter)


@ti.func
def _deepest(s: ti.template(), t, k, u, m, f, g, la, lb):
    """How deep [m] edges that really cross can be: of thin bodies side by side, those of the far sides cross too, as deep as both
    are thick."""
    deepest = ti.cast(0.5, ti.f64) * ti.min(la, lb, s.thickness[s.body[t]], s.thickness[s.body[u]])
    if s.body[t] == s.body[u]:  # deeper it is the body's own thickness, squeezed
        rest = (1.0 - f) * s.rest[s.triangle[t, k]] + f * s.rest[s.triangle[t, (k + 1) % 3]]
        rest -= (1.0 - g) * s.rest[s.triangle[u, m]] + g * s.rest[s.triangle[u, (m + 1) % 3]]
        deepest = ti.min(deepest, through(s, s.body[t], rest.norm()))
    return deepest


@ti.func
def edge_contact(s: ti.template(), way: ti.template(), t, k, u, m, margin, out: ti.template(), start, end):
    """The contact of edge k of triangle t with edge m of triangle u, if they cross, or if they cross at the end of the step and
    penetrate by then: a fold that slides over an edge. Its gap is that of the same points at the start. way: as in
    `find_proximity`. Returns the new count."""
    at = start
    for ahead in range(2):
        good = int(at == start)
        if ahead == 1 and good == 1:
            good = _moves(s, t, k, u, m)
        if good == 1:
            late, closing = ti.cast(ahead, ti.f64), ti.cast(0.0, ti.f64)
            a0, a1 = corner(s, t, k) + late * _way(s, t, k, 0.0), corner(s, t, k + 1) + late * _way(s, t, k, 1.0)
            b0, b1 = corner(s, u, m) + late * _way(s, u, m, 0.0), corner(s, u, m + 1) + late * _way(s, u, m, 1.0)
            da, db = a1 - a0, b1 - b0
            c = da.cross(db)
            la, lb = da.norm(), db.norm()
            if c.norm() > ti.cast(CROSSING, ti.f64) * la * lb:
                n = unit(c)
                f, g, _ = closest_lines(a0, a1, b0, b1)
                gap = (a0 - b0).dot(n)
                over = (1.0 - late) * ti.cast(MISS, ti.f64) * ti.abs(gap)  # what penetrates has shifted along the edges
                # most pairs do not cross, whichever of them is above: that takes longer to tell
                good = int(-over <= f * la <= la + over) & int(-over <= g * lb <= lb + over)
                if good == 1:
                    n_t, n_u = edge_normal(s, t, k), edge_normal(s, u, m)
                    if n.dot(n_u - n_t) < 0.0:
                        n, gap = -n, -gap
                    closing = -(_way(s, t, k, f) - _way(s, u, m, g)).dot(n)
                    over = ti.cast(MISS, ti.f64) * ti.max(-gap, 0.0)
                    near = gap - ti.max(closing, 0.0) <= margin and gap >= -_deepest(s, t, k, u, m, f, g, la, lb)
                    if ahead == 1:  # of what comes from farther away others are the nearest then
                        least = -ti.cast(AHEAD, ti.f64) * ti.min(la, lb)  # what is so little past each other counts as above
                        near = near and gap < 0.0 and gap + closing > least and gap + closing <= margin
                    # a nearly flat edge sticks out along either normal: the sides that look at each other count
                    good = int(near) & int(n.dot(n_u) > 0.0) & int(n.dot(n_t) < 0.0)
                for side in range(2):  # one edge, then the other, so that what is called is compiled once
                    t1, k1, t2, k2 = ti.select(side, u, t), ti.select(side, m, k), ti.select(side, t, u), ti.select(side, k, m)
                    place, length, along = ti.select(side, g * lb, f * la), ti.select(side, lb, la), ti.select(side, -n, n)
                    if good == 1:
                        good = edge_in_normal_cone(s, t2, k2, along)
                    if good == 1 and ahead == 0:
                        good = _within(s, t1, k1, place, length, over, t2, k2)
                    if good == 1 and ahead == 0:
                        good = 1 - _is_past_end(s, t1, k1, place, length, gap, ti.select(side, a0 + f * da, b0 + g * db))
                    if good == 1 and ahead == 0:
                        by_faces = int(way[s.body[t2]] == BY_FACES) | int(s.body[t1] == s.body[t2])
                        p = ti.select(side, b0 + g * db, a0 + f * da)
                        good = 1 - _end_tells(s, t1, k1, p, place, length, gap, t2, k2, along, by_faces)
                if good == 1:
                    gap += late * closing
                    # where one was clamped to an end, the contact is at that end
                    f_in, g_in = ti.min(ti.max(f, 0.0), 1.0), ti.min(ti.max(g, 0.0), 1.0)
                    middle = a0 + f_in * da - late * _way(s, t, k, f) - 0.5 * gap * n
                    if g_in != g:
                        middle = b0 + g_in * db + 0.5 * gap * n
                    f, g = f_in, g_in
                    write_contact(
                        out, at, end, s.body[t], s.body[u], ivec(EDGE_EDGE, 3 * t + k, 3 * u + m), middle + 0.5 * gap * n, n, gap,
                        ivec(s.triangle[t, k], s.triangle[t, (k + 1) % 3], -1), dvec(1.0 - f, f, 0.0),
                        ivec(s.triangle[u, m], s.triangle[u, (m + 1) % 3], -1), dvec(1.0 - g, g, 0.0),
                    )  # fmt: skip
                    at += 1
    return at
