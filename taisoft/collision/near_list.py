"""The list of near pairs for the check of paths (`passages`): triangles without a common vertex whose boxes overlap.

The broad phase makes it from the boxes of a search: around the straight paths of that search, grown by half the reach on every
side. It serves for later paths as long as no pair that is not listed can touch on them. The two triangles of such a pair were
farther apart than the reach along some axis, wherever their corners were on the listed paths. So they still are apart where
their corners have left those paths by vectors that differ by less than the reach along every axis: motion that bodies have in
common does not count. On a straight path it suffices that they do at both ends. Every collider has a box of these vectors at
either end, and those of two colliders that may touch are compared.

Only *active* triangles count, whose present boxes meet that of another collider: other triangles cannot touch anything, provided
that the present paths do not leave the boxes of the present search.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Count
from taisoft.backend.lists import part_first
from taisoft.backend.runtime import kernel
from taisoft.collision.features import unit
from taisoft.collision.separation import ROUNDING
from taisoft.collision.surface import ACTIVE, dvec, may_meet

SEARCHED, TO_STATE, STILL, GIVEN, ONWARD = range(5)  # which paths are checked; ONWARD: to the state, from another one since
HINTS = 16  # planes stored per triangle
UNCOVERED, OUTDATED = range(2)  # indices into PathFields.left


@dataclass(frozen=True, eq=False)
class PathFields:
    """Fields of the check, for kernels. Vectors are 3-vectors f64 [m]."""

    path: Any  # (n_verts) vectors: displacements to be checked
    listed_x: Any  # (n_verts) vectors: positions and searched displacements when the near pairs were listed; 1 without pairs,
    listed_move: Any  # as are the fields of triangles
    has_pairs: bool  # whether triangles may touch each other
    can_touch: Any  # (n_verts) i32: 1 for vertices of active triangles; between checks 0
    unfolded: Any  # (n_verts) i32: 1 where triangles around a vertex cannot meet, see `is_unfolded`
    left_lo: Any  # (2 n_bodies) vectors: boxes of the vectors by which those have left the listed paths at the start and the end
    left_hi: Any
    left: Any  # (2) i32: 1 if paths leave what was searched (UNCOVERED), or if the list is of no use for them (OUTDATED)
    lo: Any  # (2 n_triangles) vectors: boxes of active triangles at the start and the end, grown by half the floor; else, and
    hi: Any  # between checks, the first component of lo is infinite, so that they overlap nothing
    normal: Any  # (n_triangles) vectors: their normals halfway
    low: Any  # (2 n_triangles) f64: ranges of their heights along these normals [m], likewise, grown by the floor
    high: Any
    plane: Any  # (HINTS n_triangles) i32: of pairs of triangles, the plane that last separated them, see `hint_of`
    exempt: Any  # (n_bodies^2) i32: 1 for pairs of colliders that cross already
    first_vertex: Any  # (n_bodies + 1) i32: first vertex of each collider
    adjacent: Any  # (n_adjacent, 7) i32: vertices of two triangles, and one that they have in common
    n_adjacent: Count


@ti.func
def _set_paths(surface: ti.template(), x: ti.template(), paths: ti.template(), mode, limit, is_new):
    """Set the paths, and whether they leave the searched ones by more than `limit` [m]; store these if the list is new."""
    paths.left[OUTDATED] = 0
    if mode != GIVEN:
        paths.left[UNCOVERED] = 0
    ti.loop_config(serialize=surface.serial_cheap)
    for i in range(surface.n_verts):
        path = surface.move[i]
        if mode == GIVEN:
            path = paths.path[i]
        elif mode == STILL:
            path = dvec(0.0)
        elif (mode == TO_STATE or mode == ONWARD) and surface.node[i] >= 0:
            path = x[surface.node[i]] - surface.x[i]
            since = path
            if ti.static(paths.has_pairs):
                if mode == ONWARD:
                    since = x[surface.node[i]] - paths.listed_x[i]
            change = since - surface.move[i]
            if not change.dot(change) <= limit * limit:  # cheaper, and mostly enough; also if it is not a number
                if not leaving(since, surface.move[i]).norm() <= limit:
                    paths.left[UNCOVERED] = 1
        paths.path[i] = path
        if ti.static(paths.has_pairs):
            if is_new:
                paths.listed_x[i], paths.listed_move[i] = surface.x[i], surface.move[i]


@kernel
def begin_onward(s: ti.template(), x: ti.template(), paths: ti.template()):
    """Store the searched paths, of which a new list is, then see `go_onward`."""
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.n_verts):
        paths.listed_x[i], paths.listed_move[i] = s.x[i], s.move[i]
    go_onward(s, x, 1)


@ti.func
def go_onward(s: ti.template(), x: ti.template(), go):
    """Place the soft bodies at x (n_nodes) [m], where the next path ONWARD begins, if go is 1. A top-level loop of a kernel."""
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(go * s.n_verts):
        if s.node[i] >= 0:
            s.x[i] = x[s.node[i]]


@ti.func
def leaving(r, move):
    """Vector (3,) by which a point r (3,) has left the way from the origin along a displacement [m]."""
    square, along = move.dot(move), ti.cast(0.0, ti.f64)
    if square > 0.0:
        along = ti.min(ti.max(r.dot(move) / square, 0.0), 1.0)
    return r - along * move


@ti.func
def _box_ends(s: ti.template(), g: ti.template(), floor):
    """Set the boxes and heights of active triangles at both ends of their paths, and mark their vertices."""
    ti.loop_config(serialize=s.serial_cheap)
    for e in range(s.count[ACTIVE]):
        t = s.active[e]
        i, j, k = s.triangle[t, 0], s.triangle[t, 1], s.triangle[t, 2]
        for v in ti.static((i, j, k)):
            g.can_touch[v] = 1
        a0, b0, c0 = s.x[i], s.x[j], s.x[k]
        a1, b1, c1 = a0 + g.path[i], b0 + g.path[j], c0 + g.path[k]
        a2, b2, c2 = a0 + a1, b0 + b1, c0 + c1
        n = unit((b2 - a2).cross(c2 - a2))
        g.normal[t] = n
        for end in ti.static(range(2)):
            a, b, c = ti.static(((a0, b0, c0), (a1, b1, c1))[end])
            p, q, r = a.dot(n), b.dot(n), c.dot(n)
            g.lo[2 * t + end], g.hi[2 * t + end] = ti.min(a, b, c) - 0.5 * floor, ti.max(a, b, c) + 0.5 * floor
            g.low[2 * t + end], g.high[2 * t + end] = ti.min(p, q, r) - floor, ti.max(p, q, r) + floor


@ti.func
def clear_ends(s: ti.template(), g: ti.template()):
    """Empty the boxes of active triangles and unmark their vertices: no others were set."""
    ti.loop_config(serialize=s.serial_cheap)
    for e in range(s.count[ACTIVE]):
        t = s.active[e]
        for k in ti.static(range(3)):
            g.can_touch[s.triangle[t, k]] = 0
        for end in ti.static(range(2)):
            g.lo[2 * t + end][0] = ti.math.inf


@ti.func
def _compare_with_listed(s: ti.template(), g: ti.template(), limit):
    """Set whether vectors by which two colliders have left the listed paths differ by more than `limit` [m] along an axis."""
    ti.loop_config(serialize=s.serial_cheap)
    for k in range(2 * s.n_bodies):
        g.left_lo[k], g.left_hi[k] = dvec(ti.math.inf), dvec(-ti.math.inf)
    ti.loop_config(serialize=s.serial_cheap)
    for task in range(s.chunks * s.cheap_spread):
        if task % s.cheap_spread == 0:
            c = task // s.cheap_spread
            begin, end = part_first(c, s.n_verts, s.chunks), part_first(c + 1, s.n_verts, s.chunks)
            for b in range(s.n_bodies):
                lo0, hi0, lo1, hi1 = dvec(ti.math.inf), dvec(-ti.math.inf), dvec(ti.math.inf), dvec(-ti.math.inf)
                for i in range(ti.max(g.first_vertex[b], begin), ti.min(g.first_vertex[b + 1], end)):
                    if g.can_touch[i] == 1:
                        now = s.x[i] - g.listed_x[i]
                        first, last = leaving(now, g.listed_move[i]), leaving(now + g.path[i], g.listed_move[i])
                        lo0, hi0, lo1, hi1 = ti.min(lo0, first), ti.max(hi0, first), ti.min(lo1, last), ti.max(hi1, last)
                if lo0[0] <= hi0[0]:
                    ti.atomic_min(g.left_lo[2 * b], lo0)
                    ti.atomic_max(g.left_hi[2 * b], hi0)
                    ti.atomic_min(g.left_lo[2 * b + 1], lo1)
                    ti.atomic_max(g.left_hi[2 * b + 1], hi1)
    ti.loop_config(serialize=s.serial_cheap)
    for task in range(s.n_bodies * s.cheap_spread):
        if task % s.cheap_spread == 0:
            a = task // s.cheap_spread
            for b in range(a, s.n_bodies):
                if may_meet(s, a, b) == 1:
                    for end in range(2):
                        first, second = 2 * a + end, 2 * b + end
                        if (ti.max(g.left_hi[first] - g.left_lo[second], g.left_hi[second] - g.left_lo[first]) > limit).any():
                            g.left[OUTDATED] = 1


@ti.func
def is_unfolded(s: ti.template(), g: ti.template(), i, floor):
    """1 if no row of `adjacent` around vertex i is a passage, since its triangles lie spread out; known without looking at rows.

    Seen along n, which may be any direction, they go round i once, each turned the same way. What joins the two sides of a row
    then leaves one triangle, or the sector behind it, and crosses or reaches another one, or meets i: it is no shorter than
    their least altitude. If that exceeds twice the floor and twice the motion relative to i, the plane across the shortest
    connection separates the sides at the first advance of `free_until`; a twentieth is left for rounding.
    """
    x, n, turns, least, moved = s.x[i], dvec(0.0), 0, ti.cast(ti.math.inf, ti.f64), ti.cast(0.0, ti.f64)
    for r in range(s.ring_start[i], s.ring_start[i + 1]):
        n += s.normal[s.ring[r]]
    across = n.cross(dvec(1.0, 2.0, 3.0))  # turns: how often the side of the plane across it changes from front to back
    for r in range(s.ring_start[i], s.ring_start[i + 1]):
        t = s.ring[r]
        k = int(s.triangle[t, 1] == i) + 2 * int(s.triangle[t, 2] == i)
        a, b = s.triangle[t, (k + 1) % 3], s.triangle[t, (k + 2) % 3]
        e, f = s.x[a] - x, s.x[b] - x
        height = e.cross(f).dot(n) / ti.max(e.norm(), f.norm(), (e - f).norm())
        if s.neighbour[t, k] < 0 or s.neighbour[t, (k + 2) % 3] < 0:
            height = 0.0
        least, moved = ti.min(least, height), ti.max(moved, (g.path[a] - g.path[i]).norm())
        turns += int(e.dot(across) >= 0.0) & int(f.dot(across) < 0.0)
    needed = 2.1 * (floor + moved + ti.cast(ROUNDING, ti.f64) * ti.abs(x).max())
    return int(turns == 1) & int(least > needed * n.norm())


@ti.func
def prepare_paths(surface: ti.template(), x: ti.template(), paths: ti.template(), mode, limit, listed_limit, floor):
    """Set the paths of a mode, see `passages.check_paths`, what is computed once for each triangle and vertex, and `left`.

    limit [m]: of how far vertices may leave the searched paths; listed_limit [m]: of how far they may leave the listed ones along
    an axis, beside others, infinite if the list is new.
    """
    _set_paths(surface, x, paths, mode, limit, listed_limit == ti.math.inf)
    if ti.static(paths.has_pairs):
        _box_ends(surface, paths, floor)
        _compare_with_listed(surface, paths, listed_limit)
        ti.loop_config(serialize=surface.serial_cheap)
        for i in range(ti.select(paths.n_adjacent > 0, surface.n_verts, 0)):
            paths.unfolded[i] = is_unfolded(surface, paths, i, floor)


@ti.func
def _is_beyond(s: ti.template(), g: ti.template(), own, other):
    """1 if all corners of triangle `other` are above or below `own` at both ends, along the normal of `own` halfway."""
    n, above, below = g.normal[own], 1, 1
    for k in ti.static(range(3)):
        i = s.triangle[other, k]
        now = s.x[i].dot(n)
        then = now + g.path[i].dot(n)
        above &= int(now > g.high[2 * own]) & int(then > g.high[2 * own + 1])
        below &= int(now < g.low[2 * own]) & int(then < g.low[2 * own + 1])
    return above | below


@ti.func
def hint_of(t, u):
    """Index of the plane stored for a pair of triangles; several pairs may share it, since it is only tried first."""
    return HINTS * t + u % HINTS


@ti.func
def list_unseparated(s: ti.template(), g: ti.template(), near: ti.template(), c):
    """List, in the last components of the first entries of part c, the entries whose triangles are not separated by a plane
    across an axis, nor by the plane of either halfway. Return their number.

    No branch depends on whether a pair is separated: that is hard to predict, and mispredicted branches would take longest.
    """
    begin, n, own = c * near.part, 0, -1
    lo0, hi0, lo1, hi1 = dvec(0.0), dvec(0.0), dvec(0.0), dvec(0.0)
    for e in range(near.used[c]):
        t, u = near.data[begin + e][0], near.data[begin + e][1]
        near.data[begin + n][2] = e
        if t != own:  # pairs are ordered by their first triangle
            own = t
            lo0, hi0, lo1, hi1 = g.lo[2 * t], g.hi[2 * t], g.lo[2 * t + 1], g.hi[2 * t + 1]
        above = int(lo0 > g.hi[2 * u]) & int(lo1 > g.hi[2 * u + 1])
        below = int(g.lo[2 * u] > hi0) & int(g.lo[2 * u + 1] > hi1)
        n += 1 - int((above | below).any())
    for side in range(2):
        size = n
        n = 0
        for k in range(size):
            e = near.data[begin + k][2]
            t, u = near.data[begin + e][0], near.data[begin + e][1]
            near.data[begin + n][2] = e
            n += 1 - _is_beyond(s, g, ti.select(side == 0, t, u), ti.select(side == 0, u, t))
    return n
