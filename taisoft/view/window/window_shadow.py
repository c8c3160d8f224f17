"""Shadows in the window: a fine mesh over each half-space, as dark as its shadow map.

The renderer of the window interpolates colours between vertices only, so that the ground's own triangles are too coarse.
"""

import numpy as np
from scipy.spatial import ConvexHull

from taisoft.output.viewpoint import Viewpoint
from taisoft.scene.obstacles import HalfSpace
from taisoft.view.colouring import lit_colours
from taisoft.view.shadow import MIN_SLOPE, TEXELS, Shadows

EVERY = 2  # texels between two vertices along each axis
FAINT = 1e-3  # darkness below which nothing is drawn
LIFT = 0.9995  # fraction of the distance from the eye, so that the mesh lies on the ground


class ShadowMesh:
    """Meshes of the shadows on the half-spaces of a scene. size: their largest numbers of vertices and triangles."""

    def __init__(self, scene, surfaces):
        self._scene, self._surfaces, self._shadows = scene, surfaces, Shadows(scene, surfaces)
        grounds = [o for o in scene.obstacles if isinstance(o.shape, HalfSpace)]
        n_maps = sum(o.path is not None or o.shape.normal @ self._shadows.towards >= MIN_SLOPE for o in grounds)
        side = TEXELS // EVERY
        centres = EVERY * np.arange(side) + 0.5 * EVERY
        v, u = np.meshgrid(centres, centres, indexing="ij")
        self._texels = np.column_stack([u.ravel(), v.ravel()])
        corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1, 1)
        self._triangles = np.concatenate([corner + [0, 1, side], corner + [1, side + 1, side]])
        self.size = (n_maps * side * side, n_maps * len(self._triangles))

    def draw(self, x: np.ndarray, poses: dict, camera: Viewpoint) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return positions [m] and lit colours (n,3) of the meshes and their triangles (t,3), or None without a shadow.

        x: (n,3) drawn vertices of `Surfaces`; poses: of obstacles, as of `DrawnState`.
        """
        points, colours, triangles = [], [], []
        for one in self._shadows.maps(x, poses):
            if (camera.position - one.origin) @ one.axes[2] <= 0.0 or self._surfaces.opacities[one.vertices.start] < 1.0:
                continue
            own = one.origin + _inside(one.square, self._texels * one.texel + one.low) @ one.axes[:2]
            side = TEXELS // EVERY
            darkness = one.darkness.reshape(side, EVERY, side, EVERY).mean(axis=(1, 3)).reshape(-1, 1)
            triangles.append(self._triangles[darkness[self._triangles, 0].max(axis=1) > FAINT] + len(points) * len(own))
            normals, base = (np.tile(row, (len(own), 1)) for row in (one.axes[2], self._surfaces.colours[one.vertices.start]))
            lit = lit_colours(own, normals, base, camera, self._scene.lights, self._scene.up)
            colours.append(lit * (1.0 - darkness))
            points.append(camera.nearer(own, LIFT))
        if not points:
            return None
        return np.concatenate(points), np.concatenate(colours), np.concatenate(triangles)


def _inside(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Move points (n,2) that lie outside a convex polygon, given by points (k,2) in it, onto its border."""
    for a, b, offset in ConvexHull(polygon).equations:
        beyond = np.maximum(points @ (a, b) + offset, 0.0)
        points = points - np.outer(beyond, (a, b))
    return points
