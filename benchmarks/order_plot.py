"""The picture of `order.py`: error against time, one panel a case, both axes logarithmic."""

import math
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.output.tables import require_matplotlib, save, ticks

from .order_cases import Case, Reference
from .order_runs import Row
from .order_table import GOAL, claimed

STYLES = {  # (order, degree) -> label, colour, marker, line
    (1, None): ("order 1", "#d55e00", "o", "-"),
    (2, 2): ("order 2, 4 points", "#0072b2", "s", "-"),
    (2, 4): ("order 2, 14 points", "#009e73", "^", ":"),
}
COLUMNS, PANEL = 3, (4.2, 3.2)  # panels in a row, their size in inches
SURE = 1e-5  # the lowest error that is drawn, for references that are exact


def draw(cases: list[tuple[Case, list[Row], Reference]], path: Path) -> None:
    """Write a PNG of all cases with their rows. Raises OutputError where it cannot be written or drawn."""
    require_matplotlib()
    from matplotlib import pyplot

    cases = [found for found in cases if any(r.error is not None and r.rounds for r in found[1])]
    if not cases:
        raise OutputError(f"{path}: there is nothing to draw, since no mesh has an error")
    columns = min(COLUMNS, len(cases))
    lines = math.ceil(len(cases) / columns)
    figure, grid = pyplot.subplots(
        lines, columns, figsize=(PANEL[0] * columns, PANEL[1] * lines + 0.5), squeeze=False, layout="constrained"
    )
    for panel in grid.flat[len(cases) :]:
        panel.set_visible(False)
    drawn: dict = {}
    for panel, (case, rows, reference) in zip(grid.flat, cases):
        drawn |= _panel(panel, case, rows, reference)
    figure.legend(drawn.values(), drawn.keys(), loc="outside upper center", ncols=min(len(drawn), 2 * columns), frameon=False)
    figure.supxlabel("time of a solution [s], median of the rounds")
    figure.supylabel("error [%]")
    save(figure, path)


def _panel(panel, case: Case, rows: list[Row], reference: Reference) -> dict:
    """One case; returns label -> handle of its lines."""
    handles = {}
    for (order, degree), (name, colour, marker, line) in STYLES.items():
        own = [r for r in rows if (r.order, r.degree) == (order, degree) and r.error is not None and r.rounds]
        if own:
            seconds = [r.timing.median for r in own]
            errors = [100 * max(claimed(r, reference), SURE) for r in own]
            (handles[name],) = panel.plot(seconds, errors, line, color=colour, marker=marker, ms=5, lw=1.6)
    handles[f"{GOAL:.0%} error"] = panel.axhline(100 * GOAL, color="#555555", lw=0.9, ls="--")
    if reference.uncertainty > 0.0:
        floor = 100 * reference.uncertainty
        handles["below the reference's own error"] = panel.axhspan(floor / 1e3, floor, color="#dddddd", lw=0)
    panel.set(xscale="log", yscale="log", title=f"{case.title}, {case.law}")
    shown = [r for r in rows if r.error is not None and r.rounds]
    errors = [100 * max(claimed(r, reference), SURE) for r in shown] + [100 * GOAL]
    panel.set_ylim(min(errors) / 1.6, max(errors) * 1.6)
    ticks(panel.yaxis, max(errors) / min(errors))
    seconds = [r.timing.median for r in shown]
    panel.set_xlim(min(seconds) / 1.6, max(seconds) * 1.6)
    ticks(panel.xaxis, max(seconds) / min(seconds))
    panel.grid(True, which="major", color="#eeeeee")
    panel.set_axisbelow(True)
    return handles
