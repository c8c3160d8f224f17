"""Compute how deep triangles cut into tetrahedra, to find overlaps where no vertex of one solid lies inside the other.

A disjoint triangle and tet are separated along a face normal or the cross product of two edges, one of each (separating
axes: Gottschalk, Lin, Manocha 1996, OBBTree). The smallest overlap over these 23 axes is the depth of the cut. Pure touching,
flush or along an edge, has depth 0. Tets may be inverted.
"""

import numpy as np
import scipy

from taisoft.mesh.topology import EDGES, TET_FACES

PARALLEL = 1e-6  # sine below which two edges count as parallel and give no axis
_PAIRS = 1 << 14  # maximum number of pairs processed at once, about 10 kB each


def cut_depths(triangles: np.ndarray, tets: np.ndarray, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (k,2) of a triangle and a tet whose boxes lie within slack [m], and the depths (k,) [m] of their cuts.

    triangles: (t,3,3) [m] corners. tets: (m,4,3) [m] corners.
    """
    pairs = _near_boxes(triangles.min(axis=1) - slack, triangles.max(axis=1) + slack, tets.min(axis=1), tets.max(axis=1))
    depth = np.zeros(len(pairs))
    for first in range(0, len(pairs), _PAIRS):
        t, m = pairs[first : first + _PAIRS].T
        depth[first : first + _PAIRS] = _separation(triangles[t], tets[m])
    return pairs, depth


def _near_boxes(lo_a: np.ndarray, hi_a: np.ndarray, lo_b: np.ndarray, hi_b: np.ndarray) -> np.ndarray:
    """Return the pairs (k,2) of boxes that meet. One k-d tree per size class of b: large boxes widen only their search."""
    middle_a, middle_b = 0.5 * (lo_a + hi_a), 0.5 * (lo_b + hi_b)
    reach_a, reach_b = np.linalg.norm(hi_a - middle_a, axis=1), np.linalg.norm(hi_b - middle_b, axis=1)
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    size_classes = np.floor(np.log2(np.maximum(reach_b, np.finfo(float).tiny)))
    for size_class in np.unique(size_classes):
        rows = np.flatnonzero(size_classes == size_class)
        tree, reach = scipy.spatial.cKDTree(middle_b[rows]), reach_b[rows].max()
        for first in range(0, len(middle_a), _PAIRS):
            chunk = slice(first, first + _PAIRS)
            lists = tree.query_ball_point(middle_a[chunk], (1.0 + 1e-9) * (reach_a[chunk] + reach))
            a = first + np.repeat(np.arange(len(lists)), [len(near) for near in lists])
            b = rows[np.concatenate([np.zeros(0, dtype=np.int64), *lists]).astype(np.int64)]
            meet = ((lo_a[a] <= hi_b[b]) & (lo_b[b] <= hi_a[a])).all(axis=1)
            pairs.append(np.stack([a[meet], b[meet]], axis=1))
    return np.concatenate(pairs)


def _separation(triangle: np.ndarray, tet: np.ndarray) -> np.ndarray:
    """Return the distance (k,) [m] that separates each triangle (k,3,3) from its tet (k,4,3); 0 if they are disjoint."""
    triangle, tet = triangle - tet[:, :1], tet - tet[:, :1]
    triangle_edges = np.roll(triangle, -1, axis=1) - triangle
    faces = tet[:, TET_FACES]
    sides = np.concatenate([triangle_edges[:, None], np.roll(faces, -1, axis=2) - faces], axis=1)  # (k,5,3,3) edges of each face
    depth = _smallest_overlap(triangle, tet, sides[:, :, 0], sides[:, :, 1])
    remaining = np.flatnonzero(depth > 0.0)  # most pairs are separated along a normal
    ends = tet[remaining][:, EDGES]
    edges = np.broadcast_to((ends[:, :, 1] - ends[:, :, 0])[:, None], (len(remaining), 3, 6, 3))
    paired_edges = np.broadcast_to(triangle_edges[remaining][:, :, None], edges.shape)
    edge_depth = _smallest_overlap(triangle[remaining], tet[remaining], paired_edges.reshape(-1, 18, 3), edges.reshape(-1, 18, 3))
    depth[remaining] = np.minimum(depth[remaining], edge_depth)
    return depth


def _smallest_overlap(triangle: np.ndarray, tet: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the smallest separating distance (k,) [m], at least 0, along the axes first x second, (k,n,3) each."""
    axes = np.cross(first, second)
    length = np.linalg.norm(axes, axis=2)
    usable = length > PARALLEL * np.linalg.norm(first, axis=2) * np.linalg.norm(second, axis=2)
    axes /= np.where(usable, length, 1.0)[:, :, None]
    a, b = (np.einsum("kcx,knx->knc", x, axes) for x in (triangle, tet))
    overlap = np.minimum(a.max(axis=2) - b.min(axis=2), b.max(axis=2) - a.min(axis=2))
    return np.maximum(np.where(usable, overlap, np.inf).min(axis=1), 0.0)
