"""The search for contacts: the reduction (figures 13 and 14 of the report) and the broad phase (figures 17 and 18).

Spatial hash against bounding volume hierarchy; cell size of the hash; reduction by nested loops and by one lookup per contact.
"""

from contextlib import closing

import numpy as np

from taisoft.backend.runtime import open_runtime
from taisoft.errors import SimulationError
from taisoft.machine import summarise

from ..collision import REPORTS_BEST, best_cell, broad_table, by_scene, cell_table, crossover_text, reduction_table
from ..collision_cases import CUBES, FRAMES, PILES, RATIOS, SWEPT, cubes_setup, pile_setup
from ..collision_runs import HASH, QUICK_ROUNDS, ROUNDS, TREES, Film, Row, Sweep, measure_broad, measure_film, measure_row
from ..document import crossovers, exponent, ms
from .page import COLOURS, Claim, Extent, Part, clearly_less, new_figure, plot_png

TREE = TREES[-1]  # k-DOPs of 18 planes
REPORTS_CROSSOVER = 7500  # tets
QUICK_CELLS = (0.5, 1.0, 2.2, 4.0)
CELL_ROUNDS, CELL_TURNS = 60, (20, 3)  # many, since similar cells differ little
NEAR_BEST = 1.1  # largest time over the best that counts as equally good
NEAR_CROSSOVER = 2.0  # largest factor from the report's crossover that counts as equal
CONTACT_MODE = "proximity"  # has more contacts to reduce
FILM, QUICK_FRAMES = 15, 6  # cells of two cubes turning on each other
SIZES = PILES[:5], PILES[:2]
HALF_WAY = 1.5  # exponent between linear and quadratic growth


# --- broad phases -------------------------------------------------------------------------------------------------------


