"""The grid of a study: its axes, their defaults, their product, and the frame time common to all time steps.

Plain data and pure functions. `taisoft.study.plan` checks whether a combination fits a scene.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from fractions import Fraction

from taisoft.errors import SceneError

MAX_FRAMES = 48  # at which runs are compared
MIN_FRAMES = 4
MAX_DENOMINATOR = 10_000  # of the ratio of two time steps; above it they have no common multiple
IMPLICIT_DEFAULT = ("implicit_euler", "bdf2")
DT_FACTORS = {False: (2.0, 1.0, 0.5, 0.25), True: (0.5, 1.0, 4.0, 8.0, 16.0)}  # of the scene's dt; key: explicit integrator


@dataclass(frozen=True)
class Setting:
    """One combination. order: None for the scene's; refine: number of mesh refinements; the rest: arguments of Simulator."""

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
        """Return the arguments of Simulator."""
        return {key: value for key, value in asdict(self).items() if key not in ("order", "refine")}

    @property
    def mesh(self) -> tuple[int, int | None]:
        """(refine, order)."""
        return self.refine, self.order


AXES = tuple(Setting.__dataclass_fields__)


@dataclass(frozen=True)
class Case:
    """A combination, and why it is not run (empty if it is)."""

    setting: Setting
    refused: str = ""


def mesh_name(setting: dict) -> str:
    """Return a short name of a setting's mesh."""
    return f"refine {setting['refine']}" + ("" if setting["order"] is None else f", order {setting['order']}")


def complete(given: dict[str, list], solver: dict, explicit: Iterable[str]) -> dict[str, list]:
    """Return all axes: as given, else from the scene's solver dict; dt and integrator default to several around the scene's."""
    own = {"dt": 1 / 60, "integrator": "implicit_euler"} | {key: value for key, value in solver.items() if key in AXES}
    axes = {key: [own.get(key, Setting.__dataclass_fields__[key].default)] for key in AXES} | given
    if "integrator" not in given:
        axes["integrator"] = list(dict.fromkeys([own["integrator"], *IMPLICIT_DEFAULT]))
    if "dt" not in given:
        axes["dt"] = [factor * own["dt"] for factor in DT_FACTORS[own["integrator"] in explicit]]
    return axes


def expand(axes: dict[str, list]) -> list[Setting]:
    """Return the product of all axes, the last one varying fastest, dt from large to small."""
    axes = axes | {"dt": sorted(axes["dt"], reverse=True)}
    order = ("refine", "order", "arch", "precision", "integrator", "contact_solver", "newton_tolerance", "linear_tolerance")
    keys = [*order, *(key for key in AXES if key not in order and key != "dt"), "dt"]
    return [Setting(**dict(zip(keys, values))) for values in itertools.product(*(axes[key] for key in keys))]


def cases(
    settings: Iterable[Setting], refusal: Callable[[Setting], str], unused: Callable[[Setting], dict[str, str]]
) -> list[Case]:
    """Return a case for every setting; of settings that differ only in unused axes, only the first is run.

    refusal: why a setting cannot be run, or an empty text. unused: axes that a setting does not use -> why.
    """
    found: list[Case] = []
    first: dict[tuple, Setting] = {}
    for setting in settings:
        if reason := refusal(setting):
            found.append(Case(setting, reason))
            continue
        unused_axes = unused(setting)
        key = tuple(value for name, value in asdict(setting).items() if name not in unused_axes)
        if key in first:
            differing = [name for name in unused_axes if getattr(setting, name) != getattr(first[key], name)]
            found.append(Case(setting, f"the same run as one above: {unused_axes[differing[0]]}"))
        else:
            first[key] = setting
            found.append(Case(setting))
    return found


def frame_time(steps: Iterable[float], seconds: float) -> tuple[float, int]:
    """Return the time between two frames [s], a multiple of every time step [s], and the number of frames.

    The last frame is near `seconds` [s]. Raises SceneError if the steps have no common multiple that leaves MIN_FRAMES frames.
    """
    steps = sorted(set(steps))
    ratios = [Fraction(step / steps[0]).limit_denominator(MAX_DENOMINATOR) for step in steps]
    listed = ", ".join(f"{step:.6g}" for step in steps)
    if any(abs(float(ratio) * steps[0] - step) > 1e-9 * step for step, ratio in zip(steps, ratios)):
        raise SceneError(f"the steps {listed} s have no common multiple: use steps that are multiples of one another")
    common = steps[0] * math.lcm(*(r.numerator for r in ratios)) / math.gcd(*(r.denominator for r in ratios))
    if common > seconds / MIN_FRAMES * (1.0 + 1e-9):
        raise SceneError(
            f"the steps {listed} s coincide only every {common:.6g} s, less than {MIN_FRAMES} times in {seconds:g} s: use steps "
            "that are multiples of one another, or a larger --seconds"
        )
    every = math.ceil(seconds / common / MAX_FRAMES - 1e-9)
    # prefer a multiple near this one whose last frame is at `seconds`
    whole = round(seconds / common)
    every = next((k for k in range(every, 2 * every + 1) if whole % k == 0 and whole // k >= MIN_FRAMES), every)
    return every * common, max(1, round(seconds / (every * common)))


def steps_in(frame: float, dt: float) -> int:
    """Return the number of steps of dt in a frame, which dt divides."""
    return max(1, round(frame / dt))


def tasks_of(plan: dict) -> tuple[list[dict], list[dict]]:
    """Return the tasks: for each reference its fine run, then its coarse run; and one for each case that is not refused."""
    references = []
    for reference in plan["references"]:
        for factor in (1, 2):
            steps = reference["steps"] // factor
            setting = reference["setting"] | {"dt": plan["frame"] / steps}
            references.append({"setting": setting, "steps": steps, "timed": False})
    accepted = [case["setting"] for case in plan["cases"] if not case["refused"]]
    settings = [{"setting": s, "steps": steps_in(plan["frame"], s["dt"]), "timed": True} for s in accepted]
    return references, settings
