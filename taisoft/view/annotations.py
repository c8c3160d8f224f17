"""Captions, plots and colour bars on pictures.

A caption (below) and plots (at the right) are drawn by Pillow, of the extra `plot`. All lengths are for a picture 720 pixels high
and scale with it. Annotations are drawn at twice their size and averaged.
"""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError
from taisoft.view.colouring import TITLES, UNITS, Colouring, colours_of
from taisoft.view.drawn import DrawnState
from taisoft.view.plots import Curves, PlotChoice

HEIGHT = 720.0  # of the picture that lengths refer to
MARGIN, WIDTH = 16, 300  # of the plots
TITLE_SIZE, TEXT_SIZE, SMALL_SIZE = 22, 15, 12  # font sizes
CAPTION_HEIGHT = 76  # of the area for the caption
PADDING = (22, 16, 4)  # above the curves, below them, and around a plot
CURVE_HEIGHT, MIN_CURVE_HEIGHT = 92, 40  # the smaller one if there are many plots
SAMPLES = 2  # per pixel and axis
INK, FAINT, FRAME, PAPER = (38, 41, 46), (112, 116, 122), (160, 163, 168), (252, 252, 253)  # sRGB
GRID = (222, 224, 226)
DARK = 100  # mean value of the picture's lower left corner below which text on it is light
OPACITY = 0.86  # of the plots' background
BAR, BAR_HEIGHT = (220, 12), 64  # width and height of the colour bar; height with its texts


def text_missing() -> str:
    """Return what to install for text in pictures, as a sentence; empty if nothing is missing."""
    missing = [name for module, name in (("PIL", "Pillow"), ("matplotlib", "matplotlib")) if find_spec(module) is None]
    return f"text in pictures needs {' and '.join(missing)}: pip install 'taisoft[plot]'" if missing else ""


