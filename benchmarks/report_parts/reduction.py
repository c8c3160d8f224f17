"""Figures 13 and 14 of the report: the reduction of contacts by nested loops over a list, and by looking each up once."""

import numpy as np

from taisoft.backend.runtime import open_runtime
from taisoft.errors import SimulationError
from taisoft.timing import summarise

from ..collision_cases import PILES, cubes_setup, pile_setup
from ..collision_runs import QUICK_ROUNDS, ROUNDS, Film, Row, measure_film, measure_row
from ..collision_table import reduction_table
from ..fit import exponent
from .page import COLOURS, Claim, Extent, Part, clearly_less, ms, new_figure, plot_png

CONTACT_MODES = "proximity"  # has the more contacts to reduce
FILM, FRAMES = 15, (60, 6)  # cells of two cubes that turn on each other
SIZES = PILES[:5], PILES[:2]
HALF_WAY = 1.5  # between the exponents of what is linear and what is square


def claims_of(rows: list[Row], film: Film) -> list[Claim]:
    """The complexity, the times over tets, and those of each frame."""
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
            "In the worst case a set of hashes is O(n^2) too, where all fall into one place; Theta(n) is what is expected. And "
            "the old loop as printed does not reduce: its list starts empty, so nothing is ever put into it.",
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
            "" if grown < 0.1 else "Each contact is looked at, so what is linear in contacts grows with the surface.",
        ),
        Claim(
            "over the frames the new one is steady, while the old one's time fluctuates (figure 13).",
            swing[0] < swing[1] and float(np.median(steady)) < float(np.median(before)),
            f"over {len(steady)} frames with {min(film.numbers['found']):,} to {max(film.numbers['found']):,} contacts the new "
            f"one takes {ms(np.median(steady))} ms and the old one {ms(np.median(before))} ms, medians; largest less least, over "
            f"the median, are {swing[0]:.0%} and {swing[1]:.0%}.",
            ""
            if swing[0] < swing[1]
            else "Both follow the number of contacts; at tenths of a millisecond the rest is the machine.",
        ),
    ]


def draw(rows: list[Row], film: Film) -> bytes:
    """Figure 13 on the left, 14 on the right."""
    figure, ((frames, sizes),) = new_figure(2)
    for k, (name, label) in enumerate((("reduction", "O(n)"), ("quadratic", "O(n^2)"))):
        frames.plot([1e3 * s for s in film.numbers[name]], color=COLOURS[k], label=label)
    sizes.plot([r.tets for r in rows], [1e3 * r.phase("reduction") for r in rows], "o-", ms=4, color=COLOURS[0])
    sizes.plot([r.tets for r in rows], [1e3 * np.median(r.quadratic) for r in rows], "s-", ms=4, color=COLOURS[1])
    frames.set(title=f"reduction of each frame, {film.setup}", xlabel="frame", ylabel="ms", ylim=(0, None))
    frames.legend(fontsize="small", frameon=False)
    sizes.set(title="over tets", xlabel="tets", ylabel="ms", xscale="log", yscale="log")
    return plot_png(figure)


def measure(extent: Extent) -> Part:
    """Piles of touching cubes for the sizes, a cube that turns on another for the frames."""
    runtime = open_runtime(extent.arch, "f32", "the report's reduction")
    try:
        rounds = extent.of(ROUNDS, QUICK_ROUNDS)
        rows = [measure_row(pile_setup(n), CONTACT_MODES, runtime, rounds) for n in extent.of(*SIZES)]
        for failure in (row.failure for row in rows if row.failure):
            raise SimulationError(failure)
        film = measure_film(cubes_setup(extent.of(FILM, 5)), CONTACT_MODES, runtime, extent.of(*FRAMES))
    finally:
        runtime.close()
    return Part(
        "reduction",
        "Reduction of contacts",
        "section 3.1.3, figures 13 and 14",
        "the contacts of one search, reduced by a grid of cells that holds each once, and by two nested loops over the list; "
        "both are compiled, the loops for one thread. Piles of 27 touching cubes over tets, two cubes turning on each other "
        "over frames.",
        claims_of(rows, film),
        [reduction_table(rows)],
        {"reduction.png": draw(rows, film)},
        {
            f"{r.setup}, {way}": summarise(seconds)
            for r in rows
            for way, seconds in (("O(n)", r.phases["reduction"]), ("O(n^2)", r.quadratic))
        },
        ["the report's loops are interpreted Python; these are compiled, so that they differ by their algorithms alone."],
    )
