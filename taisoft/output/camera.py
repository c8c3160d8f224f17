"""A perspective camera that looks at a point from a direction: framing, orbiting, projecting."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from taisoft.output.polygons import cut_off

UP = np.array([0.0, 1.0, 0.0])
MAX_ELEVATION = 89.0  # [deg]; at 90 "up" is no longer defined
FILL = 0.62  # of the picture's width or height, whichever is reached first, that the bodies take at the start
BORDER = 0.06  # of the picture, both sides together, kept free when the camera moves back from moving bodies
MAX_WIDENING = 4.0  # times the first distance: a body that flies away goes out of sight in the end
WIDE = 50.0  # pictures wide and high about the middle: what lies beyond is cut off where a triangle crosses that
NEAR, FAR = 0.02, 50.0  # clipping planes in units of the distance to the target


@dataclass(frozen=True)
class Camera:
    """Looks at target (3,) [m] from a distance [m].

    azimuth [deg] about y: 0 looks along -z, 90 along -x; elevation [deg] above the horizon; fov [deg]: the vertical
    opening angle.
    """

    target: np.ndarray = field(default_factory=lambda: np.zeros(3))
    distance: float = 5.0
    azimuth: float = 32.0
    elevation: float = 20.0
    fov: float = 30.0

    @classmethod
    def framing(cls, points: np.ndarray, size: tuple[int, int] = (16, 9), **angles) -> "Camera":
        """A camera at the middle of the bounding box of points (n,3), which fill FILL of a picture.

        size: width and height of the picture, in any unit.
        """
        camera = cls(target=(np.min(points, axis=0) + np.max(points, axis=0)) / 2, **angles)
        return replace(camera, distance=max(camera._distance(points, size, FILL), 1e-9))  # of a single point: above 0

    @property
    def position(self) -> np.ndarray:
        """Where the eye is, (3,) [m]."""
        return self.target - self.distance * self.forward

    @property
    def forward(self) -> np.ndarray:
        """Unit vector (3,) from the eye to the target."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        return -np.array(
            [math.sin(azimuth) * math.cos(elevation), math.sin(elevation), math.cos(azimuth) * math.cos(elevation)]
        )

    @property
    def axes(self) -> np.ndarray:
        """Rows right, up, forward of the picture: (3,3), orthonormal."""
        right = np.cross(self.forward, UP)
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(right, self.forward), self.forward])

    @property
    def clipping(self) -> tuple[float, float]:
        """Distances of the near and the far clipping plane [m]."""
        return NEAR * self.distance, FAR * self.distance

    def widened(self, points: np.ndarray, size: tuple[int, int], limit: float) -> "Camera":
        """Moved back, to limit [m] at most, until points (n,3) lie within the picture less BORDER.

        size: width and height of the picture. Never moves nearer; points that are not finite do not count.
        """
        return replace(self, distance=max(self.distance, min(self._distance(points, size, 1.0 - BORDER), limit)))

    def _distance(self, points: np.ndarray, size: tuple[int, int], share: float) -> float:
        """Distance [m] from the target at which points (n,3) fill that share of the picture's width or height."""
        right, up, forward = self.axes @ (np.asarray(points) - self.target).T
        half = share * math.tan(math.radians(self.fov) / 2)  # height by distance
        needed = np.maximum(np.abs(right) / (half * size[0] / size[1]), np.abs(up) / half) - forward
        return float(np.max(needed, initial=0.0, where=np.isfinite(needed)))

    def clipped(
        self, x: np.ndarray, triangles: np.ndarray, colours: np.ndarray, size: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (n,3) [m], triangles (t,3) and colours (n,3) without what is nearer than the near plane or far off sideways.

        size: width and height of the picture. New vertices come behind the given ones; triangles that are not finite go.
        """
        right, up, depth = (np.where(np.isfinite(x), x, np.nan) - self.position).dot(self.axes.T).T
        high = WIDE * math.tan(math.radians(self.fov) / 2) * depth
        wide = high * size[0] / size[1]
        near = depth - self.clipping[0] * (1.0 + 1e-6)
        inside = np.stack([near, wide - right, wide + right, high - up, high + up], axis=1)  # above 0 on each plane's inner side
        with np.errstate(invalid="ignore"):
            within = inside[triangles] > 0  # (t, corners, planes)
        whole = within.all(axis=(1, 2))
        crossing = within.any(axis=1).all(axis=1) & ~whole & np.isfinite(inside[triangles]).all(axis=(1, 2))
        made, points = [], []
        for corners in triangles[crossing]:
            polygon = np.concatenate([inside[corners], x[corners], colours[corners]], axis=1)
            for k in range(inside.shape[1]):
                polygon = cut_off(polygon, k)
            first = len(x) + len(points)
            made += [(first, first + k, first + k + 1) for k in range(1, len(polygon) - 1)]
            points += [row[inside.shape[1] :] for row in polygon]
        if not made:
            return x, triangles[whole], colours
        new = np.array(points)
        return np.concatenate([x, new[:, :3]]), np.concatenate([triangles[whole], made]), np.concatenate([colours, new[:, 3:]])

    def clipped_lines(self, ends: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lines, ends (2k,3) [m] and their colours (2k,3), without what is nearer than the near plane; those not finite go."""
        a, b = ends[0::2], ends[1::2]
        near = self.clipping[0] * (1.0 + 1e-6)
        first, second = ((end - self.position) @ self.forward - near for end in (a, b))
        with np.errstate(invalid="ignore"):
            kept = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1) & (np.maximum(first, second) > 0)
        lines = np.concatenate([a, colours[0::2], b, colours[1::2]], axis=1)[kept]
        first, second = first[kept], second[kept]
        crossing = np.minimum(first, second) < 0
        share = (first[crossing] / (first[crossing] - second[crossing]))[:, None]
        cut = lines[crossing, :6] + share * (lines[crossing, 6:] - lines[crossing, :6])
        ahead = (first[crossing] > 0)[:, None]
        lines[crossing, :6] = np.where(ahead, lines[crossing, :6], cut)
        lines[crossing, 6:] = np.where(ahead, cut, lines[crossing, 6:])
        lines = lines.reshape(-1, 6)
        return lines[:, :3], lines[:, 3:]

    def orbit(self, azimuth: float, elevation: float) -> "Camera":
        """Turned about the target by so many degrees; elevation stops short of the poles."""
        raised = min(max(self.elevation + elevation, -MAX_ELEVATION), MAX_ELEVATION)
        return replace(self, azimuth=(self.azimuth + azimuth) % 360.0, elevation=raised)

    def zoom(self, factor: float) -> "Camera":
        """Distance times factor."""
        return replace(self, distance=self.distance * factor)

    def pan(self, right: float, up: float) -> "Camera":
        """Moved in the picture's plane, in units of the picture's height at the target."""
        height = 2 * self.distance * math.tan(math.radians(self.fov) / 2)
        return replace(self, target=self.target + height * (right * self.axes[0] + up * self.axes[1]))

    def ray(self, at: tuple[float, float], size: tuple[int, int]) -> np.ndarray:
        """Unit vector (3,) from the eye through a point of the picture, in [0, 1] from its lower left corner.

        size: width and height of the picture, in any unit.
        """
        half = math.tan(math.radians(self.fov) / 2)
        right, up = half * (2 * at[0] - 1) * size[0] / size[1], half * (2 * at[1] - 1)
        direction = np.array([right, up, 1.0]) @ self.axes
        return direction / np.linalg.norm(direction)

    def nearer(self, points: np.ndarray, share: float) -> np.ndarray:
        """Points (n,3) moved along their rays to a share of their distance from the eye: they stay on their pixels."""
        return self.position + share * (points - self.position)

    def project(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Pixel coordinates (from the left, from the top) and depth along the view [m] of points (n,3): (n,3).

        size: width and height in pixels. A point at or behind the eye has depth <= 0 and no meaningful pixel.
        """
        width, height = size
        seen = (np.asarray(points) - self.position) @ self.axes.T
        focal = height / 2 / math.tan(math.radians(self.fov) / 2)
        depth = seen[:, 2]
        scale = focal / np.where(depth > 0, depth, np.inf)
        return np.column_stack([width / 2 + scale * seen[:, 0], height / 2 - scale * seen[:, 1], depth])
