"""Candidates by a chunked bounding volume hierarchy of k-DOPs, the report's alternative to the spatial hash.

Each collider has a tree over its triangles, built once (`trees.py`). A chunk is a subtree of at most `leaves` triangles. Every
search refits the slabs: chunks in parallel, then the nodes above them. `queries.py` then finds the triangles near one vertex or
triangle. If all pairs are requested, each chunk is traversed against the trees; the larger of two nodes is opened, so a stack
needs no more entries than both trees have levels. Memory for pairs is allocated at their first request.

Slabs bound each triangle at the start and at the end of the step, grown by half the margin. k = 6 gives the boxes of the spatial
hash and so its candidates; 14 (with the space diagonals) and 18 (with the face diagonals) give fewer. Weak: the trees keep
the order of the first positions, and each chunk is tested against the root of every collider that may follow its own.

Source: report, section 2.3.2, algorithm 1 and figure 7; Schmidtke and Erleben, Chunked bounding volume hierarchies for fast
digital prototyping using volumetric meshes, 2018.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import Runtime, kernel
from taisoft.collision.candidates import Buffer, Candidates, PairRows, pairs, sum_parts
from taisoft.collision.surface import Surface, Topology, dvec, may_touch
from taisoft.collision.trees import TreeTables, build_trees

LEAVES = {"cpu": 64, "cuda": 8}  # triangles per chunk: the fastest of 4 to 256 on the CPU, small on CUDA for enough threads
PAIRS_PER_TRIANGLE = 24  # initial capacity

AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
DIRECTIONS = {  # k -> normals of the slabs
    6: AXES,
    14: (*AXES, (1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)),
    18: (*AXES, (1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1)),
}


@dataclass(frozen=True, eq=False)
class Trees:
    """Fields of the trees, for kernels; the tables are described in `TreeTables`."""

    slabs: int  # k / 2
    directions: tuple[tuple[int, int, int], ...]
    n_chunks: Count
    n_top: Count
    levels: Count  # size of a stack
    parts: int
    link: Any  # i32
    root: Any  # i32
    chunk: Any  # i32
    chunk_body: Any  # i32
    top: Any  # i32
    lo: Any  # (nodes) vectors f64, one entry per slab [m], scaled by the length of its direction
    hi: Any
    stack: Any  # (parts * levels) 2-vectors i32
    walked: bool = True  # queried by traversal, unlike rows


def place_trees(t: TreeTables, k: int, parts: int, arena: FieldArena) -> Trees:
    """Allocate and fill the fields of the trees."""
    levels = t.chunk_depth + t.depth + 1

    def ints(name: str, data: np.ndarray):
        return arena.field(f"bvh_{name}", ti.i32, max(len(data), 1), (data if len(data) else np.zeros(1)).astype(np.int32))

    def slabs(name: str):
        return arena.vectors(f"bvh_{name}", ti.f64, max(len(t.link), 1), n=k // 2)

    return Trees(
        k // 2,
        DIRECTIONS[k],
        len(t.chunk),
        len(t.top),
        levels,
        parts,
        ints("link", t.link),
        ints("root", t.root),
        ints("chunk", t.chunk),
        ints("chunk_body", t.chunk_body),
        ints("top", t.top),
        slabs("lo"),
        slabs("hi"),
        arena.vectors("bvh_stack", ti.i32, parts * levels, n=2),
    )


@ti.func
def _project(b: ti.template(), x):
    """Project a vector onto the directions of the slabs."""
    return ti.Vector([x[q] if q < 3 else x.dot(dvec(b.directions[q])) for q in ti.static(range(b.slabs))], ti.f64)


@ti.func
def slabs_of(s: ti.template(), b: ti.template(), t, q, padding):
    """Slabs of corner q of triangle t at both ends of the step, of all of t if q > 2, padded by `padding` [m]."""
    lo, hi = ti.Vector([ti.math.inf] * b.slabs, ti.f64), ti.Vector([-ti.math.inf] * b.slabs, ti.f64)
    if s.lo[t][0] <= s.hi[t][0]:  # finite
        for k in range(3):
            if q > 2 or q == k:
                i = s.triangle[t, k]
                begin = _project(b, s.x[i])
                end = _project(b, s.x[i] + s.move[i])
                lo, hi = ti.min(lo, begin, end), ti.max(hi, begin, end)
        for k in ti.static(range(b.slabs)):
            grown = padding
            if ti.static(k >= 3):
                grown = padding * dvec(b.directions[k]).norm()
            lo[k] -= grown
            hi[k] += grown
    return lo, hi


@ti.func
def _refit_leaf(s: ti.template(), b: ti.template(), node, padding):
    """Set a leaf's slabs from its triangle at both ends of the step."""
    t = -1 - b.link[node]
    if ti.static(b.slabs == 3):
        b.lo[node], b.hi[node] = s.lo[t], s.hi[t]
    else:
        lo, hi = slabs_of(s, b, t, 3, padding)
        b.lo[node], b.hi[node] = lo, hi


