"""What lies under the cursor: the nearest surface triangle on its ray, and the nodes round that point by which it is pulled.

A pull acts on a patch, not on one triangle: its force is then spread over a mass that allows a strong spring, and does not
crush the tets at the point. The patch is measured at rest, so that it does not grow while the body is stretched.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.dynamics.drag_spring import EARTH
from taisoft.output.camera import Camera

PATCH = 0.1  # radius in units of the diagonal of the body's bounding box at rest
LEAST = 4  # nodes; with fewer in the patch the triangle's corners alone are pulled


@dataclass(frozen=True)
class Hit:
    """A point (3,) [m] on a body's surface: on the triangle of nodes (3,), with barycentric weights (3,)."""

    body: int
    nodes: np.ndarray
    weights: np.ndarray
    point: np.ndarray


def nearest_hit(origin: np.ndarray, direction: np.ndarray, x: np.ndarray, triangles: np.ndarray) -> tuple[int, np.ndarray] | None:
    """The triangle (of (t,3), vertices x (n,3)) that a ray from origin meets first, and the point's barycentric weights (3,).

    Both sides of a triangle count. None where nothing is met in front of the origin. Source: Moeller and Trumbore 1997.
    """
    a, b, c = (x[triangles[:, k]] for k in range(3))
    e, f = b - a, c - a
    p = np.cross(direction, f)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = 1.0 / np.einsum("ti,ti->t", e, p)
        s = origin - a
        u = np.einsum("ti,ti->t", s, p) * inverse
        q = np.cross(s, e)
        v = q @ direction * inverse
        far = np.einsum("ti,ti->t", f, q) * inverse
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0) & np.isfinite(far)
    if not met.any():
        return None
    t = int(np.argmin(np.where(met, far, np.inf)))
    return t, np.array([1 - u[t] - v[t], u[t], v[t]])


def pick(sim, camera: Camera, cursor: tuple[float, float], size: tuple[int, int]) -> Hit | None:
    """The point of a body under the cursor, which is in [0, 1] from the lower left corner of a window of size (width, height)."""
    direction, best, distance = camera.ray(cursor, size), None, np.inf
    for k, body in enumerate(sim.scene.bodies):
        x, surface = sim.positions(body.name), np.asarray(body.nodes.surface)
        found = nearest_hit(camera.position, direction, x, surface)
        if found is None:
            continue
        point = found[1] @ x[surface[found[0]]]
        away = float(np.linalg.norm(point - camera.position))
        if away < distance:
            best, distance = Hit(k, surface[found[0]], found[1], point), away
    return best


class MouseDrag:
    """A drag of what was hit: pulls it towards the cursor, in the plane through the point that is parallel to the picture."""

    def __init__(self, sim, hit: Hit):
        body = sim.scene.bodies[hit.body]
        self.body = body.name
        rest = np.asarray(body.rest_positions)
        self._diagonal = float(np.linalg.norm(rest.max(axis=0) - rest.min(axis=0)))
        self._mass = float(body.material.density * body.mesh.volumes.sum())
        self.nodes, self.weights = _patch(rest, hit, PATCH * self._diagonal)
        self._plane = hit.point
        self._offset = self.weights @ sim.positions(body.name)[self.nodes] - hit.point

    def drag(self, sim, camera: Camera, cursor: tuple[float, float], size: tuple[int, int], strength: float) -> None:
        """Towards the cursor, by so many weights of the body for a way as long as its bounding box's diagonal."""
        ray, forward = camera.ray(cursor, size), camera.forward
        self.target = camera.position + ray * ((self._plane - camera.position) @ forward / (ray @ forward))
        stiffness = strength * self._mass * EARTH / self._diagonal
        sim.drag(self.body, self.nodes, self.weights, self.target + self._offset, stiffness)

    def line(self, sim) -> np.ndarray:
        """From the point that is pulled to the cursor's, (2,3) [m]."""
        return np.array([self.weights @ sim.positions(self.body)[self.nodes] - self._offset, self.target])


def _patch(rest: np.ndarray, hit: Hit, radius: float) -> tuple[np.ndarray, np.ndarray]:
    near = np.linalg.norm(rest - hit.weights @ rest[hit.nodes], axis=1) / radius
    nodes = np.flatnonzero(near < 1.0)
    if len(nodes) < LEAST:
        return hit.nodes, hit.weights
    weights = (1.0 - near[nodes] ** 2) ** 2
    return nodes, weights / weights.sum()
