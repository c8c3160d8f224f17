"""The contact solve: colourings of the contact graph (figure 19 of the report) and contact solvers (figure 20).

Claims and figures from the numbers of `taisoft bench contact`, whose page has the tables.
"""

from itertools import accumulate

import numpy as np

from ..charts import COLOURS, Panel
from ..contact import CONTACTS
from ..contact_colouring import REPORT, Colouring, Point, Touching
from ..contact_colouring import SCENE as COLOURED_SCENE
from ..contact_runs import COLOURED, SERIAL, Film, Outcome
from ..document import ms
from .page import Claim, Part, clearly_less, is_near, plot_png, restored

REPORTS_CONTACTS, COLOURS_FOUND = REPORT[COLOURED_SCENE]
SCENE = "cube_on_box"
JACOBI, HYBRID = "jacobi", "hybrid"
SPIKE = 5.0  # time over the median from which a frame is a spike
MOSTLY = 0.9  # fraction of frames in which a solver must win to be by far the fastest
COLOURINGS = ("random", "greedy")  # drawn as grouped Jacobians
NEAR = 0.25  # relative difference from the report's number that counts as equal
NO_MESH = "The number depends on the mesh, which the report does not give, and on its reduction."


# --- colours ------------------------------------------------------------------------------------------------------------


def colours(numbers: dict) -> Part:
    """Colourings of the report's scene, in a full run also refined once."""
    found = [restored(Colouring, one) for one in numbers["colourings"]]
    return Part(
        "colours",
        "Colours of the contact graph",
        "section 3.2.3, figure 19",
        f"the contacts of the demo {COLOURED_SCENE} in explicit steps, when its cubes rest; two contacts are neighbours where "
        "they share a node that can move. Each colouring is checked: no two neighbours have one colour.",
        colour_claims([one for one in found if one.scene.startswith(COLOURED_SCENE)]),
        pictures={"colours.png": draw_colours(restored(Touching, numbers["touching"]))},
        short=[f"the report does not give its mesh, so its {REPORTS_CONTACTS} contacts are reproduced only approximately."],
    )


def colour_claims(found: list[Colouring]) -> list[Claim]:
    """Claims on colours and contacts. found: colourings of scenes from coarse to fine."""
    by = {way: [c for c in found if c.way == way] for way in ("greedy", "random")}
    greedy, random = ([float(np.median(c.numbers)) for c in by[way]] for way in by)
    contacts, least = ([getattr(c, name) for c in by["greedy"]] for name in ("contacts", "least"))
    spans = [int(np.ptp(c.numbers)) for c in by["random"]]
    groups = [k / n for k, n in zip(contacts, greedy)]
    return [
        Claim(
            f"the scene has {REPORTS_CONTACTS} contacts.",
            any(is_near(k, REPORTS_CONTACTS, NEAR * REPORTS_CONTACTS) for k in contacts),
            f"ours has {_listed(contacts)}, on the demo's mesh and on that once refined.",
            NO_MESH,
        ),
        Claim(
            f"greedy colouring needs fewer groups than random, {COLOURS_FOUND['greedy']} against {COLOURS_FOUND['random']}.",
            all(g < r for g, r in zip(greedy, random)),
            f"greedy needs {_listed(greedy)}, random {_listed(random)} (median over seeds).",
            "Both reach the minimum.",
        ),
        Claim(
            "each group holds only about three contacts.",
            all(is_near(n, REPORTS_CONTACTS / COLOURS_FOUND["greedy"], NEAR * 3) for n in groups),
            f"greedy groups hold {_listed(round(n, 1) for n in groups)} contacts each.",
            f"A colouring needs at least as many groups as contacts meet at one node, here {_listed(least)}.",
        ),
        Claim("random colouring varies.", max(spans) > 0, f"its numbers of groups span {_listed(spans)} over the seeds."),
    ]


def _listed(values) -> str:
    return " and ".join(f"{v:g}" for v in values)


def draw_colours(touching: Touching) -> bytes:
    """The contact Jacobian of the scene, and the same grouped by colour with alternating tints, as figure 19."""
    row, node = np.array(touching.contacts), np.array(touching.nodes)
    n = row.max() + 1
    panels = []
    for name in ("contact Jacobian", *COLOURINGS):
        colour = np.array(touching.colours.get(name, np.zeros(n, dtype=int)))
        place = np.argsort(np.argsort(colour, kind="stable"))  # contacts by colour
        panel = Panel(f"{name}: {n} contacts, {colour.max() + 1} colours", "nodes in contact", "contacts")
        for tint in (0, 1):
            own = colour[row] % 2 == tint
            panel.curve(node[own], place[row[own]], "", COLOURS[tint], "s", ms=2.5)
        for at in accumulate(np.bincount(colour)[:-1]):
            panel.level("y", at - 0.5, color="#bbbbbb", lw=0.6, ls="-")
        panels.append(panel)
    return plot_png(*panels)


# --- solvers ------------------------------------------------------------------------------------------------------------


