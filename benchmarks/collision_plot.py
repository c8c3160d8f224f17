"""The picture of `collision.py`: a panel for each of the report's figures on the collision system."""

from pathlib import Path

from taisoft.output.tables import log_ticks, require_matplotlib, save

from .collision_runs import GEOMETRIES, HASH, TREES, Film, Row, Sweep
from .collision_table import REPORTS_BEST, best_cell

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
COLUMNS, PANEL = 4, (4.2, 3.2)  # panels in a row, their size in inches


def draw(found: dict, path: Path) -> None:
    """Write a PNG. found: "piles" rows, "films", "broad" and "cells" sweeps. Raises OutputError where it cannot be written."""
    require_matplotlib()
    from matplotlib import pyplot

    piles, films = [r for r in found["piles"] if r.whole], found["films"]
    panels = [
        ("contacts of each frame (fig. 11)", "frame", lambda p: _frames(p, films, "contacts", None)),
        ("contacts against tets (fig. 12)", "tets", lambda p: _rows(p, piles, lambda r: r.phase("contacts"))),
        ("reduction of each frame (fig. 13)", "frame", lambda p: _frames(p, films[:1], "reduction", "quadratic")),
        ("reduction against tets (fig. 14)", "tets", lambda p: _reductions(p, piles)),
        ("broad phase of each frame (fig. 17)", "frame", lambda p: _broad_frames(p, films[-1])),
        ("broad phase against tets (fig. 17)", "tets", lambda p: _broad(p, found["broad"])),
        ("cell of the hash (fig. 18)", "cell / mean edge", lambda p: _cells(p, found["cells"])),
        ("whole search of a pile", "surface triangles", lambda p: _rows(p, piles, lambda r: r.timing.median, "triangles")),
    ]
    size = PANEL[0] * COLUMNS, PANEL[1] * (len(panels) // COLUMNS)
    figure, grid = pyplot.subplots(len(panels) // COLUMNS, COLUMNS, figsize=size, layout="constrained")
    for panel, (title, below, plot) in zip(grid.flat, panels):
        plot(panel)
        panel.set(title=title, xlabel=below, ylabel="ms")
        panel.grid(True, which="major", color="#eeeeee")
        panel.set_axisbelow(True)
        log_ticks(panel)
        if panel.get_legend_handles_labels()[1]:
            panel.legend(fontsize="small", frameon=False)
    save(figure, path)


def _ms(seconds) -> list[float]:
    return [1e3 * s for s in seconds]


def _frames(panel, films: list[Film], number: str, beside: str | None) -> None:
    """A number of each film over its frames, and another one beside it."""
    for film, colour in zip(films, COLOURS):
        label = f"{film.setup}, {film.geometry}"
        panel.plot(_ms(film.numbers[number]), color=colour, label=label if beside is None else "O(n)")
        if beside is not None:
            panel.plot(_ms(film.numbers[beside]), ":", color=COLOURS[1], label="O(n^2)")
    panel.set_ylim(bottom=0)


def _rows(panel, rows: list[Row], seconds, restart_test: str = "tets") -> None:
    """A time of each geometry against size."""
    for geometry, colour in zip(GEOMETRIES, COLOURS):
        own = [r for r in rows if r.geometry == geometry]
        if own:
            panel.plot([getattr(r, restart_test) for r in own], _ms(map(seconds, own)), "o-", color=colour, label=geometry)
    panel.set(xscale="log", yscale="log")


def _reductions(panel, rows: list[Row]) -> None:
    own = [r for r in rows if r.geometry == GEOMETRIES[0] and r.quadratic]
    if own:
        tets = [r.tets for r in own]
        panel.plot(tets, _ms(r.phase("reduction") for r in own), "o-", color=COLOURS[0], label="O(n)")
        panel.plot(tets, _ms(sorted(r.quadratic)[len(r.quadratic) // 2] for r in own), "s:", color=COLOURS[1], label="O(n^2)")
    panel.set(xscale="log", yscale="log")


def _broad_frames(panel, film: Film) -> None:
    for name, colour in zip((HASH, *TREES), COLOURS):
        panel.plot(_ms(film.numbers[name]), color=colour, label=name)
    panel.set_ylim(bottom=0)


def _broad(panel, sweeps: list[Sweep]) -> None:
    for name, colour in zip((HASH, *TREES), COLOURS):
        panel.plot([s.tets for s in sweeps], _ms(s.median(name) for s in sweeps), "o-", color=colour, ms=4, label=name)
    panel.set(xscale="log", yscale="log")


def _cells(panel, sweeps: list[Sweep]) -> None:
    """Times over the best one, since the scenes' sizes differ."""
    for scene, colour in zip(dict.fromkeys(s.setup for s in sweeps), COLOURS):
        own = [s for s in sweeps if s.setup == scene]
        panel.plot([s.at for s in own], _ms(s.median(HASH) for s in own), "o-", color=colour, ms=4, label=f"{own[0].tets:,} tets")
        best = best_cell(own)
        panel.plot(best.at, 1e3 * best.median(HASH), "*", color=colour, ms=13)
    panel.axvline(REPORTS_BEST, color="#555555", lw=0.9, ls="--", label="the report's best")
    panel.set(yscale="log")
