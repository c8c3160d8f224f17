"""Offscreen pictures of a simulation: by Taichi's renderer if there is a Vulkan driver, else in NumPy.

Both draw the same triangles with the same colours at twice the size, and average four pixels into one.
"""

import sys
from dataclasses import replace

import numpy as np

from taisoft.backend.runtime import open_kind
from taisoft.errors import OutputError
from taisoft.output.camera import MAX_WIDENING, Camera, start_positions
from taisoft.view.colouring import Colouring
from taisoft.view.ggui import Canvas, vulkan_missing, window_holder
from taisoft.view.layers import IN_PICTURES, Layers
from taisoft.view.raster import rasterise, stroke
from taisoft.view.shading import background, lit_colours
from taisoft.view.surfaces import Surfaces

SIZE = (1280, 720)
SAMPLES = 2  # per pixel and axis
LINE_WIDTH = 1.25  # pixels
KEY_COLOUR = (1.0, 0.0, 1.0)  # magenta, of pixels that no triangle covers; no lit body has it
RENDERERS = ("auto", "vulkan", "software")

_printed: set[str] = set()  # reasons printed by this process


class Offscreen:
    """Draws a scene's bodies and obstacles as pictures.

    scene: read once; size: (width, height) in pixels; camera: fixed if given, else it frames all bodies at the start and
    moves back, never nearer, when a body would leave the picture; renderer: "vulkan", "software" or "auto": Vulkan
    if available, else a line on stderr gives the reason; colour: of the bodies, their own ("body") or by "stress",
    "stretch" or "speed"; layers: names of visible LAYERS. Raises OutputError.
    """

    def __init__(
        self,
        scene,
        size: tuple[int, int] = SIZE,
        camera: Camera | None = None,
        renderer: str = "auto",
        colour: str = "body",
        layers: tuple[str, ...] = IN_PICTURES,
    ):
        if renderer not in RENDERERS:
            raise OutputError(f"renderer '{renderer}' is unknown: it must be one of {', '.join(RENDERERS)}")
        if min(size) < 1:
            raise OutputError(f"a picture of {size[0]} x {size[1]} pixels cannot be drawn: both must be at least 1")
        self.size = (int(size[0]), int(size[1]))
        self.camera = camera or Camera.framing(start_positions(scene), size)
        self._widest = 0.0 if camera else MAX_WIDENING * self.camera.distance  # [m]
        self.surfaces = Surfaces(scene)
        self.colouring = Colouring(scene, self.surfaces, colour)
        self.layers = Layers(scene, layers)
        self.surfaces.with_markers = self.layers.shown["fixed_nodes"]
        self._large = (self.size[0] * SAMPLES, self.size[1] * SAMPLES)
        self._background = background(self._large)
        self._canvas = None
        self.renderer = _choose_renderer() if renderer == "auto" else renderer
        if self.renderer == "vulkan":
            n = self.layers.n_segments if self.layers.has_lines else 0
            self._canvas = Canvas(self.surfaces, self._large, visible=False, n_segments=n, line_width=SAMPLES * LINE_WIDTH)

    def resume(self, distance: float | None) -> None:
        """Set the camera's distance [m] to that of an earlier run; None keeps it."""
        if distance is not None:
            self.camera = replace(self.camera, distance=float(distance))

    def image(self, sim) -> np.ndarray:
        """Return a picture of sim's present state, uint8 (height, width, 3), first row on top."""
        bodies = self.surfaces.of_bodies(sim)
        self.camera = self.camera.widened(bodies[0], self.size, self._widest)
        x, normals = self.surfaces.with_obstacles(bodies, sim.time, self.camera.position)
        lines = self.layers.lines(sim, self.camera) if self.layers.has_lines else None
        projected = self.camera.project(x if lines is None else np.concatenate([x, lines[0]]), self._large)
        left, top, right, bottom = _bounds(projected, self._large)  # everything else is background
        base = self.colouring.base(sim)
        picture = self._background[::SAMPLES, ::SAMPLES].copy()
        if left == right or top == bottom:
            return picture
        part = self._background[top:bottom, left:right].copy()
        if self._canvas is None or not self._draw(x, normals, base, lines, (left, top, right, bottom), part):
            colours = lit_colours(x, normals, base, self.camera)
            self._rasterise(x, colours, lines, (left, top), part)
        picture[top // SAMPLES : bottom // SAMPLES, left // SAMPLES : right // SAMPLES] = _averaged(part)
        return picture

    def _rasterise(self, x: np.ndarray, colours: np.ndarray, lines, corner: tuple[int, int], part: np.ndarray) -> None:
        """Draw triangles with lit colours, and lines as bands, in NumPy into part, whose upper left pixel is `corner`."""
        x, triangles, colours = self.camera.clipped(x, self.surfaces.triangles, colours, self.size)
        projected = self.camera.project(x, self._large)
        if lines is not None:
            ends, line_colours = self.camera.clipped_lines(*lines)
            corners, bands = stroke(self.camera.project(ends, self._large), SAMPLES * LINE_WIDTH)
            triangles = np.concatenate([triangles, len(projected) + bands])
            projected = np.concatenate([projected, corners])
            colours = np.concatenate([colours, np.repeat(line_colours, 2, axis=0)])
        projected[:, :2] -= corner
        rasterise(projected, triangles, colours, self.camera.clipping[0], part)

    def _draw(
        self, x: np.ndarray, normals: np.ndarray, base: np.ndarray, lines, box: tuple[int, int, int, int], part: np.ndarray
    ) -> bool:
        """Draw the contents of the box by Vulkan into part; return False if no surface was drawn.

        On a busy machine, Taichi's renderer sometimes returns a picture that was cleared but not drawn, or that shows only lines.
        """
        self._canvas.draw(x, normals, self.camera, KEY_COLOUR, base, lines)
        pixels = self._canvas.pixels(*box)
        red, green, blue = np.moveaxis(pixels, 2, 0)
        empty = (red == 255) & (green == 0) & (blue == 255)
        surface = ~empty
        for colour in np.unique(np.rint(255.0 * lines[1]), axis=0) if lines is not None else ():
            surface &= (np.abs(pixels - colour) > 2.0).any(axis=2)
        if surface.any():
            np.copyto(part, pixels, where=~empty[..., None])
        return bool(surface.any())

    def close(self) -> None:
        """Destroy the window in memory, if there is one; a second call does nothing."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None


def _bounds(projected: np.ndarray, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of the area that the vertices cover, in whole final pixels and within size.

    The whole of size if a vertex is behind the eye or not finite.
    """
    if not (np.isfinite(projected).all() and (projected[:, 2] > 0).all()):
        return 0, 0, *size
    low = np.floor(projected[:, :2].min(axis=0) / SAMPLES) * SAMPLES
    high = np.ceil(projected[:, :2].max(axis=0) / SAMPLES) * SAMPLES
    (left, top), (right, bottom) = np.clip(low, 0, size).astype(int), np.clip(high, 0, size).astype(int)
    return left, top, right, bottom


def _averaged(image: np.ndarray) -> np.ndarray:
    """Average every block of SAMPLES x SAMPLES pixels into one."""
    total = np.zeros((image.shape[0] // SAMPLES, image.shape[1] // SAMPLES, 3), dtype=np.uint16)
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            total += image[i::SAMPLES, j::SAMPLES]
    return ((total + SAMPLES**2 // 2) // SAMPLES**2).astype(np.uint8)


def _choose_renderer() -> str:
    """Return the renderer that is available now; print the reason against Vulkan once per process."""
    reason = vulkan_missing()
    if not reason and open_kind() is not None and open_kind()[0] != "cpu":
        reason = "Taichi's renderer is used only with arch cpu"
    if not reason and window_holder():
        reason = f"{window_holder()} holds the only window that a process can have"
    if not reason:
        return "vulkan"
    if reason not in _printed:
        _printed.add(reason)
        print(f"taisoft: pictures are drawn in software: {reason}", file=sys.stderr)
    return "software"
