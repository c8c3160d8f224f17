"""The search for contacts: the reduction (figures 13 and 14 of the report) and the broad phase (figures 17 and 18).

Claims and figures from the numbers of `taisoft bench collision`, whose page has the tables.
"""

import numpy as np

from ..charts import Panel
from ..collision import Film, Row, Sweep, best_cell, by_scene
from ..collision_runs import HASH, TREES
from ..document import crossovers, exponent, ms
from .page import Claim, Part, clearly_less, plot_png, restored

TREE = TREES[-1]  # k-DOPs of 18 planes
REPORTS_CROSSOVER = 7500  # tets
REPORTS_BEST = 2.2  # ratio of cell to edge
NEAR_BEST = 1.1  # largest time over the best that counts as equally good
NEAR_CROSSOVER = 2.0  # largest factor from the report's crossover that counts as equal
CONTACT_MODE = "proximity"  # has more contacts to reduce
HALF_WAY = 1.5  # exponent between linear and quadratic growth


# --- broad phases -------------------------------------------------------------------------------------------------------


def broad(numbers: dict) -> Part:
    """The hash beside the trees, over frames at the report's size and over tets."""
    film = next(restored(Film, one) for one in numbers["films"] if HASH in one["numbers"])
    sweeps = [restored(Sweep, one) for one in numbers["broad"]]
    return Part(
        "broad",
        "Spatial hash against tree",
        "section 3.1.4, figure 17",
        "boxes and all pairs of near triangles of a cube on another; the trees are of k-DOPs with k = 6, 14 and 18 planes, and "
        "the claims are about 18.",
        broad_claims(film, sweeps),
        pictures={"broad.png": draw_broad(film, sweeps)},
        short=["the report gives neither its scene nor k, and its hash is a perfect hash."],
    )


def broad_claims(film: Film, sweeps: list[Sweep]) -> list[Claim]:
    """Claims on each frame at 1,250 tets, on small and large scenes, and on the crossover."""
    hashed, trees = (np.array(film.numbers[name]) for name in (HASH, TREE))
    fraction = float((hashed < trees).mean())
    slower = [clearly_less(s.rounds[TREE], s.rounds[HASH]) for s in sweeps if s.tets < REPORTS_CROSSOVER]
    faster = [clearly_less(s.rounds[HASH], s.rounds[TREE]) for s in sweeps if s.tets > REPORTS_CROSSOVER]
    places = crossovers([s.tets for s in sweeps], *([s.median(n) for s in sweeps] for n in (HASH, TREE)))
    near = any(REPORTS_CROSSOVER / NEAR_CROSSOVER <= x <= REPORTS_CROSSOVER * NEAR_CROSSOVER for x in places)
    ratios = [s.median(HASH) / s.median(TREE) for s in sweeps]
    crossed = f"they cross at {', '.join(f'{x:,.0f}' for x in places)} tets." if places else "they do not cross."
    return [
        Claim(
            "at 1,250 tets the spatial hash takes less time than the tree in every frame (figure 17, left).",
            fraction == 1.0,
            f"it does in {fraction:.0%} of the frames; medians are {ms(np.median(hashed))} and {ms(np.median(trees))} ms.",
            "The trees are built once and then refitted; such scenes have few surface triangles.",
        ),
        Claim(
            f"below about {REPORTS_CROSSOVER:,} tets the hash is the slower one (section 3.1.4).",
            bool(slower) and all(slower),
            f"it is at {sum(slower)} of {len(slower)} sizes. The report's left figure and its text contradict each other here.",
        ),
        Claim(
            "above that it is the faster one, with the crossover just there (figure 17, right).",
            near and all(faster),
            f"over all sizes it takes {min(ratios):.2g} to {max(ratios):.2g} times the tree's time; {crossed}",
        ),
    ]


def draw_broad(film: Film, sweeps: list[Sweep]) -> bytes:
    """Figure 17."""
    frames = Panel(f"broad phase of each frame, {film.tets:,} tets", "frame", "ms")
    sizes = Panel("over tets", "tets", "ms", log="xy")
    for k, name in enumerate((HASH, TREES[0], TREE)):
        frames.curve(range(len(film.numbers[name])), [1e3 * s for s in film.numbers[name]], name, k, "-")
        sizes.curve([s.tets for s in sweeps], [1e3 * s.median(name) for s in sweeps], name, k)
    sizes.level("x", REPORTS_CROSSOVER, "the report's crossover")
    return plot_png(frames, sizes)


# --- cells --------------------------------------------------------------------------------------------------------------


def cells(numbers: dict) -> Part:
    """The hash over ratios of cell to mean edge."""
    sweeps = [restored(Sweep, one) for one in numbers["cells"]]
    panel = Panel("spatial hash over the size of its cells", "cell / mean edge", "time / best")
    for k, own in enumerate(by_scene(sweeps).values()):
        best = best_cell(own).median(HASH)
        panel.curve([s.at for s in own], [s.median(HASH) / best for s in own], f"{own[0].tets:,} tets", k)
    panel.level("x", REPORTS_BEST, "the report's best")
    return Part(
        "cells",
        "Cells of the spatial hash",
        "section 3.1.4, figure 18",
        "the spatial hash alone, on a cube on another in the middle of its turn, over the size of its cells.",
        cell_claims(sweeps),
        pictures={"cells.png": plot_png(panel)},
    )


