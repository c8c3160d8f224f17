"""Collision detection: time of a search and its phases, broad phases and reductions, over size and over frames.

taisoft bench collision [--quick] [--arch cpu|cuda] [--precision f32|f64] [--out FILE.json]

Configurations: piles of 27 touching cubes, two cubes, and the report's scenes, by proximity of surfaces or by distance fields.
A time is the median over rounds of one phase or of a whole search, without copies to the host; phases are those of its kernels,
the rest is launches, the host and what else is measured of contacts (benchmarks/kinds.py). Spread is the interquartile range
over the median. The first search, which compiles kernels and grows buffers, is timed separately. Figure numbers are those of
the report, of which `taisoft bench report` judges claims by these numbers. Exit status: 0, or 1 if a limit is not met. --quick
has small meshes, few rounds and frames, and no limits. A full run takes about fifteen minutes on two cores.
"""

import sys
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.backend.runtime import Runtime, compile_clock, open_runtime
from taisoft.machine import Timing, summarise
from taisoft.output.tables import percent, spread_of

from .collision_cases import CUBES, FRAMES, LARGE_PILE, PILES, RATIOS, REPORT, SHEET, SWEPT, Setup, cubes_setup, pile_setup
from .collision_runs import HASH, PHASES, TREES, Quadratic, Rig, phases_of
from .document import Document, Limit, begin, ms, table, timed_limit
from .kinds import watching
from .runner import REST, clock, make_parser, parse_options, repeated

GEOMETRIES = ("proximity", "distance_field")
ROUNDS, QUICK_ROUNDS = 15, 2
FRAME_ROUNDS = 3
TURNS = 3  # the rounds of compared broad phases are divided into this many turns
QUICK_FRAMES = 3
MANY = 15  # cells of two cubes whose contacts are many, for the reduction over frames
CELL_ROUNDS, CELL_TURNS = 60, 20  # many, since similar cells differ little
LIMITS = {pile_setup(6).name: 8.0, pile_setup(LARGE_PILE).name: 80.0}  # [ms] a whole search, f32 on two cores


@dataclass
class Row:
    """Search of a configuration. phases, whole, quadratic: wall seconds per round; first: of the first search, with compilation;
    same: whether the quadratic reduction kept the same contacts."""

    setup: str
    geometry: str
    tets: int = 0
    triangles: int = 0
    active: int = 0
    pairs: int = 0
    found: int = 0
    contacts: int = 0
    phases: dict[str, list[float]] = field(default_factory=dict)
    whole: list[float] = field(default_factory=list)
    quadratic: list[float] = field(default_factory=list)
    same: bool | None = None
    first: float = 0.0
    compile_seconds: float = 0.0
    field_bytes: int = 0
    failure: str = ""

    @property
    def timing(self) -> Timing | None:
        """Timing of a whole search [s]; None if it failed."""
        return summarise(self.whole) if self.whole else None

    def phase(self, name: str) -> float:
        """Median time of a phase [s]."""
        return float(np.median(self.phases[name]))

    def record(self) -> dict:
        """The row as plain data."""
        return asdict(self) | {"seconds": self.timing and asdict(self.timing)}


@dataclass
class Film:
    """A configuration in motion. numbers: a list over frames of each; times are medians over FRAME_ROUNDS [s]; same: whether the
    quadratic reduction kept the same contacts in every frame."""

    setup: str
    geometry: str
    tets: int
    same: bool = True
    numbers: dict[str, list] = field(default_factory=dict)

    def add(self, **numbers) -> None:
        """Append a frame."""
        for name, value in numbers.items():
            self.numbers.setdefault(name, []).append(value)


@dataclass
class Sweep:
    """Times [s] of broad phases. at: the parameter, tets or cell size over the mean edge; rounds: times by broad phase."""

    what: str
    setup: str
    at: float
    tets: int
    triangles: int
    pairs: dict[str, int] = field(default_factory=dict)
    rounds: dict[str, list[float]] = field(default_factory=dict)

    def median(self, name: str) -> float:
        """Median time of a broad phase [s]."""
        return float(np.median(self.rounds[name]))