@ti.func
def _second_child(b: ti.template(), node):
    """Return the second child; the first one follows its parent."""
    return node + (b.link[node] + 3) // 4 * 2


@ti.func
def _refit_inner(b: ti.template(), node):
    """Set a node's slabs from those of its children."""
    other = _second_child(b, node)
    b.lo[node] = ti.min(b.lo[node + 1], b.lo[other])
    b.hi[node] = ti.max(b.hi[node + 1], b.hi[other])


@ti.func
def nodes_below(b: ti.template(), node):
    """Number of nodes of a subtree, including its root."""
    return ti.max(b.link[node], 1)


@ti.func
def _refit_chunks(s: ti.template(), b: ti.template(), margin):
    """Refit all nodes in the chunks."""
    ti.loop_config(serialize=s.serial_cheap)
    for task in range(b.n_chunks * s.cheap_spread):
        if task % s.cheap_spread == 0:
            first = b.chunk[task // s.cheap_spread]
            n = nodes_below(b, first)
            for k in range(n):
                node = first + n - 1 - k
                if b.link[node] < 0:
                    _refit_leaf(s, b, node, ti.cast(0.5, ti.f64) * margin)
                else:
                    _refit_inner(b, node)


@kernel
def refit(s: ti.template(), b: ti.template(), margin: ti.f64):
    """Refit all nodes in the chunks, then those above them one by one."""
    _refit_chunks(s, b, margin)
    ti.loop_config(serialize=True)
    for k in range(b.n_top):
        _refit_inner(b, b.top[k])


@kernel
def refit_chunks(s: ti.template(), b: ti.template(), margin: ti.f64):
    """Refit all nodes in the chunks."""
    _refit_chunks(s, b, margin)


@kernel
def refit_level(b: ti.template(), first: ti.i32, last: ti.i32):
    """Refit the nodes top[first:last] above the chunks, all of one level."""
    for k in range(first, last):
        _refit_inner(b, b.top[k])


@ti.func
def _walk(s: ti.template(), b: ti.template(), part, root_a, root_b, pair: ti.template(), begin, last):
    """Append the pairs of leaves below two nodes. Return the index after the last one, beyond `last` if they did not fit.

    The second leaf of a pair comes after the first, so that each pair of a tree against itself is found once; the trees follow
    each other in the order of the colliders, so this holds for different trees too.
    """
    i, j, at = root_a, root_b, begin
    bottom = part * b.levels
    depth = 0
    walking = 1
    while walking == 1:
        split = 0
        if j + nodes_below(b, j) > i and (b.lo[i] <= b.hi[j]).all() and (b.lo[j] <= b.hi[i]).all():
            if b.link[i] < 0 and b.link[j] < 0:
                t, u = -1 - b.link[i], -1 - b.link[j]
                if j > i and may_touch(s, t, u) == 1:
                    if at < last:
                        pair[at] = ti.Vector([t, u], ti.i32)
                    at += 1
            else:
                split = 1
        if split == 1:  # descend into one child, push the other
            if b.link[i] >= b.link[j]:
                b.stack[bottom + depth] = ti.Vector([_second_child(b, i), j], ti.i32)
                i += 1
            else:
                b.stack[bottom + depth] = ti.Vector([i, _second_child(b, j)], ti.i32)
                j += 1
            depth += 1
        elif depth > 0:
            depth -= 1
            i, j = b.stack[bottom + depth][0], b.stack[bottom + depth][1]
        else:
            walking = 0
    return at


@kernel
def walk_trees(s: ti.template(), b: ti.template(), pair: ti.template(), used: ti.template(), total: ti.template(), part: ti.i32):
    """Find the triangle pairs whose slabs overlap, each once. Neighbouring chunks go to different parts to balance the load."""
    ti.loop_config(serialize=s.serial)
    for task in range(b.parts * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            at = c * part
            for k in range((b.n_chunks - c + b.parts - 1) // b.parts):
                chunk = c + k * b.parts
                own = b.chunk_body[chunk]
                for other in range(own, s.n_bodies):
                    may_collide = s.self_on[own]
                    if other != own:
                        may_collide = s.soft[own] | s.soft[other]
                    if may_collide == 1 and b.root[other] >= 0:
                        at = _walk(s, b, c, b.chunk[chunk], b.root[other], pair, at, (c + 1) * part)
            used[c] = at - c * part
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(used, total, b.parts)


class Bvh:
    """Broad phase by trees. margin [m] must be that of the surface's boxes; it may be changed at any time."""

    def __init__(
        self,
        surface: Surface,
        topology: Topology,
        x: np.ndarray,
        margin: float,
        runtime: Runtime,
        arena: FieldArena,
        k_dop: int = 6,
        leaves: int | None = None,
        capacity: int | None = None,
        max_capacity: int | None = None,
    ):
        """x: (n_verts, 3) [m], the positions that the trees are built for. k_dop: 6, 14 or 18. leaves: most triangles per chunk.
        capacity: initial pairs; max_capacity: limit of pairs and of row entries. None for the default."""
        self.surface, self.margin = surface, margin
        self.tables = build_trees(x[topology.triangle].mean(axis=1), topology.first, leaves or LEAVES[runtime.arch])
        self.trees = place_trees(self.tables, k_dop, surface.chunks, arena)
        self.by_levels = runtime.arch != "cpu"  # else one thread refits the nodes above the chunks, in one launch
        self._limits, self._arena = (capacity, max_capacity), arena
        self.pairs: Buffer | None = None
        self.rows: PairRows | None = None

    def near(self) -> Trees:
        """Refit the trees to the present boxes and return them, for `queries.py`."""
        if not self.by_levels:
            refit(self.surface, self.trees, self.margin)
            return self.trees
        refit_chunks(self.surface, self.trees, self.margin)
        first = self.tables.top_first
        for begin, end in zip(first[:-1], first[1:]):
            refit_level(self.trees, int(begin), int(end))
        return self.trees

    def find(self) -> Candidates:
        """Return the candidates of the present boxes. Raise SimulationError if a buffer would outgrow its limit."""
        self.near()
        if self.pairs is None:
            self._allocate_pairs()
        while True:
            found = self.pairs
            walk_trees(self.surface, self.trees, found.data, found.used, found.count, found.part)
            if not found.grow_if_full():
                return self.rows.from_pairs(found)

    def _allocate_pairs(self) -> None:
        s, (capacity, max_capacity) = self.surface, self._limits
        n = s.n_triangles
        self.pairs = Buffer("bvh_pairs", pairs, capacity or PAIRS_PER_TRIANGLE * n + 64, max_capacity, s.chunks, self._arena)
        self.rows = PairRows(s, self._arena, capacity or 2 * PAIRS_PER_TRIANGLE * n + 64, max_capacity)

    @property
    def buffers(self) -> tuple[Buffer, ...]:
        """The growing buffers."""
        return () if self.pairs is None else (self.pairs, self.rows.rows)

    def release(self) -> None:
        """Free the memory of the buffers."""
        if self.pairs is not None:
            self.pairs.release()
            self.rows.release()
