"""Figure 10 of the report: which phase takes the time of demonstration 3.

The parts of a step are timed between synchronisations, which a plain step does without; shares are of the step so timed. The
scene is taken from its first impulse on, when the search has something to find.
"""

from dataclasses import dataclass, field

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.machine import summarise
from taisoft.output.tables import percent, spread_of
from taisoft.stability import stable_dt

from ..collision_runs import PHASES
from ..contact_runs import PARTS, SETTINGS, explicit_places, to_impulses
from ..document import ms, table
from ..runner import REST, Stopwatch
from .page import COLOURS, Claim, Extent, Part, new_figure, plot_png

SCENE = "sheet_and_cube"
CALLS = dict(zip(PHASES, ("_move", "_near", "_search", "_reduce")))  # of a search, by phase
SEARCH, POINTS, OTHER = "search", "contacts", "other search"
SHARE = 0.9  # of the largest stable step: an explicit step here
EXPLICIT, IMPLICIT = "symplectic_euler", "implicit_euler"
STEPS = {EXPLICIT: (400, 60), IMPLICIT: (120, 20)}  # timed, in a full and in a quick run
WAYS = ("distance_field", "proximity")
REPORTS_WAY = (EXPLICIT, WAYS[0])
SIGNIFICANT = 0.1  # share of the search


@dataclass
class Shares:
    """Steps of one kind. parts: name -> wall seconds of each step; those of a search are PHASES and OTHER."""

    integrator: str
    contact_mode: str
    dt: float
    parts: dict[str, list[float]] = field(default_factory=dict)

    @property
    def whole(self) -> np.ndarray:
        """Seconds of each step."""
        return np.sum(list(self.parts.values()), axis=0)

    def total(self, *names: str) -> float:
        """Share of these parts in a step: medians, in the sum of the medians of all parts."""
        middle = {name: float(np.median(seconds)) for name, seconds in self.parts.items()}
        return sum(middle[name] for name in names) / sum(middle.values())

    @property
    def search(self) -> float:
        """Share of the search for contacts."""
        return self.total(*PHASES, OTHER)

    @property
    def points(self) -> float:
        """Share of the contact points in the search."""
        return self.total(POINTS) / self.search


def watched(watch: Stopwatch, sim: ts.Simulator):
    """The stopwatch takes the parts of the simulator's steps meanwhile, those of a search apart."""
    detection = sim._dynamics.contact.detection
    places = explicit_places(sim) if sim.settings.explicit else [(SEARCH, detection, "find")]
    return watch.on(places + [(phase, detection, name) for phase, name in CALLS.items()])


def open_demo(integrator: str, contact_mode: str, arch: str) -> ts.Simulator:
    """The demo in the demo's own steps, or in explicit ones near their limit."""
    scene, own = load_scene(SCENE)
    for body in scene.bodies:
        body.collision = contact_mode
    settings = {key: own[key] for key in SETTINGS if key in own}
    if integrator == EXPLICIT:
        settings = {"integrator": integrator, "dt": SHARE * stable_dt(scene, verlet=False)}
    return ts.Simulator(scene, arch=arch, **settings)


def measure_shares(integrator: str, contact_mode: str, extent: Extent) -> Shares:
    """Time the parts of steps from the first impulse on."""
    with open_demo(integrator, contact_mode, extent.arch) as sim:
        to_impulses(sim)
        sim.step()  # compiles what the first contact needs
        parts = (*PHASES, OTHER, *(name for name in PARTS if name != SEARCH and sim.settings.explicit), REST)
        shares, watch = Shares(integrator, contact_mode, sim.dt, {part: [] for part in parts}), Stopwatch()
        with watched(watch, sim):
            for _ in range(extent.of(*STEPS[integrator])):
                spent = watch.parts_of(sim.step)
                spent[OTHER] = spent.pop(SEARCH, 0.0)
                for part in parts:
                    shares.parts[part].append(spent.get(part, 0.0))
    return shares


