"""Exact signed distances from a closed triangle surface, negative inside: at scattered points, and on grids, which are cached.

Distance: blocks of grid points are halved down to single points, each with the triangles that can be nearest to a point
in it. Let u bound the distances of all points in a block with centre q and half diagonal s from above. A triangle can be
nearest only if its distance from q is at most u + s. The triangle's bounding disc around its centroid bounds that distance
from below, much more tightly than a ball if many triangles are about equally far. u comes from the triangle with the
nearest centroid (k-d tree).
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

FORMAT = 1  # version of cached grids; increase it when their numbers or meaning change
MIN_CELLS = 8  # smallest number of cells across a side
MIN_PADDING = 2  # cells beyond the surface on every side
MAX_POINTS = 2_000_000  # default limit on the number of grid points
_ROUNDING = 1e-9  # fraction of a cell ignored when the number of cells is rounded up
_CHUNK = 1 << 16  # maximum number of points, or pairs of a block and a triangle, processed at once, about 800 bytes each
_SLACK = 1e-9  # relative to the size: bounds are widened by this against rounding
_SCATTERED_PAIRS = 1 << 15  # maximum number of point-triangle pairs processed at once for scattered points
_BATCH = 64  # points evaluated exactly at once, before checking whether any other point can lie deeper


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
    return _Search(_Surface(vertices, triangles), axes).run()


def signed_distances_at(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return signed distances (k,) float64 [m] at points (k,3), negative inside; surface as in `signed_distances`."""
    search = _PointSearch(_Surface(vertices, triangles), points)
    return search.signed(np.arange(len(points)))


