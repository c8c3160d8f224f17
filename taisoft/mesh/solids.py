"""The overlap depth of two solids, and points inside of each.

Two solids may overlap though their surfaces cross, coincide in part or wholly, or do not meet. The vertices of each are
evaluated by exact signed distance from the other's surface. If surfaces coincide, as those of a body and its copy, or cross
without a vertex inside, the volumes decide: solids overlap exactly if a triangle of one cuts into a tet of the other, or a tet
lies wholly inside the other, including its centroid. Obstacles have no tets; at least one of the two solids must have some.

A disjoint triangle and tet are separated along a face normal or the cross product of two edges, one of each (separating axes:
Gottschalk, Lin, Manocha 1996, OBBTree). The smallest overlap over these 23 axes is the depth of the cut. Pure touching, flush
or along an edge, has depth 0. Tets may be inverted.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.distances import BallTree, are_inside, distances, greatest_depth, is_closed, nearest_hit
from taisoft.mesh.topology import EDGES, TET_FACES, connected_pieces, normals_and_heights

ALLOWED = 1e-6  # largest depth that is not an overlap, over the smaller solid's size
PARALLEL = 1e-6  # sine below which two edges count as parallel and give no axis
EQUAL = 1e-9  # relative size difference that counts as a tie; ties take the first element, independent of rounding
SHELL = 0.01  # depth of `shell_tets`
_POINT_PAIRS = 1 << 16  # maximum number of point-triangle pairs processed at once, about 1 kB each
_TET_PAIRS = 1 << 14  # maximum number of triangle-tet pairs processed at once, about 10 kB each


def solid_depths(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the depths (p,) [m] of points (p,3) inside the solid of a closed surface; 0 outside.

    corners: (t,3,3) [m] of its triangles, normals outward. A surface whose normals all point inward bounds a cavity.
    """
    depth = np.zeros(len(points))
    step = max(_POINT_PAIRS // max(len(corners), 1), 1)
    for first in range(0, len(points), step):
        batch = points[first : first + step]
        inside = np.flatnonzero(are_inside(corners, batch))
        if len(inside):
            depth[first + inside] = distances(corners, batch[inside])
    return depth


def connected_parts(elements: np.ndarray) -> np.ndarray:
    """Return the connected part (m,) of each element (m,k), numbered from 0; elements that share a vertex are connected."""
    used, corner = np.unique(elements, return_inverse=True)
    corner = corner.reshape(elements.shape)
    return connected_pieces(corner, len(used))[1][corner[:, 0]]


def inner_tets(vertices: np.ndarray, tets: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each part the tet (k,) whose centroid lies farthest from its faces, and that distance (k,) [m].

    vertices: (n,3) [m]. tets: (m,4). part: (m,) of `connected_parts`.
    """
    faces = vertices[tets[:, TET_FACES]]
    twice = np.linalg.norm(np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0]), axis=2)
    x = vertices[tets]
    clearance = 0.25 * np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / twice.max(axis=1)  # a quarter of the smallest height
    best = _first_largest(clearance, part)
    return best, clearance[best]


def inner_depths(vertices: np.ndarray, triangles: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each part of a surface its largest triangle, the depth of an inner point behind it, and that point's clearance.

    vertices: (n,3) [m]. triangles: (t,3), normals outward. part: (t,) of `connected_parts`. Returns triangles (k,); depth (k,)
    [m] along the inward normal from the centroid, half the distance to the next triangle; distance (k,) [m] of the point from the
    surface. If no triangle lies behind, both are 0 and the point lies on the surface.
    """
    corners = vertices[triangles]
    normals = normals_and_heights(vertices, triangles)[0]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    largest = _first_largest(area, part)
    depth, clearance = np.zeros(len(largest)), np.zeros(len(largest))
    for k, t in enumerate(largest):
        centroid = corners[t].mean(axis=0)
        hit = nearest_hit(np.delete(corners, t, axis=0), centroid, -normals[t])
        if np.isfinite(hit):
            depth[k] = 0.5 * hit
            clearance[k] = distances(corners, (centroid - depth[k] * normals[t])[None])[0]
    return largest, depth, clearance


def _first_largest(size: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return for each part the first element whose size is within EQUAL of the largest."""
    largest = np.zeros(part.max() + 1)
    np.maximum.at(largest, part, size)
    rows = np.flatnonzero(size >= (1.0 - EQUAL) * largest[part])
    return rows[np.unique(part[rows], return_index=True)[1]]


def cut_depths(triangles: np.ndarray, tets: np.ndarray, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (k,2) of a triangle and a tet whose boxes lie within slack [m], and the depths (k,) [m] of their cuts.

    triangles: (t,3,3) [m] corners. tets: (m,4,3) [m] corners.
    """
    pairs = _near_boxes(triangles.min(axis=1) - slack, triangles.max(axis=1) + slack, tets.min(axis=1), tets.max(axis=1))
    depth = np.zeros(len(pairs))
    for first in range(0, len(pairs), _TET_PAIRS):
        t, m = pairs[first : first + _TET_PAIRS].T
        depth[first : first + _TET_PAIRS] = _separation(triangles[t], tets[m])
    return pairs, depth


def _near_boxes(lo_a: np.ndarray, hi_a: np.ndarray, lo_b: np.ndarray, hi_b: np.ndarray) -> np.ndarray:
    """Return the pairs (k,2) of boxes that meet."""
    middle_a, middle_b = 0.5 * (lo_a + hi_a), 0.5 * (lo_b + hi_b)
    reach, tree = np.linalg.norm(hi_a - middle_a, axis=1), BallTree(middle_b, np.linalg.norm(hi_b - middle_b, axis=1))
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for first in range(0, len(middle_a), _TET_PAIRS):
        a, b = tree.pairs(middle_a[first : first + _TET_PAIRS], reach[first : first + _TET_PAIRS])
        a = a + first
        meet = ((lo_a[a] <= hi_b[b]) & (lo_b[b] <= hi_a[a])).all(axis=1)
        pairs.append(np.stack([a[meet], b[meet]], axis=1))
    return np.concatenate(pairs)


def _separation(triangle: np.ndarray, tet: np.ndarray) -> np.ndarray:
    """Return the distance (k,) [m] that separates each triangle (k,3,3) from its tet (k,4,3); 0 if they are disjoint."""
    triangle, tet = triangle - tet[:, :1], tet - tet[:, :1]
    triangle_edges = np.roll(triangle, -1, axis=1) - triangle
    faces = tet[:, TET_FACES]
    sides = np.concatenate([triangle_edges[:, None], np.roll(faces, -1, axis=2) - faces], axis=1)  # (k,5,3,3) edges of each face
    depth = _smallest_overlap(triangle, tet, sides[:, :, 0], sides[:, :, 1])
    remaining = np.flatnonzero(depth > 0.0)  # most pairs are separated along a normal
    ends = tet[remaining][:, EDGES]
    edges = np.broadcast_to((ends[:, :, 1] - ends[:, :, 0])[:, None], (len(remaining), 3, 6, 3))
    paired_edges = np.broadcast_to(triangle_edges[remaining][:, :, None], edges.shape)
    edge_depth = _smallest_overlap(triangle[remaining], tet[remaining], paired_edges.reshape(-1, 18, 3), edges.reshape(-1, 18, 3))
    depth[remaining] = np.minimum(depth[remaining], edge_depth)
    return depth


def _smallest_overlap(triangle: np.ndarray, tet: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the smallest separating distance (k,) [m], at least 0, along the axes first x second, (k,n,3) each."""
    axes = np.cross(first, second)
    length = np.linalg.norm(axes, axis=2)
    usable = length > PARALLEL * np.linalg.norm(first, axis=2) * np.linalg.norm(second, axis=2)
    axes /= np.where(usable, length, 1.0)[:, :, None]
    a, b = (np.einsum("kcx,knx->knc", x, axes) for x in (triangle, tet))
    overlap = np.minimum(a.max(axis=2) - b.min(axis=2), b.max(axis=2) - a.min(axis=2))
    return np.maximum(np.where(usable, overlap, np.inf).min(axis=1), 0.0)


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid in its current position [m]: surface, with every vertex in a triangle, and tets; arrays may be empty."""

    vertices: np.ndarray  # (v,3)
    triangles: np.ndarray  # (t,3), normals outward
    nodes: np.ndarray  # (n,3)
    elements: np.ndarray  # (m,4) nodes of each tet

    @cached_property
    def size(self) -> float:
        """Distance [m] from the vertex farthest from the mean to the vertex farthest from that one; inf without vertices."""
        if not len(self.vertices):
            return np.inf
        far = np.linalg.norm(self.vertices - self.vertices.mean(axis=0), axis=1).argmax()
        return float(np.linalg.norm(self.vertices - self.vertices[far], axis=1).max())

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest coordinates (3,) [m]; inf and -inf without vertices."""
        return self.vertices.min(axis=0, initial=np.inf), self.vertices.max(axis=0, initial=-np.inf)

    @cached_property
    def corners(self) -> np.ndarray:
        """Corners of the triangles (t,3,3) [m]."""
        return self.vertices[self.triangles]

    @cached_property
    def tets(self) -> np.ndarray:
        """Corners of the tets (m,4,3) [m]."""
        return self.nodes[self.elements]

    @cached_property
    def centroids(self) -> np.ndarray:
        """Centroids of the tets (m,3) [m]."""
        return self.tets.mean(axis=1)

    def depth_of(self, points: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> float:
        """Return the largest depth [m] inside the solid of the points (p,3) within a box; 0 for an open surface."""
        points = points[((points >= lo) & (points <= hi)).all(axis=1)]
        try:
            return greatest_depth(self.vertices, self.triangles, points)
        except MeshError:  # open surface, edges of four triangles, or triangles without area
            return float(solid_depths(self.corners, points).max(initial=0.0)) if is_closed(self.triangles) else 0.0


def overlap_depth(a: Solid, b: Solid) -> float:
    """Return the overlap depth [m] of two solids: the largest depth of a vertex, tet centroid, or cut of a triangle into a tet.

    Inner nodes and centroids are evaluated only if the solids overlap.
    """
    tolerance = ALLOWED * min(a.size, b.size)
    if not (np.minimum(a.box[1] - b.box[0], b.box[1] - a.box[0]) > tolerance).all():  # the overlap of the boxes bounds the depth
        return 0.0
    lo, hi = np.maximum(a.box[0], b.box[0]), np.minimum(a.box[1], b.box[1])
    depth, centroid_depth = 0.0, 0.0
    for inner, outer in ((a, b), (b, a)):
        depth = max(depth, outer.depth_of(inner.vertices, lo, hi))
        nearby, cut_depth = _cuts(outer, inner, lo, hi, tolerance)
        depth = max(depth, cut_depth)
        if depth <= tolerance and centroid_depth <= tolerance:  # an uncut tet lies wholly inside or wholly outside
            centroid_depth = max(centroid_depth, outer.depth_of(inner.centroids[nearby], lo, hi))
    if max(depth, centroid_depth) <= tolerance:
        return depth
    return max(depth, *(one.depth_of(np.concatenate([two.nodes, two.centroids]), lo, hi) for one, two in ((a, b), (b, a))))


def shell_tets(vertices: np.ndarray, triangles: np.ndarray, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points and flat tets (t,4) behind the triangles of a closed surface, for a solid without tets of its own.

    thickness: of the solid [m]; the tets reach SHELL times that, or times the triangle's height, into it.
    """
    normals, heights = normals_and_heights(vertices, triangles)
    longest = np.linalg.norm(vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)], axis=2).max(axis=1)
    depth = SHELL * np.minimum(heights * longest, thickness)
    apexes = vertices[triangles].mean(axis=1) - depth[:, None] * normals
    return np.concatenate([vertices, apexes]), np.column_stack(
        [triangles[:, [0, 2, 1]], len(vertices) + np.arange(len(triangles))]
    )


def _cuts(cutter: Solid, cut: Solid, lo: np.ndarray, hi: np.ndarray, slack: float) -> tuple[np.ndarray, float]:
    """Return the tets of `cut` near triangles of `cutter` within a box, and the largest depth [m] of a cut."""
    near = [_near_box(x, lo - slack, hi + slack) for x in (cutter.corners, cut.tets)]
    pairs, depth = cut_depths(cutter.corners[near[0]], cut.tets[near[1]], slack)
    return near[1][np.unique(pairs[:, 1])], float(depth.max(initial=0.0))


def _near_box(x: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Return rows of x (n,k,3), given by corners, whose bounding boxes meet a box."""
    return np.flatnonzero(((x.min(axis=1) <= hi) & (x.max(axis=1) >= lo)).all(axis=1))
