"""`taisoft study SCENE`: runs a scene over a grid of settings, speed against error."""

import sys
import time
from argparse import Namespace
from contextlib import ExitStack, closing
from pathlib import Path

from taisoft.cli import EXIT_FAILED, EXIT_SIGNAL
from taisoft.cli.scene_file import find_scene
from taisoft.cli.settings import parse_scalar
from taisoft.cli.signals import Interrupted, Signals
from taisoft.errors import SceneError
from taisoft.output.files import FolderLock, check_free, make_folder
from taisoft.output.report import machine
from taisoft.scene import checks
from taisoft.scene.checks import check_solver
from taisoft.study.grid import AXES
from taisoft.study.output import FILES, check_scene, write
from taisoft.study.results import Request, Study
from taisoft.study.runner import Runner
from taisoft.study.store import Store
from taisoft.study.table import text_of
from taisoft.study.workers import local_places

INTEGER_AXES = {"order": (1, 2), "refine": (0, 1, 2, 3, 4)}
ENDING = "ending; runs that are finished are kept"


def command(arguments: Namespace) -> int:
    """Run the study and return the exit status: 1 if no run of the grid has both a time and an error."""
    request = parse_request(arguments)
    find_scene(request.scene)
    budget = checks.number(arguments.budget, "--budget", above=0.0, unit="s")
    with Signals(ENDING if arguments.out is not None else "ending") as signals, ExitStack() as stack:
        places, machines = _places(arguments, request, stack)
        if arguments.out is not None:
            check_free(arguments.out, overwrite=False)
        signals.run_began()
        runner = Runner(request, places, machines, signals.requested, lambda: end - time.monotonic(), _print_status)
        plan = runner.plan()
        if plan is None:
            raise Interrupted(signals.number)
        if arguments.scheduler is None:
            check_device(plan, len(places))
        if arguments.out is not None:
            check_scene(Path(arguments.out), plan["scenes"]["refine 0"])
            folder = make_folder(arguments.out)
            stack.enter_context(closing(FolderLock(folder)))
            runner.store = Store(folder)
        end = time.monotonic() + budget
        return _report_study(runner.run(plan), arguments, signals)


def _report_study(study: Study, arguments: Namespace, signals: Signals) -> int:
    """Print and write the results; return the exit status."""
    print(text_of(study), end="")
    if arguments.out is not None:
        if note := write(study, Path(arguments.out)):
            _print_status(note)
        files = [name for name in FILES if (Path(arguments.out) / name).exists()]
        print(f"\nwritten to {arguments.out}: {', '.join(files)}, runs/")
    if signals.number is not None and study.ended:  # a signal while the table is written leaves a complete study
        return EXIT_SIGNAL + signals.number
    return 0 if study.comparable_rows() else EXIT_FAILED


def check_device(plan: dict, workers: int) -> None:
    """Raise SceneError if several processes of this machine would be timed on one device."""
    if workers > 1 and any(case["setting"]["arch"] == "cuda" for case in plan["cases"] if not case["refused"]):
        raise SceneError("--workers above 1 cannot be used with arch cuda: timed runs would share the device")


def _places(arguments: Namespace, request: Request, stack: ExitStack) -> tuple[list, list[dict]]:
    """Return the places that execute runs, and their machines."""
    if arguments.scheduler is None:
        return local_places(1 if arguments.workers is None else arguments.workers), [machine()]
    if arguments.workers is not None:
        raise SceneError("--workers sets this machine's processes, and --scheduler has its own workers: give one of them")
    from taisoft.study.cluster import cluster_places, connect

    client = stack.enter_context(closing(connect(arguments.scheduler)))
    request.scene = str(Path(request.scene).absolute()) if request.scene.endswith((".py", ".toml")) else request.scene
    return cluster_places(client)


def parse_request(arguments: Namespace) -> Request:
    """Return the request given by the options. Raises SceneError for invalid values."""
    axes = {}
    for key in AXES:
        if (text := getattr(arguments, key)) is not None:
            axes[key] = values_of(key, text)
    for key in ("seconds", "reference_dt", "tolerance"):
        if (value := getattr(arguments, key)) is not None:
            checks.number(value, f"--{key.replace('_', '-')}", above=0.0)
    checks.whole(arguments.repeats, "--repeats", tuple(range(1, 101)))
    checks.whole(arguments.reference_refine, "--reference-refine", INTEGER_AXES["refine"])
    return Request(
        arguments.scene,
        axes,
        arguments.allow_outside,
        arguments.seconds,
        arguments.reference_dt,
        arguments.reference_integrator,
        arguments.reference_refine,
        arguments.repeats,
        arguments.tolerance,
        arguments.by,
    )


def values_of(key: str, text: str) -> list:
    """Return the distinct values of an axis from a comma-separated list; `none` is adaptive."""
    option = f"--{key.replace('_', '-')}"
    values = [parse_scalar(part.strip(), part, option) for part in text.split(",")]
    for k, value in enumerate(values):
        if key in INTEGER_AXES:
            checks.whole(value, option, INTEGER_AXES[key])
        else:
            try:
                check_solver(**{key: value})
            except SceneError as error:
                raise SceneError(f"{option} {text}: {error}") from None
        if value in values[:k]:
            raise SceneError(f"{option} {text}: {value} is given twice")
    return [float(value) if key == "dt" else value for value in values]


def _print_status(text: str) -> None:
    print(f"taisoft: {text}", file=sys.stderr, flush=True)
