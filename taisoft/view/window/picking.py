"""Dragging a body with the mouse: the point under the cursor, and the spring's end that follows the cursor.

What is drawn is picked: the body's surface, or the skin that rides in its tets, whose points are sums of the tets' nodes.

A drag acts on a patch of nodes around the nearest point on the cursor's ray, rather than on the triangle hit. So its force is
spread over enough mass for a stiff spring, and does not crush the tets at the point. The patch is measured at rest, so that it
does not grow while the body is stretched.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.mesh.distances import ray_hits
from taisoft.output.viewpoint import Viewpoint
from taisoft.view.drawn import DrawnState

PATCH = 0.1  # radius in units of the diagonal of the body's bounding box at rest
MIN_NODES = 4  # with fewer nodes in the patch, only those that carry the point are dragged


@dataclass(frozen=True)
class Hit:
    """A point (3,) [m] on what is drawn of a body: the sum of nodes (k,), by weights (k,) of sum 1.

    Those are a triangle's corners with barycentric weights, or, below a skin, the nodes of the tets that carry the corners.
    """

    body: int
    nodes: np.ndarray
    weights: np.ndarray
    point: np.ndarray


def pick(state: DrawnState, camera: Viewpoint, cursor: tuple[float, float], size: tuple[int, int]) -> Hit | None:
    """Return the point of a body under the cursor, or None.

    cursor: in [0, 1] from the window's lower left corner; size: (width, height) of the window.
    """
    direction, best, distance = camera.ray(cursor, size), None, np.inf
    for k, body in enumerate(state.scene.bodies):
        skin, x = body.weights, state.positions(body.name)
        shown, triangles = (x, body.surface) if skin is None else (skin @ x, body.triangles)
        along, u, v = ray_hits(shown[triangles], camera.position, direction)
        t = int(np.argmin(along))
        if np.isinf(along[t]):
            continue
        corners, weights = triangles[t], np.array([1.0 - u[t] - v[t], u[t], v[t]])
        point = weights @ shown[corners]
        depth = float(np.linalg.norm(point - camera.position))
        if depth < distance:
            best, distance = Hit(k, *_carriers(skin, corners, weights), point), depth
    return best


def _carriers(skin, corners: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes (k,) and weights (k,) of a point, given by those of a drawn triangle's corners; skin: its weights, or None."""
    if skin is None:
        return corners, weights
    of_nodes = weights @ skin[corners].toarray()
    nodes = np.flatnonzero(of_nodes)
    return nodes, of_nodes[nodes]


class MouseDrag:
    """A mouse drag of a hit point towards the cursor, in the plane through the point that is parallel to the picture.

    body: its name; nodes (k,) with weights (k,) of sum 1: what is dragged; target: where the cursor holds it (3,) [m].
    """

    def __init__(self, state: DrawnState, hit: Hit):
        body = state.scene.bodies[hit.body]
        self.body = body.name
        rest = np.asarray(body.rest_positions)
        diagonal = float(np.linalg.norm(rest.max(axis=0) - rest.min(axis=0)))
        self.nodes, self.weights = _patch(rest, hit, PATCH * diagonal)
        self._plane = hit.point
        self._offset = self._point(state) - hit.point
        self.target = hit.point + self._offset

    def move(self, camera: Viewpoint, cursor: tuple[float, float], size: tuple[int, int]) -> bool:
        """Move the target with the cursor; return whether it changed."""
        before, ray, forward = self.target, camera.ray(cursor, size), camera.forward
        on_plane = camera.position + ray * ((self._plane - camera.position) @ forward / (ray @ forward))
        self.target = on_plane + self._offset
        return not np.array_equal(before, self.target)

    def line(self, state: DrawnState) -> np.ndarray:
        """Return the line from the dragged point to the cursor's, (2,3) [m]."""
        return np.array([self._point(state), self.target]) - self._offset

    def _point(self, state: DrawnState) -> np.ndarray:
        return self.weights @ state.positions(self.body)[self.nodes]


def _patch(rest: np.ndarray, hit: Hit, radius: float) -> tuple[np.ndarray, np.ndarray]:
    distance = np.linalg.norm(rest - hit.weights @ rest[hit.nodes], axis=1) / radius
    nodes = np.flatnonzero(distance < 1.0)
    if len(nodes) >= MIN_NODES:
        weights = (1.0 - distance[nodes] ** 2) ** 2
    else:  # weights of a skin's point outside of its tet, or in one of second order, may be negative
        nodes, weights = hit.nodes[hit.weights > 0.0], hit.weights[hit.weights > 0.0]
    return nodes, weights / weights.sum()
