"""Plots in the live window: a column at its right edge, each a box with curves beside its numbers, which are GGUI text.

GGUI writes text only in sub-windows. It positions each once, by name, in units of the window's initial size. So the name of a
sub-window contains its position and size, which change with the window and the visible plots.
"""

import math
import time
from dataclasses import dataclass

import numpy as np

from taisoft.view.plots import CAPACITY, GRID_LINES, PLOTS, Curves, Plots

BOX, TEXT, GAP, LINE, TITLE = 230, 200, 8, 17, 34  # widths; heights of a line of text and of title and borders [pixels]
FRAME_COLOUR, GRID_COLOUR = (0.45, 0.46, 0.48), (0.84, 0.85, 0.86)  # sRGB
BOX_COLOUR = (0.97, 0.975, 0.98)
REFRESH = 0.2  # time between updates of the curves [s]
LIGHTER = 0.55  # blend of a curve's colour towards white for its numbers, which have a dark background
MAX_BOXES = len(PLOTS)
MAX_SEGMENTS = sum(4 + 2 * GRID_LINES + len(plot.series) * 2 * CAPACITY for plot in PLOTS.values())


@dataclass(frozen=True)
class Cell:
    """A plot in the window. box, text: left, top, width, height in pixels."""

    curves: Curves
    box: tuple[int, int, int, int]
    text: tuple[int, int, int, int]

    def contains(self, x: float, y: float) -> bool:
        """Return whether a pixel lies in the plot."""
        return any(a <= x <= a + w and b <= y <= b + h for a, b, w, h in (self.box, self.text))


class PlotOverlay:
    """The visible plots in the window, updated when the choice or the window changes, and otherwise every REFRESH seconds.

    opened: initial size of the window, (width, height) in pixels.
    """

    def __init__(self, plots: Plots, opened: tuple[int, int]):
        self.plots, self.cells, self._opened = plots, [], opened
        self._drawing = drawing([], (1, 1))
        self._drawn_for, self._drawn_at = None, -math.inf  # plots and size of the drawing; its time [s]

    def draw(self, canvas, gui, size: tuple[int, int]) -> None:
        """Draw boxes and lines by a `Canvas`, and numbers by GGUI."""
        content, now = (self.plots.visible(), size), time.perf_counter()
        if content != self._drawn_for or now - self._drawn_at >= REFRESH:
            self.cells = cells(self.plots, size)
            self._drawing, self._drawn_for, self._drawn_at = drawing(self.cells, size), content, now
        if self.cells:
            canvas.draw_over(*self._drawing, (MAX_BOXES, MAX_SEGMENTS), BOX_COLOUR)
            write(gui, self.cells, self._opened)

    def contains(self, x: float, y: float) -> bool:
        """Return whether a pixel, counted from the upper left corner, lies in one of the plots."""
        return any(cell.contains(x, y) for cell in self.cells)


def cells(plots: Plots, size: tuple[int, int]) -> list[Cell]:
    """Lay out the visible plots from the top down, as many as fit in a window of size (width, height)."""
    found, top = [], GAP
    for curves in [plots.curves(name) for name in plots.visible()]:
        height = TITLE + LINE * (len(curves.legend) + 2)
        left = size[0] - GAP - BOX
        if top + height > size[1] or left - TEXT < 0:
            break
        found.append(Cell(curves, (left, top, BOX, height), (left - TEXT, top, TEXT, height)))
        top += height + GAP
    return found


def drawing(shown: list[Cell], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the boxes (k,4), ends of lines (2n,2) and their colours (2n,3) to pass to `Canvas.draw_over`."""
    boxes, ends, colours = np.empty((len(shown), 4)), [np.empty((0, 2))], [np.empty((0, 3))]
    for k, cell in enumerate(shown):
        left, top, width, height = cell.box
        boxes[k] = left / size[0], 1 - (top + height) / size[1], (left + width) / size[0], 1 - top / size[1]
        across = [np.array([(0.0, y), (1.0, y)]) for y in cell.curves.grid]
        frame = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)], dtype=float)
        lines = [(GRID_COLOUR, line) for line in across] + cell.curves.lines + [(FRAME_COLOUR, frame)]
        for colour, points in lines:
            pairs = np.stack([points[:-1], points[1:]], axis=1)
            pairs = pairs[np.isfinite(pairs).all(axis=(1, 2))].reshape(-1, 2)
            ends.append(boxes[k, :2] + pairs * (boxes[k, 2:] - boxes[k, :2]))
            colours.append(np.tile(colour, (len(pairs), 1)))
    return boxes, np.concatenate(ends), np.concatenate(colours)


def write(gui, shown: list[Cell], opened: tuple[int, int]) -> None:
    """Write the numbers of the plots in sub-windows of GGUI; opened: as for `PlotOverlay`."""
    for cell in shown:
        curves, (left, top, width, height) = cell.curves, cell.text
        rectangle = left / opened[0], top / opened[1], width / opened[0], height / opened[1]
        with gui.sub_window(f"{curves.title}##{cell.text}", *rectangle) as page:
            for name, value, colour in curves.legend:
                lighter = tuple(LIGHTER + (1 - LIGHTER) * c for c in colour)
                page.text(f"{name:9}{value:>13}", color=lighter)
            page.text(f"axis {curves.ends[0]} to {curves.ends[1]}")
            page.text(f"time {curves.times[0]:.4g} to {curves.times[1]:.4g} s")
