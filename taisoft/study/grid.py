"""The grid of a study: its axes, what they are by default, their product, and the frame time that all steps share.

Plain data and pure functions. What a combination needs to fit a scene is asked in `taisoft.study.plan`.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from fractions import Fraction

from taisoft.errors import SceneError

MOST_FRAMES = 48  # at which runs are compared
FEWEST_FRAMES = 4
LARGEST_RATIO = 10_000  # denominator of the ratio of two steps above which they never meet
IMPLICIT_DEFAULT = ("implicit_euler", "bdf2")
FACTORS = {False: (2.0, 1.0, 0.5, 0.25), True: (0.5, 1.0, 4.0, 8.0, 16.0)}  # of the scene's dt; whether that is an explicit one


@dataclass(frozen=True)
class Setting:
    """One combination. order: None for what the scene says; refine: how often its meshes are refined; the rest: Simulator's."""

    dt: float
    integrator: str
    order: int | None = None
    refine: int = 0
    precision: str = "f32"
    newton_tolerance: float | None = None
    linear_tolerance: float | None = None
    contact_solver: str = "auto"
    contact_tolerance: float | None = None
    arch: str = "cpu"

    def simulator(self) -> dict:
        """The arguments of Simulator among them."""
        return {key: value for key, value in asdict(self).items() if key not in ("order", "refine")}

    @property
    def mesh(self) -> tuple[int, int | None]:
        """What the scene is asked for: (refine, order)."""
        return self.refine, self.order


AXES = tuple(Setting.__dataclass_fields__)


@dataclass(frozen=True)
class Case:
    """A combination, and the reason why it is not run, or an empty text."""

    setting: Setting
    refused: str = ""


def mesh_name(setting: dict) -> str:
    """What a setting asks of the scene, in short."""
    return f"refine {setting['refine']}" + ("" if setting["order"] is None else f", order {setting['order']}")


def complete(given: dict[str, list], solver: dict, explicit: Iterable[str]) -> dict[str, list]:
    """All axes: as given, else as the scene's solver dict says; without any dt or integrator some about the scene's."""
    own = {"dt": 1 / 60, "integrator": "implicit_euler"} | {key: value for key, value in solver.items() if key in AXES}
    axes = {key: [own.get(key, Setting.__dataclass_fields__[key].default)] for key in AXES} | given
    if "integrator" not in given:
        axes["integrator"] = list(dict.fromkeys([own["integrator"], *IMPLICIT_DEFAULT]))
    if "dt" not in given:
        axes["dt"] = [factor * own["dt"] for factor in FACTORS[own["integrator"] in explicit]]
    return axes


def expand(axes: dict[str, list]) -> list[Setting]:
    """The product of all axes, the last one fastest, dt from large to small."""
    axes = axes | {"dt": sorted(axes["dt"], reverse=True)}
    order = ("refine", "order", "arch", "precision", "integrator", "contact_solver", "newton_tolerance", "linear_tolerance")
    keys = [*order, *(key for key in AXES if key not in order and key != "dt"), "dt"]
    return [Setting(**dict(zip(keys, values))) for values in itertools.product(*(axes[key] for key in keys))]


def cases(
    settings: Iterable[Setting], refusal: Callable[[Setting], str], unused: Callable[[Setting], dict[str, str]]
) -> list[Case]:
    """Every setting with its refusal; of those that differ only in what they do not use the first is run.

    unused: names of axes that a setting does not use -> why.
    """
    found: list[Case] = []
    first: dict[tuple, Setting] = {}
    for setting in settings:
        if reason := refusal(setting):
            found.append(Case(setting, reason))
            continue
        idle = unused(setting)
        key = tuple(value for name, value in asdict(setting).items() if name not in idle)
        if key in first:
            differing = [name for name in idle if getattr(setting, name) != getattr(first[key], name)]
            found.append(Case(setting, f"the same run as one above: {idle[differing[0]]}"))
        else:
            first[key] = setting
            found.append(Case(setting))
    return found


def frame_time(steps: Iterable[float], seconds: float) -> tuple[float, int]:
    """Time between two frames [s], a multiple of every step [s], and the number of frames, which end near `seconds` [s].

    Raises SceneError where steps have no common multiple that leaves some frames.
    """
    steps = sorted(set(steps))
    ratios = [Fraction(step / steps[0]).limit_denominator(LARGEST_RATIO) for step in steps]
    told = ", ".join(f"{step:.6g}" for step in steps)
    if any(abs(float(ratio) * steps[0] - step) > 1e-9 * step for step, ratio in zip(steps, ratios)):
        raise SceneError(f"the steps {told} s never meet: take steps that are multiples of one another")
    common = steps[0] * math.lcm(*(r.numerator for r in ratios)) / math.gcd(*(r.denominator for r in ratios))
    if common > seconds / FEWEST_FRAMES * (1.0 + 1e-9):
        raise SceneError(
            f"the steps {told} s meet only every {common:.6g} s, less than {FEWEST_FRAMES} times in {seconds:g} s: take steps "
            "that are multiples of one another, or more --seconds"
        )
    every = math.ceil(seconds / common / MOST_FRAMES - 1e-9)
    # Of the numbers of steps near that, one that ends at `seconds` where there is one
    whole = round(seconds / common)
    every = next((k for k in range(every, 2 * every + 1) if whole % k == 0 and whole // k >= FEWEST_FRAMES), every)
    return every * common, max(1, round(seconds / (every * common)))


def steps_in(frame: float, dt: float) -> int:
    """Number of steps of dt in a frame, which it divides."""
    return max(1, round(frame / dt))


def tasks_of(plan: dict) -> tuple[list[dict], list[dict]]:
    """What is to be run: of each reference the fine and the coarse run, one after the other, and each case not refused."""
    references = []
    for reference in plan["references"]:
        for part in (1, 2):
            steps = reference["steps"] // part
            setting = reference["setting"] | {"dt": plan["frame"] / steps}
            references.append({"setting": setting, "steps": steps, "timed": False})
    accepted = [case["setting"] for case in plan["cases"] if not case["refused"]]
    settings = [{"setting": s, "steps": steps_in(plan["frame"], s["dt"]), "timed": True} for s in accepted]
    return references, settings
