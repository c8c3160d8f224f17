"""The picture of `scaling.py`: time per tet, bytes per second and memory per tet over the number of tets."""

from collections.abc import Callable, Sequence
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.output.tables import require_matplotlib, save, ticks

from .scaling_bytes import Copy, copy_rate
from .scaling_runs import KINDS, Row
from .scaling_table import measured

COLOURS = ("#0072b2", "#56b4e9", "#d55e00", "#009e73", "#cc79a7", "#e69f00")
PANEL = (4.6, 3.6)  # inches


def draw(rows: Sequence[Row], copies: Sequence[Copy], path: Path) -> None:
    """Write a PNG. Raises OutputError where it cannot be written or drawn."""
    require_matplotlib()
    from matplotlib import pyplot

    rows = measured(rows)
    if not rows:
        raise OutputError(f"{path}: there is nothing to draw, since nothing could be measured")
    panels: tuple[tuple[str, Callable[[Row], float]], ...] = (
        ("time of a step or a search [ns/tet]", lambda row: 1e9 * row.timing.median / row.tets),
        ("moved at least [GB/s]", lambda row: 1e-9 * row.moved / row.timing.median),
        ("fields [B/tet]", lambda row: sum(row.field_bytes.values()) / row.tets),
    )
    figure, axes = pyplot.subplots(1, 3, figsize=(3 * PANEL[0], PANEL[1] + 0.4), layout="constrained")
    for axis, (title, value) in zip(axes, panels):
        for kind, colour in zip(KINDS, COLOURS, strict=True):
            own = sorted((row for row in rows if row.kind == kind), key=lambda row: row.tets)
            if not own:
                continue
            axis.plot([row.tets for row in own], [value(row) for row in own], "o-", color=colour, ms=4, lw=1.5, label=kind)
        axis.set(xscale="log", yscale="log", title=title, xlabel="tets")
        values = [value(row) for row in rows]
        ticks(axis.yaxis, max(values) / min(values))
        ticks(axis.xaxis, max(row.tets for row in rows) / min(row.tets for row in rows))
        axis.xaxis.set_major_formatter("{x:,.0f}")
        axis.grid(True, which="major", color="#eeeeee")
        axis.set_axisbelow(True)
    for n in sorted({copy.threads for copy in copies}):
        line = axes[1].axhline(1e-9 * copy_rate(copies, n), color="#555555", lw=0.9, ls="--" if n == 1 else ":")
        line.set_label(f"a copy, {n} thread{'s' if n > 1 else ''}")
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=8)
    save(figure, path)
