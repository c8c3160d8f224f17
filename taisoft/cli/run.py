"""`taisoft run SCENE`: load, check, build, run, save, report."""

import os
import sys
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from taisoft.checkpoint import Checkpoint
from taisoft.cli import EXIT_FAILED, EXIT_OUTPUT, EXIT_SIGNAL
from taisoft.cli.pictures import DisplayOptions, check_modelled, display_options
from taisoft.cli.recording import Observers, Recording
from taisoft.cli.scene_file import load_scene
from taisoft.cli.settings import RunSettings, resolve, resolve_resumed
from taisoft.cli.signals import Signals
from taisoft.cli.summary import print_plan, print_state, print_summary
from taisoft.cli.warnings import printed_warnings
from taisoft.errors import SceneError, SimulationError
from taisoft.output.files import check_free, read_last_good
from taisoft.output.report import Progress
from taisoft.records import RunReport
from taisoft.running import check_length, first_frame
from taisoft.scene import checks
from taisoft.scene.scene import Scene
from taisoft.simulator import Simulator
from taisoft.view.ggui import display_missing, vulkan_missing
from taisoft.view.plots import Plots


def command(arguments: Namespace) -> int:
    """Run the scene and return the exit status. Bad input is refused before any file is written."""
    _check_working_folder()
    with Signals() as signals, printed_warnings() as warned:
        scene, solver = load_scene(arguments.scene, arguments.allow_outside)
        every = _checkpoint_interval(arguments)
        saved: Checkpoint | None = None
        has_window = not arguments.headless and _window_is_possible()
        shown = display_options(arguments, has_window)
        interactive = has_window and arguments.out is None and arguments.seconds is None
        if arguments.resume is None:
            settings = resolve(solver, arguments, Simulator)
            if arguments.out is not None:
                check_free(arguments.out, arguments.overwrite)
            with _prefix_errors(arguments.scene):
                sim = Simulator(scene, **settings.simulator | ({"draggable": True} if interactive else {}))  # by the mouse
        else:
            saved = read_last_good(arguments.resume)
            kept = saved.settings | ({"fps": saved.notes["fps"]} if "fps" in saved.notes else {})  # frames have numbers
            settings = resolve_resumed(solver, arguments, Simulator, kept)
            sim = _resumed(saved, scene, settings)
        with sim:
            check_modelled(shown, sim)
            print_plan(sim)
            if interactive:
                return _show_window(sim, settings, shown)
            _check_time_left(sim, settings, arguments)
            with _prefix_errors(arguments.scene):
                check_length(settings.seconds, sim.dt, settings.fps)
            return _run(sim, settings, arguments, signals, warned, has_window, every, saved, shown)


@contextmanager
def _prefix_errors(scene: str) -> Iterator[None]:
    """Prefix errors raised in the context with the scene's name."""
    try:
        yield
    except (SceneError, SimulationError) as error:
        raise type(error)(f"{scene}: {error}") from error


def _checkpoint_interval(arguments: Namespace) -> float | None:
    """Return the value of --checkpoint-every [s], or None. Raises SceneError."""
    every = arguments.checkpoint_every
    if every is None:
        return None
    if arguments.out is None:
        raise SceneError("--checkpoint-every needs --out, the folder to write to")
    return checks.number(every, "--checkpoint-every", above=0.0, unit="s")


def _resumed(saved: Checkpoint, scene: Scene, settings: RunSettings) -> Simulator:
    """Return the resumed simulator, with another dt if requested."""
    sim = Simulator.from_checkpoint(saved, scene, arch=settings.simulator["arch"])
    if "dt" in settings.changed:
        try:
            sim.dt = settings.simulator["dt"]
        except BaseException:
            sim.close()
            raise
    print(f"resumed  from {saved.path}, t = {sim.time:.6g} s")
    return sim


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
    from taisoft.view.window import show

    show(sim, fps=settings.fps or 1.0 / sim.dt, colour=shown.colour, layers=shown.in_window, plots=shown.plots)
    print_state(sim)
    return 0


def _run(
    sim: Simulator,
    settings: RunSettings,
    arguments: Namespace,
    signals: Signals,
    warned: list[str],
    has_window: bool,
    every: float | None,
    saved: Checkpoint | None,
    shown: DisplayOptions,
) -> int:
    """Run until settings.seconds; save what was computed, however the run ends."""
    observers, resumed, notes = Observers(), None, {}
    plots = Plots(sim, shown.plots) if shown.plots or has_window else None
    if saved is not None:
        notes = saved.notes
        resumed = {"checkpoint": str(saved.path), "time": sim.time, "frame": first_frame(sim, settings.fps)}
    with ExitStack() as stack:
        recording = None
        signals.run_began()
        if arguments.out is not None:
            recording = stack.enter_context(closing(Recording(arguments.out, arguments.overwrite, resumed, every, notes)))
        stack.callback(observers.close)
        if has_window:
            observers.members.append(_open_window(sim, shown, plots))
        if recording is not None:
            recording.add_writers(observers, sim, settings.fps, not arguments.no_usd, not arguments.no_frames, shown, plots)
        observers.members.append(Progress(settings.seconds, label=Path(arguments.scene).stem))
        result = sim.run(
            settings.seconds,
            on_frame=observers.on_frame,
            fps=settings.fps,
            stop=lambda: signals.requested() or observers.failed(),
            resumed=resumed is not None,
            on_step=plots.take if plots is not None else None,
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
            reported = observers.guard(recording.report, result, sim, settings)
            video = arguments.video and not signals.requested()
            video_written = not video or observers.guard(recording.video, settings.fps or 1.0 / sim.dt)
            _report_failed_output(result, observers, signals)
            if reported and not video_written:
                observers.guard(recording.report, result, sim, settings)  # again, with the video's errors
        print_summary(result, sim, observers, recording)
    if observers.failed():
        for error in observers.errors:
            print(f"taisoft: {error}", file=sys.stderr)
        return EXIT_OUTPUT
    if signals.number is not None:
        return EXIT_SIGNAL + signals.number
    return EXIT_FAILED if result.status == "failed" else 0


def _open_window(sim: Simulator, shown: DisplayOptions, plots: Plots):
    from taisoft.view.window import LiveWindow

    return LiveWindow(sim.scene, plots, colour=shown.colour, layers=shown.in_window)


def _report_failed_output(result: RunReport, observers: Observers, signals: Signals) -> None:
    """Add all output errors to the run's report: report.json may still fit on the disk when a picture did not."""
    result.problems += [error for error in observers.errors if error not in result.problems]
    if observers.failed():
        result.interrupted = result.interrupted and signals.requested()
    if observers.failed() and result.status == "ok":
        result.status = "degraded"
