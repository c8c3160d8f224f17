"""Signed distance from a closed triangle surface at the points of a grid: negative inside, exact at every point.

Distance: blocks of grid points are halved down to single points, each with the triangles that could be nearest to a point
in it. With u an upper bound of the distance of every point in a block of centre q and half diagonal s, a triangle can be
nearest only if its distance from q is at most u + s; the disc round the triangle's centroid that holds it bounds that
distance from below, far better than a ball where many triangles are about as far. u comes from the triangle with the
nearest centroid (k-d tree).
Sign: by the pseudonormal of the nearest feature, the face's, the sum of the two faces' at an edge, the faces' weighted by
their angles at a vertex (Baerentzen & Aanaes 2005, Signed distance computation using the angle weighted pseudonormal,
IEEE TVCG 11(3)). Where parts of the surface touch at a vertex only, each has its own pseudonormal there, and the part
that the point sees tells. Surfaces that intersect themselves have no inside of their own; their sign is that of the
nearest sheet.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from taisoft.errors import MeshError
from taisoft.mesh.half_edges import normals_and_heights, opposite_half_edges

PAIRS = 1 << 19  # of blocks and triangles that are looked at together at most, about 100 bytes each
_SLACK = 1e-9  # of the size, by which bounds are loosened against rounding
_PAIRS_AT = 1 << 15  # the same for scattered points
_BLOCK = 64  # points whose exact distances are found together, before it is asked whether others can lie deeper


def signed_distances(vertices: np.ndarray, triangles: np.ndarray, axes: list[np.ndarray]) -> np.ndarray:
    """(nx,ny,nz) float64 [m] at the points (x_i, y_j, z_k), negative inside.

    vertices: (n,3) float64 [m]. triangles: (t,3) int64, normals outward. axes: ascending coordinates (nx,), (ny,), (nz,)
    [m]. Raises MeshError for a surface that is open, not oriented alike, or has triangles without area.
    """
    return _Search(_Surface(vertices, triangles), axes).run()


def signed_distances_at(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(k,) float64 [m] at points (k,3), negative inside; the surface as in `signed_distances`."""
    search = _PointSearch(_Surface(vertices, triangles), points)
    return search.signed(np.arange(len(points)))