class Annotations:
    """Draws plots, a caption and a colour bar on the pictures of a run.

    plots: those that are drawn; name: the scene's name for the caption, or None for no caption; colouring: its scale is
    drawn as a colour bar, unless bodies have their own colours. Raises OutputError if Pillow, or matplotlib, which supplies the
    font, is missing.
    """

    def __init__(self, plots: PlotChoice | None = None, name: str | None = None, colouring: Colouring | None = None):
        missing = text_missing()
        if missing:
            raise OutputError(missing)
        import matplotlib

        self._plots, self._name, self._colouring = plots, name, colouring
        self._bar: tuple | None = None  # what it shows, and its layer
        self._font_file = Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"

    def draw(self, picture: np.ndarray, state: DrawnState, index: int) -> np.ndarray:
        """Return an annotated copy of a picture, uint8 (height, width, 3), of a state; index: frame number."""
        height, width = picture.shape[:2]
        self._unit = SAMPLES * height / HEIGHT  # drawn pixels per unit of length
        self._on_dark = picture[-(height // 4) :, : width // 3].mean() < DARK
        size = width * HEIGHT / height, HEIGHT
        names = self._plots.visible() if self._plots is not None else []
        result = picture.copy()
        if names:
            with self._overlay(result, (size[0] - MARGIN - WIDTH, MARGIN, size[0] - MARGIN, size[1] - MARGIN)):
                self._draw_plots(names, size)
        caption = size[1] - CAPTION_HEIGHT if self._name is not None else size[1] - MARGIN
        if self._name is not None:
            with self._overlay(result, (0.0, caption, size[0] - WIDTH * bool(names), size[1])):
                self._draw_caption(state, index, size)
        legend = self._colouring.legend() if self._colouring is not None else []
        if legend:
            box = (0.0, caption - BAR_HEIGHT, 2 * MARGIN + BAR[0], caption)
            self._compose(result, box, self._bar_layer(legend, caption, self._blank(result, box)))
        return result

    def _bar_layer(self, legend: list[tuple[str, np.ndarray]], bottom: float, blank):
        """Return the colour bar as a layer; it is drawn again only when the legend or the size of the pictures changes."""
        key = self._on_dark, self._colouring.kind, *(text for text, _ in legend), blank.size
        if self._bar is None or self._bar[0] != key:
            self._draw_colour_bar(legend, bottom)
            self._bar = key, blank.reduce(SAMPLES)
        return self._bar[1]

    @contextmanager
    def _overlay(self, picture: np.ndarray, box: tuple[float, float, float, float]) -> Iterator[None]:
        """Draw in the block on a transparent layer over a part of the picture: left, top, right, bottom, in lengths."""
        layer = self._blank(picture, box)
        yield
        self._compose(picture, box, layer.reduce(SAMPLES))

    def _blank(self, picture: np.ndarray, box: tuple[float, float, float, float]):
        """Return a transparent layer, SAMPLES times as large as its part of the picture, and draw on it from now on."""
        from PIL import Image, ImageDraw

        left, top, right, bottom = self._pixels(picture, box)
        layer = Image.new("RGBA", (SAMPLES * (right - left), SAMPLES * (bottom - top)), (*PAPER, 0))
        self._pen, self._origin = ImageDraw.Draw(layer), np.array([SAMPLES * left, SAMPLES * top], dtype=float)
        return layer

    def _compose(self, picture: np.ndarray, box: tuple[float, float, float, float], layer) -> None:
        """Draw a finished layer over its part of the picture."""
        from PIL import Image

        left, top, right, bottom = self._pixels(picture, box)
        part = picture[top:bottom, left:right]
        under = Image.fromarray(np.ascontiguousarray(part)).convert("RGBA")
        under.alpha_composite(layer)
        part[:] = np.asarray(under)[..., :3]

    def _pixels(self, picture: np.ndarray, box: tuple[float, float, float, float]) -> list[int]:
        """Convert a box to pixels, within the picture."""
        height, width = picture.shape[:2]
        edges = [max(0, round(self._unit / SAMPLES * length)) for length in box]
        return [min(edge, limit) for edge, limit in zip(edges, (width, height, width, height))]

    # --- plots --------------------------------------------------------------------------------------------------------

    def _draw_plots(self, names: list[str], size: tuple[float, float]) -> None:
        padding = sum(PADDING) + PADDING[2]
        available = (HEIGHT - 2 * MARGIN) / len(names) - padding - PADDING[2]
        height = min(CURVE_HEIGHT, max(MIN_CURVE_HEIGHT, available))
        right = size[0] - MARGIN
        for k, name in enumerate(names):
            self._draw_plot(self._plots.curves(name), right - WIDTH, MARGIN + k * (height + padding + PADDING[2]), height)

    def _draw_plot(self, curves: Curves, left: float, top: float, height: float) -> None:
        """Draw a plot at its upper left corner: title and legend above the curves, times below, the axis limits inside."""
        pad = PADDING[2]
        self._pen.rectangle(
            self._at(left, top, left + WIDTH, top + height + sum(PADDING) + pad), fill=(*PAPER, int(255 * OPACITY))
        )
        x0, x1, y0 = left + 2 * pad, left + WIDTH - 2 * pad, top + PADDING[0]
        y1 = y0 + height
        self._write(x0, top + pad, curves.title, SMALL_SIZE, INK)
        for level in curves.grid:
            y = y1 - level * height
            self._stroke(np.array([(x0, y), (x1, y)]), GRID, 1.0)
        for colour, points in curves.lines:
            for piece in _pieces(points):
                self._stroke(np.array([x0, y1]) + piece * (x1 - x0, y0 - y1), _bytes(colour), 1.6)
        self._stroke(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]), FRAME, 1.0)
        self._write(x0 + 3, y0 + 2, curves.ends[1], SMALL_SIZE - 2, FAINT, halo=True)
        self._write(x0 + 3, y1 - 2, curves.ends[0], SMALL_SIZE - 2, FAINT, anchor="lb", halo=True)
        self._write(x0, y1 + 2, f"{curves.times[0]:.4g}", SMALL_SIZE - 2, FAINT)
        self._write(x1, y1 + 2, f"{curves.times[1]:.4g} s", SMALL_SIZE - 2, FAINT, anchor="ra")
        x, y = x1, top + pad
        texts = [(name if len(curves.legend) > 1 else value, _bytes(colour)) for name, value, colour in reversed(curves.legend)]
        stacked = sum(self._width(text, SMALL_SIZE) + 8 for text in (curves.title, *(text for text, _ in texts))) > x1 - x0
        for k, (text, colour) in enumerate(texts):
            if stacked:  # in the plot, one below the other
                x, y = x1 - 4, y0 + 2 + SMALL_SIZE * (len(texts) - 1 - k)
            self._write(x, y, text, SMALL_SIZE, colour, anchor="ra", halo=stacked)
            x -= self._width(text, SMALL_SIZE) + 8

    # --- caption ------------------------------------------------------------------------------------------------------

    def _draw_caption(self, state: DrawnState, index: int, size: tuple[float, float]) -> None:
        bottom = size[1] - MARGIN
        text = "   ".join(f"{name} {energy:.4g} J" for name, energy in state.energies.items())
        self._write(MARGIN, bottom, f"frame {index}   t = {state.time:.4f} s   {text}", TEXT_SIZE, INK, anchor="lb", halo=True)
        self._write(MARGIN, bottom - TEXT_SIZE - 8, self._name, TITLE_SIZE, INK, anchor="lb", halo=True)

    def _draw_colour_bar(self, legend: list[tuple[str, np.ndarray]], bottom: float) -> None:
        """Draw the colour bar from low to high, its limits below it, and the name of its quantity above."""
        width, height = BAR
        colours = colours_of(np.linspace(0.0, 1.0, width + 1))
        top = bottom - TEXT_SIZE - height
        for k in range(width):
            left, high, right, low = self._at(MARGIN + k, top, MARGIN + k + 1, top + height)
            if right >= left:  # on a small picture a step of the bar may be narrower than a pixel
                self._pen.rectangle((left, high, right, max(low, high)), fill=(*_bytes(colours[k]), 255))
        kind = self._colouring.kind
        self._write(MARGIN, top - 4, TITLES[kind], TEXT_SIZE, INK, anchor="lb", halo=True)
        for (text, _), fraction, anchor in zip(legend, (1.0, 0.5, 0.0), ("ra", "ma", "la")):
            short = text.removesuffix(UNITS[kind]).strip() if fraction == 0.5 else text.strip()
            self._write(MARGIN + fraction * width, top + height + 3, short, SMALL_SIZE, INK, anchor=anchor, halo=True)

    # --- drawing, in lengths ------------------------------------------------------------------------------------------

    def _at(self, left: float, top: float, right: float, bottom: float) -> tuple[int, int, int, int]:
        """Convert a rectangle to pixels, the last ones included."""
        (left, top), (right, bottom) = np.round(self._unit * np.array([(left, top), (right, bottom)]) - self._origin)
        return int(left), int(top), int(right) - 1, int(bottom) - 1

    def _stroke(self, points: np.ndarray, colour: tuple[int, int, int], width: float) -> None:
        pixels = [tuple(p) for p in (self._unit * points - self._origin).tolist()]
        self._pen.line(pixels, fill=(*colour, 255), width=max(1, round(width * self._unit)), joint="curve")

    def _write(
        self, x: float, y: float, text: str, size: float, colour: tuple[int, int, int], anchor: str = "la", halo: bool = False
    ) -> None:
        """Write text at x, y. anchor: the part of the text at that point, in Pillow's notation; halo: outline the letters."""
        swapped = halo and colour == INK and self._on_dark
        colour, outline = (PAPER, INK) if swapped else (colour, PAPER)
        edge = {"stroke_width": round(1.5 * self._unit), "stroke_fill": (*outline, 200)} if halo else {}
        position = tuple((self._unit * np.array([x, y]) - self._origin).tolist())
        self._pen.text(position, text, (*colour, 255), _font(self._font_file, round(size * self._unit)), anchor, **edge)

    def _width(self, text: str, size: float) -> float:
        return _font(self._font_file, round(size * self._unit)).getlength(text) / self._unit


@functools.cache
def _font(file: Path, pixels: int):
    from PIL import ImageFont

    return ImageFont.truetype(str(file), max(1, pixels))


def _pieces(points: np.ndarray) -> list[np.ndarray]:
    """Split a line (k,2) at its gaps, which are rows of NaN; return the pieces of two or more points."""
    gap = np.isnan(points).any(axis=1)
    parts = (part[~np.isnan(part).any(axis=1)] for part in np.split(points, np.flatnonzero(gap)))
    return [part for part in parts if len(part) > 1]


def _bytes(colour) -> tuple[int, int, int]:
    return tuple(round(255 * float(c)) for c in colour)
