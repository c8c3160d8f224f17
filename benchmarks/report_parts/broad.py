"""Figures 17 and 18 of the report: spatial hash against bounding volume hierarchy, and the size of the hash's cells."""

import numpy as np

from taisoft.backend.runtime import open_runtime
from taisoft.timing import summarise

from ..collision_cases import CUBES, FRAMES, RATIOS, SWEPT, cubes_setup
from ..collision_runs import HASH, QUICK_ROUNDS, ROUNDS, TREES, Film, Sweep, measure_broad, measure_film
from ..collision_table import REPORTS_BEST, best_cell, broad_table, cell_table, crossover_text, crossovers
from .page import COLOURS, Claim, Extent, Part, clearly_less, new_figure, plot_png

TREE = TREES[-1]  # k-DOPs of 18 planes, as wide as the report's
REPORTS_CROSSOVER = 7500  # tets
QUICK_CELLS = (0.5, 1.0, 2.2, 4.0)
CELL_ROUNDS, CELL_TURNS = 60, (20, 3)  # cells near each other differ by little
NEAR_BEST = 1.1  # times the best: what a cell may take to be called as good
NEAR_CROSSOVER = 2.0  # a factor from the report's that still counts as its


def claims_of(film: Film, sweeps: list[Sweep]) -> list[Claim]:
    """Each frame at 1,250 tets, small and large scenes, and where the one overtakes the other."""
    hashed, trees = (np.array(film.numbers[name]) for name in (HASH, TREE))
    share = float((hashed < trees).mean())
    small = [s for s in sweeps if s.tets < REPORTS_CROSSOVER]
    large = [s for s in sweeps if s.tets > REPORTS_CROSSOVER]
    slower = [clearly_less(s.rounds[TREE], s.rounds[HASH]) for s in small]
    faster = [clearly_less(s.rounds[HASH], s.rounds[TREE]) for s in large]
    places = crossovers([s.tets for s in sweeps], *([s.median(n) for s in sweeps] for n in (HASH, TREE)))
    near = any(REPORTS_CROSSOVER / NEAR_CROSSOVER <= x <= REPORTS_CROSSOVER * NEAR_CROSSOVER for x in places)
    ratios = [s.median(HASH) / s.median(TREE) for s in sweeps]
    crossed = f"they cross at {', '.join(f'{x:,.0f}' for x in places)} tets." if places else "they do not cross."
    why = (
        "The trees here are built once and only refitted; a hash is filled anew in every search, and with the few surface "
        "triangles of such scenes neither is short of work that the other saves."
    )
    return [
        Claim(
            "at 1,250 tets the spatial hash takes less time than the tree in every frame (figure 17, left).",
            share == 1.0,
            f"at {film.tets:,} tets it does in {share:.0%} of {len(hashed)} frames; medians are {1e3 * np.median(hashed):.3g} "
            f"and {1e3 * np.median(trees):.3g} ms.",
            "" if share == 1.0 else why,
        ),
        Claim(
            f"below about {REPORTS_CROSSOVER:,} tets the hash is the slower one (section 3.1.4).",
            bool(small) and all(slower),
            f"it is, by more than the spread, at {sum(slower)} of {len(small)} sizes below.",
            "The report's left figure and its text contradict each other here.",
        ),
        Claim(
            "above that it is the faster one, with the crossover just there (figure 17, right).",
            near and all(faster),
            f"over {sweeps[0].tets:,} to {sweeps[-1].tets:,} tets it takes {min(ratios):.2g} to {max(ratios):.2g} times "
            f"the tree's time; {crossed}",
            "" if near and all(faster) else why,
        ),
    ]


def cell_claims(sweeps: list[Sweep]) -> list[Claim]:
    """The best size of the cells in each scene, and small cells."""
    claims = []
    for scene in dict.fromkeys(s.setup for s in sweeps):
        own = sorted((s for s in sweeps if s.setup == scene), key=lambda s: s.at)
        best = best_cell(own)
        reports = min(own, key=lambda s: abs(s.at - REPORTS_BEST))
        good = reports.median(HASH) <= NEAR_BEST * best.median(HASH)
        flat = [s.at for s in own if s.median(HASH) <= NEAR_BEST * best.median(HASH)]
        claims.append(
            Claim(
                f"at {own[0].tets:,} tets cells of {REPORTS_BEST:g} mean edges are best (figure 18).",
                good,
                f"{best.at:g} are best; all of {', '.join(f'{x:g}' for x in flat)} are within {NEAR_BEST - 1:.0%} of it, and "
                f"{reports.at:g} take {reports.median(HASH) / best.median(HASH):.2f} times the best.",
                "The minimum is flat: larger cells hold more triangles, smaller ones hold each triangle more often.",
            )
        )
        worst = own[0].median(HASH) / best.median(HASH)
        claims.append(
            Claim(
                f"at {own[0].tets:,} tets smaller cells take longer (figure 18).",
                clearly_less(best.rounds[HASH], own[0].rounds[HASH]),
                f"cells of {own[0].at:g} mean edges take {worst:.2f} times the best.",
            )
        )
    return claims


