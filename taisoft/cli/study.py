"""`taisoft study SCENE`: runs a scene over a grid of settings, speed against error.

`python -m taisoft.cli.study` is the child process that plans, or executes one run. The command itself loads no Taichi.
"""

import os
import sys
import time
from argparse import Namespace
from contextlib import ExitStack, closing
from dataclasses import fields
from pathlib import Path

from taisoft.cli import EXIT_FAILED, EXIT_SIGNAL, Interrupted, Signals, parse_scalar
from taisoft.cli.scene_file import check_scene_solver, find_scene, load_scene
from taisoft.errors import SceneError, TaisoftError, reworded
from taisoft.machine import machine, usable_cores
from taisoft.many.cluster import cluster_places, connect
from taisoft.many.places import LocalPlace
from taisoft.many.store import Store, code_digest, digests, sources
from taisoft.output.folder import FolderLock, check_free, make_folder
from taisoft.processes import serve
from taisoft.scene import checks
from taisoft.scene.checks import check_solver
from taisoft.study import AXES, Request, mesh_name
from taisoft.study.pages import FILES, check_scene, write
from taisoft.study.results import Study, text_of
from taisoft.study.runner import CHILD, Runner

INTEGER_AXES = {"order": (1, 2), "refine": (0, 1, 2, 3, 4)}
ENDING = "ending; runs that are finished are kept"


def study(arguments: Namespace) -> int:
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
        return report_study(runner.run(plan), arguments, signals)


def report_study(results: Study, arguments: Namespace, signals: Signals) -> int:
    """Print and write the results; return the exit status."""
    print(text_of(results), end="")
    if arguments.out is not None:
        if note := write(results, Path(arguments.out)):
            _print_status(note)
        files = [name for name in FILES if (Path(arguments.out) / name).exists()]
        print(f"\nwritten to {arguments.out}: {', '.join(files)}, runs/")
    if signals.number is not None and results.ended:  # a signal while the table is written leaves a complete study
        return EXIT_SIGNAL + signals.number
    return 0 if results.comparable_rows() else EXIT_FAILED


def check_device(plan: dict, workers: int) -> None:
    """Raise SceneError if several processes of this machine would be timed on one device."""
    if workers > 1 and any(case["setting"]["arch"] == "cuda" for case in plan["cases"] if not case["refused"]):
        raise SceneError("--workers above 1 cannot be used with arch cuda: timed runs would share the device")


def _places(arguments: Namespace, request: Request, stack: ExitStack) -> tuple[list, list[dict]]:
    """Return the places that execute runs, and their machines."""
    if arguments.scheduler is None:
        return local_places(1 if arguments.workers is None else arguments.workers), [machine(named=True)]
    if arguments.workers is not None:
        raise SceneError("--workers sets this machine's processes, and --scheduler has its own workers: give one of them")
    client = stack.enter_context(closing(connect(arguments.scheduler, "--scheduler")))
    request.scene = str(Path(request.scene).absolute()) if request.scene.endswith((".py", ".toml")) else request.scene
    return cluster_places(client, CHILD)


def local_places(number: int) -> list[LocalPlace]:
    """Return places that divide this process's cores evenly. Raises SceneError if there are fewer cores than places."""
    cores = usable_cores()
    if not 1 <= number <= len(cores):
        raise SceneError(f"--workers {number}: it must be between 1 and {len(cores)}, the number of cores: timed runs share none")
    if number > 1 and not hasattr(os, "sched_setaffinity"):
        raise SceneError(f"--workers {number}: this system cannot pin processes to cores, so timed runs could share one")
    each = len(cores) // number
    return [LocalPlace(cores[k * each : (k + 1) * each], CHILD) for k in range(number)]


def parse_request(arguments: Namespace) -> Request:
    """Return the request given by the options. Raises SceneError for invalid values."""
    axes = {key: values_of(key, text) for key in AXES if (text := getattr(arguments, key)) is not None}
    for key in ("seconds", "reference_dt", "tolerance"):
        if (value := getattr(arguments, key)) is not None:
            checks.number(value, f"--{key.replace('_', '-')}", above=0.0)
    checks.whole(arguments.repeats, "--repeats", tuple(range(1, 101)))
    checks.whole(arguments.reference_refine, "--reference-refine", INTEGER_AXES["refine"])
    return Request(axes=axes, **{f.name: getattr(arguments, f.name) for f in fields(Request) if f.name != "axes"})


def values_of(key: str, text: str) -> list:
    """Return the distinct values of an axis from a comma-separated list; `none` is adaptive."""
    option = f"--{key.replace('_', '-')}"
    values = [parse_scalar(part.strip(), part, option) for part in text.split(",")]
    for k, value in enumerate(values):
        if key in INTEGER_AXES:
            checks.whole(value, option, INTEGER_AXES[key])
        else:
            with reworded(SceneError, f"{option} {text}: "):
                check_solver(**{key: value})
        if value in values[:k]:
            raise SceneError(f"{option} {text}: {value} is given twice")
    return [float(value) if key == "dt" else value for value in values]


def _print_status(text: str) -> None:
    print(f"taisoft: {text}", file=sys.stderr, flush=True)


def answer(request: dict) -> dict:
    """Answer {"action": "plan" or "run", ...} in the child process: {"answer": plan or record} or {"error": sentence}."""
    from taisoft.scene.fingerprint import scene_digest
    from taisoft.study.measure import measure
    from taisoft.study.tasks import Planner

    scenes: dict[str, str] = {}  # digest of each variant that was loaded
    name, allow_outside = request["scene"], request["allow_outside"]

    def variant(refine, order):
        scene = load_scene(name, allow_outside, refine, order)[0]
        scenes[mesh_name({"refine": refine, "order": order})] = scene_digest(scene)
        return scene

    try:
        if request["action"] == "plan":
            _, solver = load_scene(name, allow_outside, refine=0)
            check_scene_solver(solver)
            plan = Planner(variant, solver, request["request"]).plan()
            # include the files' content: nothing else distinguishes paths that are functions
            return {"answer": plan | {"scenes": scenes, "sources": sources(find_scene(name)), "code": code_digest()}}
        if code_digest() != request["code"]:
            return {"error": "taisoft, Taichi or NumPy there differs from the one that planned the study"}
        task = request["task"]
        scene = variant(task["setting"]["refine"], task["setting"]["order"])
        found = digests(find_scene(name).parent, request["sources"])
        if scenes != {mesh_name(task["setting"]): request["digest"]} or found != request["sources"]:
            return {"error": "the scene there differs from the planned one: it was changed meanwhile, or is another file"}
        return {"answer": measure(scene, task)}
    except TaisoftError as error:
        return {"error": str(error)}


if __name__ == "__main__":
    serve(answer)
