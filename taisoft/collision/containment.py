"""Colliders wholly inside one another, on the host, step after step: no surfaces of theirs need cross.

Contacts and crossings exist only where surfaces meet. A body wholly inside another has none, nor has an exact duplicate. So every
connected part of a collider has an inner point, see `taisoft.mesh.solids`. The few inner points in another collider's box are
tested by winding numbers, and retested only after something has moved by the distance that separated them.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import download
from taisoft.collision.analytic import AnalyticObstacles
from taisoft.collision.colliders import Topology
from taisoft.collision.surface import Surface
from taisoft.fem.model import Layout
from taisoft.mesh.distances import are_inside, distances, is_closed
from taisoft.mesh.solids import connected_parts, inner_depths, inner_tets
from taisoft.scene.body import Body
from taisoft.scene.connections import attached_pairs
from taisoft.scene.locate import locate, weight_matrix
from taisoft.scene.obstacles import Capsule, Obstacle, Sphere
from taisoft.scene.scene import Scene


@dataclass(frozen=True)
class Inside:
    """A part of collider a lies inside collider b; if a == b, inside another part of it.

    depth: of the part's inner point in b [m]. room: depth of that point in the part itself, at rest [m].
    """

    a: int
    b: int
    depth: float
    room: float


class Containment:
    """Inner points of a scene's colliders, and a test for those inside other colliders."""

    def __init__(
        self,
        scene: Scene,
        topology: Topology,
        layout: Layout,
        rest: np.ndarray,
        analytic: list[tuple[int, Obstacle]],
        self_collision: bool,
    ):
        """rest: (v,3) [m] vertices of the surfaces. analytic: colliders and obstacles in the order of `AnalyticObstacles`."""
        self._scene, self._topology, self._layout, self._rest, self._self_on = scene, topology, layout, rest, self_collision
        self._round = [(i, k, o.shape) for i, (k, o) in enumerate(analytic) if isinstance(o.shape, (Sphere, Capsule))]
        self._solid = np.flatnonzero(np.diff(topology.first))  # colliders with triangles
        parts = sum(b.mesh.n_components for b in scene.bodies) if self_collision else 0
        self._enabled = len(self._solid) + len(self._round) > 1 or parts > 1
        self._single = len(self._solid) == 1 and not self_collision
        self._ready = False

    def _prepare(self) -> None:
        """Find the inner points; done at the first test, since many scenes are never stepped."""
        topology, colliders, n_bodies = self._topology, self._scene.colliders, len(self._scene.bodies)
        self._soft = np.arange(len(colliders)) < n_bodies
        self._part = np.zeros(len(topology.triangle), dtype=np.int64)  # part of each triangle, from 0 in each collider
        self._closed, self._n_parts = np.zeros(len(colliders), dtype=bool), np.zeros(len(colliders), dtype=np.int64)
        n_nodes = len(self._layout.rest)
        inner, triangles, inner_depth, room = [sp.csr_matrix((0, n_nodes))], [np.zeros(0, dtype=np.int64)], [np.zeros(0)], []
        for k in self._solid:
            first, last = topology.first[k : k + 2]
            own = topology.triangle[first:last]
            self._closed[k] = is_closed(own)
            if k < n_bodies:
                find = self._inner_tets if colliders[k].nodes.embedded is None else self._inner_of_embedded
                nodes, weights, rooms = find(colliders[k], slice(first, last))
                best, nodes = nodes, nodes + self._layout.node_start[k]
                inner.append(weight_matrix(nodes, weights, n_nodes))
            else:
                self._part[first:last] = connected_parts(own)
                best, depths, rooms = inner_depths(self._rest, own, self._part[first:last])
                triangles.append(first + best)
                inner_depth.append(depths)
            self._n_parts[k] = len(best)
            room.append(rooms)
        self._inner, self._triangles, self._inner_depth = (
            sp.vstack(inner, format="csr"),
            *map(np.concatenate, (triangles, inner_depth)),
        )
        self._room = np.concatenate([*room, [shape.radius for _, _, shape in self._round]])
        counts = self._n_parts[self._solid]
        self._owner = np.concatenate([np.repeat(self._solid, counts), np.array([k for _, k, _ in self._round], dtype=np.int64)])
        self._own_part = np.concatenate([*(np.arange(n) for n in counts), np.zeros(len(self._round), dtype=np.int64)])
        own, other = self._owner[:, None], self._solid
        self._testable = (self._soft[own] | self._soft[other]) & self._closed[other]  # (points, solid): whether to test
        self._testable &= ~attached_pairs(self._scene)[own, other]
        self._testable &= (own != other) | (self._self_on & (self._n_parts[other] > 1))
        self._separations: dict[tuple[int, int], tuple] = {}  # point and surface when last apart, and their distance [m]
        self._corners = self._inner_points = np.zeros((0, 3))  # last triangles, and the inner points behind them
        self._ready = True

    def _inner_tets(self, body: Body, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes (k,4) and weights (k,4) of an inner point of each part of a body with triangles `rows`, and its clearance [m]."""
        tets = body.nodes.tets
        parts = connected_parts(tets) if body.mesh.n_components > 1 else np.zeros(len(tets), dtype=np.int64)
        of_node = np.zeros(body.n_nodes, dtype=np.int64)
        of_node[tets] = parts[:, None]
        self._part[rows] = of_node[body.nodes.surface[:, 0]]
        best, rooms = inner_tets(body.rest_positions, tets, parts)
        return tets[best], np.full((len(best), 4), 0.25), rooms

    def _inner_of_embedded(self, body: Body, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same of a body whose surface is embedded: nodes and weights (k, 4 or 10)."""
        own, x = body.nodes.surface, body.rest_positions
        self._part[rows] = connected_parts(own)
        best, depths, rooms = inner_depths(x, own, self._part[rows])
        nodes, weights, _ = locate(body, _behind(x[own[best]], depths))
        return nodes, weights, rooms

    def find(self, surface: Surface, x_nodes, shapes: AnalyticObstacles) -> list[Inside]:
        """Return all containments. surface, shapes: as of the last search; x_nodes: field of the model's nodes [m]."""
        if not self._enabled:
            return []
        if not self._ready:
            self._prepare()
        nodes, lo, hi = download([x_nodes, surface.body_lo, surface.body_hi])
        x = surface.x.to_numpy() if len(self._triangles) or self._single else None
        if self._single:  # detection computes collider boxes only if two colliders have triangles
            lo, hi = x.min(axis=0, keepdims=True), x.max(axis=0, keepdims=True)
        frames = download([shapes.origin, shapes.rotation]) if self._round else None
        points = self._points(x, nodes, frames)
        boxed = (lo[self._solid] <= points[:, None]) & (points[:, None] <= hi[self._solid])
        boxed = boxed.all(axis=2) & self._testable
        found = []
        if boxed.any():
            x = surface.x.to_numpy()
            results = (self._test_point(int(k), int(self._solid[b]), points[k], x) for k, b in np.argwhere(boxed))
            found += [result for result in results if result is not None]
        for i, b, shape in self._round:
            depth = _round_depths(shape, (points[: self._inner.shape[0]] - frames[0][i]) @ frames[1][3 * i : 3 * i + 3])
            found += [Inside(int(self._owner[k]), b, float(depth[k]), float(self._room[k])) for k in np.flatnonzero(depth > 0.0)]
        return found

    def _points(self, x: np.ndarray | None, nodes: np.ndarray, frames: list[np.ndarray] | None) -> np.ndarray:
        """Return the inner points (n,3) [m] of bodies, of obstacles with triangles, and of round obstacles."""
        points = [self._inner @ nodes]
        if len(self._triangles):
            corners = x[self._topology.triangle[self._triangles]]
            if not np.array_equal(corners, self._corners):  # most obstacles are static
                self._corners, self._inner_points = corners, _behind(corners, self._inner_depth)
            points.append(self._inner_points)
        if frames is not None:
            points.append(frames[0][[i for i, _, _ in self._round]])
        return np.concatenate(points) if len(points) > 1 else points[0]

    def _test_point(self, k: int, b: int, point: np.ndarray, x: np.ndarray) -> Inside | None:
        """Test inner point k against collider b; None if it lies outside."""
        topology, own = self._topology, int(self._owner[k])
        vertices = x[topology.vertex_first[b] : topology.vertex_first[b + 1]]
        if (k, b) in self._separations:
            old_point, old_vertices, distance = self._separations[k, b]
            if np.sqrt(3.0) * np.abs(vertices - old_vertices - (point - old_point)).max() < distance:  # it cannot have entered
                return None
        first, last = topology.first[b : b + 2]
        corners = x[topology.triangle[first:last]]
        if own == b:
            corners = corners[self._part[first:last] != self._own_part[k]]
        distance = float(distances(corners, point[None])[0])
        if are_inside(corners, point[None])[0]:
            self._separations.pop((k, b), None)
            return Inside(own, b, distance, float(self._room[k]))
        self._separations[k, b] = point, vertices.copy(), distance
        return None


def _behind(corners: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Points (n,3) [m] at depths (n,) [m] behind the centroids of triangles (n,3,3) [m]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return corners.mean(axis=1) - depths[:, None] * normal


def _round_depths(shape: Sphere | Capsule, points: np.ndarray) -> np.ndarray:
    """Depths (n,) [m] of points (n,3) in a sphere or a capsule, in its frame; negative outside."""
    along = np.zeros(len(points))
    if isinstance(shape, Capsule):
        half_length = shape.size()[0]
        along = np.clip(points[:, 0], -half_length, half_length)
    return shape.radius - np.linalg.norm(points - along[:, None] * np.array([1.0, 0.0, 0.0]), axis=1)
