"""Compute distances and hits of points, rays and segments with triangles by brute force, meant for few queries.

Source: Ericson, Real-Time Collision Detection, 2005, sections 5.1.5 and 5.1.9; rays: Moeller, Trumbore 1997.
"""

import numpy as np

EDGE_TOLERANCE = 1e-9  # tolerance in barycentric coordinates, so that no ray passes between adjacent triangles


def distances(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distances (p,) [m] of points (p,3) from the nearest triangle. corners: (t,3,3) [m]."""
    edges = np.roll(corners, -1, axis=1) - corners
    squared = np.einsum("tkx,tkx->tk", edges, edges)
    normal = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(normal, axis=1)
    normal /= np.where(length > 0.0, length, 1.0)[:, None]
    inward = np.cross(normal[:, None], edges)
    d = points[:, None, None] - corners[None]  # (p,t,3,3), from each corner
    along = np.einsum("ptkx,tkx->ptk", d, edges) / np.where(squared > 0.0, squared, 1.0)
    offset = d - np.clip(along, 0.0, 1.0)[..., None] * edges
    edge_distance = np.sqrt(np.einsum("ptkx,ptkx->ptk", offset, offset)).min(axis=2)
    inside = (np.einsum("ptkx,tkx->ptk", d, inward) >= 0.0).all(axis=2) & (length > 0.0)
    plane_distance = np.abs(np.einsum("ptx,tx->pt", d[:, :, 0], normal))
    return np.where(inside, plane_distance, edge_distance).min(axis=1)


def nearest_hit(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    """Return the distance along a ray, in lengths of direction, to the first triangle hit, inf if none. corners: (t,3,3) [m]."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, e2)
    det = np.einsum("tx,tx->t", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("tx,tx->t", origin - corners[:, 0], p) / det
        q = np.cross(origin - corners[:, 0], e1)
        v, along = (q @ direction) / det, np.einsum("tx,tx->t", e2, q) / det
        hits = (u >= -EDGE_TOLERANCE) & (v >= -EDGE_TOLERANCE) & (u + v <= 1.0 + EDGE_TOLERANCE) & (along > 0.0)
    return float(along[hits].min(initial=np.inf))


def segment_distance(corners: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance [m] of the segment from a to b, two distinct points (3,), from triangles (t,3,3); 0 if it cuts one."""
    d = b - a
    length = np.linalg.norm(d)
    if nearest_hit(corners, a, d / length) <= length:
        return 0.0
    edges = (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    r = a - corners.reshape(-1, 3)
    dd, ee, de = d @ d, np.einsum("ex,ex->e", edges, edges), edges @ d
    dr, er = r @ d, np.einsum("ex,ex->e", edges, r)
    determinant = dd * ee - de**2
    s = np.clip(np.where(determinant > 0.0, de * er - dr * ee, 0.0) / np.where(determinant > 0.0, determinant, 1.0), 0.0, 1.0)
    t = np.clip((de * s + er) / np.where(ee > 0.0, ee, 1.0), 0.0, 1.0)
    s = np.clip((de * t - dr) / dd, 0.0, 1.0)
    edge_distance = np.linalg.norm(r + s[:, None] * d - t[:, None] * edges, axis=1).min()
    return float(min(edge_distance, distances(corners, np.stack([a, b])).min()))
