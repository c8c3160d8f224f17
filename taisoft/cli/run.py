"""`taisoft run SCENE`: load, check, build, run, save, report.

Settings come from the scene's `solver` dict, --set and the other options; the later ones override the earlier ones.
"""

import inspect
import os
import sys
import tomllib
from argparse import Namespace
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from taisoft.checkpoint import Checkpoint, read_checkpoint
from taisoft.cli import EXIT_FAILED, EXIT_OUTPUT, EXIT_SIGNAL, Signals, parse_scalar, printed_warnings
from taisoft.cli.pictures import camera_of
from taisoft.cli.recording import DisplayOptions, Observers, Recording, check_modelled, display_options
from taisoft.cli.scene_file import OF_SCENE, load_scene, refuse_unknown
from taisoft.cli.summary import print_plan, print_state, print_summary
from taisoft.cli.units import warn_millimetres
from taisoft.dynamics.schemes import STATIC
from taisoft.errors import SceneError, SimulationError, reworded
from taisoft.estimation.quantities import definitions
from taisoft.frame_steps import check_length, first_frame
from taisoft.output.folder import check_free
from taisoft.output.report import Progress
from taisoft.records import RunReport
from taisoft.scene import checks
from taisoft.scene.numbers import set_numbers
from taisoft.scene.scene import Scene
from taisoft.simulator import Simulator
from taisoft.view.plots import Plots
from taisoft.view.window.ggui import display_missing, vulkan_missing

RUN_KEYS = ("seconds", "fps", "quantities")  # arguments of Simulator.run that a `solver` dict may hold too
COMPANIONS = {  # by --error-mesh
    None: "for two to three times its work",
    "refined": "the one on the refined mesh for some 10 to 40 times its work: see docs/errors.md",
    "order": "one of them with the other order of elements",
}
MAY_CHANGE = ("dt", "arch")  # arguments of Simulator that may change when a run is resumed


@dataclass
class RunSettings:
    """Settings of a run. simulator: arguments of Simulator; seconds [s]; fps [1/s], None for a frame per step; quantities: of
    Simulator.run, by name.

    defaults: Simulator's own; changed: for a resumed run, the arguments that replace the checkpoint's; numbers: of the scene, by
    --set.
    """

    simulator: dict
    seconds: float
    fps: float | None
    defaults: dict
    changed: list[str] = field(default_factory=list)
    numbers: dict = field(default_factory=dict)
    quantities: dict = field(default_factory=dict)

    def as_dict(self) -> dict:
        """Return every setting of the run by name, given or default."""
        return self.defaults | self.simulator | {"seconds": self.seconds, "fps": self.fps, "set": self.numbers}


def run(arguments: Namespace) -> int:
    """Run the scene and return the exit status. Bad input is refused before any file is written."""
    _check_working_folder()
    with Signals() as signals, printed_warnings() as warned:
        scene, solver = load_scene(arguments.scene, arguments.allow_outside)
        if arguments.camera is not None:
            scene.camera = camera_of(arguments.camera)
        numbers = set_given(scene, arguments.assignments)
        warn_millimetres({body.name: body.mesh for body in scene.bodies})
        _check_checkpoint_interval(arguments)
        shown = display_options(arguments, has_window=not arguments.headless and _window_is_possible())
        interactive = shown.window and arguments.out is None and arguments.seconds is None
        if shown.errors and interactive:
            raise SceneError("--error: a window without end has no error of a run: give --seconds, or --out")
        if arguments.error_mesh is not None and arguments.resume is not None:
            raise SceneError("--error-mesh excludes --resume: a run on another mesh starts with the scene")
        saved: Checkpoint | None = None
        if arguments.resume is None:
            settings = resolve(solver, arguments, Simulator)
            _check_tolerance(settings, interactive)
            if arguments.out is not None:
                check_free(arguments.out, arguments.overwrite)
            with reworded((SceneError, SimulationError), f"{arguments.scene}: "):
                sim = Simulator(scene, **settings.simulator | ({"draggable": True} if interactive else {}))  # by the mouse
        else:
            saved = read_checkpoint(arguments.resume)
            kept = saved.settings | ({"fps": saved.notes["fps"]} if "fps" in saved.notes else {})  # frames have numbers
            settings = resolve(solver, arguments, Simulator, kept)
            if "dt" in settings.changed and saved.settings.get("tolerance") is not None:
                raise SceneError(f"--resume {arguments.resume}: its dt was chosen for a tolerance and cannot change in a run")
            sim = Simulator.from_checkpoint(saved, scene, arch=settings.simulator["arch"])
        settings.numbers = numbers
        with sim:
            if "dt" in settings.changed:
                sim.dt = settings.simulator["dt"]
            if saved is not None:
                print(f"resumed  from {saved.path}, t = {sim.time:.6g} s")
            check_modelled(shown, sim)
            print_plan(sim, arguments.verbose)
            if interactive:
                return _show_window(sim, settings, shown)
            _check_time_left(sim, settings, arguments)
            with reworded((SceneError, SimulationError), f"{arguments.scene}: "):
                check_length(settings.seconds, sim.dt, settings.fps)
                if not definitions(sim, settings.quantities) and "quantities" in shown.details:
                    raise SceneError("--details quantities: the run has none, give --quantity")
                if arguments.error_mesh is not None:
                    from taisoft.estimation.companions import other_mesh  # loads modules with kernels that the run may not need

                    other_mesh(sim, arguments.error_mesh)  # refuse it before earlier results are removed
            return _run(sim, settings, arguments, signals, warned, saved, shown)


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
    refuse_unknown(solver, keys, OF_SCENE)
    given, changed = _given(arguments, keys), []
    merged = solver | given
    if saved is not None:
        for key, value in given.items():
            if key not in (*MAY_CHANGE, "seconds") and value != saved.get(key, value):
                raise SceneError(f"--resume {arguments.resume}: {key} is {saved[key]} there and cannot become {value} in a run")
        changed = [key for key in MAY_CHANGE if key in given]
        run_keys = {key: merged[key] for key in RUN_KEYS if key in merged}
        merged = run_keys | saved | {key: given[key] for key in changed}
    fps = None if merged.get("integrator") == STATIC else merged.get("fps", 60.0)
    return RunSettings(
        simulator={key: value for key, value in merged.items() if key not in RUN_KEYS},
        seconds=checks.number(merged.get("seconds", 1.0), "seconds", above=0.0),
        fps=None if fps is None else checks.number(fps, "fps", above=0.0),
        defaults=defaults,
        changed=changed,
        quantities=merged.get("quantities", {}) | _quantities(arguments.quantity),
    )


