"""The picture of `peers.py`: error against time, one panel a work whose path is known."""

from pathlib import Path

from taisoft.output.tables import require_matplotlib, save, ticks
from taisoft.study.pareto import front

from .runs import Row

STYLES = {"taisoft": ("#d55e00", "o"), "MuJoCo": ("#0072b2", "s"), "PyBullet": ("#009e73", "^"), "Newton": ("#cc79a7", "D")}
COLUMNS, PANEL = 3, (4.2, 3.4)  # panels in a row, their size in inches


def draw(works: list[list[Row]], path: Path) -> None:
    """Write a PNG; nothing where no path is known. Raises OutputError where it cannot be written or drawn."""
    works = [rows for rows in works if rows[0].work.kind == "path" and any(row.timing for row in rows)]
    if not works:
        return
    require_matplotlib()
    from matplotlib import pyplot

    lines = -(-len(works) // COLUMNS)
    figure, grid = pyplot.subplots(
        lines, COLUMNS, figsize=(PANEL[0] * COLUMNS, PANEL[1] * lines + 0.4), squeeze=False, layout="constrained"
    )
    for panel in grid.flat[len(works) :]:
        panel.set_visible(False)
    drawn: dict = {}
    for panel, rows in zip(grid.flat, works):
        drawn |= _panel(panel, rows)
    figure.legend(drawn.values(), drawn.keys(), loc="outside upper center", ncols=len(drawn), frameon=False)
    figure.supxlabel("wall time of a simulated second [s], median")
    figure.supylabel("error [%]")
    save(figure, path, dpi=100)


def _panel(panel, rows: list[Row]) -> dict:
    timed = [row for row in rows if row.timing is not None]
    points = [(row.timing.median, 100 * row.claimed) for row in timed]
    handles = {}
    for name, (colour, marker) in STYLES.items():
        own = [p for p, row in zip(points, timed) if row.setting.program == name]
        if own:
            (handles[name],) = panel.plot(*zip(*own), marker, color=colour, ms=5)
    best = [points[k] for k in front(points)]
    (handles["front"],) = panel.step(*zip(*best), where="post", color="#888888", lw=1.0, ls="--")
    panel.set(xscale="log", yscale="log", title=f"{rows[0].work.key}, {rows[0].work.tets:,} tets")
    for axis, values in zip((panel.xaxis, panel.yaxis), zip(*points)):
        ticks(axis, max(values) / min(values))
    panel.grid(True, which="major", color="#eeeeee")
    panel.set_axisbelow(True)
    return handles
