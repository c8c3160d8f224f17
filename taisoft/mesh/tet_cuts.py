"""How deep triangles cut into tetrahedra: what tells whether solids overlap where no vertex of one lies inside the other.

A triangle and a tet are clear of each other along a normal of one of them or along the cross product of an edge of each
(separating axes: Gottschalk, Lin, Manocha 1996, OBBTree); the least width over these 23 axes is how far they must part. What
only touches, flush or along an edge, cuts 0 deep. Tets may be inverted.
"""

import numpy as np
import scipy

from taisoft.mesh.topology import EDGES, TET_FACES

PARALLEL = 1e-6  # sine below which two edges, or those of a face, have no common normal
_PAIRS = 1 << 14  # that are looked at together, about 10 kB each


def cut_depths(triangles: np.ndarray, tets: np.ndarray, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (k,2) of a triangle and a tet whose boxes come within slack [m] of each other, and how deep each cuts (k,) [m].

    triangles: (t,3,3), tets: (m,4,3) [m], by corners.
    """
    pairs = _near_boxes(triangles.min(axis=1) - slack, triangles.max(axis=1) + slack, tets.min(axis=1), tets.max(axis=1))
    depth = np.zeros(len(pairs))
    for first in range(0, len(pairs), _PAIRS):
        t, m = pairs[first : first + _PAIRS].T
        depth[first : first + _PAIRS] = _parting(triangles[t], tets[m])
    return pairs, depth


def _near_boxes(lo_a: np.ndarray, hi_a: np.ndarray, lo_b: np.ndarray, hi_b: np.ndarray) -> np.ndarray:
    """(k,2) pairs of boxes that meet. The second ones have a tree for each size: a large one must not widen every search."""
    middle_a, middle_b = 0.5 * (lo_a + hi_a), 0.5 * (lo_b + hi_b)
    reach_a, reach_b = np.linalg.norm(hi_a - middle_a, axis=1), np.linalg.norm(hi_b - middle_b, axis=1)
    found = [np.zeros((0, 2), dtype=np.int64)]
    scale = np.floor(np.log2(np.maximum(reach_b, np.finfo(float).tiny)))
    for one in np.unique(scale):
        rows = np.flatnonzero(scale == one)
        tree, reach = scipy.spatial.cKDTree(middle_b[rows]), reach_b[rows].max()
        for first in range(0, len(middle_a), _PAIRS):
            some = slice(first, first + _PAIRS)
            lists = tree.query_ball_point(middle_a[some], (1.0 + 1e-9) * (reach_a[some] + reach))
            a = first + np.repeat(np.arange(len(lists)), [len(near) for near in lists])
            b = rows[np.concatenate([np.zeros(0, dtype=np.int64), *lists]).astype(np.int64)]
            meet = ((lo_a[a] <= hi_b[b]) & (lo_b[b] <= hi_a[a])).all(axis=1)
            found.append(np.stack([a[meet], b[meet]], axis=1))
    return np.concatenate(found)


def _parting(triangle: np.ndarray, tet: np.ndarray) -> np.ndarray:
    """How far (k,) [m] triangles (k,3,3) and tets (k,4,3) must part to be clear of each other; 0 where they are."""
    triangle, tet = triangle - tet[:, :1], tet - tet[:, :1]
    own = np.roll(triangle, -1, axis=1) - triangle
    faces = tet[:, TET_FACES]
    sides = np.concatenate([own[:, None], np.roll(faces, -1, axis=2) - faces], axis=1)  # (k,5,3,3) edges of each face
    depth = _width(triangle, tet, sides[:, :, 0], sides[:, :, 1])
    left = np.flatnonzero(depth > 0.0)  # most pairs are clear along a normal
    ends = tet[left][:, EDGES]
    edges = np.broadcast_to((ends[:, :, 1] - ends[:, :, 0])[:, None], (len(left), 3, 6, 3))
    crossed = np.broadcast_to(own[left][:, :, None], edges.shape)
    across = _width(triangle[left], tet[left], crossed.reshape(-1, 18, 3), edges.reshape(-1, 18, 3))
    depth[left] = np.minimum(depth[left], across)
    return depth


def _width(triangle: np.ndarray, tet: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """How far (k,) [m] they must part along the best of the directions first x second, (k,n,3) each; at least 0."""
    axes = np.cross(first, second)
    length = np.linalg.norm(axes, axis=2)
    usable = length > PARALLEL * np.linalg.norm(first, axis=2) * np.linalg.norm(second, axis=2)
    axes /= np.where(usable, length, 1.0)[:, :, None]
    a, b = (np.einsum("kcx,knx->knc", x, axes) for x in (triangle, tet))
    width = np.minimum(a.max(axis=2) - b.min(axis=2), b.max(axis=2) - a.min(axis=2))
    return np.maximum(np.where(usable, width, np.inf).min(axis=1), 0.0)
