"""How deep points lie inside a closed surface, by winding numbers: for few points, or surfaces that have no pseudonormals.

The winding number is the sum of the triangles' solid angles over 4 pi (van Oosterom, Strackee 1983, The solid angle of a plane
triangle, IEEE Trans. Biomed. Eng. 30): 1 inside, 0 outside, 2 where two parts of a solid overlap. Edges of four triangles and
triangles without area do not disturb it. Weak: every point looks at every triangle.
"""

import numpy as np

from taisoft.mesh.triangle_queries import distances

_PAIRS = 1 << 16  # of points and triangles that are looked at together, about 500 bytes each


def is_closed(triangles: np.ndarray) -> bool:
    """Whether a surface (t,3) has no border: each of its edges is run along as often one way as the other."""
    ends = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, edge = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    return not np.bincount(edge.reshape(-1), np.where(ends[:, 0] < ends[:, 1], 1, -1)).any()


def solid_depths(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How deep (p,) [m] points (p,3) lie inside the solid of a closed surface; 0 outside.

    corners: (t,3,3) [m] of its triangles, normals outward. A surface that is inside out as a whole bounds a hollow.
    """
    depth = np.zeros(len(points))
    step = max(_PAIRS // max(len(corners), 1), 1)
    for first in range(0, len(points), step):
        some = points[first : first + step]
        inside = np.flatnonzero(are_inside(corners, some))
        if len(inside):
            depth[first + inside] = distances(corners, some[inside])
    return depth


def are_inside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(p,) bool: whether points (p,3) lie inside the solid, see `solid_depths`."""
    return winding_numbers(corners, points) > (0.5 if _volume(corners) >= 0.0 else -0.5)


def winding_numbers(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(p,) winding numbers of points (p,3) in triangles with corners (t,3,3)."""
    a, b, c = np.moveaxis(corners[None] - points[:, None, None], 2, 0)  # (p,t,3)
    la, lb, lc = (np.sqrt(np.einsum("ptx,ptx->pt", x, x)) for x in (a, b, c))
    volume = np.einsum("ptx,ptx->pt", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ptx,ptx->pt", x, y) for x, y in ((a, b), (b, c), (c, a)))
    return np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2.0 * np.pi)


def _volume(corners: np.ndarray) -> float:
    """Six times what the surface encloses [m^3], negative where it is inside out."""
    a, b, c = np.moveaxis(corners - corners.reshape(-1, 3).mean(axis=0), 1, 0)
    return float(np.einsum("tx,tx->", a, np.cross(b, c)))
