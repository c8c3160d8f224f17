"""A perspective camera aimed at a target point: framing, orbiting, projection, and clipping of triangles and lines."""

import itertools
import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from taisoft.mesh.placing import FROM_Y_UP
from taisoft.scene.key_frames import ShapePath
from taisoft.scene.obstacles import Capsule, HalfSpace, Sphere

MAX_ELEVATION = 89.0  # [deg]; at 90 "up" is undefined
FILL = 0.8  # fraction of the picture's width or height, whichever is reached first, that what is framed fills at the start
BORDER = 0.06  # fraction of the picture, both sides together, kept free when the camera moves back from moving bodies
AROUND = 1.0  # obstacles wholly within this of the bodies are framed, in diagonals of all bodies
EDGE = 0.35  # of larger obstacles, such as a table, what lies within this of the bodies
POSES = 5  # of an obstacle that key frames move, at which it is framed
MAX_FALL = 3.0  # the part of a body's fall that is framed at the start, over the diagonal of all bodies
MAX_WIDENING = 4.0  # largest distance over the first one; a body that flies away finally leaves the picture
LEAST_SLOPE = 0.1  # cosine between a ground's normal and the vertical; a steeper half-space is a wall
WHOLE = (0.0, 0.0, 1.0, 1.0)  # left, bottom, right and top of a picture, of which a part may be free
DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])  # (26,3); unit vectors from here on
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
NEAR, FAR = 0.02, 50.0  # clipping planes in units of the distance to the target


def start_positions(scene) -> np.ndarray:
    """Return the initial positions of the nodes of all bodies, (n,3) [m]."""
    return np.concatenate([body.rest_positions + body.position for body in scene.bodies])


def framed_points(scene) -> np.ndarray:
    """Return what a picture shows from the start on, (n,3) [m]: bodies, where those that fall land, and obstacles near them.

    A body falls if it has no constraint and no connection; it lands on the first half-space at rest below it. Half-spaces are
    not framed. Obstacles with key frames are framed at POSES of their way.
    """
    starts, connected = start_positions(scene), {name for one in scene.connections for name in one.owners}
    diagonal = float(np.linalg.norm(np.ptp(starts, axis=0)))
    falling = [body for body in scene.bodies if not scene.constraints(body) and body.name not in connected]
    landed = (_landed(scene, body.rest_positions + body.position, MAX_FALL * diagonal) for body in falling)
    bodies = np.concatenate([starts, *landed])
    low, high, framed = bodies.min(axis=0), bodies.max(axis=0), [bodies]
    for obstacle in (o for o in scene.obstacles if not isinstance(o.shape, HalfSpace)):
        end = obstacle.path.frames.times[-1] if isinstance(obstacle.path, ShapePath) else 0.0
        for t in np.linspace(0.0, end, POSES) if end > 0.0 else (0.0,):
            x = obstacle.points_at(t, _outline(obstacle.shape))
            is_near = np.maximum(low - x, x - high).max() <= AROUND * diagonal
            margin = (AROUND if is_near else EDGE) * diagonal
            if (x.max(axis=0) >= low - margin).all() and (x.min(axis=0) <= high + margin).all():
                framed.append(np.clip(x, low - margin, high + margin))
    return np.concatenate(framed)


def _outline(shape) -> np.ndarray:
    """Return points (n,3) [m] on a shape that span it: vertices, or those of round shapes along DIRECTIONS."""
    if not isinstance(shape, (Sphere, Capsule)):
        return shape.surface()[0]
    ends = (shape.a, shape.b) if isinstance(shape, Capsule) else (shape.center,)
    return np.concatenate([end + shape.radius * DIRECTIONS for end in ends])


def _landed(scene, x: np.ndarray, longest: float) -> np.ndarray:
    """Return points (n,3) [m] after a fall along gravity of at most `longest` [m]; none if there is no ground below."""
    strength, depths = float(np.linalg.norm(scene.gravity)), []
    for shape in (o.shape for o in scene.obstacles if isinstance(o.shape, HalfSpace) and o.path is None):
        steepness = -float(shape.normal @ scene.gravity) / strength if strength > 0.0 else 0.0
        if steepness > LEAST_SLOPE:
            depths.append(float(((x - shape.point) @ shape.normal).min()) / steepness)
    if not depths or min(depths) <= 0.0:
        return np.empty((0, 3))
    return x + min(*depths, longest) / strength * np.asarray(scene.gravity)


def camera_viewpoint(scene, t: float, x: np.ndarray) -> "Viewpoint | None":
    """Return where the scene's own camera is at time t [s], with all nodes at x (n,3) [m]; None without a camera."""
    if scene.camera is None:
        return None
    at, first = scene.camera.at(t, scene.up), 0
    for body in scene.bodies:
        if body.name == scene.camera.follow:
            moved = x[first : first + body.n_nodes] - (body.rest_positions + body.position)
            moved = moved[np.isfinite(moved).all(axis=1)]
            at["target"] = at["target"] + (moved.mean(axis=0) if len(moved) else 0.0)
        first += body.n_nodes
    return Viewpoint(**at)


