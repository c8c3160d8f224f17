"""Balanced binary trees over the triangles of each collider, as tables on the host; `bvh.py` keeps k-DOPs at their nodes.

Built top-down, all nodes of a level at once: the triangles of a node are sorted along the longest extent of their centroids and
split in the middle. The nodes of a subtree are consecutive, the first child follows its parent, and the trees follow each other
in the order of the colliders.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TreeTables:
    """Trees on the host.

    link: (nodes,) number of nodes of the subtree, for a leaf -1 - its triangle; root: (colliders,) -1 if there is no triangle;
    chunk: roots of the chunks; chunk_body: their colliders; top: nodes above the chunks, the deepest first; top_first: start of
    each level of those, then their number; chunk_depth, depth: maximum levels below the root of a chunk and of a tree.
    """

    link: np.ndarray
    root: np.ndarray
    chunk: np.ndarray
    chunk_body: np.ndarray
    top: np.ndarray
    top_first: np.ndarray
    chunk_depth: int
    depth: int


def build_trees(centroid: np.ndarray, first: np.ndarray, leaves: int) -> TreeTables:
    """Build balanced trees over centroids (t,3) of triangles. first: (colliders + 1,) first triangle of each collider."""
    count, start = np.diff(first), np.asarray(first[:-1])
    nodes = np.maximum(2 * count - 1, 0)
    node = np.cumsum(nodes) - nodes
    link = np.zeros(int(nodes.sum()), dtype=np.int64)
    root = np.where(count > 0, node, -1)
    body = np.flatnonzero(count)
    start, count, node, order = start[body], count[body], node[body], np.arange(first[-1])
    above = np.ones(len(body), dtype=bool)  # whether the node lies above the chunks
    chunks, bodies, levels = [], [], []
    level = 0
    while len(count):
        begins = above & (count <= leaves)
        chunks.append(node[begins])
        bodies.append(body[begins])
        above &= ~begins
        levels.append(node[above])
        leaf = count == 1
        link[node[leaf]] = -1 - order[start[leaf]]
        start, count, node, body, above = (a[~leaf] for a in (start, count, node, body, above))
        link[node] = 2 * count - 1
        _split(order, start, count, centroid)
        left = (count + 1) // 2
        start, count = np.concatenate([start, start + left]), np.concatenate([left, count - left])
        node, body, above = np.concatenate([node + 1, node + 2 * left]), np.tile(body, 2), np.tile(above, 2)
        level += 1
    levels = [x for x in levels if len(x)][::-1]
    chunk, chunk_body = np.concatenate([[], *chunks]).astype(np.int64), np.concatenate([[], *bodies]).astype(np.int64)
    in_order = np.argsort(chunk)
    deepest = int(np.log2(link[chunk].max(initial=1)))  # a balanced tree of n leaves has 2 n - 1 nodes and ceil(log2(n)) levels
    return TreeTables(
        link,
        root,
        chunk[in_order],
        chunk_body[in_order],
        np.concatenate([[], *levels]).astype(np.int64),
        np.cumsum([0, *map(len, levels)]),
        deepest,
        max(level - 1, 0),
    )


def _split(order: np.ndarray, start: np.ndarray, count: np.ndarray, centroid: np.ndarray) -> None:
    """Sort each range order[start : start + count] along the longest extent of its centroids, in place."""
    if len(count) == 0:
        return
    offset = np.cumsum(count) - count
    which = np.repeat(np.arange(len(count)), count)
    at = np.arange(len(which)) - offset[which] + start[which]
    points = centroid[order[at]]
    extent = np.maximum.reduceat(points, offset) - np.minimum.reduceat(points, offset)
    key = points[np.arange(len(which)), extent.argmax(axis=1)[which]]
    order[at] = order[at[np.lexsort((key, which))]]
