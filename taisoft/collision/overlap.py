"""Overlap at the start of a scene: how deep bodies stick in each other and in obstacles, whatever the search for contacts sees.

The search looks for what can touch in a step and passes over what lies deep inside. Here every vertex near another collider is
asked for its exact signed distance, on the host between surfaces. Triangles that cut each other add how far they must part, and
the contacts that were found faces under a ball.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from taisoft.collision.crossings import PARALLEL
from taisoft.collision.pipeline import Detection
from taisoft.errors import MeshError
from taisoft.mesh.signed_distance import signed_distances_at
from taisoft.runtime import kernel
from taisoft.scene.obstacles import HalfSpace, Shape
from taisoft.transfer import array_of, download

ALLOWED = 1e-6  # of the smaller body's size: deeper is an overlap


@dataclass(frozen=True)
class Overlap:
    """Two colliders that overlap by a depth [m]."""

    name_a: str
    name_b: str
    depth: float


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
    colliders, topology = detection.scene.colliders, detection.topology
    x = array_of(detection.surface.x)
    parts = [x[topology.vertex_first[k] : topology.vertex_first[k + 1]] for k in range(len(colliders))]
    size = np.array([np.ptp(p, axis=0).max() if len(p) else np.inf for p in parts])
    depth: dict[tuple[int, int], float] = {}

    def tell(a: int, b: int, deep: float) -> None:
        depth[a, b] = max(depth.get((a, b), 0.0), deep)

    contacts, place = detection.contacts(), {c.name: k for k, c in enumerate(colliders)}
    for a, b, gap in zip(contacts.body_a, contacts.body_b, contacts.gap):
        if gap < 0.0 and a != b:
            tell(place[a], place[b], -gap)
    n_bodies = len(detection.scene.bodies)
    for a in range(n_bodies):
        for b in range(a + 1, len(colliders)):
            if len(parts[b]):
                tell(a, b, _depth_between(detection, parts, a, b))
    if detection.shapes.count:
        phi = np.full((len(colliders), detection.shapes.count), np.inf)
        _deepest_vertices(detection.surface, detection.shapes, phi)
        owner, origin = download([detection.shapes.body, detection.shapes.origin])
        for a, k in np.ndindex(n_bodies, len(owner)):
            b = int(owner[k])
            tell(a, b, max(-phi[a, k], _depth_of_middle(detection, parts[a], a, colliders[b].shape, origin[k : k + 1])))
    told = {pair for pair, deep in depth.items() if deep > ALLOWED * min(size[pair[0]], size[pair[1]])}
    for a, b, deep in _crossings(detection, x):
        if (a, b) not in told:  # only that something crosses is known of them, and about how far
            tell(a, b, deep)
    shares = {(a, b): deep / min(size[a], size[b]) for (a, b), deep in depth.items()}
    pairs = sorted((pair for pair in depth if shares[pair] > ALLOWED), key=lambda pair: -shares[pair])
    return [Overlap(colliders[a].name, colliders[b].name, float(depth[a, b])) for a, b in pairs]


def _depth_of_middle(detection: Detection, vertices: np.ndarray, a: int, shape: Shape, middle: np.ndarray) -> float:
    """How deep [m] the middle (1,3) of a shape, which may be wholly inside body a, lies in it; 0 where it does not."""
    if isinstance(shape, HalfSpace):
        return 0.0
    first = detection.topology.first
    triangles = detection.topology.triangle[first[a] : first[a + 1]] - detection.topology.vertex_first[a]
    if (middle < vertices.min(axis=0)).any() or (middle > vertices.max(axis=0)).any():
        return 0.0
    return max(0.0, -float(signed_distances_at(vertices, triangles, middle)[0]))


def _crossings(detection: Detection, x: np.ndarray) -> list[tuple[int, int, float]]:
    """Pairs of different colliders whose triangles cut each other, and how far the two triangles must part to be clear [m].

    Bodies overlap by at least as much. Two triangles are clear of each other along one of their normals, or along what is across
    an edge of each (Gottschalk, Lin, Manocha 1996).
    """
    pairs, topology = detection.intersections(), detection.topology
    owner = np.searchsorted(topology.first, pairs, side="right") - 1
    apart = owner[:, 0] != owner[:, 1]
    pairs, owner = pairs[apart], owner[apart]
    corners = x[topology.triangle[pairs]]  # (k, 2, 3, 3)
    edges = np.roll(corners, -1, axis=2) - corners
    normals = np.cross(edges[:, :, 0], edges[:, :, 1])
    across = np.cross(edges[:, 0, :, None], edges[:, 1, None, :]).reshape(-1, 9, 3)
    axes = np.concatenate([normals, across], axis=1)
    length = np.linalg.norm(axes, axis=2)
    one, other = np.moveaxis(np.linalg.norm(edges, axis=3), 1, 0)  # (k, 3) each
    pairwise = (one[:, :, None] * other[:, None]).reshape(-1, 9)
    usable = length > PARALLEL * np.column_stack([one[:, 0] * one[:, 1], other[:, 0] * other[:, 1], pairwise])
    places = np.einsum("kncx,kax->knac", corners, axes / np.where(usable, length, 1.0)[..., None])
    low, high = places.min(axis=3), places.max(axis=3)  # (k, 2, 11)
    width = np.minimum(high[:, 0] - low[:, 1], high[:, 1] - low[:, 0])
    deep = np.maximum(np.where(usable, width, np.inf).min(axis=1, initial=np.inf), 0.0)
    return [(int(min(o)), int(max(o)), float(d)) for o, d in zip(owner, deep) if np.isfinite(d)]


def _depth_between(detection: Detection, parts: list[np.ndarray], a: int, b: int) -> float:
    """How deep [m] the vertices of two surfaces lie in each other at most; 0 where none does."""
    lo = np.maximum(parts[a].min(axis=0), parts[b].min(axis=0))
    hi = np.minimum(parts[a].max(axis=0), parts[b].max(axis=0))
    if (lo > hi).any():
        return 0.0
    deep = 0.0
    for inner, outer in ((a, b), (b, a)):
        points = parts[inner][((parts[inner] >= lo) & (parts[inner] <= hi)).all(axis=1)]
        first = detection.topology.first
        triangles = detection.topology.triangle[first[outer] : first[outer + 1]] - detection.topology.vertex_first[outer]
        try:
            phi = signed_distances_at(parts[outer], triangles, points)
        except MeshError:  # an open surface has no inside; what cuts it is told by the triangles
            continue
        deep = max(deep, -float(phi.min(initial=0.0)))
    return deep