def measure_row(setup: Setup, geometry: str, runtime: Runtime, rounds: int) -> Row:
    """Counts and times of a configuration's search; the row records a failure."""
    row = Row(setup.name, geometry)
    try:
        with Rig(setup, geometry, runtime) as rig:
            row.tets, row.triangles = rig.tets, rig.detection.surface.n_triangles
            before, begin = compile_clock(), clock()
            rig.search()
            row.first, row.compile_seconds = clock() - begin, compile_clock() - before
            rig.search()
            counts = rig.detection.counts
            row.active, row.found, row.contacts, row.pairs = counts.active, counts.found, counts.contacts, rig.n_pairs()
            row.field_bytes = sum(rig.detection._arena.bytes.values())
            row.whole = repeated(rig.search, rounds)
            with watching() as spend:
                taken = [phases_of(spend(rig.search)) for _ in row.whole]
            row.phases = {name: [one[name] for one in taken] for name in (*PHASES, REST)}
            with Quadratic(rig.detection) as quadratic:
                row.same, row.quadratic = quadratic.same(), repeated(quadratic.reduce, rounds)
    except ts.TaisoftError as error:
        row.failure = str(error)
    return row


def measure_film(setup: Setup, geometry: str, runtime: Runtime, frames: int = FRAMES, broad: bool = False) -> Film:
    """Phases and quadratic reduction of every frame. broad: also all broad phases."""
    with Rig(setup, geometry, runtime) as rig:
        film, others = Film(setup.name, geometry, rig.tets), {}
        if broad:
            others = {name: rig.broad_phase(name) for name in (HASH, *TREES)}
        for k in range(-1, frames):  # the last frame first, to compile and to grow buffers
            rig.place(1.0 if k < 0 else k / max(frames - 1, 1))
            rig.search()
            with watching() as spend:
                taken = [phases_of(spend(rig.search)) for _ in range(FRAME_ROUNDS)]
            numbers = {name: float(np.median([one[name] for one in taken])) for name in PHASES}
            with Quadratic(rig.detection) as quadratic:
                film.same &= quadratic.same()
                numbers["quadratic"] = float(np.median(repeated(quadratic.reduce, FRAME_ROUNDS)))
            for name, other in others.items():
                rig.n_pairs(other)
                numbers[name] = float(np.median(repeated(partial(rig.list_pairs, other), FRAME_ROUNDS)))
            if k >= 0:
                counts = rig.detection.counts
                film.add(active=counts.active, found=counts.found, kept=counts.contacts, **numbers)
    return film


