"""Tables of `collision.py`, the crossover of two broad phases, the best cell, and the limits."""

import math
from collections.abc import Sequence

import numpy as np

from taisoft.output.tables import markdown, percent, spread_of

from .collision_cases import LARGE_PILE, OLDER, SHEET, pile_setup
from .collision_runs import GEOMETRIES, HASH, PHASES, TREES, Film, Row, Sweep
from .elasticity_table import Limit

LIMITS = {pile_setup(6).name: 8.0, pile_setup(LARGE_PILE).name: 80.0}  # [ms] of a whole search, f32 on two cores
WANTED_GAIN = 1000.0  # of the sheet and cube over the older code
REPORTS_BEST = 2.2  # ratio of cell to edge that the report found


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}"


def row_table(rows: list[Row]) -> str:
    """A row a configuration and geometry; what failed is told below."""
    lines = []
    for r in rows:
        t = r.timing
        times = ["-"] * (len(PHASES) + 2)
        if t is not None:
            times = [*(_ms(r.phase(name)) for name in PHASES), _ms(t.median), percent(spread_of(t))]
        sizes = (f"{n:,}" for n in (r.tets, r.triangles, r.active, r.pairs, r.found, r.contacts))
        rest = (f"{x:.1f}" for x in (r.first, r.compile_seconds, r.field_bytes / 1e6))
        lines.append((r.setup, r.geometry, *sizes, *times, *rest))
    headings = (
        "scene",
        "hit by",
        "tets",
        "triangles",
        "active",
        "pairs",
        "found",
        "contacts",
        *(f"{p} [ms]" for p in PHASES),
        "whole [ms]",
        "spread",
        "first [s]",
        "compile [s]",
        "fields [MB]",
    )
    notes = [f"* {r.setup}, {r.geometry}: {r.failure}" for r in rows if r.failure]
    return markdown(headings, lines, left=(0, 1)) + ("\n\n" + "\n".join(notes) if notes else "")


def older_table(rows: list[Row]) -> str:
    """The report's scenes beside a whole step of the older code, which is quoted."""
    lines = []
    for r in rows:
        if r.setup in OLDER and r.timing:
            low, high = OLDER[r.setup]
            quoted = f"{low:,.0f}" if low == high else f"{low:,.0f} to {high:,.0f}"
            ms = 1e3 * r.timing.median
            lines.append((r.setup, r.geometry, f"{ms:.3g}", quoted, f"{low / ms:,.0f}"))
    return markdown(("scene", "hit by", "search [ms]", "older code, whole step [ms]", "at least faster"), lines, left=(0, 1))


def film_table(films: list[Film]) -> str:
    """Median and extremes over the frames of each number."""
    lines = []
    for film in films:
        for name, values in film.numbers.items():
            seconds = isinstance(values[0], float)
            shown = [_ms(v) if seconds else f"{v:,.0f}" for v in (np.median(values), min(values), max(values))]
            lines.append((film.setup, film.geometry, f"{name} [ms]" if seconds else name, *shown))
    return markdown(("scene", "hit by", "number", "median", "least", "most"), lines, left=(0, 1, 2))


def reduction_table(rows: list[Row]) -> str:
    """Reduction of O(n) beside that of two nested loops."""
    lines = []
    for r in rows:
        if r.quadratic:
            linear, quadratic = r.phase("reduction"), float(np.median(r.quadratic))
            sizes = (f"{n:,}" for n in (r.tets, r.found, r.contacts))
            times = (_ms(linear), _ms(quadratic), f"{quadratic / linear:.3g}")
            lines.append((r.setup, r.geometry, *sizes, *times, "yes" if r.same else "NO"))
    headings = ("scene", "hit by", "tets", "found", "contacts", "O(n) [ms]", "O(n^2) [ms]", "ratio", "same contacts")
    return markdown(headings, lines, left=(0, 1))


