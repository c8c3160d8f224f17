"""Overlap at the start of a scene: how deep bodies stick in each other and in obstacles, whatever the search for contacts sees.

The search looks for what can touch in a step and passes over what lies deep inside. Here every vertex near another collider is
asked for its exact signed distance, on the host between surfaces, and the contacts that were found add faces under a ball. Where
surfaces coincide, as of a body and its double, or cross without a vertex inside, the volumes tell: two solids overlap exactly
where a triangle of one cuts into a tet of the other, or else a tet lies in the other whole, with its middle.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import taichi as ti

from taisoft.collision.pipeline import Detection
from taisoft.errors import MeshError
from taisoft.mesh.signed_distance import greatest_depth
from taisoft.mesh.tet_cuts import cut_depths
from taisoft.mesh.winding import is_closed, solid_depths
from taisoft.runtime import kernel
from taisoft.scene.obstacles import HalfSpace, Shape
from taisoft.transfer import download

ALLOWED = 1e-6  # of the smaller body's size: deeper is an overlap


@dataclass(frozen=True)
class Overlap:
    """Two colliders that overlap by a depth [m]."""

    name_a: str
    name_b: str
    depth: float


@dataclass(frozen=True, eq=False)
class _Solid:
    """A collider where it is now: vertices (v,3) and triangles (t,3) of its surface, corners (m,4,3) of its tets [m]."""

    vertices: np.ndarray
    triangles: np.ndarray
    tets: np.ndarray

    @cached_property
    def size(self) -> float:
        """[m], from the vertex farthest from the mean one to that farthest from it; without end where there are none."""
        if not len(self.vertices):
            return np.inf
        far = np.linalg.norm(self.vertices - self.vertices.mean(axis=0), axis=1).argmax()
        return float(np.linalg.norm(self.vertices - self.vertices[far], axis=1).max())

    @cached_property
    def corners(self) -> np.ndarray:
        """(t,3,3) [m] of the triangles."""
        return self.vertices[self.triangles]

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


@kernel
def _deepest_vertices(s: ti.template(), o: ti.template(), phi: ti.types.ndarray()):
    """phi (n_colliders, analytic obstacles) [m]: least signed distance of each soft body's vertices from each obstacle."""
    ti.loop_config(serialize=True)
    for i in range(s.n_verts):
        if s.node[i] >= 0:
            b = s.body[s.ring[s.ring_start[i]]]
            for k in range(o.count):
                R = ti.Matrix.rows([o.rotation[3 * k], o.rotation[3 * k + 1], o.rotation[3 * k + 2]])
                value, _g = o.sample(k, R.transpose() @ (s.x[i] - o.origin[k]))
                phi[b, k] = ti.min(phi[b, k], value)


def find_overlaps(detection: Detection) -> list[Overlap]:
    """The overlaps in the state that was searched last that are deeper than ALLOWED, the largest share of a size first."""
    colliders = detection.scene.colliders
    solids = _solids(detection)
    size = np.array([solid.size for solid in solids])
    depth: dict[tuple[int, int], float] = {}

    def deepen(a: int, b: int, deep: float) -> None:
        depth[a, b] = max(depth.get((a, b), 0.0), deep)

    contacts, place = detection.contacts(), {c.name: k for k, c in enumerate(colliders)}
    for a, b, gap in zip(contacts.body_a, contacts.body_b, contacts.gap):
        if gap < 0.0 and a != b:
            deepen(place[a], place[b], -gap)
    n_bodies = len(detection.scene.bodies)
    for a in range(n_bodies):
        for b in range(a + 1, len(colliders)):
            if len(solids[b].vertices):
                deepen(a, b, _depth_between(solids[a], solids[b]))
    if detection.shapes.count:
        phi = np.full((len(colliders), detection.shapes.count), np.inf)
        _deepest_vertices(detection.surface, detection.shapes, phi)
        owner, origin = download([detection.shapes.body, detection.shapes.origin])
        for a, k in np.ndindex(n_bodies, len(owner)):
            b = int(owner[k])
            deepen(a, b, max(-phi[a, k], _depth_of_middle(solids[a], colliders[b].shape, origin[k : k + 1])))
    shares = {(a, b): deep / min(size[a], size[b]) for (a, b), deep in depth.items()}
    pairs = sorted((pair for pair in depth if shares[pair] > ALLOWED), key=lambda pair: -shares[pair])
    return [Overlap(colliders[a].name, colliders[b].name, float(depth[a, b])) for a, b in pairs]


def _solids(detection: Detection) -> list[_Solid]:
    """The colliders where the last search found them; obstacles have no tets."""
    topology, start = detection.topology, detection.layout.node_start
    x, nodes = download([detection.surface.x, detection.model.x])
    solids = []
    for k, collider in enumerate(detection.scene.colliders):
        first, last = topology.vertex_first[k : k + 2]
        triangles = topology.triangle[topology.first[k] : topology.first[k + 1]] - first
        soft = k < len(detection.scene.bodies)
        tets = nodes[start[k] + collider.nodes.tets] if soft else np.zeros((0, 4, 3))
        solids.append(_Solid(x[first:last], triangles, tets))
    return solids


def _depth_between(a: _Solid, b: _Solid) -> float:
    """How deep [m] two solids lie in each other: by the deepest vertex, middle of a tet, or cut of a triangle into a tet.

    0 where that is no overlap. Middles count in the depth only where there is one, since of other solids none lies inside.
    """
    least = ALLOWED * min(a.size, b.size)
    lo = np.maximum(a.vertices.min(axis=0), b.vertices.min(axis=0))
    hi = np.minimum(a.vertices.max(axis=0), b.vertices.max(axis=0))
    if not (hi - lo > least).all():  # nothing can lie deeper than the boxes do
        return 0.0
    deep, inside = 0.0, 0.0
    for inner, outer in ((a, b), (b, a)):
        deep = max(deep, outer.depth_of(inner.vertices, lo, hi))
        touched, cut = _cuts(outer, inner, lo, hi, least)
        deep = max(deep, cut)
        if deep <= least and inside <= least:  # a tet that nothing cuts lies inside whole or not at all
            inside = max(inside, outer.depth_of(inner.middles[touched], lo, hi))
    if max(deep, inside) <= least:
        return deep
    return max(deep, b.depth_of(a.middles, lo, hi), a.depth_of(b.middles, lo, hi))


def _cuts(knife: _Solid, cut: _Solid, lo: np.ndarray, hi: np.ndarray, slack: float) -> tuple[np.ndarray, float]:
    """The tets of one solid whose boxes triangles of another come near to, in a box, and how deep [m] they are cut at most."""
    near = [_near_box(x, lo - slack, hi + slack) for x in (knife.corners, cut.tets)]
    pairs, depth = cut_depths(knife.corners[near[0]], cut.tets[near[1]], slack)
    return near[1][np.unique(pairs[:, 1])], float(depth.max(initial=0.0))


def _near_box(x: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Rows of x (n,k,3), by corners, whose boxes meet a box."""
    return np.flatnonzero(((x.min(axis=1) <= hi) & (x.max(axis=1) >= lo)).all(axis=1))


def _depth_of_middle(solid: _Solid, shape: Shape, middle: np.ndarray) -> float:
    """How deep [m] the middle (1,3) of a shape, which may be wholly inside a body, lies in it; 0 where it does not."""
    if isinstance(shape, HalfSpace):
        return 0.0
    return solid.depth_of(middle, solid.vertices.min(axis=0), solid.vertices.max(axis=0))
