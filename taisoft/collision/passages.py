"""Pairs of surfaces that would pass through each other on the straight paths of a step, by continuous detection.

The paths lead from the positions of the last search to given ones, obstacles included. A pair is checked by `separation`: it is
free if its two triangles certainly keep a small distance, and else a passage, with the part of the step until which they do. If
no pair is a passage, surfaces that did not cross at the start do not cross on the way nor at the end.

Pairs come from three lists. Triangles without a common vertex: those of `near_list`. Triangles with a common vertex touch
there for ever: of each, the edge opposite that vertex must not pass the other triangle, of triangles with a common edge the
opposite corners and the sides between them (`adjacent_rows`); that list is made once. Half-spaces, spheres and capsules: every
vertex and triangle of the soft bodies. Boxes have triangles.

Pairs of colliders that cross already are exempt until they do not.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.lists import part_first
from taisoft.backend.runtime import kernel
from taisoft.collision.analytic import CAPSULE, HALF_SPACE, SPHERE, rotation_rows
from taisoft.collision.candidates import TOTAL, sum_parts
from taisoft.collision.contacts import FACE_FACE, write_contact
from taisoft.collision.features import unit
from taisoft.collision.near_list import OUTDATED, STILL, UNCOVERED, clear_ends, hint_of, list_unseparated, prepare_paths
from taisoft.collision.separation import at_weights, free_until, nearest_of, separating_plane, unit_row
from taisoft.collision.surface import dvec, ivec
from taisoft.fem.state import EVENT, GO

# kinds of passages, by two ids: two triangles; a row of `adjacent`; a triangle and a sphere or capsule; a vertex and a half-space
NEAR, ADJACENT, ROUND, FLAT = range(4)
N_KINDS, N_FEATURES = 4, 16  # factors in ids of contacts

corners = ti.types.matrix(6, 3, ti.f64)


@ti.func
def _carried(o: ti.template(), k, p, time):
    """Origin of analytic obstacle k and vector p (3,) of its frame, at a part of the step; both lead straight to the end."""
    turned = (1.0 - time) * (rotation_rows(o.rotation, k) @ p) + time * (rotation_rows(o.next_rotation, k) @ p)
    return (1.0 - time) * o.origin[k] + time * o.next_origin[k], turned


@ti.func
def _axis_end(o: ti.template(), k, side, time):
    """An end of the axis of a capsule, or the centre of a sphere, at a part of the step (3,) [m]; side: -1 or 1."""
    half = ti.select(o.kind[k] == CAPSULE, o.size[k][0], ti.cast(0.0, ti.f64))
    origin, turned = _carried(o, k, dvec(side * half, 0.0, 0.0), time)
    return origin + turned


@ti.func
def _box_round(o: ti.template(), k, span, floor):
    """Box around sphere or capsule k and what is nearer to it than `floor` [m], at any time of the step."""
    a, b, c, d = (
        _axis_end(o, k, -1, span[0]),
        _axis_end(o, k, 1, span[0]),
        _axis_end(o, k, -1, span[1]),
        _axis_end(o, k, 1, span[1]),
    )
    grown = floor + _radius(o, ROUND, k)
    return ti.min(a, b, c, d) - grown, ti.max(a, b, c, d) + grown


@ti.func
def _is_in_box(s: ti.template(), g: ti.template(), t, lo, hi):
    """Whether the box around the path of triangle t meets another one."""
    i, j, k = s.triangle[t, 0], s.triangle[t, 1], s.triangle[t, 2]
    a, b, c = s.x[i], s.x[j], s.x[k]
    a1, b1, c1 = a + g.path[i], b + g.path[j], c + g.path[k]
    return (ti.min(a, b, c, a1, b1, c1) <= hi).all() and (ti.max(a, b, c, a1, b1, c1) >= lo).all()


@ti.func
def _radius(o: ti.template(), kind, b):
    """Radius [m] of the round shape b, 0 for other kinds of pairs."""
    radius = ti.cast(0.0, ti.f64)
    if ti.static(o.has_round):
        if kind == ROUND:
            radius = ti.select(o.kind[b] == CAPSULE, o.size[b][1], o.size[b][0])
    return radius


@ti.func
def _vertex(s: ti.template(), g: ti.template(), kind, a, b, k):
    """Vertex of corner k of a pair, 0 to 5; -1 where it belongs to an analytic obstacle."""
    v = -1
    if kind == ADJACENT:
        v = g.adjacent[a, k]
    elif k < 3:
        v = s.triangle[a, k]
    elif kind == NEAR:
        v = s.triangle[b, k - 3]
    return v


@ti.func
def _corner(s: ti.template(), o: ti.template(), g: ti.template(), kind, a, b, k, moves: ti.template(), span):
    """Corner k of a pair and its displacement along the given field, (3,) each [m]. span: parts of the step (2,) between which
    analytic obstacles move."""
    i = _vertex(s, g, kind, a, b, k)
    now, move = dvec(0.0), dvec(0.0)
    if i >= 0:
        now, move = s.x[i], moves[i]
    elif ti.static(o.has_round):
        side = ti.select(k == 3, ti.cast(-1.0, ti.f64), ti.cast(1.0, ti.f64))
        now = _axis_end(o, b, side, span[0])
        move = _axis_end(o, b, side, span[1]) - now
    return now, move


@ti.func
def _rows(s: ti.template(), o: ti.template(), g: ti.template(), kind, a, b, moves: ti.template(), span):
    """Corners (6,3) of a pair and their displacements (6,3), as `_corner`."""
    x, p = corners(0.0), corners(0.0)
    for k in ti.static(range(6)):
        now, move = _corner(s, o, g, kind, a, b, k, moves, span)
        for q in ti.static(range(3)):
            x[k, q], p[k, q] = now[q], move[q]
    return x, p


@ti.func
def _separating_plane(s: ti.template(), o: ti.template(), g: ti.template(), kind, a, b, span, need, first):
    """Number of a plane that keeps a pair at least `need` [m] apart, see `separating_plane`."""
    d0, d = _corner(s, o, g, kind, a, b, 3, g.path, span)
    x0, p = _corner(s, o, g, kind, a, b, 0, g.path, span)
    x1, q = _corner(s, o, g, kind, a, b, 1, g.path, span)
    x2, r = _corner(s, o, g, kind, a, b, 2, g.path, span)
    x4, u = _corner(s, o, g, kind, a, b, 4, g.path, span)
    x5, v = _corner(s, o, g, kind, a, b, 5, g.path, span)
    a0, b0, c0, e0, f0 = x0 - d0, x1 - d0, x2 - d0, x4 - d0, x5 - d0
    a1, b1, c1, e1, f1 = a0 + (p - d), b0 + (q - d), c0 + (r - d), e0 + (u - d), f0 + (v - d)
    return separating_plane(a0, b0, c0, e0, f0, a1, b1, c1, e1, f1, need, first, int(kind == NEAR))


@ti.func
def _plane(o: ti.template(), k, time):
    """A point (3,) [m] and the normal (3,) of half-space k at a part of the step."""
    origin, normal = _carried(o, k, dvec(0.0, 1.0, 0.0), time)
    return origin, unit(normal)


@ti.func
def _lowest(s: ti.template(), b, x, n):
    """Height [m] of the box of collider b, around its searched paths, over a plane."""
    return ti.min((s.body_lo[b] - x) * n, (s.body_hi[b] - x) * n).sum()


@ti.func
def _body_of(s: ti.template(), i):
    """Collider of vertex i."""
    return s.body[s.ring[s.ring_start[i]]]


@ti.func
def _write_passage(out: ti.template(), at, last, kind, a, b, features, time):
    """Write a passage if it fits."""
    if at < last:
        out.pair[at] = ti.Vector([kind, a, b, features], ti.i32)
        out.time[at] = time
    return at + 1


@ti.func
def _write_half_space_passages(
    s: ti.template(), o: ti.template(), g: ti.template(), k, c, span, limit, floor, out: ti.template(), start, last
):
    """Write the passages of the vertices of chunk c through half-space k; limit, floor [m]: as in `check_paths`. Return the new
    count."""
    at, first, end = start, part_first(c, s.n_verts, s.chunks), part_first(c + 1, s.n_verts, s.chunks)
    x0, n0 = _plane(o, k, span[0])
    x1, n1 = _plane(o, k, span[1])
    for b in range(s.n_bodies):
        # without a limit, paths may leave the boxes, and there may be none
        if s.soft[b] == 1 and (limit == ti.math.inf or _lowest(s, b, x1, n1) < floor):
            for i in range(ti.max(g.first_vertex[b], first), ti.min(g.first_vertex[b + 1], end)):
                now, then = (s.x[i] - x0).dot(n0), (s.x[i] + g.path[i] - x1).dot(n1)
                need = ti.min(floor, ti.select(now > 0.0, 0.5 * now, now))  # no deeper than before
                if then < need:
                    at = _write_passage(out, at, last, FLAT, i, k, 0, (now - need) / (now - then))
    return at


@ti.func
def _write_triangle_passages(
    s: ti.template(),
    o: ti.template(),
    g: ti.template(),
    near: ti.template(),
    c,
    mode,
    span,
    floor,
    out: ti.template(),
    start,
    last,
):
    """Write the passages of chunk c through triangles, spheres and capsules. Return the new count."""
    at, n_near, n_adjacent, n_round, n_triangles, last_round = start, 0, 0, 0, 0, -1
    lo, hi = dvec(0.0), dvec(0.0)
    if ti.static(g.has_pairs):
        n_near = list_unseparated(s, g, near, c)
        n_adjacent = part_first(c + 1, g.n_adjacent, s.chunks) - part_first(c, g.n_adjacent, s.chunks)
    if ti.static(o.has_round):
        n_triangles = part_first(c + 1, s.n_triangles, s.chunks) - part_first(c, s.n_triangles, s.chunks)
        n_round = o.count * n_triangles
    for e in range(n_near + n_adjacent + n_round):
        kind, a, b, checked, plane = NEAR, 0, 0, True, 0
        if e < n_near:
            pair = near.data[c * near.part + near.data[c * near.part + e][2]]
            a, b = pair[0], pair[1]
            plane = g.plane[hint_of(a, b)]
            checked = g.exempt[s.body[a] * s.n_bodies + s.body[b]] == 0
        elif e < n_near + n_adjacent:
            kind, a = ADJACENT, part_first(c, g.n_adjacent, s.chunks) + e - n_near
            checked = g.unfolded[g.adjacent[a, 6]] == 0
            if checked:
                checked = g.exempt[_body_of(s, g.adjacent[a, 0]) * (s.n_bodies + 1)] == 0
        elif ti.static(o.has_round):
            kind, a = ROUND, part_first(c, s.n_triangles, s.chunks) + (e - n_near - n_adjacent) % n_triangles
            b = (e - n_near - n_adjacent) // n_triangles
            checked = (o.kind[b] == SPHERE or o.kind[b] == CAPSULE) and s.soft[s.body[a]] == 1
            if checked:
                if b != last_round:
                    last_round = b
                    lo, hi = _box_round(o, b, span, floor)
                checked = _is_in_box(s, g, a, lo, hi) and g.exempt[s.body[a] * s.n_bodies + o.body[b]] == 0
        radius = _radius(o, kind, b)
        if checked:
            found = _separating_plane(s, o, g, kind, a, b, span, floor + radius, plane)
            checked = found < 0
            if e < n_near and found >= 0 and found != plane:
                g.plane[hint_of(a, b)] = found
        if checked:
            y, p = _rows(s, o, g, kind, a, b, g.path, span)
            time, features = free_until(y, p, radius, floor, mode != STILL)
            if time < 1.0:
                at = _write_passage(out, at, last, kind, a, b, features, time)
    return at


@kernel(cse=False)
def check_paths(
    s: ti.template(),
    x: ti.template(),
    o: ti.template(),
    g: ti.template(),
    near: ti.template(),
    out: ti.template(),
    mode: ti.i32,
    begin: ti.f64,
    end: ti.f64,
    limit: ti.f64,
    listed_limit: ti.f64,
    floor: ti.f64,
    event: ti.i32,
):
    """Find the passages on the paths to the positions x (n_nodes) [m] (TO_STATE), on the searched ones (SEARCHED), on those given
    (GIVEN), or where surfaces are already, half-spaces left out (STILL). ONWARD: as TO_STATE, from positions s.x that are on the
    way since the search, at which the near pairs were listed.

    near: listed pairs. begin, end: parts of the step between which obstacles move. limit, listed_limit [m]: see `prepare_paths`;
    beyond them, nothing is checked. floor [m]: to be kept. event: number of the event that ends a batch if paths are not known to
    be free; 0 outside of batches.
    """
    span = ti.Vector([begin, end], ti.f64)
    prepare_paths(s, x, g, mode, limit, listed_limit, floor)
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, last = c * out.part, (c + 1) * out.part
            if g.left[UNCOVERED] == 0 and g.left[OUTDATED] == 0:
                if ti.static(HALF_SPACE in o.kinds):
                    for k in range(o.count):
                        if o.kind[k] == HALF_SPACE and mode != STILL:
                            at = _write_half_space_passages(s, o, g, k, c, span, limit, floor, out.data, at, last)
                if ti.static(g.has_pairs or o.has_round):
                    at = _write_triangle_passages(s, o, g, near, c, mode, span, floor, out.data, at, last)
            out.used[c] = at - c * out.part
    if ti.static(g.has_pairs):
        clear_ends(s, g)
    sum_parts(s.team, out)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if event != 0 and s.run[GO] == 1 and g.left[UNCOVERED] + g.left[OUTDATED] + out.count[TOTAL] > 0:
            s.run[GO], s.run[EVENT] = 0, event


@kernel(cse=False)
def append_passages(
    s: ti.template(),
    o: ti.template(),
    g: ti.template(),
    pairs: ti.types.ndarray(),
    times: ti.types.ndarray(),
    out: ti.template(),
    append: ti.i32,
):
    """Append a contact for each passage (k,4) to the buffer of contacts: between its features at a time (k,) along the
    searched paths. Their normal then holds them apart; the gap is that of the same points now.
    """
    ti.loop_config(serialize=s.on_cpu)
    for c in range(out.chunks):
        at, last, r = c * out.part + append * out.used[c], (c + 1) * out.part, c
        while r < pairs.shape[0]:  # dealt out to the parts in turn
            kind, a, b, features = pairs[r, 0], pairs[r, 1], pairs[r, 2], pairs[r, 3]
            corner, wall, n = ivec(a, -1, -1), ivec(-1), dvec(0.0)
            u, v, point, gap, body_b = unit_row(0), dvec(0.0), dvec(0.0), ti.cast(0.0, ti.f64), 0
            if ti.static(o.any):
                if kind == FLAT or kind == ROUND:
                    body_b = o.body[b]
            if kind == FLAT:
                if ti.static(o.any):
                    origin, normal = _plane(o, b, ti.cast(0.0, ti.f64))
                    n, point = normal, s.x[a]
                    gap = (point - origin).dot(n)
            else:
                corner = ivec([_vertex(s, g, kind, a, b, k) for k in ti.static(range(3))])
                wall = ivec([_vertex(s, g, kind, a, b, k) for k in ti.static(range(3, 6))])
                x, p = _rows(s, o, g, kind, a, b, s.move, ti.Vector([0.0, 1.0], ti.f64))
                y = x + times[r] * p  # stored: the compiler fails when an expression is indexed
                u, v, offset = nearest_of(y, features)
                n = unit(offset)
                point = at_weights(x, 0, u)
                gap = (point - at_weights(x, 3, v)).dot(n) - _radius(o, kind, b)
                if kind != ROUND:
                    body_b = _body_of(s, wall[0])
            if n.dot(n) > 0.0:
                feature = ivec(FACE_FACE, N_KINDS * a + kind, N_FEATURES * b + features)
                body_a = _body_of(s, corner[0])
                write_contact(out.data, at, last, body_a, body_b, feature, point, n, gap, corner, 1.0 * u, wall, 1.0 * v)
                at += 1
            r += out.chunks
        out.used[c] = at - c * out.part
    sum_parts(s.team, out)


@dataclass(frozen=True, eq=False)
class PassageFields:
    """A buffer of passages, for kernels."""

    pair: Any  # 4-vectors i32: kind, two ids and the nearest features, see `separation.nearest_of`
    time: Any  # f64: part of the step until which they are certainly apart


def passage_fields(arena: FieldArena, capacity: int) -> PassageFields:
    """Allocate a buffer for `capacity` passages."""
    return PassageFields(arena.vectors("passage_pair", ti.i32, capacity, n=4), arena.field("passage_time", ti.f64, capacity))
