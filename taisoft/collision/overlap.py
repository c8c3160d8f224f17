"""Bodies and obstacles that overlap, at any depth, on the host: all pairs are tested.

Contact detection finds features that can touch in a step and misses deep penetration. In later steps `intersections` and
`containment` find what overlaps.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.backend.arrays import download
from taisoft.collision.detector import Detection
from taisoft.mesh.distances import distances, segment_distance
from taisoft.mesh.solids import ALLOWED, Solid, overlap_depth, shell_tets
from taisoft.scene.connections import attached_pairs
from taisoft.scene.obstacles import Capsule, HalfSpace, Sphere


@dataclass(frozen=True)
class Overlap:
    """Two colliders that overlap by a depth [m]."""

    name_a: str  #: of a body
    name_b: str  #: of a body or an obstacle
    depth: float  #: [m]


def find_overlaps(detection: Detection) -> list[Overlap]:
    """Return the overlaps deeper than ALLOWED in the state of the last search, in order of decreasing relative depth."""
    colliders = detection.scene.colliders
    solids = _solids(detection)
    size = np.array([solid.size for solid in solids])
    depth: dict[tuple[int, int], float] = {}

    def update_depth(a: int, b: int, new_depth: float) -> None:
        depth[a, b] = max(depth.get((a, b), 0.0), new_depth)

    n_bodies, attached = len(detection.scene.bodies), attached_pairs(detection.scene)
    lo, hi = (np.array(corner) for corner in zip(*(solid.box for solid in solids)))
    for a in range(n_bodies):
        overlapping = ((lo[a] <= hi[a + 1 :]) & (lo[a + 1 :] <= hi[a])).all(axis=1)
        for b in a + 1 + np.flatnonzero(overlapping & ~attached[a, a + 1 :]):
            update_depth(a, int(b), overlap_depth(solids[a], solids[b]))
    if detection.shapes.count:
        owner, origin, rotation = download([detection.shapes.body, detection.shapes.origin, detection.shapes.rotation])
        for a, k in np.ndindex(n_bodies, len(owner)):
            b, frame = int(owner[k]), (origin[k], rotation[3 * k : 3 * k + 3])
            if attached[a, b]:
                continue
            if isinstance(colliders[b].shape, HalfSpace):
                update_depth(a, b, -float((solids[a].vertices - frame[0]).dot(frame[1][:, 1]).min()))
            elif isinstance(colliders[b].shape, (Sphere, Capsule)):  # boxes are handled as solids
                update_depth(a, b, _depth_in_round(solids[a], colliders[b].shape, *frame))
    relative_depth = {(a, b): new_depth / min(size[a], size[b]) for (a, b), new_depth in depth.items()}
    pairs = sorted((pair for pair in depth if relative_depth[pair] > ALLOWED), key=lambda pair: -relative_depth[pair])
    return [Overlap(colliders[a].name, colliders[b].name, float(depth[a, b])) for a, b in pairs]


def _solids(detection: Detection) -> list[Solid]:
    """Return the colliders at the positions of the last search; obstacles have no tets."""
    topology, start = detection.topology, detection.layout.node_start
    x, nodes = download([detection.surface.x, detection.model.state.x])
    solids = []
    for k, collider in enumerate(detection.scene.colliders):
        used, triangles = np.unique(topology.triangle[topology.first[k] : topology.first[k + 1]], return_inverse=True)
        triangles = triangles.reshape(-1, 3)
        if k < len(detection.scene.bodies) and collider.nodes.embedded is not None:
            body = shell_tets(x[used], triangles, float(detection.thickness[k]))
        elif k < len(detection.scene.bodies):
            body = nodes[start[k] : start[k + 1]], collider.nodes.tets
        else:
            body = np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64)
        solids.append(Solid(x[used], triangles, *body))
    return solids


def _depth_in_round(solid: Solid, shape: Sphere | Capsule, origin: np.ndarray, rotation: np.ndarray) -> float:
    """Penetration depth [m] of a solid and a sphere or a capsule; 0 if separate. origin (3,), rotation (3,3): its frame."""
    lo, hi = solid.box
    half_length = shape.size()[0] if isinstance(shape, Capsule) else 0.0
    ends = origin + half_length * np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]) @ rotation.T
    if (ends.max(axis=0) < lo - shape.radius).any() or (ends.min(axis=0) > hi + shape.radius).any():
        return 0.0
    inside = solid.depth_of(np.stack([*ends, origin]), lo, hi)
    if inside > 0.0:
        return max(inside, shape.radius)
    distance = segment_distance(solid.corners, *ends) if half_length else float(distances(solid.corners, ends[:1])[0])
    return max(0.0, shape.radius - distance)
