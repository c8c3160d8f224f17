"""Edge lengths of tets, their mean ratio, and the mean edge of surfaces."""

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
