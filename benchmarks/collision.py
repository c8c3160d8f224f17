"""Collision detection: time of a search and its phases, broad phases and reductions, over size and over frames.

taisoft bench collision [--quick] [--arch cpu|cuda] [--precision f32|f64] [--out FILE.json]

Configurations: piles of 27 touching cubes, two cubes, and the report's scenes, by proximity of surfaces or by distance fields.
A time is the median over rounds of one phase or of a whole search, without copies to the host; phases are those of its kernels,
the rest is launches, the host and what else is measured of contacts (benchmarks/kinds.py). Spread is the interquartile range over
the median. The first search, which compiles kernels and grows buffers, is timed separately. Figure numbers are those of the
report, of which `taisoft bench report` judges claims by these numbers. The older code's times are quoted: a whole step with
contacts and solver on this class of machine. Exit status: 0, or 1 if a limit is not met. --quick has small meshes, few rounds and
frames, and no limits. A full run takes about fifteen minutes on two cores.
"""

import sys
from contextlib import closing

import numpy as np

from taisoft.backend.runtime import Runtime, open_runtime
from taisoft.output.tables import percent, spread_of

from .collision_cases import CUBES, FRAMES, LARGE_PILE, OLDER, PILES, RATIOS, REPORT, SHEET, SWEPT, cubes_setup, pile_setup
from .collision_rig import HASH, PHASES, TREES
from .collision_runs import GEOMETRIES, QUICK_ROUNDS, ROUNDS, TURNS, Film, Row, Sweep, measure_broad, measure_film, measure_row
from .document import Document, Limit, begin, crossovers, ms, table, timed_limit
from .runner import REST, make_parser, parse_options

QUICK_FRAMES = 3
MANY = 15  # cells of two cubes whose contacts are many, for the reduction over frames
CELL_ROUNDS, CELL_TURNS = 60, 20  # many, since similar cells differ little
LIMITS = {pile_setup(6).name: 8.0, pile_setup(LARGE_PILE).name: 80.0}  # [ms] a whole search, f32 on two cores
MIN_SPEEDUP = 1000.0  # sheet and cube, over the older code
REPORTS_BEST = 2.2  # the report's best ratio of cell to edge


def measure(quick: bool, runtime: Runtime, document: Document) -> dict:
    """Measure and print everything: rows, films and sweeps by name."""
    rounds, frames = (QUICK_ROUNDS, QUICK_FRAMES) if quick else (ROUNDS, FRAMES)
    few = slice(2 if quick else None)

    def rows(setups) -> list:
        return [measure_row(setup, geometry, runtime, rounds) for setup in setups for geometry in GEOMETRIES]

    piles = rows([pile_setup(n) for n in (*PILES[few], *(() if quick else (LARGE_PILE,)))])
    document.add("## Piles of 27 cubes at rest, touching (fig. 12)\n\n" + row_table(piles))
    scenes = rows(REPORT[few])
    document.add("## The report's scenes\n\n" + row_table(scenes) + "\n\n" + older_table(scenes))
    films = [measure_film(SHEET, geometry, runtime, frames) for geometry in GEOMETRIES]
    films.append(measure_film(cubes_setup(SWEPT[0]), GEOMETRIES[0], runtime, frames, broad=True))
    if not quick:
        films.append(measure_film(cubes_setup(MANY), GEOMETRIES[0], runtime, frames))
    document.add(f"## Over {frames} frames (figs. 11, 13, 17)\n\n" + film_table(films))
    document.add("## Reduction (fig. 14)\n\n" + reduction_table(piles))
    broad = [sweep for n in CUBES[few] for sweep in measure_broad(cubes_setup(n), runtime, rounds)]
    document.add("## Broad phases, two cubes (fig. 17)\n\n" + broad_table(broad) + "\n\n" + crossover_text(broad))
    rounds, turns = (QUICK_ROUNDS, TURNS) if quick else (CELL_ROUNDS, CELL_TURNS)
    setups = [cubes_setup(n) for n in SWEPT[: 1 if quick else None]]
    cells = [s for setup in setups for s in measure_broad(setup, runtime, rounds, RATIOS[few], turns)]
    document.add("## Cells of the spatial hash (fig. 18)\n\n" + cell_table(cells))
    return {"piles": piles, "scenes": scenes, "films": films, "broad": broad, "cells": cells}


