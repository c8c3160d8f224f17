"""Figure 10 of the report: which phase takes the time of demonstration 3.

Claims and figure from the numbers of `taisoft bench contact`: steps from the first impulse on, explicit ones near their limit and
the demo's own, with both contact geometries. Kinds are explained in benchmarks/kinds.py.
"""

from taisoft.output.tables import percent

from ..charts import Panel
from ..contact import GEOMETRIES, SHEET
from ..contact_runs import EXPLICIT, Profile
from ..kinds import CANDIDATES, IN_SEARCH, KINDS, POINTS, REDUCTION
from .page import Claim, Part, plot_png, restored

REPORTED = (EXPLICIT["integrator"], GEOMETRIES[0])
SIGNIFICANT = 0.1  # fraction of the search time


def fraction(profile: Profile, *kinds: str) -> float:
    """Fraction of a step spent on these kinds."""
    return sum(profile.kinds.get(kind, 0.0) for kind in kinds) / sum(profile.kinds.values())


def in_search(profile: Profile, *kinds: str) -> float:
    """Fraction of the search spent on these kinds."""
    return fraction(profile, *kinds) / fraction(profile, *IN_SEARCH)


def phases(numbers: dict) -> Part:
    """Steps of the sheet with the cube."""
    profiles = [restored(Profile, one) for one in numbers["steps"] if one["scene"] == SHEET]
    return Part(
        "phases",
        "Where the time goes",
        "section 3.1.1, figure 10",
        f"steps of the demo {SHEET} from the first impulse on, explicit ones near their limit and the demo's own implicit ones. "
        "Contacts come from distance fields by Frank-Wolfe (the report: with explicit steps) or from the proximity of surfaces.",
        claims_of(profiles),
        pictures={"phases.png": draw(profiles)},
        short=["the report profiled its whole program, including meshing and drawing; here only steps are measured."],
    )


def claims_of(profiles: list[Profile]) -> list[Claim]:
    """Claims about the search in a step and the contact points in the search.

    The profile with the report's settings decides; the text quotes the others.
    """
    own = next(p for p in profiles if (p.integrator, p.geometry) == REPORTED)
    others = [p for p in profiles if p is not own]

    def with_others(of) -> str:
        text = f"{percent(of(own))} in {own.integrator} with distance fields, as in the report"
        beside = "; ".join(f"{percent(of(p))} in {p.integrator}, {p.geometry}" for p in others)
        return f"{text} ({beside})" if others else text

    rest = {kind: in_search(own, kind) for kind in (REDUCTION, CANDIDATES)}
    return [
        Claim(
            "collision detection takes most of the time.",
            fraction(own, *IN_SEARCH) > 0.5,
            f"the search takes {with_others(lambda p: fraction(p, *IN_SEARCH))}.",
            "All code here is compiled, also the linear systems of implicit steps, the contact solve and the report of steps.",
        ),
        Claim(
            "the contact points, by Frank-Wolfe, take most of the search.",
            in_search(own, POINTS) > 0.5,
            f"of the search they take {with_others(lambda p: in_search(p, POINTS))}.",
        ),
        Claim(
            "reducing contacts and updating the tree take a significant part too.",
            all(part > SIGNIFICANT for part in rest.values()),
            "of the search they take " + " and ".join(f"{percent(part)} ({kind})" for kind, part in rest.items()) + ".",
            "Trees are refitted here, not built, and for a few tens of contacts the kernel launches dominate.",
        ),
    ]


def draw(profiles: list[Profile]) -> bytes:
    """A bar for each kind of step, the parts of a step one after the other."""
    panel = Panel(
        "; ".join(f"{k}: {p.integrator}, {p.geometry}" for k, p in enumerate(profiles)), "fraction of a step [%]", "steps"
    )
    left = [0.0] * len(profiles)
    for number, kind in enumerate(kind for kind in KINDS if any(p.kinds.get(kind) for p in profiles)):
        x, y = [], []
        for k, p in enumerate(profiles):
            right = left[k] + 100.0 * fraction(p, kind)
            x += [left[k], right, float("nan")]
            y += [k, k, float("nan")]
            left[k] = right
        grey = f"{0.8 - 0.2 * (number - 6):.1f}"  # after the colours
        panel.curve(x, y, kind, number if number < 7 else grey, "-", lw=12, solid_capstyle="butt")
    return plot_png(panel)