def claims_of(found: list[Shares]) -> list[Claim]:
    """Whether the search takes most of a step, contact points most of the search, and what else counts there. The report's way
    decides; what others show stands beside it."""
    own = next(s for s in found if (s.integrator, s.contact_mode) == REPORTS_WAY)
    others = [s for s in found if s is not own]

    def beside_others(share) -> str:
        beside = "; ".join(f"{percent(share(s))} in {s.integrator}, {s.contact_mode}" for s in others)
        return f"{percent(share(own))} in {own.integrator} through distance fields, as there" + (f" ({beside})" if others else "")

    rest = {name: own.total(name) / own.search for name in ("reduction", "candidates")}
    return [
        Claim(
            "collision detection is where most of the time goes.",
            own.search > 0.5,
            f"the search takes {beside_others(lambda s: s.search)}.",
            "Where it is less than half, it is compiled code beside other compiled code: the linear systems of implicit steps, "
            "the contact solve and the report of explicit ones."
            if any(s.search <= 0.5 for s in found)
            else "",
        ),
        Claim(
            "within it the contact points, by Frank-Wolfe, take most.",
            own.points > 0.5,
            f"of the search they take {beside_others(lambda s: s.points)}.",
        ),
        Claim(
            "reducing contacts and updating the tree are significant too.",
            all(share > SIGNIFICANT for share in rest.values()),
            "of the search they take " + " and ".join(f"{percent(share)} ({name})" for name, share in rest.items()) + ".",
            ""
            if all(share > SIGNIFICANT for share in rest.values())
            else "Trees are refitted here, not built, and what a few tens of contacts need is launching the kernels.",
        ),
    ]


def share_table(found: list[Shares]) -> str:
    """A row a part of each kind of step: median, spread, share of the time of all steps."""
    rows = [(s, part, summarise(seconds)) for s in found for part, seconds in s.parts.items()]
    columns = (
        ("<steps", "{[0].integrator}"),
        ("<hit by", "{[0].contact_mode}"),
        ("<part", "{[1]}"),
        ("ms", lambda row: ms(row[2].median)),
        ("spread", lambda row: percent(spread_of(row[2])) if row[2].median else ""),
        ("share of a step", lambda row: percent(row[0].total(row[1]))),
    )
    return table(rows, columns)


def draw(found: list[Shares]) -> bytes:
    """A bar for each kind of step, in parts."""
    figure, ((panel,),) = new_figure(1)
    figure.set_size_inches(8.0, 2.6)
    names = list(dict.fromkeys(part for s in found for part in s.parts))
    left = np.zeros(len(found))
    for k, name in enumerate(names):
        width = np.array([100 * s.total(name) if name in s.parts else 0.0 for s in found])
        colour = COLOURS[k] if k < len(COLOURS) else f"{0.75 - 0.2 * (k - len(COLOURS)):.2f}"
        panel.barh(range(len(found)), width, left=left, color=colour, label=name)
        left += width
    panel.set_yticks(range(len(found)), [f"{s.integrator}\n{s.contact_mode}" for s in found], fontsize="small")
    panel.set(xlabel="share of a step [%]", xlim=(0, 100))
    figure.legend(loc="outside right upper", fontsize="small", frameon=False)
    return plot_png(figure)


def measure(extent: Extent) -> Part:
    """Explicit steps as the report's, and the demo's implicit ones; bodies hit both ways."""
    part = Part(
        "phases",
        "Where the time goes",
        "section 3.1.1, figure 10",
        f"steps of the demo {SCENE} from the first impulse on, in {EXPLICIT} at {SHARE:g} of its largest stable step and in the "
        "demo's own implicit steps; bodies hit through distance fields by Frank-Wolfe, which with explicit steps is the report's "
        "way, or by the proximity of their surfaces. Parts are timed between synchronisations; shares are those of their "
        "medians.",
    )
    kinds = [(i, way) for i in (EXPLICIT, IMPLICIT) for way in WAYS]
    found = [measure_shares(integrator, way, extent) for integrator, way in kinds[: extent.of(None, 1)]]
    part.claims, part.tables = claims_of(found), [share_table(found)]
    part.pictures["phases.png"] = draw(found)
    part.short.append("the report profiled its whole program, mesh and drawing included; these are the steps alone.")
    part.times = {f"{s.integrator}, {s.contact_mode}: a step": summarise(s.whole) for s in found}
    return part
