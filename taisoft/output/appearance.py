"""What viewers show of a scene beside its motion: colours of bodies, and triangle surfaces of obstacles.

Boxes and meshes keep their own surface; spheres and capsules are faceted. A half-space is shown as a square of its boundary
around the bodies, clipped at the other half-spaces so that the walls of a bin meet in its corners. A half-space with a path turns
about the centre of its square and moves along its normal; it neither clips others nor is clipped.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from taisoft.errors import OutputError, SceneError, reworded
from taisoft.output.viewpoint import clip_polygon, start_positions
from taisoft.scene.obstacles import Capsule, HalfSpace, Obstacle, Sphere

# sRGB; distinct hues of similar lightness, so that shading shows the shape
BODY_COLOURS = np.array(
    [(0.33, 0.56, 0.80), (0.90, 0.55, 0.27), (0.42, 0.68, 0.44), (0.80, 0.40, 0.42)]
    + [(0.58, 0.50, 0.76), (0.85, 0.73, 0.36), (0.36, 0.67, 0.68), (0.72, 0.53, 0.42)]
)
OBSTACLE_COLOUR = np.array([0.72, 0.72, 0.71])  # sRGB
HALF_SIDE = 1.2  # half the side of a half-space's square, in diagonals of the bodies' bounding box at the start
REFINEMENTS = 3  # times each triangle of the square is cut in four, so that shading varies over it
TINY = 1e-9  # relative to the square's half side: closer corners and boundaries count as on a boundary
AROUND, ALONG = 40, 10  # facets of spheres and capsules: around the axis, and from the equator to a pole


def body_colours(scene) -> list[np.ndarray]:
    """Return the sRGB colours (3,) in [0, 1] of all bodies: their own, else those of the palette, which repeats."""
    palette = (BODY_COLOURS[k % len(BODY_COLOURS)] for k in range(len(scene.bodies)))
    return [other if body.colour is None else body.colour for body, other in zip(scene.bodies, palette)]


def obstacle_colour(obstacle: Obstacle) -> np.ndarray:
    """Return the sRGB colour (3,) in [0, 1] of an obstacle."""
    return OBSTACLE_COLOUR if obstacle.colour is None else obstacle.colour


def linear_rgb(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB colours (..., 3) to linear Rec. 709, both in [0, 1] (IEC 61966-2-1)."""
    srgb = np.asarray(srgb, dtype=float)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def compact_surface(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renumber surface triangles by the nodes that they use.

    triangles: int (t,3) of nodes. Returns (nodes int (s,) ascending, local int (t,3)) with nodes[local] == triangles.
    """
    nodes, local = np.unique(np.asarray(triangles), return_inverse=True)
    return nodes, local.reshape(-1, 3)


def subdivide(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut every triangle in four at its edge midpoints, which are appended to the points.

    points: (n,3); triangles: (t,3). Returns the new points and triangles.
    """
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)  # of edges ab, bc, ca
    pairs, edge = np.unique(np.sort(ends.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    (a, b, c), (ab, bc, ca) = triangles.T, len(points) + edge.reshape(-1, 3).T
    cut = [np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return np.concatenate([points, points[pairs].mean(axis=1)]), np.concatenate(cut)


class ShownBodies:
    """What is shown of the bodies: the surface that touches, whose vertices are nodes, or a skin that only rides along.

    scene: a `taisoft.view.drawn.DrawnScene`; surfaces: (rest (v,3) [m], triangles (t,3)) of each body; starts: (n_bodies + 1,)
    its first shown vertex.
    """

    def __init__(self, scene):
        self.surfaces = [
            (body.rest_positions, body.surface) if body.weights is None else (body.vertices, body.triangles)
            for body in scene.bodies
        ]
        self.starts = np.cumsum([0, *(len(rest) for rest, _ in self.surfaces)])
        self.matrix: sp.csr_matrix | None = None  # (shown vertices, nodes); None: they are the same
        if any(body.weights is not None for body in scene.bodies):
            own = [sp.identity(body.n_nodes) if body.weights is None else body.weights for body in scene.bodies]
            self.matrix = sp.block_diag(own, format="csr")

    def of(self, values: np.ndarray) -> np.ndarray:
        """Return values (n_nodes, ...) of the bodies' nodes at their shown vertices."""
        return values if self.matrix is None else self.matrix @ values


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
        with reworded(SceneError, "an obstacle cannot be shown: ", raised=OutputError):
            return self.placed(*self.obstacle.pose(t))

    def placed(self, translation: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return the vertices (n,3) [m] of the obstacle at a pose."""
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
            others = [h for h in fixed if h is not shape] if o.path is None else []
            others = [h for h in others if not _duplicate(shape, h, surfaces, TINY * half_side)]
            surface = _square(shape, middle, half_side, others)
        elif isinstance(shape, (Sphere, Capsule)):
            half_length = shape.size()[0] if isinstance(shape, Capsule) else 0.0
            local, triangles = capsule(half_length, shape.radius)
            surface = local @ shape.frame().T + shape.pivot, triangles
        else:
            vertices, triangles = shape.surface()
            used, triangles = compact_surface(triangles)
            surface = vertices[used], triangles
        surfaces.append(ObstacleSurface(o, *surface))
    return surfaces


def _duplicate(shape: HalfSpace, other: HalfSpace, surfaces: list[ObstacleSurface], tiny: float) -> bool:
    """Return whether another half-space has the same boundary and comes later; only the first of such is shown."""
    close = shape.normal @ other.normal > 1.0 - TINY and abs((shape.point - other.point) @ shape.normal) <= tiny
    return bool(close) and not any(one.obstacle.shape is other for one in surfaces)


def _square(shape: HalfSpace, middle: np.ndarray, half_side: float, others: list[HalfSpace]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of the square around the boundary point nearest to `middle`, clipped at other half-spaces."""
    z, n, x = shape.frame().T
    at = middle - ((middle - shape.point) @ n) * n
    corners = np.array([at + half_side * (a * z + b * x) for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))])
    for other in others:
        height = (corners - other.point) @ other.normal
        height[np.abs(height) <= TINY * half_side] = 0.0
        corners = clip_polygon(np.column_stack([height, corners]))[:, 1:] if height.max(initial=0.0) > 0.0 else corners[:0]
    if len(corners) < 3:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    points = np.concatenate([corners.mean(axis=0)[None], corners])
    k = np.arange(1, len(points))
    triangles = np.stack([np.zeros_like(k), k, np.roll(k, -1)], axis=1)
    for _ in range(REFINEMENTS):
        points, triangles = subdivide(points, triangles)
    return points, triangles


def capsule(half_length: float, radius: float, around: int = AROUND, along: int = ALONG) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a capsule along x about the origin; a sphere if half_length is 0.

    around, along: facets around its axis, and from the equator to a pole.
    """
    latitude = np.linspace(0.0, np.pi / 2, along + 1)[:-1]
    lower = np.stack([-half_length - radius * np.sin(latitude), radius * np.cos(latitude)], axis=1)[::-1]
    upper = np.stack([half_length + radius * np.sin(latitude), radius * np.cos(latitude)], axis=1)
    rings = np.concatenate([lower, upper if half_length > 0 else upper[1:]])  # coordinate along x, distance from the axis
    angle = np.linspace(0.0, 2 * np.pi, around, endpoint=False)
    x = np.stack(np.broadcast_arrays(rings[:, :1], rings[:, 1:] * np.cos(angle), rings[:, 1:] * np.sin(angle)), axis=2)
    points = np.concatenate([x.reshape(-1, 3), [[-half_length - radius, 0, 0], [half_length + radius, 0, 0]]])
    k, following = np.arange(around), np.roll(np.arange(around), -1)
    top, pole = around * (len(rings) - 1), np.full(around, around * len(rings))
    corners = []
    for a in range(0, top, around):
        b = a + around
        corners += [(a + k, a + following, b + k), (b + k, a + following, b + following)]
    corners += [(pole, following, k), (pole + 1, top + k, top + following)]
    return points, np.array(corners).transpose(0, 2, 1).reshape(-1, 3)