def measure_broad(setup: Setup, runtime: Runtime, rounds: int, ratios=None, turns: int = TURNS) -> list[Sweep]:
    """All broad phases of a configuration in the middle of its motion, or the hash over ratios of cell to edge."""
    with Rig(setup, "proximity", runtime) as rig:
        rig.place(0.5)
        rig.search()
        size = rig.tets, rig.detection.surface.n_triangles
        if ratios is None:
            sweeps = [Sweep("tets", setup.name, rig.tets, *size)]
            jobs = [(sweeps[0], name, rig.broad_phase(name)) for name in (HASH, *TREES)]
        else:
            sweeps = [Sweep("ratio", setup.name, ratio, *size) for ratio in ratios]
            jobs = [(sweep, HASH, rig.broad_phase(HASH, sweep.at)) for sweep in sweeps]
        for sweep, name, broad in jobs:
            sweep.pairs[name] = rig.n_pairs(broad)  # compiles and grows buffers
            rig.n_pairs(broad)
        for _ in range(turns):  # a slow moment of the machine affects all
            for sweep, name, broad in jobs:
                some = repeated(partial(rig.list_pairs, broad), max(rounds // turns, 1))
                sweep.rounds.setdefault(name, []).extend(some)
    return sweeps


# --- tables and limits ------------------------------------------------------------------------------------------------


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


def cell_table(sweeps: list[Sweep]) -> str:
    """Time of the hash over its cell size, a column per scene."""
    by = {(s.setup, s.at): s for s in sweeps}
    columns = [("cell / edge", "{:g}")]
    columns += [(f"{scene} [ms]", lambda at, scene=scene: ms(by[scene, at].median(HASH))) for scene in by_scene(sweeps)]
    return table(sorted({s.at for s in sweeps}), columns)


def by_scene(sweeps: list[Sweep]) -> dict[str, list[Sweep]]:
    """Sweeps by scene."""
    return {scene: [s for s in sweeps if s.setup == scene] for scene in dict.fromkeys(s.setup for s in sweeps)}


def best_cell(sweeps: list[Sweep]) -> Sweep:
    """The sweep with the fastest hash."""
    return min(sweeps, key=lambda s: s.median(HASH))


def find_limits(rows: list[Row], films: list[Film]) -> list[Limit]:
    """Limits on the time of searches, and equal reductions."""
    by = {(r.setup, r.geometry): r for r in rows}
    limits = []
    for setup, limit in LIMITS.items():
        for geometry in GEOMETRIES:
            r = by.get((setup, geometry))
            what = f"{setup}, {geometry}, {r.triangles if r else 0:,} triangles: whole search [ms]"
            limits.append(timed_limit(what, r.timing if r else None, limit, 1e3))
    unequal = sum(r.same is False for r in rows) + sum(not film.same for film in films)
    return [*limits, Limit("reductions that differ from two nested loops", unequal, 0)]


# --- the whole --------------------------------------------------------------------------------------------------------


def measure(quick: bool, runtime: Runtime, document: Document) -> dict:
    """Measure and print everything: rows, films and sweeps by name."""
    rounds, frames = (QUICK_ROUNDS, QUICK_FRAMES) if quick else (ROUNDS, FRAMES)
    few = slice(2 if quick else None)

    def rows(setups) -> list:
        return [measure_row(setup, geometry, runtime, rounds) for setup in setups for geometry in GEOMETRIES]

    piles = rows([pile_setup(n) for n in (*PILES[few], *(() if quick else (LARGE_PILE,)))])
    document.add("## Piles of 27 cubes at rest, touching (fig. 12)\n\n" + row_table(piles))
    scenes = rows(REPORT[few])
    document.add("## The report's scenes\n\n" + row_table(scenes))
    films = [measure_film(SHEET, geometry, runtime, frames) for geometry in GEOMETRIES]
    films.append(measure_film(cubes_setup(SWEPT[0]), GEOMETRIES[0], runtime, frames, broad=True))
    if not quick:
        films.append(measure_film(cubes_setup(MANY), GEOMETRIES[0], runtime, frames))
    document.add(
        f"{len(films)} films of {frames} frames (figs. 11, 13, 17): numbers in the file, figures by `taisoft bench report`."
    )
    document.add("## Reduction (fig. 14)\n\n" + reduction_table(piles))
    broad = [sweep for n in CUBES[few] for sweep in measure_broad(cubes_setup(n), runtime, rounds)]
    document.add("## Broad phases, two cubes (fig. 17)\n\n" + broad_table(broad))
    rounds, turns = (QUICK_ROUNDS, TURNS) if quick else (CELL_ROUNDS, CELL_TURNS)
    setups = [cubes_setup(n) for n in SWEPT[: 1 if quick else None]]
    cells = [s for setup in setups for s in measure_broad(setup, runtime, rounds, RATIOS[few], turns)]
    document.add("## Cells of the spatial hash (fig. 18)\n\n" + cell_table(cells))
    return {"piles": piles, "scenes": scenes, "films": films, "broad": broad, "cells": cells}


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