def set_given(scene: Scene, assignments: list[str]) -> dict:
    """Set numbers of a scene as --set NAME.NUMBER=VALUE gives them, and return them by name. Raises SceneError."""
    given = {}
    for assignment in assignments:
        name, equals, text = (part.strip() for part in assignment.partition("="))
        if not equals or not name:
            raise SceneError(f"--set {assignment}: write NAME.NUMBER=VALUE, such as beam.young=2e5, or solver.KEY=VALUE")
        if name.startswith("solver."):
            continue
        given[name] = _number_or_list(text, assignment)
        with reworded(SceneError, f"--set {assignment}: "):
            set_numbers(scene, {name: given[name]})
    return given


def _quantities(texts: list[str]) -> dict[str, str]:
    """Return the texts of --quantity NAME=TEXT by name. Raises SceneError."""
    pairs = [[part.strip() for part in text.partition("=")] for text in texts]
    for text, (name, _, what) in zip(texts, pairs):
        if not name or not what:
            raise SceneError(f"--quantity {text}: write NAME=TEXT, such as 'grip=contact_force.x finger fruit'")
    return {name: what for name, _, what in pairs}


def _number_or_list(text: str, assignment: str) -> float | int | bool | str | list | None:
    """Parse a value as `parse_scalar`, or a list of numbers in TOML syntax, whose outer brackets may be left out."""
    if "," not in text and "[" not in text:
        return parse_scalar(text, assignment)
    with suppress(tomllib.TOMLDecodeError, ValueError):
        value = tomllib.loads(f"value = {text if text.startswith('[') else f'[{text}]'}")["value"]
        if not any(isinstance(one, bool) for one in np.array(value, dtype=object).flat):
            return value
    raise SceneError(f"--set {assignment}: {text!r} is not a list of numbers")


def _given(arguments: Namespace, keys: list[str]) -> dict:
    """Return the settings given by --set solver.KEY=VALUE and by the other options."""
    given = {}
    for assignment in arguments.assignments:
        name, _, text = assignment.partition("=")
        head, _, key = name.strip().partition(".")
        if head == "solver":
            refuse_unknown([key], keys, f"--set {assignment}: ")
            given[key] = parse_scalar(text.strip(), assignment)
    for key in ("arch", "precision", "tolerance", "seconds", "fps"):
        option = getattr(arguments, key)
        if option is None:
            continue
        if key in given and given[key] != option:
            raise SceneError(f"--{key} {option} and --set solver.{key}={given[key]} disagree; give one of them")
        given[key] = option
    return given


def _check_checkpoint_interval(arguments: Namespace) -> None:
    if arguments.checkpoint_every is not None:
        if arguments.out is None:
            raise SceneError("--checkpoint-every needs --out, the folder to write to")
        checks.number(arguments.checkpoint_every, "--checkpoint-every", above=0.0, unit="s")


