"""Shadows in the window: a fine mesh over each half-space, as dark as its shadow map.

The renderer of the window interpolates colours between vertices only, so that the ground's own triangles are too coarse.
"""

import numpy as np

from taisoft.output.appearance import OBSTACLE_COLOUR
from taisoft.output.camera import Camera
from taisoft.scene.obstacles import HalfSpace
from taisoft.view.colouring import lit_colours
from taisoft.view.shadow import TEXELS, Shadows

EVERY = 2  # texels between two vertices along each axis
LIFT = 0.9995  # fraction of the distance from the eye, so that the mesh lies on the ground


class ShadowMesh:
    """Meshes of the shadows on the half-spaces of a scene. triangles: int32 (t,3), of the meshes of all of them."""

    def __init__(self, scene, surfaces):
        self._shadows = Shadows(scene, surfaces)
        n_maps = sum(isinstance(o.shape, HalfSpace) for o in scene.obstacles)
        side = TEXELS // EVERY
        self._coordinates = EVERY * np.arange(side) + 0.5 * EVERY  # in texels
        corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1, 1)
        quads = np.concatenate([corner + [0, 1, side], corner + [1, side + 1, side]])
        self._n_of_map = side * side
        self.triangles = np.concatenate([np.empty((0, 3), np.int32), *(quads + k * side * side for k in range(n_maps))])
        self._x = np.zeros((n_maps * side * side, 3))
        self._colours = np.zeros_like(self._x)

    def draw(self, x: np.ndarray, t: float, camera: Camera) -> tuple[np.ndarray, np.ndarray] | None:
        """Return positions [m] and lit colours (n,3) of the meshes, or None without a shadow.

        x: (n,3) drawn vertices of `Surfaces`; t: time [s].
        """
        found = [one for one in self._shadows.maps(x, t) if (camera.position - one.origin) @ one.axes[2] > 0.0]
        self._x[:] = camera.target  # unused triangles have no area
        for k, one in enumerate(found):
            rows = slice(k * self._n_of_map, (k + 1) * self._n_of_map)
            v, u = np.meshgrid(self._coordinates, self._coordinates, indexing="ij")
            plane = np.column_stack([u.ravel(), v.ravel()]) * one.texel + one.low
            points = one.origin + plane @ one.axes[:2]
            darkness = one.darkness.reshape(len(u), EVERY, len(u), EVERY).mean(axis=(1, 3))
            normals, base = np.tile(one.axes[2], (len(points), 1)), np.tile(OBSTACLE_COLOUR, (len(points), 1))
            lit = lit_colours(points, normals, base, camera)
            self._x[rows] = camera.nearer(points, LIFT)
            self._colours[rows] = lit * (1.0 - darkness.reshape(-1, 1))
        return (self._x, self._colours) if found else None