def greatest_depth(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> float:
    """How deep [m] the deepest of points (k,3) lies inside, 0 where none does; the surface as in `signed_distances`."""
    search = _PointSearch(_Surface(vertices, triangles), points)
    order = np.argsort(-search.upper, kind="stable")
    deepest = 0.0
    for first in range(0, len(order), _BLOCK):
        some = order[first : first + _BLOCK]
        if search.upper[some[0]] <= deepest:  # no other can lie deeper
            break
        deepest = max(deepest, -float(search.signed(some).min()))
    return deepest


class _PointSearch:
    """Points (k,3) near a surface. upper: (k,) [m], at least their distances."""

    def __init__(self, surface: "_Surface", points: np.ndarray):
        self.surface, self.points, self.tree = surface, points, scipy.spatial.cKDTree(surface.centroid)
        first = self.tree.query(points)[1].astype(np.int64) if len(points) else np.zeros(0, dtype=np.int64)
        self.upper = np.sqrt(surface.nearest(points, first)[0])

    def signed(self, rows: np.ndarray) -> np.ndarray:
        """Signed distances [m] of some of the points."""
        surface = self.surface
        if not len(rows):
            return np.zeros(0)
        # a triangle can be nearer only if its centroid is within the bound and its own radius
        reach = (1.0 + _SLACK) * (self.upper[rows] + surface.radius.max())
        near = self.tree.query_ball_point(self.points[rows], reach, return_sorted=True)
        counts = np.array([len(candidates) for candidates in near])
        result = []
        for some in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(np.cumsum(counts) // _PAIRS_AT)) + 1):
            starts = np.concatenate([[0], np.cumsum(counts[some])[:-1]])
            row, triangle = np.repeat(rows[some], counts[some]), np.concatenate(near[some]).astype(np.int64)
            squared, offset, feature = surface.nearest(self.points[row], triangle)
            equal = np.flatnonzero(squared == np.repeat(np.minimum.reduceat(squared, starts), counts[some]))
            best = equal[np.searchsorted(equal, starts)]  # of equally near triangles the first
            inside = surface.sides(offset[best], triangle[best], feature[best]) < 0.0
            result.append(np.where(inside, -1.0, 1.0) * np.sqrt(squared[best]))
        return np.concatenate(result)


class _Surface:
    """Triangles with what distance and sign need."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray):
        self.normals, heights = normals_and_heights(vertices, triangles)
        flat = ~(heights > 0)
        if flat.any():
            raise MeshError(f"a distance field needs triangles with area: triangle {int(np.argmax(flat))} has none")
        opposite = opposite_half_edges(triangles)
        if (opposite < 0).any():
            t, k = np.argwhere(opposite < 0)[0]
            edge = tuple(sorted((int(triangles[t, k]), int(triangles[t, (k + 1) % 3]))))
            raise MeshError(
                f"a distance field needs a closed surface: edge {edge} belongs to triangle {t} alone "
                f"({int((opposite < 0).sum())} such edges)"
            )
        self.triangles = triangles
        self.corners = vertices[triangles]  # (t,3,3)
        self.edges = np.roll(self.corners, -1, axis=1) - self.corners
        self.centroid = self.corners.mean(axis=1)
        self.radius = np.linalg.norm(self.corners - self.centroid[:, None], axis=2).max(axis=1)
        # (t,7,3): pseudonormals of the face, of its three edges, of its three corners; their lengths do not matter.
        at_edges = self.normals[:, None] + self.normals[opposite // 3]
        part = self._parts(opposite)
        self.pseudonormals = np.concatenate([self.normals[:, None], at_edges, self._at_corners(part)], axis=1)
        pairs = np.unique(np.stack([triangles.reshape(-1), part], axis=1), axis=0)[:, 0]
        self.joints = np.unique(pairs[1:][pairs[1:] == pairs[:-1]])  # vertices where several parts touch

    @staticmethod
    def _parts(opposite: np.ndarray) -> np.ndarray:
        """(3t,) a number for each corner, the same for those of one vertex that edges lead between."""
        # Corner k starts half-edge k and ends its opposite, so it follows that one in the other triangle.
        n = opposite.size
        neighbour = opposite // 3 * 3 + (opposite + 1) % 3
        graph = coo_matrix((np.ones(n, dtype=np.int8), (np.arange(n), neighbour.reshape(-1))), shape=(n, n))
        return connected_components(graph, directed=False)[1]

    def _at_corners(self, part: np.ndarray) -> np.ndarray:
        """(t,3,3) sums, over the triangles round each corner, of their normals times their angles there."""
        back = -np.roll(self.edges, 1, axis=1)
        sine = np.linalg.norm(np.cross(self.edges, back), axis=2)
        angle = np.arctan2(sine, np.einsum("tkx,tkx->tk", self.edges, back)).reshape(-1)
        weighted = angle[:, None] * np.repeat(self.normals, 3, axis=0)
        total = np.stack([np.bincount(part, weighted[:, x]) for x in range(3)], axis=1)
        return total[part].reshape(-1, 3, 3)

    def sides(self, offset: np.ndarray, triangle: np.ndarray, feature: np.ndarray) -> np.ndarray:
        """(p,) below 0 for points inside; arguments as `nearest` takes and gives them."""
        pseudonormal = self.pseudonormals[triangle, feature]
        if len(self.joints):
            vertex = np.where(feature >= 4, self.triangles[triangle, np.maximum(feature - 4, 0)], -1)
            for v in np.intersect1d(self.joints, vertex):
                # All edges there lead away from the points. The one that does so least bounds what a point sees.
                t, k = np.nonzero(self.triangles == v)
                out, back = self.edges[t, k], -self.edges[t, (k + 2) % 3]
                rows = np.flatnonzero(vertex == v)
                ahead = [offset[rows] @ (e / np.linalg.norm(e, axis=1, keepdims=True)).T for e in (out, back)]
                seen = np.argmax(np.maximum(*ahead), axis=1)
                pseudonormal[rows] = self.pseudonormals[t[seen], 4 + k[seen]]
        return np.einsum("px,px->p", offset, pseudonormal)

    def bound(self, centre: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """(p,) [m], at most the distances of points (p,3) from triangles (p,): those from the discs round them."""
        d = centre - self.centroid[triangle]
        height = np.einsum("px,px->p", d, self.normals[triangle])
        across = np.sqrt(np.maximum(np.einsum("px,px->p", d, d) - height**2, 0.0)) - self.radius[triangle]
        return np.sqrt(height**2 + np.maximum(across, 0.0) ** 2)

    def nearest(self, points: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Squared distances (p,), offsets (p,3) from the nearest point, and (p,) its feature: a column of `pseudonormals`.

        points: (p,3), each with its triangle (p,).
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
        # Above the face where all three edges have the point on their left.
        face = (np.einsum("pkx,pkx->pk", np.cross(edges, d), normal[:, None]) >= 0).all(axis=1)
        height = np.einsum("px,px->p", d[:, 0], normal)
        return (
            np.where(face, height**2, squared),
            np.where(face[:, None], height[:, None] * normal, offset),
            np.where(face, 0, feature),
        )


@dataclass(frozen=True, eq=False)
class _Level:
    """Blocks of grid points, all of one size."""

    upper: np.ndarray  # (bx,by,bz) [m]: no point of the block is farther from the surface
    centres: list[np.ndarray]  # three arrays (bx,), (by,), (bz,) [m]
    reach: np.ndarray  # (bx*by*bz,) [m]: no triangle farther from the centre is nearest to a point of the block


class _Search:
    """The nearest triangle of every point of a grid."""

    def __init__(self, surface: _Surface, axes: list[np.ndarray]):
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self._surface, self._axes, self._points = surface, axes, points
        self._triangle = np.empty(len(points), dtype=np.int64)
        self._squared = np.empty(len(points))
        self._slack = _SLACK * float(np.linalg.norm(points[-1] - points[0]))
        tree = scipy.spatial.cKDTree(surface.centroid)
        for some in self._chunks(len(points)):
            self._triangle[some] = tree.query(points[some])[1]
            self._squared[some] = surface.nearest(points[some], self._triangle[some])[0]
        self._levels = [self._level(0, np.sqrt(self._squared).reshape([len(a) for a in axes]))]
        while self._levels[-1].reach.size > 1:
            coarse = self._levels[-1].upper
            for axis in range(3):
                coarse = np.maximum.reduceat(coarse, np.arange(0, coarse.shape[axis], 2), axis=axis)
            self._levels.append(self._level(len(self._levels), coarse))

    def _level(self, level: int, upper: np.ndarray) -> "_Level":
        """Blocks of 2^level points along each axis. upper: bound of the distances of the points of each [m]."""
        centres, half = [], np.zeros(())
        for axis, x in enumerate(self._axes):
            first = np.arange(upper.shape[axis]) << level
            low, high = x[first], x[np.minimum(first + (1 << level), len(x)) - 1]
            centres.append(0.5 * (low + high))
            half = half[..., None] + (0.5 * (high - low)) ** 2
        return _Level(upper, centres, (upper + np.sqrt(half) + self._slack).reshape(-1))

    @staticmethod
    def _chunks(count: int) -> Iterator[slice]:
        return (slice(i, i + PAIRS // 8) for i in range(0, count, PAIRS // 8))

    def run(self) -> np.ndarray:
        """(nx,ny,nz) signed distances [m]."""
        n = len(self._surface.centroid)
        waiting = [(len(self._levels) - 1, np.zeros(n, dtype=np.int64), np.arange(n))]
        while waiting:  # depth first, a bounded number of pairs at a time
            level, block, triangle = waiting.pop()
            if len(block) > PAIRS // 8:
                half = len(block) // 2
                waiting += [(level, block[:half], triangle[:half]), (level, block[half:], triangle[half:])]
            elif level:
                waiting.append((level - 1, *self._children(level - 1, block, triangle)))
            else:
                self._improve(block, triangle)
        phi = np.empty(len(self._points))
        for some in self._chunks(len(phi)):
            triangle = self._triangle[some]
            squared, offset, feature = self._surface.nearest(self._points[some], triangle)
            phi[some] = np.where(self._surface.sides(offset, triangle, feature) < 0, -1.0, 1.0) * np.sqrt(squared)
        return phi.reshape([len(a) for a in self._axes])

    def _children(self, level: int, block: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pairs of the blocks' eighths, at `level`, and triangles that may hold a nearest point."""
        fine, parent = self._levels[level], np.unravel_index(block, self._levels[level + 1].upper.shape)
        kept = []
        for corner in range(8):
            ijk = [2 * p + (corner >> (2 - a) & 1) for a, p in enumerate(parent)]
            exists = np.logical_and.reduce([i < n for i, n in zip(ijk, fine.upper.shape)])
            ijk, some = [i[exists] for i in ijk], triangle[exists]
            child = np.ravel_multi_index(ijk, fine.upper.shape)
            centre = np.stack([x[i] for x, i in zip(fine.centres, ijk)], axis=1)
            near = self._surface.bound(centre, some) <= fine.reach[child]
            kept.append((child[near], some[near]))
        return tuple(np.concatenate(column) for column in zip(*kept))

    def _improve(self, point: np.ndarray, triangle: np.ndarray) -> None:
        """Take the pairs' distances where they are less than what is known; of equal ones the first triangle."""
        squared = self._surface.nearest(self._points[point], triangle)[0]
        order = np.lexsort((triangle, squared, point))
        point, triangle, squared = point[order], triangle[order], squared[order]
        first = np.ones(len(point), dtype=bool)
        first[1:] = point[1:] != point[:-1]
        first &= squared < self._squared[point]
        self._squared[point[first]], self._triangle[point[first]] = squared[first], triangle[first]
