"""Compute triangle neighbours and normals. Half-edge 3t + k runs from corner k of triangle t to corner (k + 1) mod 3."""

import numpy as np

from taisoft.errors import MeshError

_ENDS = np.array([(0, 1), (1, 2), (2, 0)])


def opposite_half_edges(triangles: np.ndarray) -> np.ndarray:
    """Return (t,3) int64: the opposite half-edge of half-edge k of each triangle, -1 at a border.

    triangles: (t,3) int, vertex ids from 0. Raises MeshError if an edge has more than two triangles, or two triangles that
    traverse it in the same direction.
    """
    ends = triangles[:, _ENDS].reshape(-1, 2).astype(np.int64)
    low, high = ends.min(axis=1), ends.max(axis=1)
    order = np.lexsort((high, low))
    new = np.ones(len(order), dtype=bool)
    new[1:] = (low[order[1:]] != low[order[:-1]]) | (high[order[1:]] != high[order[:-1]])
    starts = np.flatnonzero(new)
    counts = np.diff(np.append(starts, len(order)))
    if (counts > 2).any():
        k = int(np.argmax(counts > 2))
        owners = np.sort(order[starts[k] : starts[k] + counts[k]] // 3)
        raise MeshError(
            f"edge {_sorted_ends(ends[order[starts[k]]])} belongs to {counts[k]} triangles "
            f"({', '.join(map(str, owners[:5].tolist()))}{', ...' if len(owners) > 5 else ''}); an edge may have at most two"
        )
    first = starts[counts == 2]
    a, b = order[first], order[first + 1]
    same = ends[a, 0] == ends[b, 0]
    if same.any():
        k = int(np.argmax(same))
        s, t = sorted((int(a[k]) // 3, int(b[k]) // 3))
        raise MeshError(
            f"triangles {s} and {t} traverse their edge {_sorted_ends(ends[a[k]])} in the same direction: one of them has the "
            "wrong orientation"
        )
    opposite = np.full(len(ends), -1, dtype=np.int64)
    opposite[a], opposite[b] = b, a
    return opposite.reshape(-1, 3)


def _sorted_ends(edge: np.ndarray) -> tuple:
    return tuple(sorted(edge.tolist()))


def normals_and_heights(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (t,3), zero for triangles without area, and the smallest height over the longest edge (t,).

    vertices: (n,3) [m]. triangles: (t,3) int; seen from the tip of the normal, corners run counter-clockwise.
    """
    x = vertices[triangles]
    edges = np.roll(x, -1, axis=1) - x
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    # Scale by the longest edge first: the area of a tiny triangle underflows.
    scaled = edges / np.where(longest > 0, longest, 1.0)[:, None, None]
    area = np.cross(scaled[:, 0], scaled[:, 1])
    twice = np.linalg.norm(area, axis=1)
    return area / np.where(twice > 0, twice, 1.0)[:, None], twice
