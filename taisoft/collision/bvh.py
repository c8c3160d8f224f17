"""Candidates by a chunked bounding volume hierarchy of k-DOPs, the report's alternative to the spatial hash.

Each collider has a balanced binary tree over its triangles, built once on the host, top-down and all nodes of a level at once:
the triangles of a node are sorted along the longest extent of their centroids and split in the middle. The nodes of a subtree
are consecutive, the first child follows its parent, and the trees follow each other in the order of the colliders. A chunk is a
subtree of at most `leaves` triangles. Every search refits the slabs: chunks in parallel, then the nodes above them. The trees
are then traversed for the triangles near one corner or one triangle.

Slabs bound each triangle at the start and at the end of the step, grown by half the margin. k = 6 gives the boxes of the spatial
hash and so its candidates; 14 (with the space diagonals) and 18 (with the face diagonals) give fewer. Weak: the trees keep
the order of the first positions, and a query visits the root of every collider whose box meets that of its own.

Source: report, section 2.3.2, algorithm 1 and figure 7; Schmidtke and Erleben, Chunked bounding volume hierarchies for fast
digital prototyping using volumetric meshes, 2018.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.lists import sort_range
from taisoft.backend.runtime import Runtime, kernel
from taisoft.collision.candidates import WHOLE, Buffer, is_candidate
from taisoft.collision.colliders import Topology
from taisoft.collision.surface import Surface, dvec, integers
from taisoft.ranges import expand

CPU_LEAVES, GPU_LEAVES = 64, 8  # triangles per chunk: the fastest of 4 to 256 on the CPU, small on CUDA for enough threads

AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
DIRECTIONS = {  # k -> normals of the slabs
    6: AXES,
    14: (*AXES, (1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)),
    18: (*AXES, (1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1)),
}


@dataclass(frozen=True)
class TreeTables:
    """Trees on the host."""

    link: np.ndarray  # (nodes,) number of nodes of the subtree; for a leaf -1 - its triangle
    root: np.ndarray  # (colliders,) -1 if there is no triangle
    chunk: np.ndarray  # roots of the chunks, ascending
    top: np.ndarray  # nodes above the chunks, the deepest first
    top_first: np.ndarray  # start of each level of those, then their number


def build_trees(centroid: np.ndarray, first: np.ndarray, leaves: int) -> TreeTables:
    """Build balanced trees over centroids (t,3) of triangles. first: (colliders + 1,) first triangle of each collider."""
    count, start = np.diff(first), np.asarray(first[:-1])
    nodes = np.maximum(2 * count - 1, 0)
    node = np.cumsum(nodes) - nodes
    link = np.zeros(int(nodes.sum()), dtype=np.int64)
    root = np.where(count > 0, node, -1)
    used = count > 0
    start, count, node, order = start[used], count[used], node[used], np.arange(first[-1])
    above = np.ones(len(count), dtype=bool)  # whether the node lies above the chunks
    chunks, levels = [], []
    while len(count):
        begins = above & (count <= leaves)
        chunks.append(node[begins])
        above &= ~begins
        levels.append(node[above])
        leaf = count == 1
        link[node[leaf]] = -1 - order[start[leaf]]
        start, count, node, above = (a[~leaf] for a in (start, count, node, above))
        link[node] = 2 * count - 1
        _split(order, start, count, centroid)
        left = (count + 1) // 2
        start, count = np.concatenate([start, start + left]), np.concatenate([left, count - left])
        node, above = np.concatenate([node + 1, node + 2 * left]), np.tile(above, 2)
    levels = [x for x in levels if len(x)][::-1]
    chunk, top = (np.concatenate([[], *x]).astype(np.int64) for x in (chunks, levels))
    return TreeTables(link, root, np.sort(chunk), top, np.cumsum([0, *map(len, levels)]))


def _split(order: np.ndarray, start: np.ndarray, count: np.ndarray, centroid: np.ndarray) -> None:
    """Sort each range order[start : start + count] along the longest extent of its centroids, in place."""
    if len(count) == 0:
        return
    offset = np.cumsum(count) - count
    which, at = expand(start, count)
    points = centroid[order[at]]
    extent = np.maximum.reduceat(points, offset) - np.minimum.reduceat(points, offset)
    key = points[np.arange(len(which)), extent.argmax(axis=1)[which]]
    order[at] = order[at[np.lexsort((key, which))]]


@ti.func
def _project(b: ti.template(), x):
    """Project a vector onto the directions of the slabs."""
    return ti.Vector([x[q] if ti.static(q < 3) else x.dot(dvec(b.directions[q])) for q in ti.static(range(b.slabs))], ti.f64)


@dataclass(frozen=True, eq=False)
class Trees:
    """Fields of the trees, for kernels; the tables are described in `TreeTables`."""

    slabs: int  # k / 2
    directions: tuple[tuple[int, int, int], ...]
    n_chunks: Count
    n_levels: Count  # of the nodes above the chunks
    link: Any  # i32
    root: Any  # i32
    chunk: Any  # i32
    top: Any  # i32
    top_first: Any  # i32
    lo: Any  # (nodes) vectors f64, one entry per slab [m], scaled by the length of its direction
    hi: Any

    @ti.func
    def bounds(self, s: ti.template(), t, q, padding):
        """Slabs of corner q of triangle t at both ends of the step, of all of t if q > 2, padded by `padding`: half the reach."""
        lo, hi = ti.Vector([ti.math.inf] * self.slabs, ti.f64), ti.Vector([-ti.math.inf] * self.slabs, ti.f64)
        if s.lo[t][0] <= s.hi[t][0]:  # finite
            for k in range(3):
                if q > 2 or q == k:
                    i = s.triangle[t, k]
                    begin = _project(self, s.x[i])
                    end = _project(self, s.x[i] + s.move[i])
                    lo, hi = ti.min(lo, begin, end), ti.max(hi, begin, end)
            for k in ti.static(range(self.slabs)):
                grown = padding
                if ti.static(k >= 3):
                    grown = padding * dvec(self.directions[k]).norm()
                lo[k] -= grown
                hi[k] += grown
        return lo, hi

    @ti.func
    def list_triangles(self, s: ti.template(), other, t, q, lo, hi, entry: ti.template(), begin, last):
        """List the triangles of collider `other` near a query, as `Candidates.list_triangles` does."""
        at, node = begin, self.root[other]
        end = node + _nodes_below(self, node)
        while node < end:
            size = self.link[node]
            step = ti.max(size, 1)
            if (lo <= self.hi[node]).all() and (self.lo[node] <= hi).all():
                step = 1  # to the first child, or past the leaf
                if size < 0:
                    if at < last:
                        entry[at] = -1 - size
                    at += is_candidate(s, t, q, -1 - size)  # no branch, since nobody can predict it
            node += step
        if at <= last:
            sort_range(entry, begin, at)
        return at - begin


@ti.func
def _nodes_below(b: ti.template(), node):
    """Number of nodes of a subtree, including its root."""
    return ti.max(b.link[node], 1)


@ti.func
def _refit_inner(b: ti.template(), node):
    """Set a node's slabs from those of its children: the first one follows it, the second one follows the first one's subtree."""
    other = node + (b.link[node] + 3) // 4 * 2
    b.lo[node] = ti.min(b.lo[node + 1], b.lo[other])
    b.hi[node] = ti.max(b.hi[node + 1], b.hi[other])


@kernel
def refit(s: ti.template(), b: ti.template(), margin: ti.f64):
    """Refit all nodes in the chunks, then those above them level by level."""
    ti.loop_config(serialize=s.serial_cheap)
    for task in range(b.n_chunks * s.cheap_spread):
        if task % s.cheap_spread == 0:
            first = b.chunk[task // s.cheap_spread]
            n = _nodes_below(b, first)
            for k in range(n):
                node = first + n - 1 - k
                t = -1 - b.link[node]
                if t < 0:
                    _refit_inner(b, node)
                elif ti.static(b.slabs == 3):
                    b.lo[node], b.hi[node] = s.lo[t], s.hi[t]
                else:
                    lo, hi = b.bounds(s, t, WHOLE, ti.cast(0.5, ti.f64) * margin)
                    b.lo[node], b.hi[node] = lo, hi
    ti.loop_config(serialize=s.team.alone, block_dim=s.team.threads)
    for t in range(s.team.threads):
        for level in range(b.n_levels):
            first, n = b.top_first[level], b.top_first[level + 1] - b.top_first[level]
            for j in range(s.team.share(t, n)):
                _refit_inner(b, b.top[first + s.team.entry(t, j, n)])
            s.team.sync()


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
    ):
        """x: (n_verts, 3) [m], the positions that the trees are built for. k_dop: 6, 14 or 18. leaves: most triangles per chunk,
        None for the default."""
        self.surface, self.margin = surface, margin
        self.tables = t = build_trees(
            x[topology.triangle].mean(axis=1), topology.first, leaves or (CPU_LEAVES if runtime.on_cpu else GPU_LEAVES)
        )

        slabs = {name: arena.vectors(f"bvh_{name}", ti.f64, max(len(t.link), 1), n=k_dop // 2) for name in ("lo", "hi")}
        indices = {
            name: integers(arena, f"bvh_{name}", getattr(t, name)) for name in ("link", "root", "chunk", "top", "top_first")
        }
        self.trees = Trees(k_dop // 2, DIRECTIONS[k_dop], len(t.chunk), len(t.top_first) - 1, **indices, **slabs)

    def near(self) -> Trees:
        """Refit the trees to the present boxes and return them, for queries."""
        refit(self.surface, self.trees, self.margin)
        return self.trees

    search = near  # as of `SpatialHash`

    @property
    def buffers(self) -> tuple[Buffer, ...]:
        """The growing buffers."""
        return ()

    def release(self) -> None:
        """Free the memory of the buffers."""