# --- tables and limits --------------------------------------------------------------------------------------------------


def row_table(rows: list[Row]) -> str:
    """A row per configuration and geometry; failures below."""

    def phase(name: str):
        return lambda r: ms(r.phase(name)) if r.whole else "-"

    columns = [("<scene", "{.setup}"), ("<geometry", "{.geometry}")]
    columns += [(name, f"{{.{name}:,}}") for name in ("tets", "triangles", "active", "pairs", "found", "contacts")]
    columns += [(f"{name} [ms]", phase(name)) for name in (*PHASES, REST)]
    columns += [
        ("whole [ms]", lambda r: ms(r.timing.median) if r.whole else "-"),
        ("spread", lambda r: percent(spread_of(r.timing)) if r.whole else "-"),
        ("first [s]", "{.first:.1f}"),
        ("compile [s]", "{.compile_seconds:.1f}"),
        ("fields [MB]", lambda r: f"{r.field_bytes / 1e6:.1f}"),
    ]
    return table(rows, columns, [f"{r.setup}, {r.geometry}: {r.failure}" for r in rows if r.failure])


def older_table(rows: list[Row]) -> str:
    """The report's scenes and the quoted time of a whole step of the older code."""

    def quoted(r: Row) -> str:
        low, high = OLDER[r.setup]
        return f"{low:,.0f}" if low == high else f"{low:,.0f} to {high:,.0f}"

    columns = (
        ("<scene", "{.setup}"),
        ("<geometry", "{.geometry}"),
        ("search [ms]", lambda r: ms(r.timing.median)),
        ("older code, whole step [ms]", quoted),
        ("speed-up, at least", lambda r: f"{OLDER[r.setup][0] / (1e3 * r.timing.median):,.0f}"),
    )
    return table([r for r in rows if r.setup in OLDER and r.whole], columns)


def film_table(films: list[Film]) -> str:
    """Median, minimum and maximum of each number over the frames."""
    lines = []
    for film in films:
        for name, values in film.numbers.items():
            seconds = isinstance(values[0], float)
            shown = [ms(v) if seconds else f"{v:,.0f}" for v in (np.median(values), min(values), max(values))]
            lines.append((film.setup, film.geometry, f"{name} [ms]" if seconds else name, *shown))
    headings = ("<scene", "<geometry", "<number", "median", "minimum", "maximum")
    return table(lines, [(heading, f"{{[{k}]}}") for k, heading in enumerate(headings)])


def reduction_table(rows: list[Row]) -> str:
    """The O(n) reduction and that by two nested loops."""
    columns = (
        ("<scene", "{.setup}"),
        ("<geometry", "{.geometry}"),
        ("tets", "{.tets:,}"),
        ("found", "{.found:,}"),
        ("contacts", "{.contacts:,}"),
        ("O(n) [ms]", lambda r: ms(r.phase("reduction"))),
        ("O(n^2) [ms]", lambda r: ms(np.median(r.quadratic))),
        ("ratio", lambda r: f"{np.median(r.quadratic) / r.phase('reduction'):.3g}"),
        ("same contacts", lambda r: "yes" if r.same else "NO"),
    )
    return table([r for r in rows if r.quadratic], columns)


def broad_table(sweeps: list[Sweep]) -> str:
    """Times of the broad phases over tets."""
    columns = [("<scene", "{.setup}"), ("tets", "{.tets:,}"), ("triangles", "{.triangles:,}")]
    columns += [("pairs, k = 6", lambda s: f"{s.pairs[HASH]:,}"), ("pairs, k = 18", lambda s: f"{s.pairs[TREES[-1]]:,}")]
    columns += [(f"{name} [ms]", lambda s, name=name: ms(s.median(name))) for name in (HASH, *TREES)]
    return table(sweeps, columns)


