"""Figure 19 of the report: colourings of the contact graph of two cubes on two boxes."""

import numpy as np

from taisoft.timing import summarise

from ..contact_colours import QUICK_SEEDS, REPORT, SEEDS, Colouring, colour_all, colour_table
from ..contact_plot import figure_19, take_snapshot
from ..contact_runs import open_explicit, to_first_impulse
from .page import Claim, Extent, Part, is_near, new_figure, plot_png

SCENE = "two_cubes_two_boxes"
CONTACTS, COLOURS_FOUND = REPORT[SCENE]
SETTLE = 60  # steps from the first impulse on, by which the cubes lie on their boxes
NEAR = 0.25  # of a number of the report's, within which ours counts as its


def claims_of(found: list[Colouring]) -> list[Claim]:
    """Numbers of colours and contacts. found: of scenes from coarse to fine, ways as `colour_all` has them."""
    by = {(c.scene, c.way): c for c in found}
    scenes = list(dict.fromkeys(c.scene for c in found))
    greedy, random = ([float(np.median(by[scene, way].numbers)) for scene in scenes] for way in ("greedy", "random"))
    contacts, least = ([getattr(by[scene, "greedy"], name) for scene in scenes] for name in ("contacts", "least"))
    spans = [int(np.ptp(by[scene, "random"].numbers)) for scene in scenes]
    each = f"of {_listed(contacts)} contacts"
    groups = [is_near(k / n, CONTACTS / COLOURS_FOUND["greedy"], NEAR * 3) for k, n in zip(contacts, greedy)]
    fewer, theirs = all(g < r for g, r in zip(greedy, random)), COLOURS_FOUND["greedy"]
    return [
        Claim(
            f"the scene has {CONTACTS} contacts.",
            any(is_near(k, CONTACTS, NEAR * CONTACTS) for k in contacts),
            f"ours has {_listed(contacts)}, on the demo's mesh and on that once refined.",
            "The number is that of the mesh, which the report does not tell, and of what its reduction leaves.",
        ),
        Claim(
            f"greedy colouring needs fewer groups than random, {theirs} against {COLOURS_FOUND['random']}.",
            fewer,
            f"greedy needs {_listed(greedy)}, random {_listed(random)} (median over seeds), {each}.",
            "" if fewer else "Both come to the fewest that there can be, so that neither can be better.",
        ),
        Claim(
            "so many groups are needed that each holds about three contacts.",
            all(groups),
            f"greedy groups hold {_listed(round(k / n, 1) for k, n in zip(contacts, greedy))} contacts each, {each}.",
            ""
            if all(groups)
            else f"No colouring can do with fewer groups than contacts meet at one node, here "
            f"{_listed(least)}, and greedy comes to about that. A greedy colouring of {theirs} colours says that some contact of "
            f"the report's has at least {theirs - 1} neighbours.",
        ),
        Claim(
            "random colouring is not steady.",
            max(spans) > 0,
            f"over {len(by[scenes[0], 'random'].numbers)} seeds its numbers of groups span {_listed(spans)}.",
        ),
    ]


def _listed(values) -> str:
    return " and ".join(f"{v:g}" for v in values)


def measure(extent: Extent) -> Part:
    """The demo in explicit steps, as it is and, in a full run, refined once."""
    found, times, picture = [], {}, b""
    for refine in extent.of((0, 1), (0,)):
        with open_explicit(SCENE, extent.arch, refine or None) as sim:
            to_first_impulse(sim)
            for _ in range(SETTLE):
                sim.step()
            name = SCENE if not refine else f"{SCENE}, refined"
            made, colours = colour_all(name, sim._dynamics.contact.problem, extent.of(SEEDS, QUICK_SEEDS))
            found += made
            times |= {f"{name}, {c.way}": summarise(c.seconds) for c in made}
            if not refine:
                figure, (panels,) = new_figure(4)
                figure_19(panels, take_snapshot(name, sim, colours))
                picture = plot_png(figure)
    return Part(
        "colours",
        "Colours of the contact graph",
        "section 3.2.3, figure 19",
        f"the contacts of the demo {SCENE} in explicit steps, {SETTLE} after the first impulse; two contacts are neighbours "
        "where they share a node that can move. Each colouring is checked: no two neighbours have one colour.",
        claims_of(found),
        [colour_table(found)],
        {"colours.png": picture},
        times,
        [f"the report's mesh is not told, so its {CONTACTS} contacts are met only about as well as a refinement comes to them."],
    )
