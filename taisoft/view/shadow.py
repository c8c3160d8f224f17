"""Soft shadows of the bodies on half-spaces, as maps of the fraction of light that is missing.

Light falls along the first of the scene's lights that shines down steeply enough, else straight down. The bodies' triangles are
drawn into a map of the half-space's boundary, each point with opacity * exp(-height / FADE), so that a shadow is darkest where a
body touches. The map is then blurred. A map covers only the shadows, so that its texels are small. Obstacles cast no shadow, and
receive none unless they are half-spaces.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.mesh.placing import UP
from taisoft.view.raster import Raster

TEXELS = 128  # per side of a map
SOFTNESS, FADE = 0.025, 0.4  # standard deviation of the blur; height: in diagonals of the bodies' bounding box at the start
STRENGTH = 0.5  # fraction of the ground's light that a body in contact takes away
MIN_SLOPE = 0.3  # smallest upward component of the normal of a half-space that gets shadows
REACH = 2.0  # standard deviations of the blur on either side


@dataclass(frozen=True)
class ShadowMap:
    """Shadows on a half-space.

    vertices: its range of drawn ones; origin (3,) [m] and axes (3,3), the third its normal: frame of the map; darkness: (v, u),
    fraction of light that is missing; low (2,) [m]: coordinates of its corner; texel (2,): size of a texel [m]; square (k,2) [m]:
    the half-space's drawn vertices in the frame.
    """

    vertices: slice
    origin: np.ndarray
    axes: np.ndarray
    darkness: np.ndarray
    low: np.ndarray
    texel: np.ndarray
    square: np.ndarray


class Shadows:
    """Shadow maps of the half-spaces of `Surfaces`. scene: a `DrawnScene`; towards: unit vector (3,) to the light."""

    def __init__(self, scene, surfaces):
        steep = [-one.direction for one in scene.lights or () if -one.direction @ UP[scene.up] >= MIN_SLOPE]
        self._surfaces, self.towards = surfaces, steep[0] if steep else UP[scene.up]
        self._size = scene.size
        self._raster: Raster | None = None  # made for the first half-space

    def draw(self, x: np.ndarray, poses: dict) -> tuple[np.ndarray, np.ndarray]:
        """Draw the maps for drawn vertices x (n,3) [m] and obstacles at poses, as of `DrawnState`.

        Returns the maps (maps, v, u) and, for every vertex, u and v in texels and the number of its map, -1 if none: (n,3).
        """
        at = np.zeros((len(x), 3))
        at[:, 2] = -1.0
        maps = self.maps(x, poses)
        for k, one in enumerate(maps):
            at[one.vertices, :2] = ((x[one.vertices] - one.origin) @ one.axes[:2].T - one.low) / one.texel
            at[one.vertices, 2] = k
        return np.array([one.darkness for one in maps]) if maps else np.zeros((1, 2, 2)), at

    def maps(self, x: np.ndarray, poses: dict) -> list["ShadowMap"]:
        """Return the maps of all half-spaces with shadows, as for `draw`."""
        found = []
        for vertices, boundary in self._surfaces.half_spaces(x, poses):
            axes = _frame(boundary)
            if axes is None or axes[2] @ self.towards < MIN_SLOPE:
                continue
            drawn = self._map(x[: self._surfaces.n_of_bodies], boundary[0], axes, boundary)
            if drawn is not None:
                found.append(ShadowMap(vertices, boundary[0], axes, *drawn))
        return found

    def _map(self, x: np.ndarray, origin, axes, boundary) -> tuple[np.ndarray, ...] | None:
        """Return the last four fields of a `ShadowMap`; None without a shadow."""
        height = (x - origin) @ axes[2] / (axes[2] @ self.towards)
        shadow = (x - origin) @ axes[:2].T - height[:, None] * (axes[:2] @ self.towards)
        drawn = shadow[np.isfinite(shadow).all(axis=1)]
        if len(drawn) == 0:
            return None
        sigma = SOFTNESS * self._size
        square = (boundary - origin) @ axes[:2].T
        low = np.maximum(drawn.min(axis=0) - 2 * REACH * sigma, square.min(axis=0))
        high = np.minimum(drawn.max(axis=0) + 2 * REACH * sigma, square.max(axis=0))
        texel = (high - low) / TEXELS
        if (texel <= 0.0).any():
            return None
        if self._raster is None:
            self._raster = Raster((TEXELS, TEXELS))
        with np.errstate(invalid="ignore"):  # triangles with nodes that are not finite are skipped
            depth = np.exp(np.clip(height / (FADE * self._size), 0.0, 50.0)) / self._surfaces.opacities[: len(height)]
        points = np.column_stack([(shadow - low) / texel, depth])
        darkness = STRENGTH * self._raster.inverse_depths(points, self._surfaces.body_triangles)
        return blurred(darkness, sigma / texel[::-1]), low, texel, square


def _frame(boundary: np.ndarray) -> np.ndarray | None:
    """Return orthonormal axes (3,3), two in the plane of the boundary (n,3) and its normal; None without an area."""
    if len(boundary) < 3:
        return None
    along, other = boundary[1] - boundary[0], boundary[2] - boundary[0]
    normal = np.cross(along, other)
    if not (length := float(np.linalg.norm(normal))) > 0.0:
        return None
    along, normal = along / np.linalg.norm(along), normal / length
    return np.array([along, np.cross(normal, along), normal])


def blurred(image: np.ndarray, sigma: tuple[float, float]) -> np.ndarray:
    """Return image (h,w) smoothed by a Gaussian of sigma texels along each axis, with zeros beyond it."""
    from scipy.ndimage import gaussian_filter  # takes a third of a second to load

    return gaussian_filter(image, sigma, mode="constant", truncate=REACH)