def cell_claims(sweeps: list[Sweep]) -> list[Claim]:
    """Claims on the best cell size of each scene, and on small cells."""
    claims = []
    for own in by_scene(sorted(sweeps, key=lambda s: s.at)).values():
        best, tets = best_cell(own), own[0].tets
        flat = [s.at for s in own if s.median(HASH) <= NEAR_BEST * best.median(HASH)]
        claims += [
            Claim(
                f"at {tets:,} tets cells of {REPORTS_BEST:g} mean edges are best (figure 18).",
                min(own, key=lambda s: abs(s.at - REPORTS_BEST)).at in flat,
                f"{best.at:g} are best; all of {', '.join(f'{x:g}' for x in flat)} are within {NEAR_BEST - 1:.0%} of it.",
                "The minimum is flat: larger cells hold more triangles, smaller ones hold each triangle more often.",
            ),
            Claim(
                f"at {tets:,} tets smaller cells take longer (figure 18).",
                clearly_less(best.rounds[HASH], own[0].rounds[HASH]),
                f"cells of {own[0].at:g} mean edges take {own[0].median(HASH) / best.median(HASH):.2f} times the best.",
            ),
        ]
    return claims


# --- reduction ----------------------------------------------------------------------------------------------------------


def reduction(numbers: dict) -> Part:
    """Reductions of piles over tets, and of a cube turning on another over frames."""
    rows = [restored(Row, one) for one in numbers["piles"] if one["geometry"] == CONTACT_MODE and not one["failure"]]
    film = restored(Film, numbers["films"][-1])
    frames = Panel(f"reduction of each frame, {film.setup}", "frame", "ms")
    sizes = Panel("over tets", "tets", "ms", log="xy")
    for k, (name, label) in enumerate((("reduction", "O(n)"), ("quadratic", "O(n^2)"))):
        frames.curve(range(len(film.numbers[name])), [1e3 * s for s in film.numbers[name]], label, k, "-")
        sizes.curve([r.tets for r in rows], [1e3 * times_of(r)[k] for r in rows], label, k)
    return Part(
        "reduction",
        "Reduction of contacts",
        "section 3.1.3, figures 13 and 14",
        "the contacts of one search, reduced by a grid of cells and by two nested loops over the list; both are compiled, the "
        "loops for one thread. Piles of 27 touching cubes over tets, two cubes turning on each other over frames.",
        reduction_claims(rows, film),
        pictures={"reduction.png": plot_png(frames, sizes)},
        short=[
            "the report's loops are interpreted Python; here both are compiled, so that only the algorithms differ.",
            "with all entries in one bucket a hash set is O(n^2) too; Theta(n) is the expected cost. The old loop as printed "
            "does not reduce: its list starts empty and stays empty.",
        ],
    )


def times_of(row: Row) -> tuple[float, float]:
    """Medians of the O(n) reduction and of that by two nested loops [s]."""
    return row.phase("reduction"), float(np.median(row.quadratic))


def reduction_claims(rows: list[Row], film: Film) -> list[Claim]:
    """Claims on complexity, on times over tets, and on times per frame."""
    found, tets = [r.found for r in rows], [r.tets for r in rows]
    linear, quadratic = zip(*map(times_of, rows))
    fast, slow, grown = exponent(found, linear)[0], exponent(found, quadratic)[0], exponent(tets, linear)[0]
    faster = [clearly_less(r.phases["reduction"], r.quadratic) for r in rows]
    steady, before = (np.array(film.numbers[name]) for name in ("reduction", "quadratic"))
    swing = [float(np.ptp(x) / np.median(x)) for x in (steady, before)]
    return [
        Claim(
            "the old reduction is O(n^2), the new one Theta(n), in the worst case (section 3.1.3).",
            fast < HALF_WAY < slow,
            f"from {found[0]:,} to {found[-1]:,} contacts the nested loops grow like n^{slow:.2f}, ours like n^{fast:.2f}; both "
            f"keep the same contacts in {sum(bool(r.same) for r in rows)} of {len(rows)} scenes.",
        ),
        Claim(
            "at every size the new reduction is faster (figure 14).",
            all(faster),
            f"it takes {quadratic[0] / linear[0]:.3g} times less at {tets[0]:,} tets and {quadratic[-1] / linear[-1]:.3g} times "
            f"less at {tets[-1]:,}.",
        ),
        Claim(
            "its time stays near zero however many tets there are (figure 14).",
            grown < 0.1,
            f"it grows like tets^{grown:.2f}: {ms(linear[0])} ms at {tets[0]:,} tets, {ms(linear[-1])} ms at {tets[-1]:,}.",
            "The reduction visits each contact, and their number grows with the surface.",
        ),
        Claim(
            "over the frames the new one is steady, while the old one's time fluctuates (figure 13).",
            swing[0] < swing[1] and float(np.median(steady)) < float(np.median(before)),
            f"over {len(steady)} frames the new one takes {ms(np.median(steady))} ms and the old one {ms(np.median(before))} ms, "
            f"medians; their relative ranges are {swing[0]:.0%} and {swing[1]:.0%}.",
            "Both follow the number of contacts; at tenths of a millisecond the rest is noise of the machine.",
        ),
    ]
