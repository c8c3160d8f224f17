"""Plots of benchmarks: panels of curves side by side, with one legend, as a figure of matplotlib."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from taisoft.output.tables import require_matplotlib, save, ticks

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#555555")
PANEL = (4.4, 3.3)  # inches
CURVE, LEVEL = {"ms": 4, "lw": 1.4}, {"color": "#555555", "lw": 0.9, "ls": "--"}


@dataclass
class Panel:
    """A plot. log: its logarithmic axes, such as "xy"; curves: x, y and style of each; levels: axis, value and style."""

    title: str
    x: str = ""
    y: str = ""
    log: str = ""
    curves: list[tuple[Sequence, Sequence, dict]] = field(default_factory=list)
    levels: list[tuple[str, float, dict]] = field(default_factory=list)

    def curve(self, x: Sequence, y: Sequence, label: str, colour: int | str, line: str = "o-", **style) -> None:
        """Add a curve. colour: a number of COLOURS or a colour; line, style: as `plot` of matplotlib has them."""
        colour = COLOURS[colour % len(COLOURS)] if isinstance(colour, int) else colour
        marker, dashes = (line[0], line[1:]) if line[:1] in "os^" else ("", line)
        more = {"color": colour, "marker": marker, "ls": dashes or "none", "label": label}
        self.curves.append((x, y, CURVE | more | style))

    def level(self, axis: str, at: float, label: str = "", **style) -> None:
        """Add a line across the panel at a value of an axis, "x" or "y"."""
        self.levels.append((axis, at, LEVEL | {"label": label} | style))


def figure_of(panels: Sequence[Panel], columns: int = 3, dpi: int = 100):
    """A figure of these panels. Raises OutputError without matplotlib."""
    require_matplotlib("a plot")
    from matplotlib import pyplot

    columns = min(columns, len(panels))
    lines = -(-len(panels) // columns)
    size = PANEL[0] * columns, PANEL[1] * lines + 0.4
    figure, grid = pyplot.subplots(lines, columns, figsize=size, dpi=dpi, squeeze=False, layout="constrained")
    handles: dict = {}
    for axes, panel in zip(grid.flat, panels):
        handles |= _fill(axes, panel)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    if handles:
        place = {"loc": "outside upper center", "ncols": min(len(handles), 2 * columns)}
        figure.legend(handles.values(), handles.keys(), frameon=False, fontsize="small", **place)
    return figure


def _fill(axes, panel: Panel) -> dict:
    """Draw a panel; returns label -> handle."""
    handles = {}
    for x, y, style in panel.curves:
        (handles[style["label"]],) = axes.plot(x, y, **style)
    scales = {f"{axis}scale": "log" if axis in panel.log else "linear" for axis in "xy"}
    axes.set(title=panel.title, xlabel=panel.x, ylabel=panel.y, **scales)
    for axis, at, style in panel.levels:
        handles[style["label"]] = (axes.axvline if axis == "x" else axes.axhline)(at, **style)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if axis.get_scale() == "log":
            ticks(axis, high / low)
    axes.grid(True, which="major", color="#eeeeee")
    axes.set_axisbelow(True)
    return {label: handle for label, handle in handles.items() if label}


def write_plot(path: Path, panels: Sequence[Panel], columns: int = 3) -> None:
    """Write a PNG. Raises OutputError."""
    save(figure_of(panels, columns), path)