def solvers(numbers: dict) -> Part:
    """A film of the demo's contact problems with every solver, and plates with many contacts."""
    film = next(restored(Film, one) for one in numbers["films"] if one["scene"] == SCENE)
    film.outcomes = {name: [Outcome(**one) for one in found] for name, found in film.outcomes.items()}
    last = numbers["crossover"][-1]
    point = restored(Point, last | {name: Outcome(**last[name]) for name in ("serial", "coloured")})
    return Part(
        "solvers",
        "Contact solvers",
        "section 3.2.4, figure 20",
        f"the contact problems of explicit steps of the demo {SCENE}, one a frame, each solved to a residual of 1e-4 by all "
        "solvers in turn on one thread. Also two plates with many contacts, by coloured Gauss-Seidel on all threads.",
        [*solver_claims(film), more_contacts(point)],
        pictures={"solvers.png": draw_solvers(film)},
        short=[
            f"the report's {CONTACTS[SCENE]} contacts are not reproduced: it does not give its mesh, and ours has "
            f"{np.median(film.contacts):g}. It does not give the solvers' tolerance either."
        ],
    )


def solver_claims(film: Film) -> list[Claim]:
    """Claims on iterations, times, spikes, and serial against parallel."""
    contacts = float(np.median(film.contacts))
    sweeps = {name: np.array([o.sweeps for o in found]) for name, found in film.outcomes.items()}
    times = {name: [o.median for o in found] for name, found in film.outcomes.items()}
    middle = {name: float(np.median(t)) for name, t in times.items()}
    beaten = float((sweeps[SERIAL] <= sweeps[JACOBI]).mean())
    fastest = min(middle, key=middle.get)
    wins = [float(np.less(times[HYBRID], t).mean()) for name, t in times.items() if name != HYBRID]
    spike = max(times[JACOBI]) / middle[JACOBI]
    return [
        Claim(
            f"the scene has {CONTACTS[SCENE]} contacts.",
            is_near(contacts, CONTACTS[SCENE], NEAR * CONTACTS[SCENE]),
            f"ours has {contacts:g}, median over {len(film.contacts)} frames.",
            NO_MESH,
        ),
        Claim(
            "Gauss-Seidel needs fewer iterations than Jacobi in every frame.",
            beaten == 1.0 and np.median(sweeps[SERIAL]) < np.median(sweeps[JACOBI]),
            f"medians are {np.median(sweeps[SERIAL]):g} and {np.median(sweeps[JACOBI]):g} sweeps; it needs no more in "
            f"{beaten:.0%} of the frames. The residual is computed after every fifth sweep.",
        ),
        Claim(
            "the parallel hybrid is by far the fastest.",
            min(wins) >= MOSTLY,
            f"{fastest} is the fastest in the median; {HYBRID} is faster than each of the others in at least {min(wins):.0%} of "
            "the frames.",
            "Hybrid sweeps are about as many as Jacobi's, and with tens of contacts a compiled serial sweep takes microseconds.",
        ),
        Claim(
            "in so small a scene parallel Gauss-Seidel is no faster than serial.",
            middle[SERIAL] <= middle[COLOURED],
            f"serial takes {ms(middle[SERIAL])} ms, coloured {ms(middle[COLOURED])} ms, without the time to wake threads.",
        ),
        Claim(
            "parallel Jacobi has spikes in time.",
            spike > SPIKE,
            f"the slowest frame takes {spike:.1f} times the median. The report attributes them to the machine; frames that need "
            "more sweeps take longer, too.",
        ),
    ]


def more_contacts(last: Point) -> Claim:
    """Claim on larger scenes. last: the largest problem."""
    return Claim(
        "with more contacts parallel Gauss-Seidel will overtake serial (expected, not measured there).",
        clearly_less(last.coloured.seconds, last.serial.seconds),
        f"at {last.contacts:,} contacts a solve takes {ms(last.serial.median)} ms serial and {ms(last.coloured.median)} ms "
        f"coloured; a sweep alone {ms(last.serial.per_sweep)} and {ms(last.coloured.per_sweep)} ms.",
        "On so few threads the gain per sweep is less than the cost of colouring and of additional sweeps.",
    )


def draw_solvers(film: Film) -> bytes:
    """Figure 20: sweeps and time of each solver over frames, and the contacts."""
    sweeps, times = Panel("sweeps (fig. 20)", "time [s]"), Panel("solve [ms] (fig. 20)", "time [s]", log="y")
    contacts = Panel("contacts", "time [s]")
    for k, (name, found) in enumerate(film.outcomes.items()):
        sweeps.curve(film.time, [o.sweeps for o in found], name, k, "-")
        times.curve(film.time, [1e3 * o.median for o in found], name, k, "-")
    contacts.curve(film.time, film.contacts, "contacts", "#000000", "-")
    contacts.curve(film.time, film.found, "before reduction", "#999999", ":")
    return plot_png(sweeps, times, contacts)
