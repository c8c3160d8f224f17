"""Offscreen pictures of a simulation: by Taichi's renderer if there is a Vulkan driver, else in NumPy.

Both draw the same triangles with the same colours at twice the size, and average four pixels into one.

The NumPy renderer is a z-buffer rasteriser. Triangles are cut into spans of pixel rows, and spans into pixels whose centre is
inside. The nearest triangle of each pixel is drawn, with its corner colours interpolated in perspective. The z-buffer holds
1/depth, which is linear in the picture.
"""

import sys
from dataclasses import replace

import numpy as np

from taisoft.backend.runtime import open_kind
from taisoft.errors import OutputError
from taisoft.output.camera import Camera
from taisoft.ranges import expand
from taisoft.view.colouring import background
from taisoft.view.ggui import Canvas, vulkan_missing, window_holder
from taisoft.view.scene_view import IN_PICTURES, SceneView

SIZE = (1280, 720)
SAMPLES = 2  # per pixel and axis
LINE_WIDTH = 1.25  # pixels
KEY_COLOUR = (1.0, 0.0, 1.0)  # magenta, of pixels that no triangle covers; no lit body has it
RENDERERS = ("auto", "vulkan", "software")
PIXELS_AT_ONCE = 2_000_000  # bounds the memory, about 100 bytes per pixel
MAX_COORDINATE = 1e6  # pixels; beyond it float64 spans would miss whole pixels; `Camera.clipped` leaves no such triangle

_printed: set[str] = set()  # reasons printed by this process


