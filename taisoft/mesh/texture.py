"""Texture coordinates and subsets of triangle surfaces: how they are checked, cut, and passed on to another surface.

Texture coordinates (UVs) belong to the corners of triangles, so a vertex on a seam has several. Triangles are connected if they
meet at an edge with the same UVs at both its ends. Subsets are named sets of triangles, such as those of one material; no
triangle is in two.
"""

from collections.abc import Callable

import numpy as np

from taisoft.errors import MeshError, value_text
from taisoft.mesh.distances import Triangles
from taisoft.mesh.topology import HALF_EDGES, linked_groups, normals_and_heights
from taisoft.scene.checks import array

CHUNK = 128  # triangles that get UVs at once, each with some hundred triangles of the source near it


def checked_uvs(uvs, n: int, error: Callable[[str], MeshError]) -> np.ndarray | None:
    """Return a copy of UVs (n,3,2) float64 of n triangles, or None for None. error: makes an error of its text."""
    return None if uvs is None else array(uvs, "uvs", ((n, 3, 2),), error)


def checked_subsets(subsets, n: int, error: Callable[[str], MeshError]) -> dict[str, np.ndarray]:
    """Return subsets of n triangles, ascending and read-only. error: makes an error of its text."""
    taken, found = np.zeros(n, dtype=bool), {}
    for name, given in dict(subsets or {}).items():
        ids = np.asarray(given)
        if not isinstance(name, str) or not name or ids.ndim != 1 or (len(ids) and ids.dtype.kind not in "iu"):
            raise error(f"subset {name!r} must be a name and numbers of triangles, not {value_text(given)}")
        ids = np.unique(ids).astype(np.int64)
        if len(ids) and not 0 <= ids[0] <= ids[-1] < n:
            raise error(f"subset {name!r}: triangle {ids[0] if ids[0] < 0 else ids[-1]} does not exist ({n} triangles)")
        if taken[ids].any():
            raise error(f"subset {name!r}: triangle {ids[taken[ids].argmax()]} is in another subset too")
        taken[ids] = True
        ids.setflags(write=False)
        found[name] = ids
    return found


def subsets_of(subsets: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return subsets of new triangles, each of which is a part of the old triangle rows (k,); empty ones are left out."""
    found = {name: np.flatnonzero(np.isin(rows, ids)) for name, ids in subsets.items()}
    return {name: ids for name, ids in found.items() if len(ids)}


def split_uvs(uvs: np.ndarray) -> np.ndarray:
    """Return the UVs (4t,3,2) of the four parts of each triangle (t,3,2), in the order of `taisoft.mesh.nodes.make_nodes`."""
    (a, b, c), (ab, bc, ca) = np.moveaxis(uvs, 1, 0), np.moveaxis(0.5 * (uvs + np.roll(uvs, -1, axis=1)), 1, 0)
    return np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3, 2)


def transferred(surface, vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray | None, dict[str, np.ndarray]]:
    """Return UVs (t,3,2), or None, and subsets of triangles (t,3) near a `SurfaceMesh`.

    vertices: (n,3) [m]. A triangle gets the subset of the source's triangle nearest to its centroid. Its corners get the UVs at
    the nearest points of those that are connected with that one nearby: where it crosses a seam, it ends at the seam.
    """
    if surface.uvs is None and not surface.subsets:
        return None, {}
    rows = np.flatnonzero(normals_and_heights(surface.vertices, surface.triangles)[1] > 0.0)
    source = Triangles(surface.vertices, surface.triangles[rows])
    given = np.zeros((len(rows), 3, 2)) if surface.uvs is None else surface.uvs[rows]
    edges = _uv_edges(source.triangles, given)
    nearest, uvs = np.empty(len(triangles), dtype=np.int64), np.empty((len(triangles), 3, 2))
    for first in range(0, len(triangles), CHUNK):
        at = slice(first, first + CHUNK)
        nearest[at], points, found = _located(source, edges, vertices[triangles[at]])
        uvs[at] = np.einsum("pk,pkx->px", _barycentric(source.corners[found], points), given[found]).reshape(-1, 3, 2)
    return None if surface.uvs is None else uvs, subsets_of(surface.subsets, rows[nearest])


def _uv_edges(triangles: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Return numbers (t,3) of the edges of triangles (t,3); connected ones have the same number. uvs: (t,3,2)."""
    corner = np.unique(np.column_stack([triangles.reshape(-1), uvs.reshape(-1, 2)]), axis=0, return_inverse=True)[1]
    ends = np.sort(corner.reshape(-1, 3)[:, HALF_EDGES].reshape(-1, 2), axis=1)
    return np.unique(ends, axis=0, return_inverse=True)[1].reshape(-1, 3)


def _located(source: Triangles, edges: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the triangles (k,) of a source nearest to centroids; nearest points (3k,3) [m] to corners (k,3,3) of triangles that
    edges (t,3) connect nearby with those; and their triangles (3k,)."""
    k, middle = len(corners), corners.mean(axis=1)
    nearest = source.closest(middle)[1]
    apart = np.linalg.norm(source.closest(corners.reshape(-1, 3))[0].reshape(corners.shape) - corners, axis=2)
    owner, near = source.balls.pairs(middle, (np.linalg.norm(corners - middle[:, None], axis=2) + apart).max(axis=1))
    numbers, n = np.unique(owner[:, None] * (edges.max() + 1) + edges[near], return_inverse=True)[1], len(owner)
    part = linked_groups(np.repeat(np.arange(n), 3), n + numbers.ravel(), n + numbers.max() + 1)[1][:n]
    first = near == nearest[owner]
    own_part = np.empty(k, dtype=np.int64)
    own_part[owner[first]] = part[first]
    owner, near = (one[part == own_part[owner]] for one in (owner, near))
    pairs = (3 * owner[:, None] + np.arange(3)).ravel(), np.repeat(near, 3)
    return nearest, *source.closest_of(corners.reshape(-1, 3), *pairs)


def _barycentric(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the barycentric coordinates (p,3) of points (p,3) in triangles (p,3,3)."""
    edges = corners[:, 1:] - corners[:, :1]
    u, v = np.einsum("pxk,px->kp", np.linalg.pinv(edges), points - corners[:, 0])
    weights = np.clip(np.stack([1.0 - u - v, u, v], axis=1), 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)
