"""A perspective camera that looks at a point from a direction: framing, orbiting, projecting."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

UP = np.array([0.0, 1.0, 0.0])
MAX_ELEVATION = 89.0  # [deg]; at 90 "up" is no longer defined
FILL = 0.62  # of the picture's width or height, whichever is reached first, that the bodies take at the start
BORDER = 0.06  # of the picture, both sides together, kept free when the camera moves back from moving bodies
MAX_WIDENING = 4.0  # times the first distance: a body that flies away goes out of sight in the end
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
        self, x: np.ndarray, triangles: np.ndarray, colours: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (n,3) [m], triangles (t,3) and colours (n,3) with what lies nearer than the near plane cut off.

        New vertices come behind the given ones. Triangles with a vertex that is not finite go.
        """
        depth = (x - self.position) @ self.forward - self.clipping[0] * (1.0 + 1e-6)
        with np.errstate(invalid="ignore"):
            front = (depth[triangles] > 0).sum(axis=1)
        crossing = (front > 0) & (front < 3) & np.isfinite(depth[triangles]).all(axis=1)
        made, points, shades = [], [], []
        for corners in triangles[crossing]:
            polygon = []
            for i, j in zip(corners, np.roll(corners, -1)):
                if depth[i] > 0:
                    polygon.append(i)
                if (depth[i] > 0) != (depth[j] > 0):
                    share = depth[i] / (depth[i] - depth[j])
                    polygon.append(len(x) + len(points))
                    points.append(x[i] + share * (x[j] - x[i]))
                    shades.append(colours[i] + share * (colours[j] - colours[i]))
            made += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
        whole = triangles[front == 3]
        if not made:
            return x, whole, colours
        return np.concatenate([x, points]), np.concatenate([whole, made]), np.concatenate([colours, shades])

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
