"""Captions, plots and colour bars on pictures, drawn by matplotlib, of the extra `plot`.

Plots are at the right, one below the other over the same times, a caption and a colour bar are below. All lengths are points of a
picture 720 points high, which scale with it. One Axes in these lengths holds everything, since Axes for each plot are slow.
"""

import math
from importlib.util import find_spec

import numpy as np

from taisoft.errors import OutputError
from taisoft.view.choices import COLOURS, Plot
from taisoft.view.colouring import Colouring, colours_of, round_up
from taisoft.view.drawn import DrawnState
from taisoft.view.plots import PlotChoice, series_of

HEIGHT, INCH = 720.0, 72.0
MARGIN, WIDTH, PLOT_HEIGHT = 16, 300, 134  # around everything; of the plots, lower if there are more than five
INSET = (50, 16, 18, 28)  # of the curves in a plot: left, right, below, above
TITLE_SIZE, TEXT_SIZE, SMALL_SIZE, TICK_SIZE = 22, 15, 11, 10  # font sizes
BAR, BAR_HEIGHT = (220, 12), 56  # width and height of the colour bar; height with its texts
INK, FAINT, GRID, PAPER = "#26292e", "#70747a", "#cdd0d4", "#fcfcfd"
DARK = 100  # mean value of the picture's lower left corner below which text on it is light
TICK_SPACE, MIN_SPAN, MAX_DECADES = 22, 1e-200, 12  # at least; values that span less count as constant; of a logarithmic axis
ROW = 45  # characters of a title and names that fit beside each other; else names are in the plot, one below the other


def text_missing() -> str:
    """Return what to install for text in pictures, as a sentence; empty if nothing is missing."""
    return "" if find_spec("matplotlib") else "text in pictures needs matplotlib: pip install 'taisoft[plot]'"


