"""Subdivision of triangles, and clipping of polygons at a plane."""

import numpy as np


def subdivide(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut every triangle in four at its edge midpoints, which are appended to the points.

    points: (n,3); triangles: (t,3). Returns the new points and triangles.
    """
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)  # of edges ab, bc, ca
    pairs, edge = np.unique(np.sort(ends.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    (a, b, c), (ab, bc, ca) = triangles.T, len(points) + edge.reshape(-1, 3).T
    cut = [np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return np.concatenate([points, points[pairs].mean(axis=1)]), np.concatenate(cut)


def clip_polygon(polygon: np.ndarray, k: int = 0) -> np.ndarray:
    """Clip a convex polygon to the side of a plane where the height is not negative (Sutherland and Hodgman 1974).

    polygon: (n,m), one row per corner; column k is the height above the plane; all columns are interpolated.
    """
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0)):
        if a[k] >= 0:
            kept.append(a)
        if a[k] * b[k] < 0:
            kept.append(a + a[k] / (a[k] - b[k]) * (b - a))
    return np.array(kept).reshape(-1, polygon.shape[1])