def draw(film: Film, sweeps: list[Sweep]) -> bytes:
    """Figure 17."""
    figure, ((frames, sizes),) = new_figure(2)
    for name, colour in zip((HASH, TREES[0], TREE), COLOURS):
        frames.plot([1e3 * s for s in film.numbers[name]], color=colour, label=name)
        sizes.plot([s.tets for s in sweeps], [1e3 * s.median(name) for s in sweeps], "o-", ms=4, color=colour)
    frames.set(title=f"broad phase of each frame, {film.tets:,} tets", xlabel="frame", ylabel="ms", ylim=(0, None))
    frames.legend(fontsize="small", frameon=False)
    sizes.axvline(REPORTS_CROSSOVER, color="#555555", lw=0.9, ls="--")
    sizes.set(title="over tets; dashed: the report's crossover", xlabel="tets", ylabel="ms", xscale="log", yscale="log")
    return plot_png(figure)


def draw_cells(sweeps: list[Sweep]) -> bytes:
    """Figure 18, times over the best of each scene."""
    figure, ((panel,),) = new_figure(1)
    for scene, colour in zip(dict.fromkeys(s.setup for s in sweeps), COLOURS):
        own = [s for s in sweeps if s.setup == scene]
        best = best_cell(own).median(HASH)
        label, times = f"{own[0].tets:,} tets", [s.median(HASH) / best for s in own]
        panel.plot([s.at for s in own], times, "o-", ms=4, color=colour, label=label)
    panel.axvline(REPORTS_BEST, color="#555555", lw=0.9, ls="--", label="the report's best")
    panel.set(title="spatial hash over the size of its cells", xlabel="cell / mean edge", ylabel="time / best", ylim=(0.9, None))
    panel.legend(fontsize="small", frameon=False)
    return plot_png(figure)


def measure(extent: Extent) -> Part:
    """Over frames at the report's size, and over tets."""
    runtime = open_runtime(extent.arch, "f32", "the report's broad phases")
    try:
        rounds = extent.of(ROUNDS, QUICK_ROUNDS)
        film = measure_film(cubes_setup(SWEPT[0]), "proximity", runtime, extent.of(FRAMES, 4), broad=True)
        sweeps = [s for n in extent.of(CUBES, (2, 5)) for s in measure_broad(cubes_setup(n), runtime, rounds)]
    finally:
        runtime.close()
    return Part(
        "broad",
        "Spatial hash against tree",
        "section 3.1.4, figure 17",
        f"the broad phases alone, on a cube that turns on another: pairs of triangles whose boxes meet. The tree is {TREE}: a "
        "chunked hierarchy of k-DOPs, k behind its name; the hash has boxes alone, which is k = 6.",
        claims_of(film, sweeps),
        [broad_table(sweeps) + "\n\n" + crossover_text(sweeps)],
        {"broad.png": draw(film, sweeps)},
        {f"{s.setup}, {name}": summarise(seconds) for s in sweeps for name, seconds in s.rounds.items()},
        ["the report's scene and k are not told, and its hash is of another kind (a perfect one)."],
    )


def measure_cells(extent: Extent) -> Part:
    """The hash over ratios of cell to mean edge, in scenes of the report's sizes."""
    runtime = open_runtime(extent.arch, "f32", "the report's cells")
    try:
        ratios, rounds = extent.of(RATIOS, QUICK_CELLS), extent.of(CELL_ROUNDS, QUICK_ROUNDS)
        turns, sizes = extent.of(*CELL_TURNS), extent.of(SWEPT, SWEPT[:1])
        sweeps = [s for n in sizes for s in measure_broad(cubes_setup(n), runtime, rounds, ratios, turns)]
    finally:
        runtime.close()
    return Part(
        "cells",
        "Cells of the spatial hash",
        "section 3.1.4, figure 18",
        "the spatial hash alone, on a cube on another in the middle of its turn, with cells of these multiples of the mean "
        "surface edge.",
        cell_claims(sweeps),
        [cell_table(sweeps)],
        {"cells.png": draw_cells(sweeps)},
        {f"{s.setup}, {s.at:g}": summarise(s.rounds[HASH]) for s in sweeps},
    )
