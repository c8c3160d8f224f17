"""The check of a step's paths: lists of pairs, exempt colliders, and the passages found; see `passages`."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Array, FieldArena, download
from taisoft.backend.reader import Reader
from taisoft.collision.analytic import AnalyticObstacles
from taisoft.collision.bent_path import TRIALS, find_inwards, set_leg
from taisoft.collision.bvh import Trees
from taisoft.collision.candidates import Buffer, Pairs, fill, list_pairs, pair_entries
from taisoft.collision.colliders import Topology
from taisoft.collision.near_list import (
    GIVEN,
    HINTS,
    ONWARD,
    OUTDATED,
    SEARCHED,
    STILL,
    TO_STATE,
    UNCOVERED,
    PathFields,
    begin_onward,
)
from taisoft.collision.passages import ADJACENT, FLAT, N_KINDS, NEAR, ROUND, check_paths, passage_fields
from taisoft.collision.surface import Surface, integers
from taisoft.ranges import expand

NEAR_PAIRS = Pairs()
IN_BOXES = 0.49  # of the reach: how far a vertex may leave its searched path and still be in the boxes, grown by half of it


class HeldPassages(NamedTuple):
    """Passages that a search adds as contacts, see `append_passages`."""

    pairs: np.ndarray  # (k,4) i32: kind, two ids and the nearest features
    times: np.ndarray  # (k,) parts of the searched path until which they are certainly apart

    @classmethod
    def at_start(cls, pairs: np.ndarray) -> "HeldPassages":
        """Hold passages (k,4) where they are at the start of a step."""
        return cls(pairs, np.zeros(len(pairs)))


NO_PASSAGES = HeldPassages.at_start(np.zeros((0, 4), dtype=np.int32))


def adjacent_rows(triangle: np.ndarray) -> np.ndarray:
    """Return (k,7): six vertices of what must not pass each other among triangles (n,3) with common vertices, and one of these.

    It is the edge of one triangle opposite the common vertex, and the other one; if an edge is common, the opposite corners and
    the sides between them.
    """
    t = np.asarray(triangle, dtype=np.int64)
    corner_of = t.reshape(-1)
    order = np.argsort(corner_of, kind="stable")
    count = np.bincount(corner_of, minlength=1)
    start, size = (np.cumsum(count) - count)[corner_of[order]], count[corner_of[order]]
    first, second = (order[at] for at in expand(start, size))
    a, b = first // 3, second // 3
    common = (t[a][:, :, None] == t[b][:, None, :]).any(axis=2)
    n_common = common.sum(axis=1)
    one, k = n_common == 1, first % 3
    opposite = np.stack([t[a, (k + 1) % 3], t[a, (k + 2) % 3], t[a, (k + 2) % 3]], axis=1)
    rows = [np.column_stack([opposite, t[b], corner_of[first]])[one]]
    both = (n_common == 2) & (a < b) & (first % 3 == common.argmax(axis=1))
    a, b, shared = a[both], b[both], common[both]
    p, q = t[a][np.arange(len(a)), shared.argmax(axis=1)], t[a][np.arange(len(a)), 2 - shared[:, ::-1].argmax(axis=1)]
    c = t[a][np.arange(len(a)), (~shared).argmax(axis=1)]
    d = np.where((t[b] != p[:, None]) & (t[b] != q[:, None]), t[b], -1).max(axis=1)
    sides = (c, c, c, p, q, d), (d, d, d, p, q, c), (p, c, c, q, d, d), (q, c, c, p, d, d)
    return np.concatenate([*rows, *(np.stack([*columns, p], axis=1) for columns in sides)])


class PathCheck:
    """Find passages on the paths from the positions of the last search. reach [m]: as of the detection; floor [m]: to be kept."""

    def __init__(
        self,
        surface: Surface,
        topology: Topology,
        shapes: AnalyticObstacles,
        self_on: np.ndarray,
        has_pairs: bool,
        reach: float,
        floor: float,
        arena: FieldArena,
        capacity: int | None = None,
        max_capacity: int | None = None,
    ):
        """self_on: (n_bodies,) whether a collider is checked against itself. has_pairs: whether any triangles may touch.
        capacity, max_capacity: of the lists, None for the default."""
        self.surface, self.shapes, self.limit, self.floor = surface, shapes, IN_BOXES * reach, floor
        s, n = surface, max(surface.n_verts, 1)
        self._topology, self._shape_body = topology, shapes.body.to_numpy() if shapes.any else np.zeros(0, dtype=np.int64)
        self._rows = rows = adjacent_rows(topology.triangle[np.asarray(self_on, dtype=bool)[topology.body]])
        n_listed = s.n_triangles if has_pairs else 0
        triangle_ends = max(2 * n_listed, 1)
        lengths = {"path": n} | dict.fromkeys(("listed_x", "listed_move"), n if has_pairs else 1)
        lengths |= dict.fromkeys(("left_lo", "left_hi"), 2 * s.n_bodies) | {"hi": triangle_ends, "normal": max(n_listed, 1)}
        self.fields = PathFields(
            **{name: arena.vectors(f"path_{name}", ti.f64, length) for name, length in lengths.items()},
            lo=arena.vectors("path_lo", ti.f64, triangle_ends, np.full((triangle_ends, 3), np.inf)),
            **{name: arena.field(f"path_{name}", ti.f64, triangle_ends) for name in ("low", "high")},
            has_pairs=has_pairs,
            **{name: arena.field(f"path_{name}", ti.i32, n) for name in ("can_touch", "unfolded")},
            left=arena.field("path_left", ti.i32, 2),
            plane=arena.field("path_plane", ti.i32, max(HINTS * n_listed, 1)),
            exempt=arena.field("path_exempt", ti.i32, s.n_bodies**2),
            first_vertex=integers(arena, "path_first_vertex", topology.vertex_first),
            adjacent=integers(arena, "path_adjacent", rows),
            n_adjacent=len(rows),
        )
        limits = capacity or (4 * n_listed + 64 if has_pairs else 1), max_capacity
        self.near = Buffer("near_pairs", pair_entries, *limits, s.chunks, arena)
        self.passages = Buffer("passages", passage_fields, 64 * s.chunks, max_capacity, s.chunks, arena)
        self._is_listed, self._arena, self._read_small = False, arena, Reader(arena, "path")
        self.also: list[list] = []  # numbers that the last check has read for others
        self._leg: Surface | None = None  # of bent paths, allocated at first use
        self._inwards: Any = None

    def exempt(self, pairs: np.ndarray) -> None:
        """Exempt pairs of colliders, (n_bodies, n_bodies) bool, and no others."""
        self.fields.exempt.from_numpy((pairs | pairs.T).astype(np.int32).reshape(-1))

    def colliders(self, passages: np.ndarray) -> np.ndarray:
        """Return the two colliders (k,2) of each passage (k,4)."""
        t, one, other = self._topology, passages[:, 1].copy(), passages[:, 2]
        body_of = np.append(t.body[t.ring[t.ring_start[:-1]]], -1) if len(t.ring) else np.zeros(1, dtype=np.int64)
        result = np.zeros((len(passages), 2), dtype=np.int64)
        for kind in range(N_KINDS):
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
        sides[adjacent] = self._rows[a[adjacent], :6].reshape(-1, 2, 3)
        sides[kind == FLAT, 0] = a[kind == FLAT, None]
        row, is_edge = np.arange(len(f)), f >= 6
        for side, edge in enumerate(((f - 6) // 3, (f - 6) % 3)):
            first = np.where(is_edge, edge, f % 3)
            ends = sides[row, side, first], sides[row, side, np.where(is_edge, (first + 1) % 3, first)]
            chosen = is_edge | (f // 3 == side)  # of a corner's other triangle, all corners
            sides[:, side] = np.where(chosen[:, None], np.stack([*ends, np.full(len(f), -1)], axis=1), sides[:, side])
        sides[(kind == ROUND) | (kind == FLAT), 1] = -2 - b[(kind == ROUND) | (kind == FLAT), None]
        sides.sort(axis=2)
        order = sides[:, 0] - sides[:, 1]
        swapped = order[np.arange(len(order)), (order != 0).argmax(axis=1)] > 0  # by the first vertex that differs
        sides[swapped] = sides[swapped][:, ::-1]
        return sides.reshape(-1, 6)

    def forget(self) -> None:
        """Discard the list of near pairs, after positions were set."""
        self._is_listed = False

    def _list(self, broad, row: Buffer) -> None:
        """List the near pairs of the last search."""
        fill(
            lambda: list_pairs(self.surface, broad, row.parts, NEAR_PAIRS, self.near.parts), row, self.near, read=self._read_small
        )
        self._is_listed = True

    def _listed_limit(self, broad) -> float:
        """How far vertices may leave the listed paths along an axis, beside others [m]: less where unlisted triangles may be
        apart along other directions only."""
        return 2.0 * self.limit / (np.sqrt(3.0) if isinstance(broad, Trees) and broad.slabs > 3 else 1.0)

    def find(self, x, broad, row: Buffer | None, mode: int, also: Sequence[Array] = ()) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the passages (k,4), ordered, and the parts (k,) of the step until which they are apart; None if the paths leave
        what the last search has covered.

        x: field of the nodes' positions [m]; mode: which paths, see `check_paths`. broad, row: result of the last broad phase and
        buffer of its rows, or None. also: small arrays that are read as well, into `also`.
        """
        return self._check(self.surface, x, broad, row, mode, 0.0, float(mode != STILL), also)

    def bends(self, x, broad, row: Buffer | None, mode: int, margin: float) -> bool:
        """Return whether a bent path is free, see `bent_path`. margin [m]: of the detection; the others are as for `find`."""
        if self._leg is None:
            n = max(self.surface.n_verts, 1)
            self._leg = replace(self.surface, x=self._arena.vectors("leg_x", ti.f64, n))
            self._inwards = self._arena.vectors("inwards", ti.f64, n)
        if not self._is_leg_free(x, broad, row, mode, 0.0, 1.0, 1.0):  # the end, where a bent path is not bent
            return False
        self.find_inwards(x, mode)

        def is_free(legs: int, depth: float) -> bool:
            return all(self._is_leg_free(x, broad, row, mode, depth, k / legs, (k + 1) / legs) for k in range(legs))

        return any(is_free(legs, part * margin) for legs, part in TRIALS)

    def find_inwards(self, x, mode: int) -> None:
        """See `bent_path.find_inwards`."""
        find_inwards(self.surface, x, int(mode == SEARCHED), self._inwards)

    def _is_leg_free(self, x, broad, row: Buffer | None, mode: int, depth: float, begin: float, end: float) -> bool:
        """Return whether nothing passes on a leg, see `bent_path.set_leg`, or crosses there if its begin is its end.

        False if it leaves what was searched.
        """
        for _ in range(2):
            where = self._inwards, depth, begin, end, self.limit if broad is not None else np.inf
            set_leg(self.surface, self._leg, self.fields, x, int(mode == SEARCHED), *where)
            if self.fields.left[UNCOVERED]:
                return False
            found = self._check(self._leg, x, broad, row, STILL if begin == end else GIVEN, begin, end)
            if found is not None:
                return len(found[0]) == 0
            self._is_listed = False  # the list of near pairs is renewed along the straight paths
            self._check(self.surface, x, broad, row, mode, 0.0, 1.0)
        return False

    def _check(
        self, s: Surface, x, broad, row: Buffer | None, mode: int, begin: float, end: float, also: Sequence[Array] = ()
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """See `find`; surface s is that of the last search, or a leg between two parts of the step: None if the list is of no use
        for that."""
        is_new, covers = False, broad is not None
        while True:
            if not self._is_listed and covers:
                self._list(broad, row)
                is_new = True
            limit, listed_limit = self.limit if covers else np.inf, np.inf if is_new or not covers else self._listed_limit(broad)
            lists = self.near.parts, self.passages.parts
            check_paths(s, x, self.shapes, self.fields, *lists, mode, begin, end, limit, listed_limit, self.floor, 0)
            left, count, *self.also = self._read_small([self.fields.left, self.passages.count, *also])
            if left[UNCOVERED]:
                return None
            if left[OUTDATED]:
                self._is_listed = False
                if s is not self.surface:
                    return None
            elif not self.passages.grow_if_full([count]):
                break
        return self._read()

    def prepare_batch(self, x, broad, row: Buffer | None) -> None:
        """List the near pairs of the last search, unless they are listed, and place the surface at x [m], where batches go on."""
        if broad is not None and not self._is_listed:
            self._list(broad, row)
            begin_onward(self.surface, x, self.fields)

    def check_in_batch(self, x, event: int) -> None:
        """Check the paths to positions x [m] from those of the surface. event: see `check_paths`."""
        lists, has_pairs = (self.near.parts, self.passages.parts), self.fields.has_pairs
        mode, limits = (ONWARD, (self.limit, np.finfo(float).max)) if has_pairs else (TO_STATE, (np.inf, np.inf))
        check_paths(self.surface, x, self.shapes, self.fields, *lists, mode, 0.0, 1.0, *limits, self.floor, event)

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the passages found."""
        out = self.passages
        if out.total == 0:
            return NO_PASSAGES
        pair, time, used = download([out.data.pair, out.data.time, out.used])
        filled = out.filled(used)
        pair, time = pair[filled], time[filled]
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
