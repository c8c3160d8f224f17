"""Triangle surfaces of obstacles, for pictures and USD.

Boxes and meshes keep their own surface; spheres and capsules are faceted. A half-space is shown as a square of its boundary
around the bodies, clipped at the other half-spaces so that the walls of a bin meet in its corners. A half-space with a path turns
about the centre of its square and moves along its normal; it neither clips others nor is clipped.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.errors import OutputError, SceneError
from taisoft.output.appearance import compact_surface, start_positions
from taisoft.output.polygons import clip_polygon, subdivide
from taisoft.scene.obstacles import Capsule, HalfSpace, Obstacle, Sphere

HALF_SIDE = 1.2  # half the side of a half-space's square, in diagonals of the bodies' bounding box at the start
REFINEMENTS = 3  # times each triangle of the square is cut in four, so that shading varies over it
TINY = 1e-9  # relative to the square's half side: a corner closer to another boundary counts as on it
AROUND, ALONG = 40, 10  # facets of spheres and capsules: around the axis, and from the equator to a pole


@dataclass(frozen=True, eq=False)
class ObstacleSurface:
    """Triangle surface of an obstacle.

    vertices: (n,3) [m], of the obstacle before its path moves it; triangles: (t,3) int, normals out of the solid.
    """

    obstacle: Obstacle
    vertices: np.ndarray
    triangles: np.ndarray

    def at(self, t: float) -> np.ndarray:
        """Return the vertices (n,3) [m] at time t [s]. Raises OutputError if the obstacle's path fails."""
        try:
            translation, rotation = self.obstacle.pose(t)
        except SceneError as error:
            raise OutputError(f"an obstacle cannot be shown: {error}") from error
        shape = self.obstacle.shape
        pivot, at = shape.pivot, shape.pivot + translation
        if isinstance(shape, HalfSpace) and self.obstacle.path is not None:
            pivot, normal = self.vertices.mean(axis=0), rotation @ shape.normal
            at = pivot - ((pivot - at) @ normal) * normal
        return (self.vertices - pivot) @ rotation.T + at


def obstacle_surfaces(scene) -> list[ObstacleSurface]:
    """Return the surfaces of all obstacles of a scene, in the order added."""
    x = start_positions(scene)
    middle, half_side = (x.min(axis=0) + x.max(axis=0)) / 2, HALF_SIDE * float(np.linalg.norm(np.ptp(x, axis=0)))
    fixed = [o.shape for o in scene.obstacles if isinstance(o.shape, HalfSpace) and o.path is None]
    surfaces = []
    for o in scene.obstacles:
        shape = o.shape
        if isinstance(shape, HalfSpace):
            others = [h for h in fixed if h is not shape and not _duplicate(shape, h, surfaces)] if o.path is None else []
            surface = _square(shape, middle, half_side, others)
        elif isinstance(shape, (Sphere, Capsule)):
            half_length = shape.size()[0] if isinstance(shape, Capsule) else 0.0
            local, triangles = _capsule(half_length, shape.radius)
            surface = local @ shape.frame().T + shape.pivot, triangles
        else:
            vertices, triangles = shape.surface()
            used, triangles = compact_surface(triangles)
            surface = vertices[used], triangles
        surfaces.append(ObstacleSurface(o, *surface))
    return surfaces


def _duplicate(shape: HalfSpace, other: HalfSpace, surfaces: list[ObstacleSurface]) -> bool:
    """Return whether another half-space has the same boundary and comes later; only the first of such is shown."""
    close = shape.normal @ other.normal > 1.0 - TINY and abs((shape.point - other.point) @ shape.normal) <= TINY
    return bool(close) and not any(one.obstacle.shape is other for one in surfaces)


def _square(shape: HalfSpace, middle: np.ndarray, half_side: float, others: list[HalfSpace]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of the square around the boundary point nearest to `middle`, clipped at other half-spaces."""
    z, n, x = shape.frame().T
    at = middle - ((middle - shape.point) @ n) * n
    corners = np.array([at + half_side * (a * z + b * x) for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))])
    for other in others:
        corners = _clipped(corners, other, TINY * half_side)
    if len(corners) < 3:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    points = np.concatenate([corners.mean(axis=0)[None], corners])
    k = np.arange(1, len(points))
    triangles = np.stack([np.zeros_like(k), k, np.roll(k, -1)], axis=1)
    for _ in range(REFINEMENTS):
        points, triangles = subdivide(points, triangles)
    return points, triangles


def _clipped(corners: np.ndarray, other: HalfSpace, tiny: float) -> np.ndarray:
    """Clip a convex polygon to the outside of a half-space. tiny: a corner this close to its boundary counts as on it [m]."""
    height = (corners - other.point) @ other.normal
    height[np.abs(height) <= tiny] = 0.0
    if height.max(initial=0.0) <= 0.0:
        return corners[:0]
    return clip_polygon(np.column_stack([height, corners]))[:, 1:]


def _capsule(half_length: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a capsule along x about the origin; a sphere if half_length is 0."""
    latitude = np.linspace(0.0, np.pi / 2, ALONG + 1)[:-1]
    lower = np.stack([-half_length - radius * np.sin(latitude), radius * np.cos(latitude)], axis=1)[::-1]
    upper = np.stack([half_length + radius * np.sin(latitude), radius * np.cos(latitude)], axis=1)
    rings = np.concatenate([lower, upper if half_length > 0 else upper[1:]])  # coordinate along x, distance from the axis
    angle = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
    x = np.stack(np.broadcast_arrays(rings[:, :1], rings[:, 1:] * np.cos(angle), rings[:, 1:] * np.sin(angle)), axis=2)
    points = np.concatenate([x.reshape(-1, 3), [[-half_length - radius, 0, 0], [half_length + radius, 0, 0]]])
    k, following = np.arange(AROUND), np.roll(np.arange(AROUND), -1)
    triangles = []
    for ring in range(len(rings) - 1):
        a, b = AROUND * ring, AROUND * (ring + 1)
        triangles += [np.stack(t, axis=1) for t in ((a + k, a + following, b + k), (b + k, a + following, b + following))]
    first, last = len(points) - 2, len(points) - 1
    top = AROUND * (len(rings) - 1)
    triangles += [np.stack([np.full(AROUND, first), following, k], axis=1)]
    triangles += [np.stack([np.full(AROUND, last), top + k, top + following], axis=1)]
    return points, np.concatenate(triangles)
