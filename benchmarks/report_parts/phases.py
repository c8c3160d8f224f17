"""Figure 10 of the report: which phase takes the time of demonstration 3.

Steps are timed from the first impulse on. Their parts are timed between synchronisations, which an ordinary step does not have;
fractions refer to the step timed in this way.
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
STEP_FRACTION = 0.9  # explicit step over the largest stable step
EXPLICIT, IMPLICIT = "symplectic_euler", "implicit_euler"
STEPS = {EXPLICIT: (400, 60), IMPLICIT: (120, 20)}  # timed steps of a full and a quick run
CONTACT_MODES = ("distance_field", "proximity")
REPORTED = (EXPLICIT, CONTACT_MODES[0])
SIGNIFICANT = 0.1  # fraction of the search time


@dataclass
class Profile:
    """Timed steps of one integrator and contact mode. parts: name -> wall seconds per step; PHASES and OTHER are the search."""

    integrator: str
    contact_mode: str
    dt: float
    parts: dict[str, list[float]] = field(default_factory=dict)

    @property
    def whole(self) -> np.ndarray:
        """Seconds of each step."""
        return np.sum(list(self.parts.values()), axis=0)

    def total(self, *names: str) -> float:
        """Fraction of a step spent in these parts: the sum of their medians over that of all parts."""
        middle = {name: float(np.median(seconds)) for name, seconds in self.parts.items()}
        return sum(middle[name] for name in names) / sum(middle.values())

    @property
    def search(self) -> float:
        """Fraction of a step spent in the search for contacts."""
        return self.total(*PHASES, OTHER)

    @property
    def points(self) -> float:
        """Fraction of the search spent on contact points."""
        return self.total(POINTS) / self.search


def watched(watch: Stopwatch, sim: ts.Simulator):
    """Context in which the stopwatch times the parts of the simulator's steps, and those of the search."""
    detection = sim._dynamics.contact.detection
    places = explicit_places(sim) if sim.settings.explicit else [(SEARCH, detection, "find")]
    return watch.on(places + [(phase, detection, name) for phase, name in CALLS.items()])


def open_demo(integrator: str, contact_mode: str, arch: str) -> ts.Simulator:
    """The demo with its own settings, or with explicit steps near the stability limit."""
    scene, own = load_scene(SCENE)
    for body in scene.bodies:
        body.collision = contact_mode
    settings = {key: own[key] for key in SETTINGS if key in own}
    if integrator == EXPLICIT:
        settings = {"integrator": integrator, "dt": STEP_FRACTION * stable_dt(scene, verlet=False)}
    return ts.Simulator(scene, arch=arch, **settings)


def measure_profile(integrator: str, contact_mode: str, extent: Extent) -> Profile:
    """Time the parts of steps from the first impulse on."""
    with open_demo(integrator, contact_mode, extent.arch) as sim:
        to_impulses(sim)
        sim.step()  # compiles what the first contact needs
        parts = (*PHASES, OTHER, *(name for name in PARTS if name != SEARCH and sim.settings.explicit), REST)
        profile, watch = Profile(integrator, contact_mode, sim.dt, {part: [] for part in parts}), Stopwatch()
        with watched(watch, sim):
            for _ in range(extent.of(*STEPS[integrator])):
                spent = watch.parts_of(sim.step)
                spent[OTHER] = spent.pop(SEARCH, 0.0)
                for part in parts:
                    profile.parts[part].append(spent.get(part, 0.0))
    return profile


