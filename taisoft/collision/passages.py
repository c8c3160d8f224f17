"""Pairs of surfaces that would pass through each other on the straight paths of a step, by continuous detection.

The paths lead from the positions of the last search to given ones, obstacles included. A pair is checked by `separation`: it is
free if its two triangles certainly keep a small distance, and else a passage, with the part of the step until which they do. If
no pair is a passage, surfaces that did not cross at the start do not cross on the way nor at the end.

Pairs come from three lists. Triangles without a common vertex: those whose boxes overlap, listed by the broad phase and used
until a vertex has left the boxes that were searched, so that bodies at rest are listed once. Triangles with a common vertex touch
there for ever: of each, the edge opposite that vertex must not pass the other triangle, of triangles with a common edge the
opposite corners and the sides between them (`adjacent_rows`); that list is made once. Half-spaces, spheres and capsules: every
vertex and triangle of the soft bodies. Boxes have triangles.

Pairs of colliders that cross already are exempt until they do not.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, download
from taisoft.backend.runtime import kernel
from taisoft.collision.analytic import CAPSULE, HALF_SPACE, SPHERE, AnalyticObstacles
from taisoft.collision.candidates import TOTAL, WHOLE, Buffer, sum_parts
from taisoft.collision.colliders import Topology
from taisoft.collision.contacts import FACE_FACE, write_contact
from taisoft.collision.features import unit
from taisoft.collision.separation import at_weights, free_until, nearest_of, unit_row
from taisoft.collision.surface import ACTIVE, Surface, dvec, integers, ivec, list_near, part_first

IN_BOXES = 0.49  # of the reach: how far a vertex may leave its searched path and still be in the boxes, grown by half of it
# kinds of passages, by two ids: two triangles; a row of `adjacent`; a triangle and a sphere or capsule; a vertex and a half-space
NEAR, ADJACENT, ROUND, FLAT = range(4)
KINDS, FEATURES = 4, 16  # factors in ids of contacts
SEARCHED, TO_STATE, STILL = range(3)  # which paths are checked

corners = ti.types.matrix(6, 3, ti.f64)


@dataclass(frozen=True, eq=False)
class PathFields:
    """Fields of the check, for kernels."""

    path: Any  # (n_verts) 3-vectors f64: displacements to be checked [m]
    listed_x: Any  # (n_verts) 3-vectors f64: positions and searched displacements when the near pairs were listed [m]
    listed_move: Any
    deviation: Any  # (1) f64: how far a vertex is from those paths [m]
    exempt: Any  # (n_bodies^2) i32: 1 for pairs of colliders that cross already
    adjacent: Any  # (n_adjacent, 6) i32: vertices of two triangles
    n_adjacent: Count


@ti.func
def _pose(o: ti.template(), k, at_end):
    """Origin and rotation of analytic obstacle k now, or at the end of the step."""
    x, R = o.origin[k], ti.Matrix.rows([o.rotation[3 * k], o.rotation[3 * k + 1], o.rotation[3 * k + 2]])
    if at_end == 1:
        x, R = o.next_origin[k], ti.Matrix.rows([o.next_rotation[3 * k], o.next_rotation[3 * k + 1], o.next_rotation[3 * k + 2]])
    return x, R


@ti.func
def _axis_end(o: ti.template(), k, side, at_end):
    """An end of the axis of a capsule, or the centre of a sphere (3,) [m]; side: -1 or 1."""
    x, R = _pose(o, k, at_end)
    half = ti.select(o.kind[k] == CAPSULE, o.size[k][0], ti.cast(0.0, ti.f64))
    return x + R @ dvec(side * half, 0.0, 0.0)


@ti.func
def _radius(o: ti.template(), kind, b):
    """Radius [m] of the round shape b, 0 for other kinds of pairs."""
    radius = ti.cast(0.0, ti.f64)
    if ti.static(o.any):
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
def _rows(s: ti.template(), o: ti.template(), g: ti.template(), kind, a, b, moves: ti.template()):
    """Corners (6,3) of a pair and their displacements (6,3) along the given field [m]."""
    x, p = corners(0.0), corners(0.0)
    for k in ti.static(range(6)):
        i = _vertex(s, g, kind, a, b, k)
        now, move = dvec(0.0), dvec(0.0)
        if i >= 0:
            now, move = s.x[i], moves[i]
        elif ti.static(o.any):
            side = ti.select(k == 3, ti.cast(-1.0, ti.f64), ti.cast(1.0, ti.f64))
            now = _axis_end(o, b, side, 0)
            move = _axis_end(o, b, side, 1) - now
        for q in ti.static(range(3)):
            x[k, q], p[k, q] = now[q], move[q]
    return x, p


@ti.func
def _height(o: ti.template(), k, p, at_end):
    """Height [m] of point p over half-space k."""
    x, R = _pose(o, k, at_end)
    return (R.transpose() @ (p - x))[1]


@ti.func
def _body_of(s: ti.template(), i):
    """Collider of vertex i."""
    return s.body[s.ring[s.ring_start[i]]]


@ti.func
def _set_paths(s: ti.template(), x: ti.template(), g: ti.template(), mode, limit):
    """Set the paths, see `check_paths`, and the deviation from the listed ones."""
    g.deviation[0] = 0.0
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.n_verts):
        path = s.move[i]
        if mode == STILL:
            path = dvec(0.0)
        elif mode == TO_STATE and s.node[i] >= 0:
            path = x[s.node[i]] - s.x[i]
        g.path[i] = path
        d = g.listed_move[i]
        square, farthest = d.dot(d), ti.cast(0.0, ti.f64)
        for end in range(2):
            r = s.x[i] + ti.cast(end, ti.f64) * path - g.listed_x[i]
            along = ti.cast(0.0, ti.f64)
            if square > 0.0:
                along = ti.min(ti.max(r.dot(d) / square, 0.0), 1.0)
            farthest = ti.max(farthest, (r - along * d).norm())
        if not farthest <= limit:
            ti.atomic_max(g.deviation[0], ti.min(farthest, ti.math.inf))


@ti.func
def _write_passage(out: ti.template(), at, last, kind, a, b, features, time):
    """Write a passage if it fits."""
    if at < last:
        out.pair[at] = ti.Vector([kind, a, b, features], ti.i32)
        out.time[at] = time
    return at + 1


@kernel(cse=False)
def check_paths(
    s: ti.template(),
    x: ti.template(),
    o: ti.template(),
    g: ti.template(),
    near: ti.template(),
    out: ti.template(),
    mode: ti.i32,
    limit: ti.f64,
    floor: ti.f64,
):
    """Find the passages on the paths to the positions x (n_nodes) [m] (TO_STATE), on the searched ones (SEARCHED), or where
    surfaces are already, half-spaces left out (STILL).

    near: listed pairs. limit [m]: of the deviation from the listed paths; beyond it, nothing is checked. floor [m]: to be kept.
    """
    _set_paths(s, x, g, mode, limit)
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, last = c * out.part, (c + 1) * out.part
            if g.deviation[0] <= limit:
                if ti.static(o.any):
                    for i in range(part_first(c, s.n_verts, s.chunks), part_first(c + 1, s.n_verts, s.chunks)):
                        for k in range(o.count):
                            if o.kind[k] == HALF_SPACE and s.node[i] >= 0:
                                if mode != STILL:
                                    now, then = _height(o, k, s.x[i], 0), _height(o, k, s.x[i] + g.path[i], 1)
                                    need = ti.min(floor, ti.select(now > 0.0, 0.5 * now, now))  # no deeper than before
                                    if then < need:
                                        at = _write_passage(out.data, at, last, FLAT, i, k, 0, (now - need) / (now - then))
                n_round, n_near = 0, near.used[c]
                if ti.static(o.any):
                    n_round = o.count * (part_first(c + 1, s.n_triangles, s.chunks) - part_first(c, s.n_triangles, s.chunks))
                n_adjacent = part_first(c + 1, g.n_adjacent, s.chunks) - part_first(c, g.n_adjacent, s.chunks)
                for e in range(n_near + n_adjacent + n_round):
                    kind, a, b, checked = NEAR, 0, 0, True
                    if e < n_near:
                        a, b = near.data[c * near.part + e][0], near.data[c * near.part + e][1]
                        checked = g.exempt[s.body[a] * s.n_bodies + s.body[b]] == 0
                    elif e < n_near + n_adjacent:
                        kind, a = ADJACENT, part_first(c, g.n_adjacent, s.chunks) + e - n_near
                        checked = g.exempt[_body_of(s, g.adjacent[a, 0]) * (s.n_bodies + 1)] == 0
                    elif ti.static(o.any):
                        kind, a = ROUND, part_first(c, s.n_triangles, s.chunks) + (e - n_near - n_adjacent) // o.count
                        b = (e - n_near - n_adjacent) % o.count
                        checked = (o.kind[b] == SPHERE or o.kind[b] == CAPSULE) and s.soft[s.body[a]] == 1
                        if checked:
                            checked = g.exempt[s.body[a] * s.n_bodies + o.body[b]] == 0
                    if checked:
                        y, p = _rows(s, o, g, kind, a, b, g.path)
                        time, features = free_until(y, p, _radius(o, kind, b), floor, mode != STILL)
                        if time < 1.0:
                            at = _write_passage(out.data, at, last, kind, a, b, features, time)
            out.used[c] = at - c * out.part
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(out)


@kernel
def list_near_pairs(
    s: ti.template(), g: ti.template(), near: ti.template(), row: ti.template(), padding: ti.f64, out: ti.template()
):
    """List the pairs of triangles without a common vertex whose boxes overlap, and store the paths that were searched.

    near, row, padding: as in the last search.
    """
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.n_verts):
        g.listed_x[i], g.listed_move[i] = s.x[i], s.move[i]
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at, last, begin, own, n_near, max_row = c * out.part, (c + 1) * out.part, c * row.part, -1, 0, 0
            for j in range(part_first(c, s.count[ACTIVE], s.chunks), part_first(c + 1, s.count[ACTIVE], s.chunks)):
                t = s.active[j]
                if s.body[t] != own:
                    own = s.body[t]
                    n_near = list_near(s, c, own)
                lo, hi = near.bounds(s, t, WHOLE, padding)
                for k in range(n_near):
                    other = s.near[c * s.n_bodies + k]
                    if other >= own:  # each pair is found once, by its first triangle
                        n = near.list_triangles(s, other, t, WHOLE, lo, hi, row.data, begin, begin + row.part)
                        max_row = ti.max(max_row, n)
                        if n <= row.part:
                            for e in range(begin, begin + n):
                                if row.data[e] > t:
                                    if at < last:
                                        out.data[at] = ti.Vector([t, row.data[e]], ti.i32)
                                    at += 1
            out.used[c], row.used[c] = at - c * out.part, max_row
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(out)
        sum_parts(row)


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
    searched paths. Their normal then holds them apart; the gap is that of the same points now."""
    ti.loop_config(serialize=True)
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
                    origin, R = _pose(o, b, 0)
                    n, point = R @ dvec(0.0, 1.0, 0.0), s.x[a]
                    gap = (point - origin).dot(n)
            else:
                corner = ivec([_vertex(s, g, kind, a, b, k) for k in ti.static(range(3))])
                wall = ivec([_vertex(s, g, kind, a, b, k) for k in ti.static(range(3, 6))])
                x, p = _rows(s, o, g, kind, a, b, s.move)
                y = x + times[r] * p  # stored: the compiler fails when an expression is indexed
                u, v, offset = nearest_of(y, features)
                n, point = unit(offset), at_weights(x, 0, u)
                gap = (point - at_weights(x, 3, v)).dot(n) - _radius(o, kind, b)
                if kind != ROUND:
                    body_b = _body_of(s, wall[0])
            if n.dot(n) > 0.0:
                feature = ivec(FACE_FACE, KINDS * a + kind, FEATURES * b + features)
                body_a = _body_of(s, corner[0])
                write_contact(out.data, at, last, body_a, body_b, feature, point, n, gap, corner, 1.0 * u, wall, 1.0 * v)
                at += 1
            r += out.chunks
        out.used[c] = at - c * out.part
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(out)


