"""Compute depths of points inside a closed surface by winding numbers, for few points or surfaces without pseudonormals.

The winding number is the sum of the triangles' solid angles over 4 pi (van Oosterom, Strackee 1983, The solid angle of a plane
triangle, IEEE Trans. Biomed. Eng. 30): 1 inside, 0 outside, 2 where two parts of a solid overlap. Edges of four triangles and
triangles without area do not affect it. Weak: the cost is points times triangles.
"""

import numpy as np

from taisoft.mesh.triangle_queries import distances

_PAIRS = 1 << 16  # maximum number of point-triangle pairs processed at once, about 500 bytes each


def is_closed(triangles: np.ndarray) -> bool:
    """Return whether a surface (t,3) has no border: each edge is traversed equally often in both directions."""
    ends = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, edge = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    return not np.bincount(edge.reshape(-1), np.where(ends[:, 0] < ends[:, 1], 1, -1)).any()


def solid_depths(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the depths (p,) [m] of points (p,3) inside the solid of a closed surface; 0 outside.

    corners: (t,3,3) [m] of its triangles, normals outward. A surface whose normals all point inward bounds a cavity.
    """
    depth = np.zeros(len(points))
    step = max(_PAIRS // max(len(corners), 1), 1)
    for first in range(0, len(points), step):
        batch = points[first : first + step]
        inside = np.flatnonzero(are_inside(corners, batch))
        if len(inside):
            depth[first + inside] = distances(corners, batch[inside])
    return depth


def are_inside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (p,) bool: whether points (p,3) lie inside the solid, see `solid_depths`."""
    return winding_numbers(corners, points) > (0.5 if _signed_volume6(corners) >= 0.0 else -0.5)


def winding_numbers(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return winding numbers (p,) of points (p,3) for triangles with corners (t,3,3)."""
    a, b, c = np.moveaxis(corners[None] - points[:, None, None], 2, 0)  # (p,t,3)
    la, lb, lc = (np.sqrt(np.einsum("ptx,ptx->pt", x, x)) for x in (a, b, c))
    volume = np.einsum("ptx,ptx->pt", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ptx,ptx->pt", x, y) for x, y in ((a, b), (b, c), (c, a)))
    return np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2.0 * np.pi)


def _signed_volume6(corners: np.ndarray) -> float:
    """Return six times the enclosed volume [m^3], negative if the normals point inward."""
    a, b, c = np.moveaxis(corners - corners.reshape(-1, 3).mean(axis=0), 1, 0)
    return float(np.einsum("tx,tx->", a, np.cross(b, c)))
