"""Edge lengths of tets, their mean ratio, the mean edge of surfaces, and second moments of what they enclose."""

import numpy as np

from taisoft.mesh.topology import EDGES


def edge_lengths(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Return the lengths (m,6) [m] of every tet's edges, in the order of EDGES. vertices: (n,3) [m]. tets: (m,4) int."""
    corners = vertices[tets]
    return np.stack([np.linalg.norm(corners[:, a] - corners[:, b], axis=1) for a, b in EDGES], axis=1)


def mean_ratio(lengths: np.ndarray, volumes: np.ndarray) -> np.ndarray:
    """Return the mean ratio (m,) of tets, 12 (3 V)^(2/3) / sum of squared edge lengths: 1 if regular, 0 if flat.

    lengths: (m,6) [m], of the edges. volumes: (m,) [m^3], positive.
    Source: Liu, Joe 1994, Relationship between tetrahedron shape measures, BIT 34.
    """
    return 12.0 * np.cbrt(3.0 * volumes) ** 2 / (lengths**2).sum(axis=1)


def mean_surface_edge(surfaces: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the mean edge length [m] over all triangles. surfaces: pairs of vertices (n,3) [m] and triangles (t,3)."""
    lengths = [np.linalg.norm(x[t] - x[np.roll(t, -1, axis=1)], axis=2).reshape(-1) for x, t in surfaces]
    return float(np.concatenate(lengths).mean())


def volume_moments(vertices: np.ndarray, triangles: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume [m^3], centre (3,) [m] and covariance (3,3) [m^2] about it of the solid in a closed surface, normals outward.

    Each triangle (a, b, c) adds the tet (o, a, b, c), whose integral of x x^T is V/20 (a a^T + b b^T + c c^T + s s^T) about o,
    with s = a + b + c.
    """
    origin = vertices.mean(axis=0)
    x = vertices[triangles] - origin
    volumes, total = np.linalg.det(x) / 6.0, x.sum(axis=1)
    volume = volumes.sum()
    centre = 0.25 * volumes @ total / volume
    second = (np.einsum("t,tki,tkj->ij", volumes, x, x) + np.einsum("t,ti,tj->ij", volumes, total, total)) / (20.0 * volume)
    return float(volume), origin + centre, second - np.outer(centre, centre)
