"""Compute the overlap depth of two solids whose surfaces may cross, coincide in part or wholly, or not meet.

The vertices of each solid are evaluated by exact signed distance from the other's surface. If surfaces coincide, as those of a
body and its copy, or cross without a vertex inside, the volumes decide: solids overlap exactly if a triangle of one cuts into
a tet of the other, or a tet lies wholly inside the other, including its centroid. Obstacles have no tets; at least one of the
two solids must have some.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.signed_distance import greatest_depth
from taisoft.mesh.tet_cuts import cut_depths
from taisoft.mesh.winding import is_closed, solid_depths

ALLOWED = 1e-6  # largest depth that is not an overlap, over the smaller solid's size


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


def _cuts(cutter: Solid, cut: Solid, lo: np.ndarray, hi: np.ndarray, slack: float) -> tuple[np.ndarray, float]:
    """Return the tets of `cut` near triangles of `cutter` within a box, and the largest depth [m] of a cut."""
    near = [_near_box(x, lo - slack, hi + slack) for x in (cutter.corners, cut.tets)]
    pairs, depth = cut_depths(cutter.corners[near[0]], cut.tets[near[1]], slack)
    return near[1][np.unique(pairs[:, 1])], float(depth.max(initial=0.0))


def _near_box(x: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Return rows of x (n,k,3), given by corners, whose bounding boxes meet a box."""
    return np.flatnonzero(((x.min(axis=1) <= hi) & (x.max(axis=1) >= lo)).all(axis=1))