class Offscreen(SceneView):
    """Draws a scene's bodies and obstacles as pictures.

    scene, size, camera, colour, layers: as for `SceneView`; renderer: "vulkan", "software" or "auto": Vulkan if available, else
    a line on stderr gives the reason. Raises OutputError.
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
        super().__init__(scene, size, camera, colour, layers)
        self.size = (int(size[0]), int(size[1]))
        self._large = (self.size[0] * SAMPLES, self.size[1] * SAMPLES)
        self._background = background(self._large)
        self._canvas = None
        self.renderer = _choose_renderer() if renderer == "auto" else renderer
        if self.renderer == "vulkan":
            n, width = self.layers.n_segments, SAMPLES * LINE_WIDTH
            self._canvas = Canvas(self.surfaces, self._large, visible=False, n_segments=n, line_width=width)

    def resume(self, distance: float | None) -> None:
        """Set the camera's distance [m] to that of an earlier run; None keeps it."""
        if distance is not None:
            self.camera = replace(self.camera, distance=float(distance))

    def image(self, sim) -> np.ndarray:
        """Return a picture of sim's present state, uint8 (height, width, 3), first row on top."""
        x, colours, lines = self._drawn(sim, self.size)
        projected = self.camera.project(np.concatenate([x, lines[0]]), self._large)
        left, top, right, bottom = _bounds(projected, self._large)  # everything else is background
        picture = self._background[::SAMPLES, ::SAMPLES].copy()
        if left == right or top == bottom:
            return picture
        part = self._background[top:bottom, left:right].copy()
        if self._canvas is None or not self._draw(x, colours, lines, (left, top, right, bottom), part):
            self._rasterise(x, colours, lines, (left, top), part)
        picture[top // SAMPLES : bottom // SAMPLES, left // SAMPLES : right // SAMPLES] = _averaged(part)
        return picture

    def _rasterise(self, x: np.ndarray, colours: np.ndarray, lines: tuple, corner: tuple[int, int], part: np.ndarray) -> None:
        """Draw triangles, and lines as bands, in NumPy into part, whose upper left pixel is `corner`."""
        x, triangles, colours = self.camera.clipped(x, self.surfaces.triangles, colours, self.size)
        ends, line_colours = self.camera.clipped_lines(*lines)
        corners, bands = stroke(self.camera.project(ends, self._large), SAMPLES * LINE_WIDTH)
        projected = np.concatenate([self.camera.project(x, self._large), corners])
        projected[:, :2] -= corner
        triangles = np.concatenate([triangles, len(x) + bands])
        colours = np.concatenate([colours, np.repeat(line_colours, 2, axis=0)])
        rasterise(projected, triangles, colours, self.camera.clipping[0], part)

    def _draw(self, x: np.ndarray, colours: np.ndarray, lines: tuple, box: tuple[int, int, int, int], part: np.ndarray) -> bool:
        """Draw the contents of the box by Vulkan into part; return False if no surface was drawn.

        On a busy machine, Taichi's renderer sometimes returns a picture that was cleared but not drawn, or that shows only lines.
        """
        self._canvas.draw(x, colours, self.camera, KEY_COLOUR, lines)
        pixels = self._canvas.pixels(*box)
        empty = (pixels == (255, 0, 255)).all(axis=2)
        surface = ~empty
        for colour in np.unique(np.rint(255.0 * lines[1]), axis=0):
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


def rasterise(projected: np.ndarray, triangles: np.ndarray, colours: np.ndarray, near: float, image: np.ndarray) -> np.ndarray:
    """Draw triangles over image (height, width, 3), uint8 and contiguous; return the mask of the pixels drawn.

    projected: (n,3) pixel coordinates and depth; triangles: (t,3); colours: (n,3) in [0, 1]. Triangles that reach
    nearer than `near`, or are not finite, are skipped; both sides of a triangle are drawn.
    """
    height, width = image.shape[:2]
    corners = projected[triangles]
    with np.errstate(invalid="ignore"):
        visible = (corners[:, :, 2] > near).all(axis=1) & (np.abs(corners[:, :, :2]) < MAX_COORDINATE).all(axis=(1, 2))
    triangles, corners = triangles[visible], corners[visible]
    planes, area = _edge_functions(corners[:, :, :2])
    triangles, corners, planes = triangles[area > 0], corners[area > 0], planes[area > 0]
    inverse = 1.0 / corners[:, :, 2]
    depth_plane = np.einsum("tk,tkm->tm", inverse, planes)  # 1/depth = a x + b y + c

    nearest = np.zeros(height * width)  # 1/depth
    owner = np.full(height * width, -1)
    for triangle, row, first, count in _spans(corners, planes, width, height):
        span, pixels = expand(row * width + first, count)
        slope = depth_plane[triangle, 0]
        start = slope * 0.5 + depth_plane[triangle, 1] * (row + 0.5) + depth_plane[triangle, 2] - slope * (row * width)
        depth = start[span] + slope[span] * pixels
        np.maximum.at(nearest, pixels, depth)
        in_front = np.flatnonzero(depth >= nearest[pixels])
        owner[pixels[in_front]] = triangle[span[in_front]]

    drawn = np.flatnonzero(owner >= 0)
    owners = owner[drawn]
    # colour / depth is linear in the picture too
    colour_planes = np.einsum("tk,tkc,tkm->tcm", inverse, colours[triangles], planes)[owners]
    x, y = drawn % width + 0.5, drawn // width + 0.5
    pixel_colours = colour_planes[..., 0] * x[:, None] + colour_planes[..., 1] * y[:, None] + colour_planes[..., 2]
    pixel_colours /= nearest[drawn, None]
    image.reshape(-1, 3)[drawn] = (255 * np.clip(pixel_colours, 0.0, 1.0) + 0.5).astype(np.uint8)
    return (owner >= 0).reshape(height, width)


def stroke(ends: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Convert lines to pairs of triangles, for `rasterise`.

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


def _edge_functions(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric weights of triangles (t,3,2) as planes (t,3,3), weight k = a x + b y + c, and twice |area| (t,)."""
    q, r = np.roll(p, -1, axis=1), np.roll(p, -2, axis=1)  # weight k vanishes on the edge from q to r
    a, b = q[..., 1] - r[..., 1], r[..., 0] - q[..., 0]
    planes = np.stack([a, b, -(a * q[..., 0] + b * q[..., 1])], axis=2)
    area = (a[:, 0] * p[:, 0, 0] + b[:, 0] * p[:, 0, 1]) + planes[:, 0, 2]
    planes /= np.where(area != 0, area, 1.0)[:, None, None]  # signed, so that inside is positive for either orientation
    return planes, np.abs(area)


def _spans(corners: np.ndarray, planes: np.ndarray, width: int, height: int):
    """Yield (triangle, row, first pixel, number of pixels) arrays of the covered spans, about PIXELS_AT_ONCE pixels at a time."""
    low = np.clip(np.ceil(corners[:, :, 1].min(axis=1) - 0.5), 0, height).astype(np.int64)
    high = np.clip(np.floor(corners[:, :, 1].max(axis=1) - 0.5), -1, height - 1).astype(np.int64)
    owner, row = expand(low, np.maximum(high - low + 1, 0))
    a, b, c = np.moveaxis(planes[owner], 2, 0)
    rest = b * (row + 0.5)[:, None] + c  # weight k = a x + rest >= 0 inside
    with np.errstate(divide="ignore", invalid="ignore"):
        root = -rest / a
    left = np.where(a > 0, root, -np.inf).max(axis=1)
    right = np.where(a < 0, root, np.inf).min(axis=1)
    outside = ((a == 0) & (rest < 0)).any(axis=1)
    first = np.clip(np.ceil(left - 0.5), 0, width).astype(np.int64)
    last = np.clip(np.floor(right - 0.5), -1, width - 1).astype(np.int64)
    count = np.where(outside, 0, np.maximum(last - first + 1, 0))
    kept = np.flatnonzero(count)
    owner, row, first, count = owner[kept], row[kept], first[kept], count[kept]
    total = np.cumsum(count)
    cuts = np.searchsorted(total, np.arange(PIXELS_AT_ONCE, total[-1] if len(total) else 0, PIXELS_AT_ONCE))
    for part in np.split(np.arange(len(count)), cuts):
        yield owner[part], row[part], first[part], count[part]