def broad_claims(film: Film, sweeps: list[Sweep]) -> list[Claim]:
    """Claims on each frame at 1,250 tets, on small and large scenes, and on the crossover."""
    hashed, trees = (np.array(film.numbers[name]) for name in (HASH, TREE))
    fraction = float((hashed < trees).mean())
    small = [s for s in sweeps if s.tets < REPORTS_CROSSOVER]
    large = [s for s in sweeps if s.tets > REPORTS_CROSSOVER]
    slower = [clearly_less(s.rounds[TREE], s.rounds[HASH]) for s in small]
    faster = [clearly_less(s.rounds[HASH], s.rounds[TREE]) for s in large]
    places = crossovers([s.tets for s in sweeps], *([s.median(n) for s in sweeps] for n in (HASH, TREE)))
    near = any(REPORTS_CROSSOVER / NEAR_CROSSOVER <= x <= REPORTS_CROSSOVER * NEAR_CROSSOVER for x in places)
    ratios = [s.median(HASH) / s.median(TREE) for s in sweeps]
    crossed = f"they cross at {', '.join(f'{x:,.0f}' for x in places)} tets." if places else "they do not cross."
    why = (
        "The trees here are built once and then refitted, while the hash is filled in every search; such scenes have few surface "
        "triangles."
    )
    return [
        Claim(
            "at 1,250 tets the spatial hash takes less time than the tree in every frame (figure 17, left).",
            fraction == 1.0,
            f"at {film.tets:,} tets it does in {fraction:.0%} of {len(hashed)} frames; medians are {1e3 * np.median(hashed):.3g} "
            f"and {1e3 * np.median(trees):.3g} ms.",
            "" if fraction == 1.0 else why,
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
    """Claims on the best cell size of each scene, and on small cells."""
    claims = []
    for own in by_scene(sorted(sweeps, key=lambda s: s.at)).values():
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


def draw_broad(film: Film, sweeps: list[Sweep]) -> bytes:
    """Plot figure 17."""
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
    """Plot figure 18: times over the best of each scene."""
    figure, ((panel,),) = new_figure(1)
    for own, colour in zip(by_scene(sweeps).values(), COLOURS):
        best = best_cell(own).median(HASH)
        label, times = f"{own[0].tets:,} tets", [s.median(HASH) / best for s in own]
        panel.plot([s.at for s in own], times, "o-", ms=4, color=colour, label=label)
    panel.axvline(REPORTS_BEST, color="#555555", lw=0.9, ls="--", label="the report's best")
    panel.set(title="spatial hash over the size of its cells", xlabel="cell / mean edge", ylabel="time / best", ylim=(0.9, None))
    panel.legend(fontsize="small", frameon=False)
    return plot_png(figure)


def measure_broad_phases(extent: Extent) -> Part:
    """Measure over frames at the report's size, and over tets."""
    with closing(open_runtime(extent.arch, "f32", "the report's broad phases")) as runtime:
        rounds = extent.of(ROUNDS, QUICK_ROUNDS)
        film = measure_film(cubes_setup(SWEPT[0]), CONTACT_MODE, runtime, extent.of(FRAMES, 4), broad=True)
        sweeps = [s for n in extent.of(CUBES, (2, 5)) for s in measure_broad(cubes_setup(n), runtime, rounds)]
    return Part(
        "broad",
        "Spatial hash against tree",
        "section 3.1.4, figure 17",
        f"the broad phases alone, on a cube that turns on another: pairs of triangles whose boxes meet. The tree is {TREE}: a "
        "chunked hierarchy of k-DOPs, k behind its name; the hash has boxes alone, which is k = 6.",
        broad_claims(film, sweeps),
        [broad_table(sweeps) + "\n\n" + crossover_text(sweeps)],
        {"broad.png": draw_broad(film, sweeps)},
        {f"{s.setup}, {name}": summarise(seconds) for s in sweeps for name, seconds in s.rounds.items()},
        ["the report gives neither its scene nor k, and its hash is a perfect hash."],
    )


def measure_cells(extent: Extent) -> Part:
    """Measure the hash over ratios of cell to mean edge, in scenes of the report's sizes."""
    ratios, rounds = extent.of(RATIOS, QUICK_CELLS), extent.of(CELL_ROUNDS, QUICK_ROUNDS)
    turns, sizes = extent.of(*CELL_TURNS), extent.of(SWEPT, SWEPT[:1])
    with closing(open_runtime(extent.arch, "f32", "the report's cells")) as runtime:
        sweeps = [s for n in sizes for s in measure_broad(cubes_setup(n), runtime, rounds, ratios, turns)]
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


# --- reduction ----------------------------------------------------------------------------------------------------------


def reduction_claims(rows: list[Row], film: Film) -> list[Claim]:
    """Claims on complexity, on times over tets, and on times per frame."""
    found = [r.found for r in rows]
    fast, _ = exponent(found, [r.phase("reduction") for r in rows])
    slow, _ = exponent(found, [float(np.median(r.quadratic)) for r in rows])
    faster = [clearly_less(r.phases["reduction"], r.quadratic) for r in rows]
    steady, before = (np.array(film.numbers[name]) for name in ("reduction", "quadratic"))
    swing = [float(np.ptp(x) / np.median(x)) for x in (steady, before)]
    ratios = [float(np.median(r.quadratic)) / r.phase("reduction") for r in rows]
    tets = [r.tets for r in rows]
    grown, _ = exponent(tets, [r.phase("reduction") for r in rows])
    return [
        Claim(
            "the old reduction is O(n^2), the new one Theta(n), in the worst case (section 3.1.3).",
            fast < HALF_WAY < slow,
            f"from {found[0]:,} to {found[-1]:,} contacts the nested loops grow like n^{slow:.2f}, ours like n^{fast:.2f}; both "
            f"keep the same contacts in {sum(bool(r.same) for r in rows)} of {len(rows)} scenes.",
            "With all entries in one bucket a hash set is O(n^2) too; Theta(n) is the expected cost. The old "
            "loop as printed does not reduce: its list starts empty and stays empty.",
        ),
        Claim(
            "at every size the new reduction is faster (figure 14).",
            all(faster),
            f"it is, by more than the spread, at {sum(faster)} of {len(rows)} sizes; it takes "
            f"{ratios[0]:.3g} times less at {tets[0]:,} tets and {ratios[-1]:.3g} times less at {tets[-1]:,}.",
        ),
        Claim(
            "its time stays near zero however many tets there are (figure 14).",
            grown < 0.1,
            f"it grows like tets^{grown:.2f}, from {ms(rows[0].phase('reduction'))} ms at {tets[0]:,} tets to "
            f"{ms(rows[-1].phase('reduction'))} ms at {tets[-1]:,}.",
            "" if grown < 0.1 else "The reduction visits each contact, and their number grows with the surface.",
        ),
        Claim(
            "over the frames the new one is steady, while the old one's time fluctuates (figure 13).",
            swing[0] < swing[1] and float(np.median(steady)) < float(np.median(before)),
            f"over {len(steady)} frames with {min(film.numbers['found']):,} to {max(film.numbers['found']):,} contacts the new "
            f"one takes {ms(np.median(steady))} ms and the old one {ms(np.median(before))} ms, medians; their relative ranges "
            f"are {swing[0]:.0%} and {swing[1]:.0%}.",
            ""
            if swing[0] < swing[1]
            else "Both follow the number of contacts; at tenths of a millisecond the rest is noise of the machine.",
        ),
    ]


def draw_reduction(rows: list[Row], film: Film) -> bytes:
    """Plot figures 13 and 14."""
    figure, ((frames, sizes),) = new_figure(2)
    for k, (name, label) in enumerate((("reduction", "O(n)"), ("quadratic", "O(n^2)"))):
        frames.plot([1e3 * s for s in film.numbers[name]], color=COLOURS[k], label=label)
    sizes.plot([r.tets for r in rows], [1e3 * r.phase("reduction") for r in rows], "o-", ms=4, color=COLOURS[0])
    sizes.plot([r.tets for r in rows], [1e3 * np.median(r.quadratic) for r in rows], "s-", ms=4, color=COLOURS[1])
    frames.set(title=f"reduction of each frame, {film.setup}", xlabel="frame", ylabel="ms", ylim=(0, None))
    frames.legend(fontsize="small", frameon=False)
    sizes.set(title="over tets", xlabel="tets", ylabel="ms", xscale="log", yscale="log")
    return plot_png(figure)


def measure_reduction(extent: Extent) -> Part:
    """Measure piles of touching cubes over tets, and a cube turning on another over frames."""
    with closing(open_runtime(extent.arch, "f32", "the report's reduction")) as runtime:
        rounds = extent.of(ROUNDS, QUICK_ROUNDS)
        rows = [measure_row(pile_setup(n), CONTACT_MODE, runtime, rounds) for n in extent.of(*SIZES)]
        for failure in (row.failure for row in rows if row.failure):
            raise SimulationError(failure)
        film = measure_film(cubes_setup(extent.of(FILM, 5)), CONTACT_MODE, runtime, extent.of(FRAMES, QUICK_FRAMES))
    return Part(
        "reduction",
        "Reduction of contacts",
        "section 3.1.3, figures 13 and 14",
        "the contacts of one search, reduced by a grid of cells and by two nested loops over the list; both are compiled, the "
        "loops for one thread. Piles of 27 touching cubes over tets, two cubes turning on each other over frames.",
        reduction_claims(rows, film),
        [reduction_table(rows)],
        {"reduction.png": draw_reduction(rows, film)},
        {f"{r.setup}, O(n)": summarise(r.phases["reduction"]) for r in rows}
        | {f"{r.setup}, O(n^2)": summarise(r.quadratic) for r in rows},
        ["the report's loops are interpreted Python; here both are compiled, so that only the algorithms differ."],
    )