def near_pairs(arena: FieldArena, capacity: int) -> Any:
    """Allocate a field of pairs of triangles."""
    return arena.vectors("near_pair", ti.i32, capacity, n=2)


@dataclass(frozen=True, eq=False)
class PassageFields:
    """A buffer of passages, for kernels."""

    pair: Any  # 4-vectors i32: kind, two ids and the nearest features, see `separation.nearest_of`
    time: Any  # f64: part of the step until which they are certainly apart


def passage_fields(arena: FieldArena, capacity: int) -> PassageFields:
    """Allocate a buffer for `capacity` passages."""
    return PassageFields(arena.vectors("passage_pair", ti.i32, capacity, n=4), arena.field("passage_time", ti.f64, capacity))


def adjacent_rows(triangle: np.ndarray) -> np.ndarray:
    """Return the vertices (k,6) of what must not pass each other among triangles (n,3) with common vertices: the edge of one
    opposite the common vertex and the other; if an edge is common, the opposite corners and the sides between them."""
    t = np.asarray(triangle, dtype=np.int64)
    corner_of = t.reshape(-1)
    order = np.argsort(corner_of, kind="stable")
    count = np.bincount(corner_of, minlength=1)
    start, size = (np.cumsum(count) - count)[corner_of[order]], count[corner_of[order]]
    first = np.repeat(order, size)
    second = order[np.arange(len(first)) - np.repeat(np.cumsum(size) - size, size) + np.repeat(start, size)]
    a, b = first // 3, second // 3
    common = (t[a][:, :, None] == t[b][:, None, :]).any(axis=2)
    n_common = common.sum(axis=1)
    one, k = n_common == 1, first % 3
    opposite = np.stack([t[a, (k + 1) % 3], t[a, (k + 2) % 3], t[a, (k + 2) % 3]], axis=1)
    rows = [np.concatenate([opposite, t[b]], axis=1)[one]]
    both = (n_common == 2) & (a < b) & (first % 3 == common.argmax(axis=1))
    a, b, shared = a[both], b[both], common[both]
    p, q = t[a][np.arange(len(a)), shared.argmax(axis=1)], t[a][np.arange(len(a)), 2 - shared[:, ::-1].argmax(axis=1)]
    c = t[a][np.arange(len(a)), (~shared).argmax(axis=1)]
    d = np.where((t[b] != p[:, None]) & (t[b] != q[:, None]), t[b], -1).max(axis=1)
    rows += [
        np.stack(columns, axis=1) for columns in ((c, c, c, p, q, d), (d, d, d, p, q, c), (p, c, c, q, d, d), (q, c, c, p, d, d))
    ]
    return np.concatenate(rows)


