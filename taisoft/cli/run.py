"""`taisoft run SCENE`: load, check, build, run, save, tell."""

import os
import sys
import warnings
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from taisoft.cli import EXIT_FAILED, EXIT_OUTPUT, EXIT_SIGNAL
from taisoft.cli.recording import Observers, Recording
from taisoft.cli.scene_file import load_scene
from taisoft.cli.settings import RunSettings, resolve
from taisoft.cli.signals import Signals
from taisoft.cli.summary import print_plan, print_state, print_summary
from taisoft.errors import SceneError
from taisoft.output.files import check_free
from taisoft.output.progress import Progress
from taisoft.records import RunReport
from taisoft.simulator import Simulator
from taisoft.view.ggui import display_missing, vulkan_missing


def command(arguments: Namespace) -> int:
    """Runs the scene and returns the exit status. What can be refused is refused before a file is written."""
    _check_working_folder()
    with Signals() as signals, _told_warnings() as told:
        if arguments.resume is not None:
            raise SceneError(f"--resume {arguments.resume}: this version writes and reads no checkpoints")
        scene, solver = load_scene(arguments.scene)
        settings = resolve(solver, arguments, Simulator)
        if arguments.out is not None:
            check_free(arguments.out, arguments.overwrite)
        has_window = not arguments.headless and _window_is_possible()
        watched = has_window and arguments.out is None and arguments.seconds is None
        pull = {"pullable": True} if watched else {}  # by the mouse
        with Simulator(scene, **settings.simulator | pull) as sim:
            print_plan(sim)
            if watched:
                return _watch(sim, settings, arguments.colour)
            return _run(sim, settings, arguments, signals, told, has_window)


def _check_working_folder() -> None:
    """Raises SceneError if the working folder is gone: Taichi asks for it when it starts."""
    try:
        os.getcwd()
    except OSError as error:
        raise SceneError(f"the working folder cannot be used ({error.strerror}): change to another one") from None


def _window_is_possible() -> bool:
    """Whether the live window can be opened; says why where it cannot, since opening it would end the process."""
    missing = display_missing() or vulkan_missing()
    if missing:
        print(f"taisoft: running without a window: {missing}", file=sys.stderr)
    return not missing


def _watch(sim: Simulator, settings: RunSettings, colour: str) -> int:
    """The live window, for as long as it stays open."""
    from taisoft.view.window import show

    show(sim, fps=settings.fps or 1.0 / sim.dt, colour=colour)
    print_state(sim)
    return 0


def _run(
    sim: Simulator, settings: RunSettings, arguments: Namespace, signals: Signals, told: list[str], has_window: bool
) -> int:
    """A run of settings.seconds, with what was computed saved however it ends."""
    observers = Observers()
    with ExitStack() as stack:
        recording = None
        signals.run_began()
        if arguments.out is not None:
            recording = stack.enter_context(closing(Recording(arguments.out, arguments.overwrite)))
        stack.callback(observers.close)
        if has_window:
            observers.members.append(_open_window(sim, arguments.colour))
        if recording is not None:
            recording.add_writers(observers, sim, settings.fps, not arguments.no_usd, not arguments.no_frames, arguments.colour)
        observers.members.append(Progress(settings.seconds, label=Path(arguments.scene).stem))
        result = sim.run(
            settings.seconds,
            on_frame=observers.on_frame,
            fps=settings.fps,
            stop=lambda: signals.asked() or observers.failed(),
        )
        observers.close()
        result.problems[:0] = [f"warning: {text}" for text in told]
        if observers.error is not None:
            _tell_failed_output(result, observers, signals)
        if recording is not None:
            observers.guard(recording.report, result, sim, settings)
        print_summary(result, sim, observers, recording)
    if observers.error is not None:
        print(f"taisoft: {observers.error}", file=sys.stderr)
        return EXIT_OUTPUT
    if signals.number is not None:
        return EXIT_SIGNAL + signals.number
    return EXIT_FAILED if result.status == "failed" else 0


def _open_window(sim: Simulator, colour: str):
    from taisoft.view.window import LiveWindow

    return LiveWindow(sim.scene, colour=colour)


def _tell_failed_output(result: RunReport, observers: Observers, signals: Signals) -> None:
    """The run's report tells of the output that failed: report.json may still fit where a picture did not."""
    result.problems.append(str(observers.error))
    result.interrupted = signals.asked()
    if result.status == "ok":
        result.status = "degraded"


@contextmanager
def _told_warnings() -> Iterator[list[str]]:
    """Prints each warning as one sentence, and yields the list of them, which the report repeats."""
    told: list[str] = []

    def tell(message, category, filename, lineno, file=None, line=None) -> None:
        is_ours = category is UserWarning
        text = str(message) if is_ours else f"{filename}, line {lineno}: {category.__name__}: {message}"
        told.append(text)
        print(f"taisoft: warning: {text}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = tell
        yield told
