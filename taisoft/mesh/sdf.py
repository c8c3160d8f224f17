"""Exact signed distances from a closed triangle surface, negative inside: at scattered points, and on grids, which are cached.

Distance: the triangle with the nearest centroid (k-d tree) bounds a point's distance by u. A triangle can be nearer only if
its bounding ball around the centroid is within u, which a k-d tree finds. Most of these are then excluded by the triangle's
bounding disc, a much tighter bound than the ball if many triangles are about equally far.
Sign: from the pseudonormal of the nearest feature: the face normal, the sum of the two face normals at an edge, or the
angle-weighted sum at a vertex (Baerentzen & Aanaes 2005, Signed distance computation using the angle weighted
pseudonormal, IEEE TVCG 11(3)). Parts of the surface that touch only at a vertex have separate pseudonormals there; the part
that faces the point decides. Weak: a self-intersecting surface has no well-defined inside; the nearest sheet gives the sign.
Grids are cached on disk under the SHA-256 of their inputs. A damaged file is computed again; if the folder is not writable,
nothing is cached.
"""

import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from taisoft.errors import MeshError, OutputError
from taisoft.files import cache_folders, replacing
from taisoft.mesh.topology import linked_groups, normals_and_heights, opposite_half_edges
from taisoft.ranges import owners

FORMAT = 1  # version of cached grids; increase it when their numbers or meaning change
MIN_CELLS = 8  # smallest number of cells across a side
MIN_PADDING = 2  # cells beyond the surface on every side
MAX_POINTS = 2_000_000  # default limit on the number of grid points
_ROUNDING = 1e-9  # fraction of a cell ignored when the number of cells is rounded up
_CHUNK = 512  # points evaluated at once, each with some hundred triangles near it
_BATCH = 64  # points evaluated exactly at once, before checking whether any other point can lie deeper
_SLACK = 1e-9  # relative to the size: bounds are widened by this against rounding


@dataclass(frozen=True, eq=False)
class SdfGrid:
    """Signed distances at the points origin + (i, j, k) * spacing. Arrays are read-only."""

    origin: np.ndarray  # (3,) [m]
    spacing: np.ndarray  # (3,) [m]
    phi: np.ndarray  # (nx,ny,nz) float64 [m], negative inside

    def __post_init__(self):
        for array in (self.origin, self.spacing, self.phi):
            array.setflags(write=False)


def sdf_grid(
    vertices: np.ndarray, triangles: np.ndarray, cells: int = 32, max_points: int = MAX_POINTS, margin: float = 0.0
) -> SdfGrid:
    """Compute exact signed distances on a grid around a closed surface.

    vertices: (n,3) [m]. triangles: (t,3) int, normals outward; every edge has two. cells: along the longest side; other
    sides get cells of about that size, but at least 8. max_points: limit on the number of grid points. margin: minimum
    distance [m] from the surface to the grid's border, which is at least two cells. Raises MeshError for an open surface,
    triangles without area, and a grid above max_points.
    """
    vertices, triangles = _arrays(vertices, triangles)
    origin, spacing, shape = _layout(vertices[np.unique(triangles)], cells, max_points, margin)
    axes = [origin[a] + spacing[a] * np.arange(shape[a]) for a in range(3)]
    return SdfGrid(origin, spacing, signed_distances(vertices, triangles, axes))


def cached_sdf_grid(
    vertices: np.ndarray, triangles: np.ndarray, cells: int = 32, max_points: int = MAX_POINTS, margin: float = 0.0
) -> SdfGrid:
    """Return `sdf_grid` of the same arguments, read from the cache or computed and stored there."""
    vertices, triangles = _arrays(vertices, triangles)
    origin, spacing, shape = _layout(vertices[np.unique(triangles)], cells, max_points, margin)
    inputs = f"{FORMAT} {len(vertices)} {len(triangles)} {int(cells)} {float(margin).hex()}\n".encode()
    path = cache_folder() / f"{hashlib.sha256(inputs + vertices.tobytes() + triangles.tobytes()).hexdigest()}.npz"
    with suppress(Exception):  # a damaged archive raises many kinds of errors, some from the decompression modules
        # Open here, because np.load leaves an unreadable file open.
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            phi = file["phi"]
        if phi.shape == shape and phi.dtype == np.float64 and np.isfinite(phi).all():
            return SdfGrid(origin, spacing, phi)
    grid = sdf_grid(vertices, triangles, cells, max_points, margin)
    with suppress(OSError, OutputError):  # the folder is not writable
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part, open(part, "wb") as file:
            np.savez(file, phi=grid.phi)
    return grid