class Annotations:
    """Draws plots, a caption and a colour bar on the pictures of a run.

    plots: those that are drawn; name: the scene's name for the caption, or None for no caption; colouring: its scale is
    drawn as a colour bar, unless bodies have their own colours. Raises OutputError if matplotlib is missing.
    """

    def __init__(self, plots: PlotChoice | None = None, name: str | None = None, colouring: Colouring | None = None):
        if missing := text_missing():
            raise OutputError(missing)
        self._plots, self._name, self._colouring = plots, name, colouring
        self._size: tuple[int, int] | None = None
        self._bar: tuple | None = None  # what it shows, and its layer

    def draw(self, picture: np.ndarray, state: DrawnState, index: int) -> np.ndarray:
        """Return an annotated copy of a picture, uint8 (height, width, 3), of a state; index: frame number."""
        height, width = picture.shape[:2]
        self._on_dark = picture[-(height // 4) :, : width // 3 + 1].mean() < DARK
        plots = self._plots.visible() if self._plots is not None else []
        if plots or self._name is not None:
            self._clear((width, height))
        if plots:
            self._draw_plots(plots, width * HEIGHT / height - MARGIN)
        bottom = MARGIN  # of what comes next
        if self._name is not None:
            text = "   ".join(f"{name} {energy:.4g} J" for name, energy in state.energies.items())
            self._write((MARGIN, bottom), f"frame {index}   t = {state.time:.4f} s   {text}", TEXT_SIZE)
            self._write((MARGIN, bottom + TEXT_SIZE + 8), self._name, TITLE_SIZE)
            bottom += TEXT_SIZE + TITLE_SIZE + 24
        result = self._composed(picture) if plots or self._name is not None else picture.copy()
        if self._colouring is not None and (legend := self._colouring.legend()):
            texts = [text.strip() for text, _ in reversed(legend)]
            opacity, layer = self._bar_layer(texts, bottom, (width, height))
            part = result[-len(layer) :, : layer.shape[1]]
            part[:] = (1.0 - opacity) * part + opacity * layer + 0.5
        return result

    def _composed(self, picture: np.ndarray) -> np.ndarray:
        """Return a picture (height, width, 3) with all that has been added since `_clear` drawn over it."""
        pixels = np.asarray(self._renderer.buffer_rgba())
        for k in range(3):  # several times faster than all channels at once
            pixels[..., k] = picture[..., k]
        pixels[..., 3] = 255
        self._axes.figure.draw(self._renderer)
        return np.dstack([pixels[..., k] for k in range(3)])

    def _bar_layer(self, texts: list[str], bottom: float, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return opacity (h,w,1) and colours (h,w,3) of the lower left part of a picture with the colour bar.

        It is drawn again only when what it shows changes, or the size of the pictures.
        """
        key = *texts, bottom, size, self._on_dark, self._colouring.kind
        if self._bar is None or self._bar[0] != key:
            self._clear(size)
            np.asarray(self._renderer.buffer_rgba())[:] = 0
            self._draw_colour_bar(texts, bottom)
            self._axes.figure.draw(self._renderer)
            across, up = (math.ceil(length * size[1] / HEIGHT) for length in (2 * MARGIN + BAR[0], bottom + BAR_HEIGHT))
            pixels = np.asarray(self._renderer.buffer_rgba())[-up:, :across].astype(np.float32)
            self._bar = key, (pixels[..., 3:] / 255.0, pixels[..., :3])
        return self._bar[1]

    def _clear(self, size: tuple[int, int]) -> None:
        """Remove what is drawn; open Axes that cover a picture of another size [pixels]."""
        from matplotlib.backends.backend_agg import RendererAgg
        from matplotlib.figure import Figure

        if size == self._size:
            for artist in (*self._axes.texts, *self._axes.collections, *self._axes.images):
                artist.remove()
            return
        self._size, width = size, size[0] * HEIGHT / size[1]
        figure = Figure((width / INCH, HEIGHT / INCH), dpi=size[1] * INCH / HEIGHT, frameon=False)
        self._renderer = RendererAgg(*size, figure.dpi)
        self._axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, HEIGHT))
        self._axes.set_axis_off()

    def _write(self, at, text: str, size: float, colour=INK, align="left bottom", halo=True, beside=None, shift=(0, 0)):
        """Write text at a point, or at a fraction of another text `beside` it, shifted. halo: outline the letters."""
        from matplotlib.patheffects import withStroke

        ink, paper = (PAPER, INK) if self._on_dark and colour == INK and halo else (colour, PAPER)
        (ha, va), effects = align.split(), [withStroke(linewidth=3.0, foreground=paper, alpha=0.8)] if halo else []
        style = {"size": max(size, HEIGHT / self._size[1]), "color": ink, "ha": ha, "va": va, "path_effects": effects}
        options = {"annotation_clip": False, "parse_math": False}
        return self._axes.annotate(text, at, shift, beside or "data", "offset points", **style, **options)

    def _draw_colour_bar(self, texts: list[str], bottom: float) -> None:
        """Draw the colour bar from low to high, its numbers below it, and the name of its quantity above."""
        (width, height), bottom = BAR, bottom + TEXT_SIZE
        colours, place = colours_of(np.linspace(0.0, 1.0, width)), (MARGIN, MARGIN + width, bottom, bottom + height)
        self._axes.imshow(colours[None], aspect="auto", extent=place, zorder=2)
        self._write((MARGIN, bottom + height + 4), COLOURS[self._colouring.kind].title, TEXT_SIZE)
        for text, fraction, side in zip(texts, (0.0, 0.5, 1.0), ("left", "center", "right")):
            self._write((MARGIN + fraction * width, bottom - 3), text, SMALL_SIZE, align=f"{side} top")

    def _draw_plots(self, plots: list[Plot], right: float) -> None:
        """Draw plots from the top down, and times below the last one."""
        history, (before, after, below, above) = self._plots.history, INSET
        height = min(PLOT_HEIGHT, (HEIGHT - 2 * MARGIN - below) / len(plots))
        top, left = HEIGHT - MARGIN, right - WIDTH
        bottom = top - len(plots) * height
        self._axes.fill_between((left, right), bottom - below, top, color=PAPER, alpha=0.9, linewidth=0.0)
        for k, plot in enumerate(plots):
            self._draw_plot(plot, left + before, right - after, top - (k + 1) * height, height - above)
        for x, text in ((left + before, f"{history.begin:.4g}"), (right - after, f"{history.times[-1]:.4g} s")):
            self._write((x, bottom - 3), text, TICK_SIZE, FAINT, "center top", halo=False)

    def _draw_plot(self, plot: Plot, left: float, right: float, bottom: float, height: float) -> None:
        """Draw title and legend above the curves, which are filled between minima and maxima, and ticks at the left."""
        history, shown = self._plots.history, series_of(plot, self._plots.history)
        columns = [history.columns.index(one.quantity) for one in shown]
        ticks, curves = curves_of(history.low[:, columns], history.high[:, columns], plot.log, height / TICK_SPACE)
        levels, top = bottom + height * np.linspace(0.0, 1.0, len(ticks)), bottom + height
        self._axes.hlines(levels, left, right, color=GRID, linewidth=1.0, zorder=1)
        for level, tick in zip(levels, ticks):
            self._write((left - 4, level), f"{tick:.6g}", TICK_SIZE, FAINT, "right center", halo=False)
        title = f"{plot.title} [{plot.unit}]" if plot.unit else plot.title
        beside = self._write((left - INSET[0] + 8, top + 5), title, SMALL_SIZE, halo=False)
        x = left + (right - left) * (history.times - history.begin) / ((history.times[-1] - history.begin) or 1.0)
        for one, (low, high) in zip(shown, bottom + height * curves):
            self._axes.fill_between(x, low, high, facecolor=(*one.colour, 0.5), edgecolor=one.colour, linewidth=1.4)
        values = [f"{value:.3g} {plot.unit}".replace("nan", "-").rstrip() for value in history.last[columns]]
        in_row = len(title) + sum(len(one.name) for one in shown) <= ROW
        for k, (one, value) in enumerate(zip(shown, values)):
            if in_row:
                text = one.name if len(shown) > 1 else value
                beside = self._write((1, 0), text, SMALL_SIZE, one.colour, halo=False, beside=beside, shift=(8, 0))
            else:
                self._write((left + 4, top - 2 - k * SMALL_SIZE), f"{one.name}  {value}", SMALL_SIZE, one.colour, "left top")


def curves_of(low: np.ndarray, high: np.ndarray, log: bool, n: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ticks of an axis for minima and maxima (n,k) of curves, and the curves (k,2,n), where the axis is 0 to 1.

    log: whether it is logarithmic, in which case smaller values and zero lie on its lower end; else it contains 0. n: least
    number of ticks, about. Steps are 1, 2 or 5 times a power of ten, of the logarithm too.
    """
    values = np.append(low, high)
    values = np.log10(values[values > 0]) if log else np.append(values[np.isfinite(values)], 0.0)
    lowest, highest = (values.min(), values.max()) if len(values) else (0.0, 0.0)
    lowest = max(lowest, highest - MAX_DECADES) if log else lowest
    step = round_up((highest - lowest) / n) if highest - lowest > MIN_SPAN else 1.0
    step = max(step, 1.0) if log else step
    first, last = math.floor(lowest / step + 1e-9), math.ceil(highest / step - 1e-9)
    last = max(last, first + 1)
    ticks, curves = step * np.arange(first, last + 1), np.stack([low.T, high.T], axis=1)
    if log:
        ticks, curves = 10.0**ticks, np.log10(np.maximum(curves, np.finfo(float).tiny))
    return ticks, np.clip((curves / step - first) / (last - first), 0.0, 1.0)
