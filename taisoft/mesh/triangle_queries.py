"""What points, rays and segments have to do with triangles: every one looks at every triangle, so for few of them.

Source: Ericson, Real-Time Collision Detection, 2005, sections 5.1.5 and 5.1.9; rays: Moeller, Trumbore 1997.
"""

import numpy as np

EDGE = 1e-9  # of a triangle, by which a ray may miss it: none slips through between two


def distances(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(p,) distances [m] of points (p,3) from triangles with corners (t,3,3)."""
    edges = np.roll(corners, -1, axis=1) - corners
    squared = np.einsum("tkx,tkx->tk", edges, edges)
    normal = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(normal, axis=1)
    normal /= np.where(length > 0.0, length, 1.0)[:, None]
    inward = np.cross(normal[:, None], edges)
    d = points[:, None, None] - corners[None]  # (p,t,3,3), from each corner
    along = np.einsum("ptkx,tkx->ptk", d, edges) / np.where(squared > 0.0, squared, 1.0)
    offset = d - np.clip(along, 0.0, 1.0)[..., None] * edges
    beside = np.sqrt(np.einsum("ptkx,ptkx->ptk", offset, offset)).min(axis=2)
    above = (np.einsum("ptkx,tkx->ptk", d, inward) >= 0.0).all(axis=2) & (length > 0.0)
    height = np.abs(np.einsum("ptx,tx->pt", d[:, :, 0], normal))
    return np.where(above, height, beside).min(axis=1)


def nearest_hit(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    """How far [m] along a ray the first of the triangles (t,3,3) lies, inf where it meets none (Moeller, Trumbore 1997)."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, e2)
    det = np.einsum("tx,tx->t", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("tx,tx->t", origin - corners[:, 0], p) / det
        q = np.cross(origin - corners[:, 0], e1)
        v, along = (q @ direction) / det, np.einsum("tx,tx->t", e2, q) / det
        hits = (u >= -EDGE) & (v >= -EDGE) & (u + v <= 1.0 + EDGE) & (along > 0.0)
    return float(along[hits].min(initial=np.inf))


def segment_distance(corners: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Distance [m] of the segment from a to b, (3,) each and not the same, from triangles (t,3,3); 0 where it cuts one."""
    d = b - a
    length = np.linalg.norm(d)
    if nearest_hit(corners, a, d / length) <= length:
        return 0.0
    edges = (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    r = a - corners.reshape(-1, 3)
    dd, ee, de = d @ d, np.einsum("ex,ex->e", edges, edges), edges @ d
    dr, er = r @ d, np.einsum("ex,ex->e", edges, r)
    across = dd * ee - de**2
    s = np.clip(np.where(across > 0.0, de * er - dr * ee, 0.0) / np.where(across > 0.0, across, 1.0), 0.0, 1.0)
    t = np.clip((de * s + er) / np.where(ee > 0.0, ee, 1.0), 0.0, 1.0)
    s = np.clip((de * t - dr) / dd, 0.0, 1.0)
    apart = np.linalg.norm(r + s[:, None] * d - t[:, None] * edges, axis=1).min()
    return float(min(apart, distances(corners, np.stack([a, b])).min()))