def _check_tolerance(settings: RunSettings, interactive: bool) -> None:
    """Refuse a tolerance where there is no run to choose steps for, or no frames for its files."""
    if settings.simulator.get("tolerance") is None:
        return
    if interactive:
        raise SceneError("--tolerance: a window without end has no run to choose steps for: give --seconds, or --out")
    if settings.fps is None:
        raise SceneError("--tolerance needs frames at a rate, not after every step: give --fps")


def _check_time_left(sim: Simulator, settings: RunSettings, arguments: Namespace) -> None:
    """Raise SceneError if the checkpoint is already at the end of the run."""
    if arguments.resume is not None and settings.seconds - sim.time < 0.5 * sim.dt:
        raise SceneError(
            f"--resume {arguments.resume}: it is already at t = {sim.time:g} s, and the run ends at {settings.seconds:g} s; "
            "--seconds sets a later end"
        )


def _check_working_folder() -> None:
    """Raise SceneError if the working folder is gone, because Taichi needs it to start."""
    try:
        os.getcwd()
    except OSError as error:
        raise SceneError(f"the working folder cannot be used ({error.strerror}): change to another one") from None


def _window_is_possible() -> bool:
    """Return whether the live window can be opened; print why not, because opening it would crash the process."""
    missing = display_missing() or vulkan_missing()
    if missing:
        print(f"taisoft: running without a window: {missing}", file=sys.stderr)
    return not missing


def _show_window(sim: Simulator, settings: RunSettings, shown: DisplayOptions) -> int:
    """Show the live window until it is closed."""
    from taisoft.view.window.window import show

    show(sim, fps=settings.fps, colour=shown.picture.colour, layers=shown.in_window)
    print_state(sim)
    return 0


def _run(sim, settings: RunSettings, arguments, signals, warned: list[str], saved, shown: DisplayOptions) -> int:
    """Run until settings.seconds; save what was computed, however the run ends."""
    observers, recording, resumed, notes = Observers(), None, None, {}
    plots = Plots(sim, shown.picture.plots, shown.errors) if shown.picture.plots else None
    if saved is not None:
        notes = saved.notes
        resumed = {"checkpoint": str(saved.path), "time": sim.time, "frame": first_frame(sim, settings.fps)}
    with ExitStack() as stack:
        signals.run_began()
        if arguments.out is not None:
            recording = Recording(arguments.out, arguments.overwrite, resumed, arguments.checkpoint_every, notes)
            stack.callback(recording.release)
        stack.callback(observers.close)
        if shown.window:
            from taisoft.view.window.window import LiveWindow

            observers.members.append(LiveWindow(sim, colour=shown.picture.colour, layers=shown.in_window))
        if recording is not None:
            recording.add_writers(observers, sim, Path(arguments.scene).stem, settings.fps, settings.seconds, shown, plots)
        progress = Progress(settings.seconds, label=Path(arguments.scene).stem)
        observers.members.append(progress)
        if shown.errors:
            print(f"error    companions follow the run, {COMPANIONS[arguments.error_mesh]}", flush=True)
        if sim.settings.tolerance is not None and resumed is None:
            print("trials   choose integrator and dt", flush=True)
        result = sim.run(
            settings.seconds,
            on_frame=observers.on_frame,
            fps=settings.fps,
            stop=lambda: signals.requested() or bool(observers.errors),
            resumed=resumed is not None,
            on_step=plots.take if plots is not None else None,
            error=shown.errors,
            error_mesh=arguments.error_mesh,
            on_iteration=progress.iteration,
            details=shown.details,
            quantities=settings.quantities,
            about=arguments.about,
        )
        observers.close()
        if recording is not None:
            try:
                observers.guard(recording.checkpoint, sim)
            except SimulationError as error:  # the state is invalid; an earlier checkpoint stays
                result.problems.append(str(error))
                result.status = "failed"
        result.problems[:0] = [f"warning: {text}" for text in warned]
        _report_failed_output(result, observers, signals)
        if recording is not None:
            reported = observers.guard(recording.report, result, sim, settings.as_dict())
            video = arguments.video and not signals.requested()
            video_written = not video or observers.guard(recording.video, (settings.fps or 1.0 / sim.dt) / shown.slow)
            _report_failed_output(result, observers, signals)
            if reported and not video_written:
                observers.guard(recording.report, result, sim, settings.as_dict())  # again, with the video's errors
        print_summary(result, sim, observers, recording)
    for error in observers.errors:
        print(f"taisoft: {error}", file=sys.stderr)
    if observers.errors:
        return EXIT_OUTPUT
    if signals.number is not None:
        return EXIT_SIGNAL + signals.number
    return EXIT_FAILED if result.status == "failed" else 0


def _report_failed_output(result: RunReport, observers: Observers, signals: Signals) -> None:
    """Add all output errors to the run's report: report.json may still fit on the disk when a picture did not."""
    if observers.errors:
        result.degrade(*(error for error in observers.errors if error not in result.problems))
        result.interrupted = result.interrupted and signals.requested()