def crossover_text(sweeps: list[Sweep]) -> str:
    """A line per tree; in the report the hash is slower below about 7,500 tets and faster above."""
    tets, lines = [s.tets for s in sweeps], []
    for name in TREES:
        hashed, trees = [s.median(HASH) for s in sweeps], [s.median(name) for s in sweeps]
        places = ", ".join(f"{x:,.0f}" for x in crossovers(tets, hashed, trees))
        first = HASH if hashed[0] < trees[0] else name
        found = f"crossover at {places} tets, below the first {first} is faster"
        lines.append(f"* {HASH} against {name}: {found if places else f'no crossover, {first} is faster throughout'}")
    return "\n".join(lines)


def cell_table(sweeps: list[Sweep]) -> str:
    """Time of the hash over its cell size, a column per scene, and the best."""
    by = {(s.setup, s.at): s for s in sweeps}
    columns, notes = [("cell / edge", "{:g}")], []
    for scene, own in by_scene(sweeps).items():
        columns.append((f"{scene} [ms]", lambda at, scene=scene: ms(by[scene, at].median(HASH))))
        best = best_cell(own)
        near = [s.at for s in own if s.median(HASH) <= 1.05 * best.median(HASH)]
        span = f"within 5 % of it from {min(near):g} to {max(near):g}"
        notes.append(f"{scene}, {best.tets:,} tets: best at {best.at:g}, {span}; the report: {REPORTS_BEST:g}")
    return table(sorted({s.at for s in sweeps}), columns, notes)


def by_scene(sweeps: list[Sweep]) -> dict[str, list[Sweep]]:
    """Sweeps by scene."""
    return {scene: [s for s in sweeps if s.setup == scene] for scene in dict.fromkeys(s.setup for s in sweeps)}


def best_cell(sweeps: list[Sweep]) -> Sweep:
    """The sweep with the fastest hash."""
    return min(sweeps, key=lambda s: s.median(HASH))


def find_limits(rows: list[Row], films: list[Film]) -> list[Limit]:
    """Limits on the time of searches, the speed-up of sheet and cube over the older code, and equal reductions."""
    by = {(r.setup, r.geometry): r for r in rows}
    limits = []
    for setup, limit in LIMITS.items():
        for geometry in GEOMETRIES:
            r = by.get((setup, geometry))
            what = f"{setup}, {geometry}, {r.triangles if r else 0:,} triangles: whole search [ms]"
            limits.append(timed_limit(what, r.timing if r else None, limit, 1e3))
    for r in (r for r in rows if r.setup == SHEET.name):
        gain = OLDER[r.setup][0] / (1e3 * r.timing.median) if r.whole else np.nan
        what = f"{r.setup}, {r.geometry}: older code's whole step (quoted) / search"
        limits.append(Limit(what, gain, MIN_SPEEDUP, spread_of(r.timing) if r.whole else None, at_least=True))
    unequal = sum(r.same is False for r in rows) + sum(not film.same for film in films)
    return [*limits, Limit("reductions that differ from two nested loops", unequal, 0)]


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("collision", __doc__)
    parser.add_argument("--quick", action="store_true", help="small meshes, few rounds and frames, no limits")
    parser.add_argument("--precision", choices=("f32", "f64"), default="f32", help="of everything but positions (default f32)")
    options = parse_options(parser, argv)
    document, numbers = begin("Collision detection", options.arch, options.precision)
    with closing(open_runtime(options.arch, options.precision, "the benchmark of collision detection")) as runtime:
        found = measure(options.quick, runtime, document)
    limits = [] if options.quick else find_limits(found["piles"] + found["scenes"], found["films"])
    return document.finish(options, numbers | found, limits)


if __name__ == "__main__":
    sys.exit(main())