def clip_polygon(polygon: np.ndarray) -> np.ndarray:
    """Clip a convex polygon to the side of a plane where the height is not negative (Sutherland and Hodgman 1974).

    polygon: (n,m), one row per corner; the first column is the height above the plane; all columns are interpolated.
    """
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0)):
        if a[0] >= 0:
            kept.append(a)
        if a[0] * b[0] < 0:
            kept.append(a + a[0] / (a[0] - b[0]) * (b - a))
    return np.array(kept).reshape(-1, polygon.shape[1])


@dataclass(frozen=True)
class Viewpoint:
    """A camera aimed at target (3,) [m] from a distance [m].

    azimuth [deg] about up: 0 looks along -z (with z up: +y), 90 along -x; elevation [deg] above the horizon; fov [deg]: vertical
    field of view; up: axis that points up, "y" or "z"; shift: how far the target is right of and above the picture's
    middle, over the depth.
    """

    target: np.ndarray = field(default_factory=lambda: np.zeros(3))
    distance: float = 5.0
    azimuth: float = 32.0
    elevation: float = 20.0
    fov: float = 30.0
    up: str = "y"
    shift: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def framing(cls, points: np.ndarray, size: tuple[int, int] = (16, 9), free: tuple = WHOLE, **angles) -> "Viewpoint":
        """Return the nearest camera for which points (n,3) lie within FILL of the free part of the picture.

        size: width and height of the picture, in any unit; free: left, bottom, right and top of the part, as fractions. The
        target is in its middle, as deep as the middle of the points.
        """
        middle = (np.min(points, axis=0) + np.max(points, axis=0)) / 2
        camera = cls(target=middle, **angles)
        local, (aim, half) = (points - middle) @ camera.axes.T, camera._slopes(free, size, FILL)
        x, depth = local[:, :2], local[:, 2:]
        # points beside the target that the eye sees within aim +- half: |x - target - aim * depth| <= half * (depth + distance)
        low, high = (x - (aim + half) * depth).max(axis=0), (x - (aim - half) * depth).min(axis=0)
        distance = max(*((low - high) / (2.0 * half)), 1e-9)  # of a single point: above 0
        return replace(camera, target=middle + (low + high) / 2 @ camera.axes[:2], distance=float(distance), shift=tuple(aim))

    @property
    def position(self) -> np.ndarray:
        """Position of the eye (3,) [m]."""
        return self.target - self.distance * (self.forward + np.array(self.shift) @ self.axes[:2])

    @cached_property
    def forward(self) -> np.ndarray:
        """Unit vector (3,) from the eye to the target."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        level = math.cos(elevation)
        return -FROM_Y_UP[self.up] @ np.array([math.sin(azimuth) * level, math.sin(elevation), math.cos(azimuth) * level])

    @cached_property
    def axes(self) -> np.ndarray:
        """Orthonormal axes of the picture (3,3), rows right, up, forward."""
        azimuth = math.radians(self.azimuth)  # from straight above, "up" gives no direction
        right = FROM_Y_UP[self.up] @ np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
        return np.array([right, np.cross(right, self.forward), self.forward])

    @property
    def slope(self) -> float:
        """Half the height of the picture over the depth."""
        return math.tan(math.radians(self.fov) / 2)

    @property
    def clipping(self) -> tuple[float, float]:
        """Distances of the near and the far clipping plane [m]."""
        return NEAR * self.distance, FAR * self.distance

    def widened(self, points: np.ndarray, size: tuple[int, int], limit: float, free: tuple = WHOLE) -> "Viewpoint":
        """Return the camera moved back, to limit [m] at most, until points (n,3) lie within the free part less BORDER.

        size, free: as for `framing`. The target moves towards what left, only so far that all that was seen stays in view: the
        camera depends on where it is alone. It never moves nearer; points that are not finite are ignored.
        """
        aim, half = self._slopes(free, size, 1.0 - BORDER)
        if limit <= self.distance:
            return replace(self, shift=tuple(aim))
        local = (points - self.target) @ self.axes.T
        local = local[np.isfinite(local).all(axis=1)]
        x, depth, seen = local[:, :2], local[:, 2:], half * self.distance
        low, high = (
            (x - (aim + half) * depth).max(axis=0, initial=-np.inf),
            (x - (aim - half) * depth).min(axis=0, initial=np.inf),
        )
        low, high = np.maximum(low, seen), np.minimum(high, -seen)
        distance = max(self.distance, min(float(((low - high) / (2.0 * half)).max()), limit))
        room = half * (distance - self.distance)
        moved = np.clip((low + high) / 2, -room, room)
        target = self.target + moved @ self.axes[:2] if moved.any() else self.target
        return replace(self, target=target, distance=distance, shift=tuple(aim))

    def _slopes(self, free: tuple, size: tuple[int, int], fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the middle of a free part, as `shift`, and half of a fraction of its width and height, (2,) over the depth."""
        low, high = 2.0 * self.slope * (np.reshape(free, (2, 2)) - 0.5) * (size[0] / size[1], 1.0)
        return (low + high) / 2, fraction * (high - low) / 2

    def clipped(self, x: np.ndarray, triangles: np.ndarray, attributes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Clip vertices x (n,3) [m], triangles (t,3) and attributes (n,k) at the near plane.

        New vertices follow the given ones; triangles that are not finite are dropped.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            inside = (x - self.position) @ self.forward - self.clipping[0] * (1.0 + 1e-6)
            outside = ~((inside > 0.0) & np.isfinite(x).all(axis=1))
        if not outside.any():
            return x, triangles, attributes
        touched = outside[triangles].any(axis=1)
        whole, cut = triangles[~touched], triangles[touched]
        crossing = (inside[cut] > 0.0).any(axis=1) & np.isfinite(x[cut]).all(axis=(1, 2))
        faces, points = [], []
        for corners in cut[crossing]:
            polygon = clip_polygon(np.column_stack([inside[corners], x[corners], attributes[corners]]))
            first = len(x) + len(points)
            faces += [(first, first + k, first + k + 1) for k in range(1, len(polygon) - 1)]
            points += list(polygon[:, 1:])
        if not faces:
            return x, whole, attributes
        new = np.array(points)
        attributes = np.concatenate([attributes, new[:, 3:]])
        return np.concatenate([x, new[:, :3]]), np.concatenate([whole, faces]), attributes

    def clipped_lines(self, ends: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Clip lines, ends (2k,3) [m] and colours (2k,3), at the near plane; lines that are not finite are dropped."""
        lines = np.concatenate([ends, colours], axis=1).reshape(-1, 2, 6)
        height = ((ends - self.position) @ self.forward - self.clipping[0] * (1.0 + 1e-6)).reshape(-1, 2)
        with np.errstate(invalid="ignore"):
            kept = np.isfinite(ends).reshape(-1, 6).all(axis=1) & (height.max(axis=1) > 0)
        lines, height = lines[kept], height[kept]
        crossing = np.flatnonzero(height.min(axis=1) < 0)
        a, b = lines[crossing].transpose(1, 0, 2)
        h, behind = height[crossing], height[crossing].argmin(axis=1)
        lines[crossing, behind] = a + (h[:, 0] / (h[:, 0] - h[:, 1]))[:, None] * (b - a)
        return lines[..., :3].reshape(-1, 3), lines[..., 3:].reshape(-1, 3)

    def orbit(self, azimuth: float, elevation: float) -> "Viewpoint":
        """Return the camera turned about the target by angles [deg]; elevation is limited to MAX_ELEVATION."""
        raised = min(max(self.elevation + elevation, -MAX_ELEVATION), MAX_ELEVATION)
        return replace(self, azimuth=(self.azimuth + azimuth) % 360.0, elevation=raised)

    def zoom(self, factor: float) -> "Viewpoint":
        """Return the camera with its distance multiplied by factor."""
        return replace(self, distance=self.distance * factor)

    def pan(self, right: float, up: float) -> "Viewpoint":
        """Return the camera moved in the picture's plane, in units of the picture's height at the target."""
        height = 2 * self.distance * self.slope
        return replace(self, target=self.target + height * (right * self.axes[0] + up * self.axes[1]))

    def ray(self, at: tuple[float, float], size: tuple[int, int]) -> np.ndarray:
        """Return the unit vector (3,) from the eye through a point of the picture, in [0, 1] from its lower left corner.

        size: width and height of the picture, in any unit.
        """
        half = self.slope
        right, up = half * (2 * at[0] - 1) * size[0] / size[1], half * (2 * at[1] - 1)
        direction = np.array([right, up, 1.0]) @ self.axes
        return direction / np.linalg.norm(direction)

    def nearer(self, points: np.ndarray, fraction: float) -> np.ndarray:
        """Move points (n,3) along their rays to a fraction of their distance from the eye; they stay on their pixels."""
        return self.position + fraction * (points - self.position)

    def project(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Return pixel coordinates (from the left, from the top) and depth along the view [m] of points (n,3): (n,3).

        size: width and height in pixels. A point at or behind the eye has depth <= 0 and no meaningful pixel.
        """
        width, height = size
        local = (np.asarray(points) - self.position) @ self.axes.T
        focal = height / 2 / self.slope
        depth = local[:, 2]
        scale = focal / np.where(depth > 0, depth, np.inf)
        return np.column_stack([width / 2 + scale * local[:, 0], height / 2 - scale * local[:, 1], depth])
