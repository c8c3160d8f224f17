"""Offscreen pictures of a simulation, drawn by kernels on the arch of the runtime; no window, driver or display is needed.

Surfaces, lines as bands, and shadows on half-spaces are drawn with four samples per pixel.
"""

import operator
from dataclasses import replace

import numpy as np

from taisoft.backend.runtime import open_kind, open_runtime
from taisoft.errors import OutputError, value_text
from taisoft.output.viewpoint import Viewpoint
from taisoft.scene.look import Camera
from taisoft.view.choices import IN_PICTURES
from taisoft.view.colouring import background
from taisoft.view.raster import Raster
from taisoft.view.scene_view import SceneView
from taisoft.view.shading import N_ATTRIBUTES, SAMPLES
from taisoft.view.shadow import Shadows

SIZE = (1280, 720)
MAX_SIDE = 16384  # pixels
LINE_WIDTH = 1.25  # pixels


def checked_size(size) -> tuple[int, int]:
    """Return width and height [pixels]. Raises OutputError unless they are two whole numbers from 1 to MAX_SIDE."""
    try:
        width, height = (operator.index(side) for side in size)
    except (TypeError, ValueError):
        raise OutputError(f"the size of a picture must be two whole numbers, width and height, not {value_text(size)}") from None
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise OutputError(f"a picture of {width} x {height} pixels cannot be drawn: both must be 1 to {MAX_SIDE}")
    return width, height


class Offscreen(SceneView):
    """Draws a scene's bodies and obstacles as pictures.

    scene, size, camera, colour, layers: as for `SceneView`. The kernels run in the open runtime, or in one of
    arch cpu that is claimed only while a picture is drawn. Raises OutputError.
    """

    def __init__(
        self,
        scene,
        size: tuple[int, int] = SIZE,
        camera: Viewpoint | Camera | None = None,
        colour: str = "body",
        layers: tuple[str, ...] = IN_PICTURES,
    ):
        self.size = checked_size(size)
        super().__init__(scene, self.size, camera, colour, layers)
        self._samples = (self.size[0] * SAMPLES, self.size[1] * SAMPLES)
        self._background = background(self.size, self.scene.background)
        self._raster = Raster(self._samples)
        self._shadows = Shadows(self.scene, self.surfaces)
        self._is_transparent = bool((self.surfaces.opacities < 1.0).any())
        self._drawn_at: float | None = None  # time of the latest picture [s]
        self._before: dict = {}  # what was kept before it

    def kept(self, time: float | None = None) -> dict:
        """Return, as plain data, what pictures from time [s] on depend on: camera, scales, recent maxima.

        A picture already drawn at that time does not count, since a resumed run draws it again; without a time all do.
        """
        return self._before if time == self._drawn_at else self._present()

    def resume(self, kept: dict) -> None:
        """Continue from what an earlier run kept; entries that are missing start anew."""
        if kept.get("camera") is not None:
            *target, distance = kept["camera"]
            self.camera = replace(self.camera, target=np.array(target), distance=distance)
        self.colouring.resume(*kept.get("scale", self.colouring.scale))
        self.layers.peaks |= {name: float(kept.get(name, 0.0)) for name in self.layers.peaks}

    def _present(self) -> dict:
        camera = None if self._has_own else [*self.camera.target.tolist(), self.camera.distance]
        return {"camera": camera, "scale": list(self.colouring.scale)} | self.layers.peaks

    def image(self, sim) -> np.ndarray:
        """Return a picture of a `DrawnState`, or of a simulator's present state, uint8 (height, width, 3), first row on top.

        Raises OutputError after `close`, and if a path fails.
        """
        if self._raster is None:
            raise OutputError("a picture cannot be drawn: its renderer is closed")
        state = self.sampled(sim)
        if state.time != self._drawn_at:
            self._before, self._drawn_at = self._present(), state.time
        x, colours, lines = self._drawn(state, self.size)
        picture = self._background.copy()
        runtime = open_runtime(*(open_kind() or ("cpu", "f32")), owner="a picture renderer")
        try:
            maps, texels = self._shadows.draw(x, state.poses)
            attributes = np.column_stack([colours, texels, self.surfaces.opacities])
            points, triangles, attributes = self._triangles(x, attributes, lines)
            opacities = attributes[triangles[:, 0], N_ATTRIBUTES] if self._is_transparent else None
            drawn = points, triangles, attributes[:, :N_ATTRIBUTES]
            self._raster.draw(*drawn, self.camera.clipping[0], maps, picture, opacities)
        finally:
            runtime.close()
        return picture

    def _triangles(self, x: np.ndarray, attributes: np.ndarray, lines: tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return projected points, triangles and attributes: clipped surfaces, then lines as bands."""
        x, triangles, attributes = self.camera.clipped(x, self.surfaces.triangles, attributes)
        points = self.camera.project(x, self._samples)
        ends, line_colours = self.camera.clipped_lines(*lines)
        if len(ends) == 0:
            return points, triangles, attributes
        corners, bands = stroke(self.camera.project(ends, self._samples), SAMPLES * LINE_WIDTH)
        unshaded = np.tile([0.0, 0.0, -1.0, 1.0], (len(corners), 1))  # and opaque
        band_attributes = np.column_stack([np.repeat(line_colours, 2, axis=0), unshaded])
        triangles = np.concatenate([triangles, len(x) + bands])
        return np.concatenate([points, corners]), triangles, np.concatenate([attributes, band_attributes])

    def close(self) -> None:
        """Free the memory; a second call does nothing."""
        self._raster = self._shadows = None


def stroke(ends: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Convert lines to pairs of triangles, for `Raster`.

    ends: (2k,3) pixel coordinates and depth, two rows per line; width in pixels. Returns corners (4k,3), for each line two at its
    first end and two at its second, and triangles (2k,3). Lines of zero length become triangles of zero area.
    """
    a, b = ends[0::2], ends[1::2]
    direction = b[:, :2] - a[:, :2]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    side = np.zeros_like(a)
    side[:, :2] = 0.5 * width * direction[:, ::-1] * (-1.0, 1.0) / np.where(length > 0, length, np.inf)
    corners = np.stack([a - side, a + side, b - side, b + side], axis=1).reshape(-1, 3)
    first = 4 * np.arange(len(a))[:, None, None]
    return corners, (first + [[0, 1, 2], [1, 3, 2]]).reshape(-1, 3)
