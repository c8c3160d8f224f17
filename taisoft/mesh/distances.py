"""Distances of points, rays and segments from triangles, and on which side of a closed surface points lie.

Signed distances, negative inside: the triangle with the nearest centroid (k-d tree) bounds a point's distance by u. A triangle
can be nearer only if its bounding ball around the centroid is within u, which a k-d tree finds. Most of these are then excluded
by the triangle's bounding disc, a much tighter bound than the ball if many triangles are about equally far.
Sign: from the pseudonormal of the nearest feature: the face normal, the sum of the two face normals at an edge, or the
angle-weighted sum at a vertex (Baerentzen & Aanaes 2005, Signed distance computation using the angle weighted
pseudonormal, IEEE TVCG 11(3)). Parts of the surface that touch only at a vertex have separate pseudonormals there; the part
that faces the point decides. Weak: a self-intersecting surface has no well-defined inside; the nearest sheet gives the sign.

Few queries of any triangles are answered by brute force (Ericson, Real-Time Collision Detection, 2005, sections 5.1.5 and 5.1.9).
The winding number then tells inside from outside: the sum of the triangles' solid angles over 4 pi (van Oosterom, Strackee 1983,
The solid angle of a plane triangle, IEEE Trans. Biomed. Eng. 30), 1 inside, 0 outside, 2 where two parts of a solid overlap.
Edges of four triangles and triangles without area do not affect it. Weak: the cost is points times triangles.
"""

from functools import cached_property

import numpy as np
import scipy

from taisoft.errors import MeshError
from taisoft.mesh.topology import linked_groups, normals_and_heights, opposite_half_edges, triangle_edges
from taisoft.ranges import owners

EDGE_TOLERANCE = 1e-9  # tolerance in barycentric coordinates, so that no ray passes between adjacent triangles
_CHUNK = 512  # points evaluated at once, each with some hundred triangles near it
_BATCH = 64  # points evaluated exactly at once, before checking whether any other point can lie deeper
_SLACK = 1e-9  # relative to the size: bounds are widened by this against rounding


def signed_distances(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return signed distances (k,) float64 [m] at points (k,3), negative inside.

    vertices: (n,3) float64 [m]. triangles: (t,3) int64, normals outward. Raises MeshError for a surface that is open,
    inconsistently oriented, or has triangles without area.
    """
    surface, phi = Surface(vertices, triangles), np.empty(len(points))
    for first in range(0, len(points), _CHUNK):
        chunk = points[first : first + _CHUNK]
        phi[first : first + _CHUNK] = surface.signed(chunk, surface.upper(chunk))
    return phi


def greatest_depth(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> float:
    """Return the largest depth [m] of points (k,3) inside, 0 if none is inside; surface as in `signed_distances`."""
    surface = Surface(vertices, triangles)
    upper = surface.upper(points)
    order = np.argsort(-upper, kind="stable")
    deepest = 0.0
    for first in range(0, len(order), _BATCH):
        batch = order[first : first + _BATCH]
        if upper[batch[0]] <= deepest:  # no other can lie deeper
            break
        deepest = max(deepest, -float(surface.signed(points[batch], upper[batch]).min()))
    return deepest


def distances(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distances (p,) [m] of points (p,3) from the nearest triangle. corners: (t,3,3) [m]."""
    t, p = len(corners), len(points)
    triangles = Triangles(corners.reshape(-1, 3), np.arange(3 * t).reshape(t, 3))
    squared = triangles.nearest(np.repeat(points, t, axis=0), np.tile(np.arange(t), p))[0]
    return np.sqrt(squared.reshape(p, t).min(axis=1))


def ray_hits(
    corners: np.ndarray, origin: np.ndarray, direction: np.ndarray, tolerance: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where a ray hits each triangle (t,3,3) [m], from both sides: lengths of direction (t,), inf without a hit, and the
    point's barycentric weights (t,) of the second and the third corner, with their tolerance. Source: Moeller and Trumbore 1997.
    """
    e, f, s = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], origin - corners[:, 0]
    p, q = np.cross(direction, f), np.cross(s, e)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = 1.0 / np.einsum("tx,tx->t", e, p)
        u, v, along = np.einsum("tx,tx->t", s, p) * inverse, q @ direction * inverse, np.einsum("tx,tx->t", f, q) * inverse
        hits = (u >= -tolerance) & (v >= -tolerance) & (u + v <= 1.0 + tolerance) & (along > 0.0)
    return np.where(hits, along, np.inf), u, v


def nearest_hit(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    """Return the distance along a ray, in lengths of direction, to the first triangle hit, inf if none. corners: (t,3,3) [m]."""
    return float(ray_hits(corners, origin, direction, EDGE_TOLERANCE)[0].min(initial=np.inf))


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


def is_closed(triangles: np.ndarray) -> bool:
    """Return whether a surface (t,3) has no border: each edge is traversed equally often in both directions."""
    return not triangle_edges(triangles)[2].any()


def are_inside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (p,) bool: whether points (p,3) lie inside the solid, see `solid_depths`."""
    return winding_numbers(corners, points) > (0.5 if _signed_volume6(corners) >= 0.0 else -0.5)


def winding_numbers(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return winding numbers (p,) of points (p,3) for triangles with corners (t,3,3)."""
    a, b, c = np.moveaxis(corners[None] - points[:, None, None], 2, 0)  # (p,t,3)
    la, lb, lc = (np.sqrt(np.einsum("ptx,ptx->pt", x, x)) for x in (a, b, c))
    volume = np.einsum("ptx,ptx->pt", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ptx,ptx->pt", x, y) for x, y in ((a, b), (b, c), (c, a)))
    return np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2.0 * np.pi)


def _signed_volume6(corners: np.ndarray) -> float:
    """Return six times the enclosed volume [m^3], negative if the normals point inward."""
    a, b, c = np.moveaxis(corners - corners.reshape(-1, 3).mean(axis=0), 1, 0)
    return float(np.einsum("tx,tx->", a, np.cross(b, c)))


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

    @cached_property
    def balls(self) -> BallTree:
        """Bounding balls around the centroids."""
        return BallTree(self.centroid, self.radius)

    def upper(self, points: np.ndarray) -> np.ndarray:
        """Return upper bounds (p,) [m] of the distances of points (p,3)."""
        triangle = scipy.spatial.cKDTree(self.centroid).query(points)[1] if len(points) else np.zeros(0, dtype=np.int64)
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
        along, length2 = np.einsum("pkx,pkx->pk", d, edges), np.einsum("pkx,pkx->pk", edges, edges)
        along = np.clip(along / np.where(length2 > 0.0, length2, 1.0), 0.0, 1.0)
        offset = d - along[:, :, None] * edges
        squared = np.einsum("pkx,pkx->pk", offset, offset)
        rows, k = np.arange(len(points)), np.argmin(squared, axis=1)
        t = along[rows, k]
        feature = np.where(t == 0.0, 4 + k, np.where(t == 1.0, 4 + (k + 1) % 3, 1 + k))
        squared, offset = squared[rows, k], offset[rows, k]
        # the point projects into the face if it is to the left of all three edges; triangles without area have no face
        face = (np.einsum("pkx,pkx->pk", np.cross(edges, d), normal[:, None]) >= 0).all(axis=1) & normal.any(axis=1)
        height = np.einsum("px,px->p", d[:, 0], normal)
        return (
            np.where(face, height**2, squared),
            np.where(face[:, None], height[:, None] * normal, offset),
            np.where(face, 0, feature),
        )


class Surface(Triangles):
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