def broad_table(sweeps: list[Sweep]) -> str:
    """Broad phases beside each other, against tets."""
    names = (HASH, *TREES)
    lines = []
    for s in sweeps:
        sizes = (f"{n:,}" for n in (s.tets, s.triangles, s.pairs[HASH], s.pairs[TREES[-1]]))
        lines.append((s.setup, *sizes, *(_ms(s.median(name)) for name in names)))
    headings = ("scene", "tets", "triangles", "pairs, k = 6", "pairs, k = 18", *(f"{n} [ms]" for n in names))
    return markdown(headings, lines, left=(0,))


def crossovers(at: Sequence[float], a: Sequence[float], b: Sequence[float]) -> list[float]:
    """Where the faster of two becomes the slower: straight in the logarithms between neighbours; never beyond the ends."""
    found, ratio = [], np.log(np.asarray(a) / np.asarray(b))
    for k in range(len(at) - 1):
        if ratio[k] * ratio[k + 1] < 0:
            share = ratio[k] / (ratio[k] - ratio[k + 1])
            found.append(math.exp((1 - share) * math.log(at[k]) + share * math.log(at[k + 1])))
    return found


def crossover_text(sweeps: list[Sweep]) -> str:
    """A sentence for each tree; the report found the hash slower below about 7,500 tets and faster above."""
    tets, lines = [s.tets for s in sweeps], []
    for name in TREES:
        hashed, trees = [s.median(HASH) for s in sweeps], [s.median(name) for s in sweeps]
        places = ", ".join(f"{x:,.0f}" for x in crossovers(tets, hashed, trees))
        first = HASH if hashed[0] < trees[0] else name
        found = f"crossover at {places} tets, below the first {first} is faster"
        lines.append(f"* {HASH} against {name}: {found if places else f'no crossover, {first} is faster throughout'}")
    return "\n".join(lines)


def cell_table(sweeps: list[Sweep]) -> str:
    """Time of the hash against the size of its cells, a column a scene, and the best."""
    scenes = list(dict.fromkeys(s.setup for s in sweeps))
    by = {(s.setup, s.at): s for s in sweeps}
    ratios = sorted({s.at for s in sweeps})
    lines = [(f"{ratio:g}", *(_ms(by[scene, ratio].median(HASH)) for scene in scenes)) for ratio in ratios]
    told = []
    for scene in scenes:
        own = [s for s in sweeps if s.setup == scene]
        best = best_cell(own)
        near = [s.at for s in own if s.median(HASH) <= 1.05 * best.median(HASH)]
        told.append(
            f"* {scene}, {best.tets:,} tets: best at {best.at:g}, within 5 % of it from {min(near):g} to {max(near):g}; "
            f"the report: {REPORTS_BEST:g}"
        )
    return markdown(("cell / edge", *(f"{scene} [ms]" for scene in scenes)), lines) + "\n\n" + "\n".join(told)


def best_cell(sweeps: list[Sweep]) -> Sweep:
    """The fastest."""
    return min(sweeps, key=lambda s: s.median(HASH))


def find_limits(rows: list[Row], films: list[Film]) -> list[Limit]:
    """Times of whole searches, what the sheet and cube gains over the older code, and equal reductions."""
    by = {(r.setup, r.geometry): r for r in rows}
    limits = []
    for setup, most in LIMITS.items():
        for geometry in GEOMETRIES:
            r = by.get((setup, geometry))
            t = r.timing if r else None
            what = f"{setup}, {geometry}, {r.triangles if r else 0:,} triangles: whole search [ms]"
            limits.append(Limit(what, 1e3 * t.median if t else math.nan, most, spread_of(t) if t else None))
    for r in rows:
        if r.setup == SHEET.name:
            t = r.timing
            gain = OLDER[r.setup][0] / (1e3 * t.median) if t else math.nan
            what = f"{r.setup}, {r.geometry}: older code's whole step (quoted) / search"
            limits.append(Limit(what, gain, WANTED_GAIN, spread_of(t) if t else None, at_least=True))
    unequal = sum(r.same is False for r in rows) + sum(not film.same for film in films)
    limits.append(Limit("reductions that kept other contacts than two nested loops", unequal, 0))
    return limits