def claims_of(profiles: list[Profile]) -> list[Claim]:
    """Claims about the search in a step and the contact points in the search.

    The profile with the report's settings decides; the text quotes the others.
    """
    own = next(s for s in profiles if (s.integrator, s.contact_mode) == REPORTED)
    others = [s for s in profiles if s is not own]

    def with_others(fraction) -> str:
        text = f"{percent(fraction(own))} in {own.integrator} with distance fields, as in the report"
        beside = "; ".join(f"{percent(fraction(s))} in {s.integrator}, {s.contact_mode}" for s in others)
        return f"{text} ({beside})" if others else text

    rest = {name: own.total(name) / own.search for name in ("reduction", "candidates")}
    return [
        Claim(
            "collision detection takes most of the time.",
            own.search > 0.5,
            f"the search takes {with_others(lambda s: s.search)}.",
            "If it takes less than half, then because all code here is compiled, also the linear systems of implicit steps, the "
            "contact solve and the report of explicit steps."
            if any(s.search <= 0.5 for s in profiles)
            else "",
        ),
        Claim(
            "the contact points, by Frank-Wolfe, take most of the search.",
            own.points > 0.5,
            f"of the search they take {with_others(lambda s: s.points)}.",
        ),
        Claim(
            "reducing contacts and updating the tree take a significant part too.",
            all(fraction > SIGNIFICANT for fraction in rest.values()),
            "of the search they take " + " and ".join(f"{percent(fraction)} ({name})" for name, fraction in rest.items()) + ".",
            ""
            if all(fraction > SIGNIFICANT for fraction in rest.values())
            else "Trees are refitted here, not built, and for a few tens of contacts the kernel launches dominate.",
        ),
    ]


def profile_table(profiles: list[Profile]) -> str:
    """A row per part of a step: median, spread, fraction of the step."""
    rows = [(s, part, summarise(seconds)) for s in profiles for part, seconds in s.parts.items()]
    columns = (
        ("<steps", "{[0].integrator}"),
        ("<hit by", "{[0].contact_mode}"),
        ("<part", "{[1]}"),
        ("ms", lambda row: ms(row[2].median)),
        ("spread", lambda row: percent(spread_of(row[2])) if row[2].median else ""),
        ("fraction of a step", lambda row: percent(row[0].total(row[1]))),
    )
    return table(rows, columns)


def draw(profiles: list[Profile]) -> bytes:
    """A stacked bar per kind of step."""
    figure, ((panel,),) = new_figure(1)
    figure.set_size_inches(8.0, 2.6)
    names = list(dict.fromkeys(part for s in profiles for part in s.parts))
    left = np.zeros(len(profiles))
    for k, name in enumerate(names):
        width = np.array([100 * s.total(name) if name in s.parts else 0.0 for s in profiles])
        colour = COLOURS[k] if k < len(COLOURS) else f"{0.75 - 0.2 * (k - len(COLOURS)):.2f}"
        panel.barh(range(len(profiles)), width, left=left, color=colour, label=name)
        left += width
    panel.set_yticks(range(len(profiles)), [f"{s.integrator}\n{s.contact_mode}" for s in profiles], fontsize="small")
    panel.set(xlabel="fraction of a step [%]", xlim=(0, 100))
    figure.legend(loc="outside right upper", fontsize="small", frameon=False)
    return plot_png(figure)


def measure(extent: Extent) -> Part:
    """Explicit steps as in the report and the demo's implicit steps, each with both contact modes."""
    part = Part(
        "phases",
        "Where the time goes",
        "section 3.1.1, figure 10",
        f"steps of the demo {SCENE} from the first impulse on, with {EXPLICIT} at {STEP_FRACTION:g} of its largest stable step "
        "and with the demo's own implicit steps. Contacts come from distance fields by Frank-Wolfe (the report: with explicit "
        "steps) or from the proximity of surfaces. Parts are timed between synchronisations; fractions are those of the medians.",
    )
    kinds = [(integrator, mode) for integrator in (EXPLICIT, IMPLICIT) for mode in CONTACT_MODES]
    profiles = [measure_profile(*kind, extent) for kind in kinds[: extent.of(None, 1)]]
    part.claims, part.tables = claims_of(profiles), [profile_table(profiles)]
    part.pictures["phases.png"] = draw(profiles)
    part.short.append("the report profiled its whole program, including meshing and drawing; here only steps are measured.")
    part.times = {f"{s.integrator}, {s.contact_mode}: a step": summarise(s.whole) for s in profiles}
    return part