def greatest_depth(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> float:
    """Return the largest depth [m] of points (k,3) inside, 0 if none is inside; surface as in `signed_distances`."""
    search = _PointSearch(_Surface(vertices, triangles), points)
    order = np.argsort(-search.upper, kind="stable")
    deepest = 0.0
    for first in range(0, len(order), _BATCH):
        batch = order[first : first + _BATCH]
        if search.upper[batch[0]] <= deepest:  # no other can lie deeper
            break
        deepest = max(deepest, -float(search.signed(batch).min()))
    return deepest


class _PointSearch:
    """Distance queries at points (k,3). upper: (k,) [m], upper bounds of their distances."""

    def __init__(self, surface: "_Surface", points: np.ndarray):
        self.surface, self.points, self.tree = surface, points, scipy.spatial.cKDTree(surface.centroid)
        first = self.tree.query(points)[1].astype(np.int64) if len(points) else np.zeros(0, dtype=np.int64)
        self.upper = np.sqrt(surface.nearest(points, first)[0])

    def signed(self, rows: np.ndarray) -> np.ndarray:
        """Return signed distances [m] of the points in rows."""
        surface = self.surface
        if not len(rows):
            return np.zeros(0)
        # a triangle can be nearer only if its centroid is within the bound plus the triangle's radius
        reach = (1.0 + _SLACK) * (self.upper[rows] + surface.radius.max())
        nearby = self.tree.query_ball_point(self.points[rows], reach, return_sorted=True)
        counts = np.array([len(candidates) for candidates in nearby])
        result = []
        for chunk in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(np.cumsum(counts) // _SCATTERED_PAIRS)) + 1):
            starts = np.concatenate([[0], np.cumsum(counts[chunk])[:-1]])
            point_row, triangle = np.repeat(rows[chunk], counts[chunk]), np.concatenate(nearby[chunk]).astype(np.int64)
            squared, offset, feature = surface.nearest(self.points[point_row], triangle)
            equal = np.flatnonzero(squared == np.repeat(np.minimum.reduceat(squared, starts), counts[chunk]))
            best = equal[np.searchsorted(equal, starts)]  # ties take the first triangle
            inside = surface.sides(offset[best], triangle[best], feature[best]) < 0.0
            result.append(np.where(inside, -1.0, 1.0) * np.sqrt(squared[best]))
        return np.concatenate(result)


class _Surface:
    """Triangles with precomputed data for distance and sign."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray):
        self.normals, heights = normals_and_heights(vertices, triangles)
        flat = ~(heights > 0)
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
        self.triangles = triangles
        self.corners = vertices[triangles]  # (t,3,3)
        self.edges = np.roll(self.corners, -1, axis=1) - self.corners
        self.centroid = self.corners.mean(axis=1)
        self.radius = np.linalg.norm(self.corners - self.centroid[:, None], axis=2).max(axis=1)
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


@dataclass(frozen=True, eq=False)
class _Level:
    """Blocks of grid points of one size."""

    upper: np.ndarray  # (bx,by,bz) [m]: upper bound of the distances of the block's points
    centres: list[np.ndarray]  # three arrays (bx,), (by,), (bz,) [m]
    reach: np.ndarray  # (bx*by*bz,) [m]: triangles farther from the centre are not nearest to any point of the block


class _Search:
    """Hierarchical search for the nearest triangle of every grid point."""

    def __init__(self, surface: _Surface, axes: list[np.ndarray]):
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self._surface, self._axes, self._points = surface, axes, points
        self._triangle = np.empty(len(points), dtype=np.int64)
        self._squared = np.empty(len(points))
        self._slack = _SLACK * float(np.linalg.norm(points[-1] - points[0]))
        tree = scipy.spatial.cKDTree(surface.centroid)
        for first in range(0, len(points), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            self._triangle[chunk] = tree.query(points[chunk])[1]
            self._squared[chunk] = surface.nearest(points[chunk], self._triangle[chunk])[0]
        self._levels = [self._level(0, np.sqrt(self._squared).reshape([len(a) for a in axes]))]
        while self._levels[-1].reach.size > 1:
            coarse = self._levels[-1].upper
            for axis in range(3):
                coarse = np.maximum.reduceat(coarse, np.arange(0, coarse.shape[axis], 2), axis=axis)
            self._levels.append(self._level(len(self._levels), coarse))

    def _level(self, level: int, upper: np.ndarray) -> _Level:
        """Return the blocks of 2^level points along each axis. upper: bounds of their points' distances [m]."""
        centres, half = [], np.zeros(())
        for axis, x in enumerate(self._axes):
            first = np.arange(upper.shape[axis]) << level
            low, high = x[first], x[np.minimum(first + (1 << level), len(x)) - 1]
            centres.append(0.5 * (low + high))
            half = half[..., None] + (0.5 * (high - low)) ** 2
        return _Level(upper, centres, (upper + np.sqrt(half) + self._slack).reshape(-1))

    def run(self) -> np.ndarray:
        """Return signed distances (nx,ny,nz) [m]."""
        n = len(self._surface.centroid)
        stack = [(len(self._levels) - 1, np.zeros(n, dtype=np.int64), np.arange(n))]
        while stack:  # depth first, with a bounded number of pairs at a time
            level, block, triangle = stack.pop()
            if len(block) > _CHUNK:
                half = len(block) // 2
                stack += [(level, block[:half], triangle[:half]), (level, block[half:], triangle[half:])]
            elif level:
                stack.append((level - 1, *self._children(level - 1, block, triangle)))
            else:
                self._improve(block, triangle)
        phi = np.empty(len(self._points))
        for first in range(0, len(phi), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            triangle = self._triangle[chunk]
            squared, offset, feature = self._surface.nearest(self._points[chunk], triangle)
            phi[chunk] = np.where(self._surface.sides(offset, triangle, feature) < 0, -1.0, 1.0) * np.sqrt(squared)
        return phi.reshape([len(a) for a in self._axes])

    def _children(self, level: int, block: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs of child blocks at `level` and triangles that can be nearest to one of their points."""
        fine, parent = self._levels[level], np.unravel_index(block, self._levels[level + 1].upper.shape)
        pairs = []
        for corner in range(8):
            ijk = [2 * p + (corner >> (2 - a) & 1) for a, p in enumerate(parent)]
            exists = np.logical_and.reduce([i < n for i, n in zip(ijk, fine.upper.shape)])
            ijk, candidates = [i[exists] for i in ijk], triangle[exists]
            child = np.ravel_multi_index(ijk, fine.upper.shape)
            centre = np.stack([x[i] for x, i in zip(fine.centres, ijk)], axis=1)
            is_near = self._surface.bound(centre, candidates) <= fine.reach[child]
            pairs.append((child[is_near], candidates[is_near]))
        return tuple(np.concatenate(column) for column in zip(*pairs))

    def _improve(self, point: np.ndarray, triangle: np.ndarray) -> None:
        """Update the nearest triangles by the pairs' distances; ties take the first triangle."""
        squared = self._surface.nearest(self._points[point], triangle)[0]
        order = np.lexsort((triangle, squared, point))
        point, triangle, squared = point[order], triangle[order], squared[order]
        first = np.ones(len(point), dtype=bool)
        first[1:] = point[1:] != point[:-1]
        first &= squared < self._squared[point]
        self._squared[point[first]], self._triangle[point[first]] = squared[first], triangle[first]
