"""The settings of a run, resolved from the scene's `solver` dict, --set and the other options, in this order."""

import inspect
import re
import tomllib
from argparse import Namespace
from dataclasses import dataclass, field

from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.solver import CHECKS, check_solver

OF_SCENE = "the scene's solver dict: "
RUN_KEYS = ("seconds", "fps")  # arguments of Simulator.run that a `solver` dict may hold too
MAY_CHANGE = ("dt", "arch")  # arguments of Simulator that may change when a run is resumed
BARE_WORD = re.compile(r"[A-Za-z_]\w*")


@dataclass
class RunSettings:
    """Settings of a run. simulator: arguments of Simulator; seconds [s]; fps [1/s], None for a frame per step.

    defaults: Simulator's own; changed: for a resumed run, the arguments that replace the checkpoint's.
    """

    simulator: dict
    seconds: float
    fps: float | None
    defaults: dict
    changed: list[str] = field(default_factory=list)

    def as_dict(self) -> dict:
        """Return every setting of the run by name, given or default."""
        return self.defaults | self.simulator | {"seconds": self.seconds, "fps": self.fps}


def resolve(solver: dict, arguments: Namespace, simulator_class: type, saved: dict | None = None) -> RunSettings:
    """Merge the three sources; options override --set, --set overrides the scene.

    saved: for a resumed run, the checkpoint's arguments of Simulator, and fps if it has it, which override the scene's.
    Raises SceneError for an unknown key, a value that is not a TOML scalar, an option and a --set that disagree, seconds
    and fps that are not finite and positive, or values that differ from saved, unless they may change. Simulator checks its own
    arguments.
    """
    parameters = inspect.signature(simulator_class).parameters.values()
    defaults = {parameter.name: parameter.default for parameter in parameters if parameter.name != "scene"}
    keys = [*defaults, *RUN_KEYS]
    _refuse_unknown(solver, keys, OF_SCENE)
    given, changed = _given(arguments, keys), []
    merged = solver | given
    if saved is not None:
        for key, value in given.items():
            if key not in (*MAY_CHANGE, "seconds") and value != saved.get(key, value):
                raise SceneError(f"--resume {arguments.resume}: {key} is {saved[key]} there and cannot become {value} in a run")
        changed = [key for key in MAY_CHANGE if key in given]
        run_keys = {key: merged[key] for key in RUN_KEYS if key in merged}
        merged = run_keys | saved | {key: given[key] for key in changed}
    fps = merged.get("fps", 60.0)
    return RunSettings(
        simulator={key: value for key, value in merged.items() if key not in RUN_KEYS},
        seconds=checks.number(merged.get("seconds", 1.0), "seconds", above=0.0),
        fps=None if fps is None else checks.number(fps, "fps", above=0.0),
        defaults=defaults,
        changed=changed,
    )


def _given(arguments: Namespace, keys: list[str]) -> dict:
    """Return the settings given by --set solver.KEY=VALUE and by the other options."""
    given = {}
    for assignment in arguments.assignments:
        name, equals, text = assignment.partition("=")
        head, _, key = name.strip().partition(".")
        if not equals or head != "solver":
            raise SceneError(f"--set {assignment}: write solver.KEY=VALUE, e.g. solver.dt=0.01")
        _refuse_unknown([key], keys, f"--set {assignment}: ")
        given[key] = parse_scalar(text.strip(), assignment)
    for key in ("arch", "precision", *RUN_KEYS):
        option = getattr(arguments, key)
        if option is None:
            continue
        if key in given and given[key] != option:
            raise SceneError(f"--{key} {option} and --set solver.{key}={given[key]} disagree; give one of them")
        given[key] = option
    return given


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
    _refuse_unknown(solver, list(CHECKS), OF_SCENE)
    try:
        check_solver(**solver)
    except SceneError as error:
        raise SceneError(f"{OF_SCENE}{error}") from None


def _refuse_unknown(names, keys: list[str], where: str) -> None:
    for name in names:
        if name not in keys:
            raise SceneError(f"{where}no setting is called {name!r}{checks.nearest(name, keys)}; there are {', '.join(keys)}")
