"""The settings of a run, resolved from the scene's `solver` dict, --set and the other options, in this order."""

import inspect
import re
import tomllib
from argparse import Namespace
from dataclasses import dataclass, field

from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.checks import SOLVER_CHECKS, check_solver, nearest

OF_SCENE = "the scene's solver dict: "
RUN_KEYS = ("seconds", "fps")  # arguments of Simulator.run that a `solver` dict may hold too
BARE_WORD = re.compile(r"[A-Za-z_]\w*")


@dataclass
class RunSettings:
    """Settings of a run. simulator: arguments of Simulator; seconds [s]; fps [1/s], None for a frame per step.

    changed: for a resumed run, the arguments that replace the checkpoint's.
    """

    simulator: dict
    seconds: float = 1.0
    fps: float | None = 60.0
    defaults: dict = field(default_factory=dict)  # Simulator's own, for the arguments that were not given
    changed: list[str] = field(default_factory=list)

    def as_dict(self) -> dict:
        """Return every setting of the run by name, given or default."""
        return self.defaults | self.simulator | {"seconds": self.seconds, "fps": self.fps}


def resolve(solver: dict, arguments: Namespace, simulator_class: type) -> RunSettings:
    """Merge the three sources; options override --set, --set overrides the scene.

    Raises SceneError for an unknown key, a value that is not a TOML scalar, an option and a --set that disagree, or
    seconds and fps that are not finite and positive. Simulator checks its own arguments.
    """
    defaults = _defaults(simulator_class)
    given = _given(arguments, defaults, solver)
    merged = {**solver, **given}
    simulator = {key: value for key, value in merged.items() if key not in RUN_KEYS}
    return _with_run_keys(RunSettings(simulator=simulator, defaults=defaults), merged)


def resolve_resumed(solver: dict, arguments: Namespace, simulator_class: type, saved: dict) -> RunSettings:
    """As `resolve`, for a resumed run: the checkpoint's settings override the scene's.

    saved: arguments of Simulator, and fps if the checkpoint has it.

    Raises SceneError for an option or a --set that differs from saved; only dt and arch may change.
    """
    defaults = _defaults(simulator_class)
    given = _given(arguments, defaults, solver)
    for key, value in given.items():
        if key not in ("seconds", "dt", "arch") and value != saved.get(key, value):
            raise SceneError(f"--resume {arguments.resume}: {key} is {saved[key]} there and cannot become {value} in a run")
    changed = {key: given[key] for key in ("dt", "arch") if key in given}
    own = {key: value for key, value in saved.items() if key not in RUN_KEYS}
    settings = RunSettings(simulator=own | changed, defaults=defaults, changed=list(changed))
    return _with_run_keys(settings, {**solver, **given, **{key: saved[key] for key in RUN_KEYS if key in saved}})


def _given(arguments: Namespace, defaults: dict, solver: dict) -> dict:
    """Return the settings given by --set and the other options; check the scene's solver dict, too."""
    keys = [*defaults, *RUN_KEYS]
    _refuse_unknown(solver, keys, OF_SCENE)
    given = parse_assignments(arguments.assignments, keys)
    for key in ("arch", "precision", *RUN_KEYS):
        option = getattr(arguments, key)
        if option is None:
            continue
        if key in given and given[key] != option:
            raise SceneError(f"--{key} {option} and --set solver.{key}={given[key]} disagree; give one of them")
        given[key] = option
    return given


def _with_run_keys(settings: RunSettings, merged: dict) -> RunSettings:
    settings.seconds = _positive("seconds", merged.get("seconds", settings.seconds))
    fps = merged.get("fps", settings.fps)
    settings.fps = None if fps is None else _positive("fps", fps)
    return settings


def parse_assignments(assignments: list[str], keys: list[str]) -> dict:
    """Parse ["solver.dt=0.01", ...] to {"dt": 0.01, ...}; a value is a TOML scalar, a bare word or none."""
    values = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        head, _, key = name.strip().partition(".")
        if not equals or head != "solver":
            raise SceneError(f"--set {assignment}: write solver.KEY=VALUE, e.g. solver.dt=0.01")
        _refuse_unknown([key], keys, f"--set {assignment}: ")
        values[key] = parse_scalar(text.strip(), assignment)
    return values


def parse_scalar(text: str, assignment: str, option: str = "--set") -> float | int | bool | str | None:
    """Parse a number, true, false or "text" in TOML syntax; a bare word is text, and none is None."""
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        if not BARE_WORD.fullmatch(text):
            raise SceneError(f"{option} {assignment}: {text!r} is not a number, true, false, none or a word") from None
        return None if text == "none" else text
    if set(table) != {"value"} or not isinstance(table["value"], (float, int, bool, str)):
        raise SceneError(f"{option} {assignment}: {text!r} is not a single number, true, false, none or a word")
    return table["value"]


def check_scene_solver(solver: dict) -> None:
    """Raise SceneError if a scene's `solver` dict has unknown keys or invalid values."""
    _refuse_unknown(solver, list(SOLVER_CHECKS), OF_SCENE)
    try:
        check_solver(**solver)
    except SceneError as error:
        raise SceneError(f"{OF_SCENE}{error}") from None


def _defaults(simulator_class: type) -> dict:
    """Return argument -> default value of Simulator, without the scene."""
    parameters = inspect.signature(simulator_class).parameters.values()
    return {parameter.name: parameter.default for parameter in parameters if parameter.name != "scene"}


def _refuse_unknown(names, keys: list[str], where: str) -> None:
    for name in names:
        if name not in keys:
            raise SceneError(f"{where}no setting is called {name!r}{nearest(name, keys)}; there are {', '.join(keys)}")


def _positive(name: str, value) -> float:
    return checks.number(value, name, above=0.0)
