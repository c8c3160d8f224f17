"""Triangles cut into smaller ones, and polygons cut off at a plane."""

import numpy as np


def cut_in_four(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n,3) and triangles (t,3) with every triangle cut at the middles of its edges, which come behind the points."""
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)  # of edges ab, bc, ca
    pairs, which = np.unique(np.sort(ends.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    (a, b, c), (ab, bc, ca) = triangles.T, len(points) + which.reshape(-1, 3).T
    cut = [np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return np.concatenate([points, points[pairs].mean(axis=1)]), np.concatenate(cut)


def cut_off(polygon: np.ndarray, k: int = 0) -> np.ndarray:
    """The part of a convex polygon where a height is not negative (Sutherland and Hodgman 1974).

    polygon: (n,m), a row a corner; column k is the height above the plane, and all columns are interpolated.
    """
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0)):
        if a[k] >= 0:
            kept.append(a)
        if a[k] * b[k] < 0:
            kept.append(a + a[k] / (a[k] - b[k]) * (b - a))
    return np.array(kept).reshape(-1, polygon.shape[1])
