"""Where connections run, for pictures and USD: polylines of springs, tendons, and nodes of attachments by springs.

A point of a body is the sum of its tet's nodes times their weights; one of an obstacle moves with it.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from taisoft.errors import OutputError, SceneError, reworded
from taisoft.scene.body import Body
from taisoft.scene.connection_records import Attachment, Connection, Point
from taisoft.scene.connections import locate_nodes
from taisoft.scene.locate import locate

if TYPE_CHECKING:
    from taisoft.scene.scene import Scene


class ConnectionLines:
    """Polylines of some connections of a scene, each of points start[k] to start[k + 1].

    names: of the connections; lines: of each, a slice of its polylines.
    """

    def __init__(self, scene: "Scene", connections: list[Connection]):
        self._first, self._rows = scene.first_nodes, []
        self._n_nodes, self._scene = sum(body.n_nodes for body in scene.bodies), scene
        self._on_obstacles: dict[str, tuple[list[int], list[np.ndarray]]] = {}
        self.names, self.lines, counts = [one.name for one in connections], [], []
        for one in connections:
            added = self._add_attachment(one) if isinstance(one, Attachment) else [self._add_points(one.points)]
            self.lines.append(slice(len(counts), len(counts) + len(added)))
            counts += added
        self.start = np.cumsum([0, *counts])
        nodes, weights = zip(*self._rows) if self._rows else ((), ())
        indices = np.concatenate([np.zeros(0, dtype=np.int64), *nodes])
        start = np.cumsum([0, *map(len, nodes)])
        self._matrix = sp.csr_matrix((np.concatenate([np.zeros(0), *weights]), indices, start), (len(nodes), self._n_nodes))
        self._placed = [
            (obstacle := scene.obstacle(name), np.array(rows), obstacle.undisplaced(np.array(points)))
            for name, (rows, points) in self._on_obstacles.items()
        ]

    def _add_points(self, points: tuple[Point, ...]) -> int:
        for point in points:
            owner = self._scene.collider(point.owner)
            if isinstance(owner, Body):
                nodes, weights, _ = locate(owner, point.position[None])
                self._rows.append((self._first[owner.name] + nodes[0], weights[0]))
            else:
                self._add_on_obstacle(owner.name, point.position)
        return len(points)

    def _add_attachment(self, one: Attachment) -> list[int]:
        a, owner = self._scene.body(one.a), self._scene.collider(one.b)
        inside = locate_nodes(self._scene, one) if isinstance(owner, Body) else None
        for k, node in enumerate(one.nodes):
            self._rows.append((np.array([self._first[a.name] + node]), np.ones(1)))
            if inside is None:
                self._add_on_obstacle(owner.name, a.rest_positions[node] + a.position)
            else:
                self._rows.append((self._first[owner.name] + inside[0][k], inside[1][k]))
        return [2] * len(one.nodes)

    def _add_on_obstacle(self, name: str, position: np.ndarray) -> None:
        rows, points = self._on_obstacles.setdefault(name, ([], []))
        rows.append(len(self._rows))
        points.append(position)
        self._rows.append((np.zeros(0, dtype=np.int64), np.zeros(0)))

    def points(self, x: np.ndarray, t: float) -> np.ndarray:
        """All points (n,3) [m] of node positions x (n_nodes,3) at time t [s]. Raises OutputError if an obstacle's path fails."""
        points = self._matrix @ x
        with reworded(SceneError, raised=OutputError):
            for obstacle, rows, undisplaced in self._placed:
                points[rows] = obstacle.points_at(t, undisplaced)
        return points

    @property
    def segments(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices (k,2) of the ends of all segments, and the polyline (k,) of each."""
        line = np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))
        first = np.flatnonzero(line[1:] == line[:-1])
        return np.stack([first, first + 1], axis=1), line[first]

    def tensions(self, sim) -> np.ndarray:
        """Tension [N] of each polyline (m,) in sim's present state: of an attachment's nodes, the size of their forces."""
        found, total = sim.tensions(), np.zeros(len(self.start) - 1)
        for name, rows in zip(self.names, self.lines):
            total[rows] = found[name] if name in found else np.linalg.norm(sim.joint_force(name), axis=1)
        return total
