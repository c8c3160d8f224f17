"""Where connections run, for pictures and USD: polylines of springs, tendons, and nodes of attachments by springs.

A point of a body is the sum of its tet's nodes times their weights; one of an obstacle moves with it.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from taisoft.errors import OutputError, SceneError, reworded
from taisoft.scene.connection_records import Connection
from taisoft.scene.connections import End, lines_of

if TYPE_CHECKING:
    from taisoft.scene.scene import Scene


class ConnectionLines:
    """Polylines of some connections of a scene, each of points start[k] to start[k + 1].

    names: of the connections; lines: of each, a slice of its polylines.
    """

    def __init__(self, scene: "Scene", connections: list[Connection]):
        self.names, lines = [one.name for one in connections], [lines_of(scene, one) for one in connections]
        first = np.cumsum([0, *map(len, lines)])
        self.lines = [slice(*pair) for pair in zip(first, first[1:])]
        lines = [line for of_one in lines for line in of_one]
        self.start, ends = np.cumsum([0, *map(len, lines)]), [end for line in lines for end in line]
        nodes, weights = (np.concatenate([End()[k], *(end[k] for end in ends)]) for k in (0, 1))
        shape = len(ends), sum(body.n_nodes for body in scene.bodies)
        self._matrix = sp.csr_matrix((weights, nodes, np.cumsum([0, *(len(end.nodes) for end in ends)])), shape)
        self._placed = []
        for obstacle in {end.obstacle.name: end.obstacle for end in ends if end.obstacle is not None}.values():
            rows = np.array([row for row, end in enumerate(ends) if end.obstacle is obstacle])
            self._placed.append((obstacle, rows, obstacle.undisplaced(np.array([ends[row].point for row in rows]))))

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
