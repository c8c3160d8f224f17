"""How deep two solids lie in each other, whatever their surfaces do: cross, coincide in part or wholly, or not meet at all.

A solid's vertices are asked for their exact signed distances from the other's surface. Where surfaces coincide, as of a body and
its double, or cross without a vertex inside, the volumes tell: solids overlap exactly where a triangle of one cuts into a tet of
the other, or else a tet lies in the other whole, with its middle. Obstacles have no tets; one of two solids must have some.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.signed_distance import greatest_depth
from taisoft.mesh.tet_cuts import cut_depths
from taisoft.mesh.winding import is_closed, solid_depths

ALLOWED = 1e-6  # of the smaller solid's size: deeper is an overlap


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid where it is now [m]: its surface, every vertex in a triangle, and its tets; empty arrays where it has none."""

    vertices: np.ndarray  # (v,3)
    triangles: np.ndarray  # (t,3), normals outward
    nodes: np.ndarray  # (n,3)
    elements: np.ndarray  # (m,4) nodes of each tet

    @cached_property
    def size(self) -> float:
        """[m], from the vertex farthest from the mean one to that farthest from it; without end where there are none."""
        if not len(self.vertices):
            return np.inf
        far = np.linalg.norm(self.vertices - self.vertices.mean(axis=0), axis=1).argmax()
        return float(np.linalg.norm(self.vertices - self.vertices[far], axis=1).max())

    @cached_property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Its lowest and highest coordinates (3,) [m]; inf and -inf where there are no vertices."""
        return self.vertices.min(axis=0, initial=np.inf), self.vertices.max(axis=0, initial=-np.inf)

    @cached_property
    def corners(self) -> np.ndarray:
        """(t,3,3) [m] of the triangles."""
        return self.vertices[self.triangles]

    @cached_property
    def tets(self) -> np.ndarray:
        """(m,4,3) [m] corners of the tets."""
        return self.nodes[self.elements]

    @cached_property
    def middles(self) -> np.ndarray:
        """(m,3) [m] of the tets."""
        return self.tets.mean(axis=1)

    def depth_of(self, points: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> float:
        """How deep [m] those of the points (p,3) that lie in a box lie inside at most; 0 for an open surface."""
        points = points[((points >= lo) & (points <= hi)).all(axis=1)]
        try:
            return greatest_depth(self.vertices, self.triangles, points)
        except MeshError:  # open, or edges of four triangles, or triangles without area
            return float(solid_depths(self.corners, points).max(initial=0.0)) if is_closed(self.triangles) else 0.0


def overlap_depth(a: Solid, b: Solid) -> float:
    """How deep [m] two solids lie in each other: by the deepest vertex, middle of a tet, or cut of a triangle into a tet.

    Nodes and middles inside the solids count only where they overlap, since of others none lies inside.
    """
    least = ALLOWED * min(a.size, b.size)
    if not (np.minimum(a.box[1] - b.box[0], b.box[1] - a.box[0]) > least).all():  # nothing can lie deeper than the boxes do
        return 0.0
    lo, hi = np.maximum(a.box[0], b.box[0]), np.minimum(a.box[1], b.box[1])
    deep, inside = 0.0, 0.0
    for inner, outer in ((a, b), (b, a)):
        deep = max(deep, outer.depth_of(inner.vertices, lo, hi))
        touched, cut = _cuts(outer, inner, lo, hi, least)
        deep = max(deep, cut)
        if deep <= least and inside <= least:  # a tet that nothing cuts lies inside whole or not at all
            inside = max(inside, outer.depth_of(inner.middles[touched], lo, hi))
    if max(deep, inside) <= least:
        return deep
    return max(deep, *(one.depth_of(np.concatenate([two.nodes, two.middles]), lo, hi) for one, two in ((a, b), (b, a))))


def _cuts(knife: Solid, cut: Solid, lo: np.ndarray, hi: np.ndarray, slack: float) -> tuple[np.ndarray, float]:
    """The tets of one solid whose boxes triangles of another come near to, in a box, and how deep [m] they are cut at most."""
    near = [_near_box(x, lo - slack, hi + slack) for x in (knife.corners, cut.tets)]
    pairs, depth = cut_depths(knife.corners[near[0]], cut.tets[near[1]], slack)
    return near[1][np.unique(pairs[:, 1])], float(depth.max(initial=0.0))


def _near_box(x: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Rows of x (n,k,3), by corners, whose boxes meet a box."""
    return np.flatnonzero(((x.min(axis=1) <= hi) & (x.max(axis=1) >= lo)).all(axis=1))
