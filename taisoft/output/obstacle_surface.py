"""Obstacles as triangles, for pictures and for USD.

Boxes and meshes are their own surface, spheres and capsules are faceted. Of a half-space's boundary a square about the bodies is
shown, cut off where another half-space begins, so that the walls of a bin meet in its corners. With a path it turns about its
own middle and moves along its normal, and neither cuts nor is cut.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.errors import OutputError, SceneError
from taisoft.output.appearance import compact_surface, start_positions
from taisoft.output.polygons import cut_in_four, cut_off
from taisoft.scene.obstacles import Capsule, HalfSpace, Obstacle, Sphere

REACH = 1.2  # half the side of the square of a half-space, in diagonals of the box about the bodies at the start
CUTS = 3  # times that each triangle of it is cut in four, so that light changes over it
TINY = 1e-9  # of that square: a corner nearer to another boundary lies on it
AROUND, ALONG = 40, 10  # facets of what is round: about its axis, and from there to a pole


@dataclass(frozen=True, eq=False)
class ObstacleSurface:
    """vertices: (n,3) [m], of the obstacle as it was given; triangles: (t,3) int, normals out of the solid."""

    obstacle: Obstacle
    vertices: np.ndarray
    triangles: np.ndarray

    def at(self, t: float) -> np.ndarray:
        """Vertices (n,3) [m] at time t [s]. Raises OutputError where the obstacle's path fails."""
        try:
            translation, rotation = self.obstacle.pose(t)
        except SceneError as error:
            raise OutputError(f"what is shown of an obstacle has no place: {error}") from error
        shape = self.obstacle.shape
        pivot, at = shape.pivot, shape.pivot + translation
        if isinstance(shape, HalfSpace) and self.obstacle.path is not None:
            pivot, normal = self.vertices.mean(axis=0), rotation @ shape.normal
            at = pivot - ((pivot - at) @ normal) * normal
        return (self.vertices - pivot) @ rotation.T + at


def obstacle_surfaces(scene) -> list[ObstacleSurface]:
    """Of all obstacles of a scene, in the order added."""
    x = start_positions(scene)
    middle, reach = (x.min(axis=0) + x.max(axis=0)) / 2, REACH * float(np.linalg.norm(np.ptp(x, axis=0)))
    flat = [o.shape for o in scene.obstacles if isinstance(o.shape, HalfSpace) and o.path is None]
    made = []
    for o in scene.obstacles:
        shape = o.shape
        if isinstance(shape, HalfSpace):
            cuts = [other for other in flat if other is not shape and not _same(shape, other, made)] if o.path is None else []
            surface = _patch(shape, middle, reach, cuts)
        elif isinstance(shape, (Sphere, Capsule)):
            half = shape.size()[0] if isinstance(shape, Capsule) else 0.0
            local, triangles = _round(half, shape.radius)
            surface = local @ shape.frame().T + shape.pivot, triangles
        else:
            vertices, triangles = shape.surface()
            used, triangles = compact_surface(triangles)
            surface = vertices[used], triangles
        made.append(ObstacleSurface(o, *surface))
    return made


def _same(shape: HalfSpace, other: HalfSpace, made: list[ObstacleSurface]) -> bool:
    """Whether another half-space has the same boundary and comes later: the first of such is shown."""
    close = shape.normal @ other.normal > 1.0 - TINY and abs((shape.point - other.point) @ shape.normal) <= TINY
    return bool(close) and not any(one.obstacle.shape is other for one in made)


def _patch(shape: HalfSpace, middle: np.ndarray, reach: float, cuts: list[HalfSpace]) -> tuple[np.ndarray, np.ndarray]:
    """The square of half a side `reach` about the point nearest to `middle`, without what lies in the other half-spaces."""
    z, n, x = shape.frame().T
    at = middle - ((middle - shape.point) @ n) * n
    corners = np.array([at + reach * (a * z + b * x) for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))])
    for other in cuts:
        corners = _clipped(corners, other, TINY * reach)
    if len(corners) < 3:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    points = np.concatenate([corners.mean(axis=0)[None], corners])
    k = np.arange(1, len(points))
    triangles = np.stack([np.zeros_like(k), k, np.roll(k, -1)], axis=1)
    for _ in range(CUTS):
        points, triangles = cut_in_four(points, triangles)
    return points, triangles


def _clipped(corners: np.ndarray, other: HalfSpace, tiny: float) -> np.ndarray:
    """The convex polygon's part outside of a half-space. tiny: [m] from its boundary a corner is on it."""
    height = (corners - other.point) @ other.normal
    height[np.abs(height) <= tiny] = 0.0
    if height.max(initial=0.0) <= 0.0:
        return corners[:0]
    return cut_off(np.column_stack([height, corners]))[:, 1:]


def _round(half: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """A capsule along x about the origin; with half a length of 0 a sphere."""
    up = np.linspace(0.0, np.pi / 2, ALONG + 1)[:-1]
    lower = np.stack([-half - radius * np.sin(up), radius * np.cos(up)], axis=1)[::-1]
    upper = np.stack([half + radius * np.sin(up), radius * np.cos(up)], axis=1)
    rings = np.concatenate([lower, upper if half > 0 else upper[1:]])  # place along x, distance from it
    turn = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
    x = np.stack(np.broadcast_arrays(rings[:, :1], rings[:, 1:] * np.cos(turn), rings[:, 1:] * np.sin(turn)), axis=2)
    points = np.concatenate([x.reshape(-1, 3), [[-half - radius, 0, 0], [half + radius, 0, 0]]])
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