class PathCheck:
    """Find passages on the paths from the positions of the last search. reach [m]: as of the detection; floor [m]: to be kept."""

    def __init__(
        self,
        surface: Surface,
        topology: Topology,
        shapes: AnalyticObstacles,
        self_on: np.ndarray,
        reach: float,
        floor: float,
        arena: FieldArena,
        capacity: int | None = None,
        max_capacity: int | None = None,
    ):
        """self_on: (n_bodies,) whether a collider is checked against itself. capacity, max_capacity: of the lists, None for the
        default."""
        self.surface, self.shapes, self.limit, self.floor = surface, shapes, IN_BOXES * reach, floor
        s, n = surface, max(surface.n_verts, 1)
        self._topology, self._shape_body = topology, shapes.body.to_numpy() if shapes.any else np.zeros(0, dtype=np.int64)
        self._rows = rows = adjacent_rows(topology.triangle[np.asarray(self_on, dtype=bool)[topology.body]])
        vectors = (arena.vectors(f"path_{name}", ti.f64, n) for name in ("displacement", "listed_x", "listed_move"))
        self.fields = PathFields(
            *vectors,
            arena.field("path_deviation", ti.f64, 1),
            arena.field("path_exempt", ti.i32, s.n_bodies**2),
            integers(arena, "path_adjacent", rows.reshape(-1, 6)),
            len(rows),
        )
        limits = capacity or 4 * s.n_triangles + 64, max_capacity
        self.near = Buffer("near_pairs", near_pairs, *limits, s.chunks, arena)
        self.passages = Buffer("passages", passage_fields, 64 * s.chunks, max_capacity, s.chunks, arena)
        self._is_listed = False

    def exempt(self, pairs: np.ndarray) -> None:
        """Exempt pairs of colliders, (n_bodies, n_bodies) bool, and no others."""
        self.fields.exempt.from_numpy((pairs | pairs.T).astype(np.int32).reshape(-1))

    def colliders(self, passages: np.ndarray) -> np.ndarray:
        """Return the two colliders (k,2) of each passage (k,4)."""
        t, one, other = self._topology, passages[:, 1].copy(), passages[:, 2]
        body_of = np.append(t.body[t.ring[t.ring_start[:-1]]], -1) if len(t.ring) else np.zeros(1, dtype=np.int64)
        result = np.zeros((len(passages), 2), dtype=np.int64)
        for kind in range(KINDS):
            k = passages[:, 0] == kind
            if kind == ADJACENT:
                result[k] = body_of[self._rows[one[k], 0]][:, None]
            else:
                result[k, 0] = body_of[one[k]] if kind == FLAT else t.body[one[k]]
                result[k, 1] = t.body[other[k]] if kind == NEAR else self._shape_body[other[k]]
        return result

    def features(self, passages: np.ndarray) -> np.ndarray:
        """Return the vertices (k,6) of the features that meet in passages (k,4), equal for passages of the same two: an edge and
        a corner belong to several triangles."""
        t, (kind, a, b, f) = self._topology.triangle, passages.T.astype(np.int64)
        sides = np.full((len(passages), 2, 3), -1)
        near, adjacent, of_triangle = kind == NEAR, kind == ADJACENT, (kind == NEAR) | (kind == ROUND)
        sides[of_triangle, 0], sides[near, 1] = t[a[of_triangle]], t[b[near]]
        sides[adjacent] = self._rows[a[adjacent]].reshape(-1, 2, 3)
        sides[kind == FLAT, 0] = a[kind == FLAT, None]
        row, is_edge = np.arange(len(f)), f >= 6
        for side, edge in enumerate(((f - 6) // 3, (f - 6) % 3)):
            first = np.where(is_edge, edge, f % 3)
            ends = sides[row, side, first], sides[row, side, np.where(is_edge, (first + 1) % 3, first)]
            chosen = is_edge | (f // 3 == side)  # of a corner's other triangle, all corners
            sides[:, side] = np.where(chosen[:, None], np.stack([*ends, np.full(len(f), -1)], axis=1), sides[:, side])
        sides[(kind == ROUND) | (kind == FLAT), 1] = -2 - b[(kind == ROUND) | (kind == FLAT), None]
        sides.sort(axis=2)
        swapped = sides[:, 0, 0] > sides[:, 1, 0]
        sides[swapped] = sides[swapped][:, ::-1]
        return sides.reshape(-1, 6)

    def forget(self) -> None:
        """Discard the list of near pairs, after positions were set."""
        self._is_listed = False

    def _list(self, broad, row: Buffer) -> None:
        """List the near pairs of the last search."""
        while True:
            list_near_pairs(self.surface, self.fields, broad, row.parts, self.limit / IN_BOXES * 0.5, self.near.parts)
            grown = row.grow_if_full()
            if not self.near.grow_if_full() and not grown:
                break
        self._is_listed = True

    def find(self, x, broad, row: Buffer | None, mode: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the passages (k,4), ordered, and the parts (k,) of the step until which they are apart; None if the paths leave
        what the last search has covered.

        x: field of the nodes' positions [m]; mode: which paths, see `check_paths`. broad, row: result of the last broad phase and
        buffer of its rows, or None.
        """
        s, listed_now = self.surface, False
        while True:
            if not self._is_listed and broad is not None:
                self._list(broad, row)
                listed_now = True
            limit = self.limit if broad is not None else np.inf
            check_paths(s, x, self.shapes, self.fields, self.near.parts, self.passages.parts, mode, limit, self.floor)
            if self.fields.deviation[0] > limit:
                self._is_listed = False
                if listed_now:
                    return None
            elif not self.passages.grow_if_full():
                break
        return self._read()

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the passages found."""
        out = self.passages
        if out.count[TOTAL] == 0:
            return np.zeros((0, 4), dtype=np.int32), np.zeros(0)
        pair, time, used = download([out.data.pair, out.data.time, out.used])
        valid = np.arange(len(time)) % out.part < np.repeat(used, out.part)
        pair, time = pair[valid], time[valid]
        order = np.lexsort(pair.T[::-1])
        return pair[order], time[order]

    @property
    def buffers(self) -> tuple[Buffer, ...]:
        """The growing buffers."""
        return self.near, self.passages

    def release(self) -> None:
        """Free the memory of the buffers."""
        for buffer in self.buffers:
            buffer.release()