def cache_folder() -> Path:
    """Return the folder of cached grids."""
    return next(cache_folders(), Path(os.devnull)) / "sdf"  # os.devnull cannot contain files


def _arrays(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(triangles, dtype=np.int64)


def _layout(vertices: np.ndarray, cells: int, max_points: int, margin: float):
    """Return origin (3,) [m], spacing (3,) [m] and shape of the grid of `sdf_grid` around vertices (n,3) [m]."""
    low, side = vertices.min(axis=0), np.ptp(vertices, axis=0)
    if not side.min() > 0:
        raise MeshError("sdf_grid: the surface is flat and has no inside")
    n_cells = np.maximum(np.ceil(side / (side.max() / cells) - _ROUNDING), MIN_CELLS)
    spacing = side / n_cells
    pad = np.maximum(np.ceil(margin / spacing - _ROUNDING), MIN_PADDING)
    shape = tuple(int(n) for n in n_cells + 2 * pad + 1)
    count = int(np.prod(shape, dtype=object))
    if count > max_points:
        raise MeshError(
            f"sdf_grid: {cells} cells along the longest side and a margin of {margin:g} m need {count} points "
            f"({' x '.join(map(str, shape))}); at most {max_points} are allowed"
        )
    return low - pad * spacing, spacing, shape


def signed_distances(vertices: np.ndarray, triangles: np.ndarray, axes: list[np.ndarray]) -> np.ndarray:
    """Return signed distances (nx,ny,nz) float64 [m] at the points (x_i, y_j, z_k), negative inside.

    vertices: (n,3) float64 [m]. triangles: (t,3) int64, normals outward. axes: ascending coordinates (nx,), (ny,), (nz,)
    [m]. Raises MeshError for a surface that is open, inconsistently oriented, or has triangles without area.
    """
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return signed_distances_at(vertices, triangles, points.reshape(-1, 3)).reshape(points.shape[:3])


def signed_distances_at(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return signed distances (k,) float64 [m] at points (k,3), negative inside; surface as in `signed_distances`."""
    surface, phi = _Surface(vertices, triangles), np.empty(len(points))
    for first in range(0, len(points), _CHUNK):
        chunk = points[first : first + _CHUNK]
        phi[first : first + _CHUNK] = surface.signed(chunk, surface.upper(chunk))
    return phi


def greatest_depth(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> float:
    """Return the largest depth [m] of points (k,3) inside, 0 if none is inside; surface as in `signed_distances`."""
    surface = _Surface(vertices, triangles)
    upper = surface.upper(points)
    order = np.argsort(-upper, kind="stable")
    deepest = 0.0
    for first in range(0, len(order), _BATCH):
        batch = order[first : first + _BATCH]
        if upper[batch[0]] <= deepest:  # no other can lie deeper
            break
        deepest = max(deepest, -float(surface.signed(points[batch], upper[batch]).min()))
    return deepest


def nearest_points(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest points (k,3) [m] of triangles (t,3), which may be open, to points (k,3), and their triangles (k,)."""
    return Triangles(vertices, triangles).closest(points)


class BallTree:
    """Balls, found by one k-d tree for each size class: large balls widen only their own search."""

    def __init__(self, centres: np.ndarray, radii: np.ndarray):
        """centres: (n,3) [m]. radii: (n,) [m]."""
        classes = np.floor(np.log2(np.maximum(radii, np.finfo(float).tiny)))
        groups = [np.flatnonzero(classes == size_class) for size_class in np.unique(classes)]
        self._groups = [(rows, scipy.spatial.cKDTree(centres[rows]), radii[rows].max()) for rows in groups]

    def pairs(self, points: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs of a point and a ball, their indices, at most reach (p,) [m] apart, and some that are farther."""
        found = [np.zeros((2, 0), dtype=np.int64)]
        for rows, tree, radius in self._groups:
            lists = tree.query_ball_point(points, (1.0 + _SLACK) * (reach + radius))
            ball = np.concatenate([np.zeros(0), *lists]).astype(np.int64)
            found.append(np.stack([owners([len(near) for near in lists]), rows[ball]]))
        return tuple(np.concatenate(found, axis=1))


class Triangles:
    """Triangles with precomputed data for distances."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray):
        self.triangles, self.corners = triangles, vertices[triangles]  # (t,3,3)
        self.normals = normals_and_heights(vertices, triangles)[0]
        self.edges = np.roll(self.corners, -1, axis=1) - self.corners
        self.centroid = self.corners.mean(axis=1)
        self.radius = np.linalg.norm(self.corners - self.centroid[:, None], axis=2).max(axis=1)
        self._tree, self.balls = scipy.spatial.cKDTree(self.centroid), BallTree(self.centroid, self.radius)

    def upper(self, points: np.ndarray) -> np.ndarray:
        """Return upper bounds (p,) [m] of the distances of points (p,3)."""
        triangle = self._tree.query(points)[1] if len(points) else np.zeros(0, dtype=np.int64)
        return np.sqrt(self.nearest(points, triangle)[0])

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest points (p,3) [m] to points (p,3), and their triangles (p,)."""
        return self.closest_of(points, *self.balls.pairs(points, self.upper(points)))

    def closest_of(self, points: np.ndarray, point: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same among given pairs of a point and a triangle, (k,) each, some for every point."""
        squared, offset, _ = self.nearest(points[point], triangle)
        order = np.lexsort((triangle, squared, point))
        best = order[np.searchsorted(point[order], np.arange(len(points)))]
        return points - offset[best], triangle[best]

    def nearest(self, points: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return squared distances (p,), offsets (p,3) from the nearest point, and its feature (p,), a column of `pseudonormals`.

        points: (p,3). triangle: (p,), one for each point.
        """
        normal, edges = self.normals[triangle], self.edges[triangle]
        d = points[:, None] - self.corners[triangle]  # from each corner
        along = np.einsum("pkx,pkx->pk", d, edges) / np.einsum("pkx,pkx->pk", edges, edges)
        along = np.clip(along, 0.0, 1.0)
        offset = d - along[:, :, None] * edges
        squared = np.einsum("pkx,pkx->pk", offset, offset)
        rows, k = np.arange(len(points)), np.argmin(squared, axis=1)
        t = along[rows, k]
        feature = np.where(t == 0.0, 4 + k, np.where(t == 1.0, 4 + (k + 1) % 3, 1 + k))
        squared, offset = squared[rows, k], offset[rows, k]
        # The point projects into the face if it is to the left of all three edges.
        face = (np.einsum("pkx,pkx->pk", np.cross(edges, d), normal[:, None]) >= 0).all(axis=1)
        height = np.einsum("px,px->p", d[:, 0], normal)
        return (
            np.where(face, height**2, squared),
            np.where(face[:, None], height[:, None] * normal, offset),
            np.where(face, 0, feature),
        )


class _Surface(Triangles):
    """A closed surface with precomputed data for distance and sign."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray):
        flat = ~(normals_and_heights(vertices, triangles)[1] > 0)
        if flat.any():
            raise MeshError(f"a distance field needs triangles with area: triangle {int(np.argmax(flat))} has none")
        opposite = opposite_half_edges(triangles)
        if (opposite < 0).any():
            t, k = np.argwhere(opposite < 0)[0]
            edge = tuple(sorted(triangles[t, [k, (k + 1) % 3]].tolist()))
            raise MeshError(
                f"a distance field needs a closed surface: edge {edge} belongs to triangle {t} alone "
                f"({int((opposite < 0).sum())} such edges)"
            )
        super().__init__(vertices, triangles)
        self._slack = _SLACK * float(np.linalg.norm(np.ptp(self.corners, axis=(0, 1))))
        # (t,7,3): pseudonormals of the face, its three edges and its three corners, of any length.
        at_edges = self.normals[:, None] + self.normals[opposite // 3]
        part = self._parts(opposite)
        self.pseudonormals = np.concatenate([self.normals[:, None], at_edges, self._at_corners(part)], axis=1)
        pairs = np.unique(np.stack([triangles.reshape(-1), part], axis=1), axis=0)[:, 0]
        self.joints = np.unique(pairs[1:][pairs[1:] == pairs[:-1]])  # vertices where several parts touch

    @staticmethod
    def _parts(opposite: np.ndarray) -> np.ndarray:
        """Return a label (3t,) for each corner, equal for corners of one vertex connected through shared edges."""
        # Corner k starts half-edge k and ends its opposite, so it is the corner after that one in the other triangle.
        neighbour = opposite // 3 * 3 + (opposite + 1) % 3
        return linked_groups(np.arange(opposite.size), neighbour.reshape(-1), opposite.size)[1]

    def _at_corners(self, part: np.ndarray) -> np.ndarray:
        """Return angle-weighted sums (t,3,3) of the normals of the triangles around each corner."""
        back = -np.roll(self.edges, 1, axis=1)
        sine = np.linalg.norm(np.cross(self.edges, back), axis=2)
        angle = np.arctan2(sine, np.einsum("tkx,tkx->tk", self.edges, back)).reshape(-1)
        weighted = angle[:, None] * np.repeat(self.normals, 3, axis=0)
        total = np.stack([np.bincount(part, weighted[:, x]) for x in range(3)], axis=1)
        return total[part].reshape(-1, 3, 3)

    def signed(self, points: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return signed distances (p,) [m] of points (p,3), p > 0, with these upper bounds."""
        point, triangle = self.balls.pairs(points, upper)
        near = np.flatnonzero(self.bound(points[point], triangle) <= upper[point] * (1.0 + _SLACK) + self._slack)
        near = near[np.lexsort((triangle[near], point[near]))]
        point, triangle = point[near], triangle[near]
        squared, offset, feature = self.nearest(points[point], triangle)
        starts = np.searchsorted(point, np.arange(len(points)))
        equal = np.flatnonzero(squared == np.minimum.reduceat(squared, starts)[point])
        best = equal[np.searchsorted(equal, starts)]  # ties take the first triangle
        inside = self.sides(offset[best], triangle[best], feature[best]) < 0.0
        return np.where(inside, -1.0, 1.0) * np.sqrt(squared[best])

    def sides(self, offset: np.ndarray, triangle: np.ndarray, feature: np.ndarray) -> np.ndarray:
        """Return (p,) values below 0 for points inside. offset, feature: returned by `nearest` for the triangles (p,)."""
        pseudonormal = self.pseudonormals[triangle, feature]
        if len(self.joints):
            vertex = np.where(feature >= 4, self.triangles[triangle, np.maximum(feature - 4, 0)], -1)
            for v in np.intersect1d(self.joints, vertex):
                # All edges there point away from the point; the one closest to perpendicular belongs to the part facing it.
                t, k = np.nonzero(self.triangles == v)
                out, back = self.edges[t, k], -self.edges[t, (k + 2) % 3]
                rows = np.flatnonzero(vertex == v)
                slope = [offset[rows] @ (e / np.linalg.norm(e, axis=1, keepdims=True)).T for e in (out, back)]
                facing = np.argmax(np.maximum(*slope), axis=1)
                pseudonormal[rows] = self.pseudonormals[t[facing], 4 + k[facing]]
        return np.einsum("px,px->p", offset, pseudonormal)

    def bound(self, centre: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """Return lower bounds (p,) [m] of the distances of points (p,3) from triangles (p,): distances from their discs."""
        d = centre - self.centroid[triangle]
        height = np.einsum("px,px->p", d, self.normals[triangle])
        across = np.sqrt(np.maximum(np.einsum("px,px->p", d, d) - height**2, 0.0)) - self.radius[triangle]
        return np.sqrt(height**2 + np.maximum(across, 0.0) ** 2)
