"""First look at a GPU: tests, sizes, repeatability, works and solvers on one page, in under eight minutes.

taisoft bench cuda_check [--arch cuda|cpu] [--budget SECONDS] [--quick] [--part NAME] [--out DIR]

Each part runs in its own process with a time limit and prints every number at once, so that results before a failure remain on
the page; the next part starts in any case. DIR/cuda-check.md and .json are rewritten after every part. Parts: tests marked
`cuda`; steps of one and four million tets, and with contacts; differences between reruns; the works W1 to W4 on GPU and CPU;
coloured against serial Gauss-Seidel. Compilation is timed separately. Exit status: 0, or 1 if a part failed or did not end.
benchmarks/cuda_check.sh installs the requirements from wheels first.
"""

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from taisoft.files import write_bytes
from taisoft.machine import usable_cores
from taisoft.output.folder import make_folder
from taisoft.output.report import json_text
from taisoft.processes import start_python

from .cuda_parts import JOBS, run_job
from .document import header, table
from .runner import RESULT, make_parser, parse_result

ROOT = Path(__file__).resolve().parent.parent
BUDGET = 470.0  # seconds for all parts: ten less than eight minutes
LAST_LINES = 15  # of a failed process's output
TESTS, RESULTS = "tests/backend/test_arch.py", "PASSED|FAILED|ERROR|SKIPPED|XFAIL"


@dataclass(frozen=True)
class Part:
    """A part of the page. command: arguments of Python; seconds: time limit; unused time of earlier parts is added."""

    name: str
    title: str
    command: tuple[str, ...]
    seconds: float


@dataclass
class Outcome:
    """Result of a part's process. ended: "ok", "failed" or "out of time"; found: results in order; tail: last lines of output."""

    part: Part
    ended: str = ""
    seconds: float = 0.0
    found: list[dict] = field(default_factory=list)
    tail: str = ""


def make_parts(arch: str, quick: bool) -> list[Part]:
    """All parts, the most important first."""
    child = ("-m", "taisoft", "bench", "cuda_check", "--arch", arch, *(("--quick",) if quick else ()), "--job")
    side_by_side = ("-n", str(min(8, len(usable_cores())))) if find_spec("xdist") else ()  # most of their time is compilation
    pytest = ("-m", "pytest", "-v", "--tb=short", "-p", "no:cacheprovider", *side_by_side, "-m", "cuda", TESTS)
    return [
        Part("tests", "Tests marked cuda", pytest, 150.0),
        *(Part(name, title, (*child, name), seconds) for name, (title, seconds, _) in JOBS.items()),
    ]


def run_part(part: Part, limit: float) -> Outcome:
    """Run a part for at most `limit` seconds, then kill its process group."""
    outcome, start = Outcome(part), time.monotonic()
    environment = {"PYTHONUNBUFFERED": "1", "TI_ADVANCED_OPTIMIZATION": "1"}  # tests: not else
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "errors": "replace"}
    process = start_python(*part.command, environment=environment, cwd=ROOT, **output)
    try:
        printed, _ = process.communicate(timeout=limit)
        outcome.ended = "ok" if process.returncode == 0 else "failed"
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        printed, _ = process.communicate()
        outcome.ended = "out of time"
    outcome.seconds = time.monotonic() - start
    lines = printed.splitlines()
    outcome.found = [found for line in lines if (found := parse_result(line)) is not None]
    if part.name == "tests":
        outcome.found = [found for line in lines if (found := parse_test(line)) is not None]
    if outcome.ended != "ok":
        rest = [line for line in lines if not line.startswith(RESULT)]
        status = f" with status {process.returncode}" if outcome.ended == "failed" else f" after {limit:.0f} s"
        outcome.tail = "\n".join([f"{outcome.ended}{status}", *rest[-LAST_LINES:]])
    return outcome


def parse_test(line: str) -> dict | None:
    """The test and its result in a line of `pytest -v`, with or without xdist, None in any other line."""
    match = re.match(rf"\S+?::(?P<test>.+) (?P<result>{RESULTS})\b", line)
    match = match or re.match(rf"\[gw\d+\] \[ *\d+%\] (?P<result>{RESULTS}) \S+?::(?P<test>.+?) *$", line)
    return {"test": match["test"], "result": match["result"].lower()} if match else None


def gpu_name() -> str:
    """Name, memory and driver of the GPU as nvidia-smi prints them; "no nvidia-smi" without it."""
    if shutil.which("nvidia-smi") is None:
        return "no nvidia-smi"
    query = ("nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader")
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=20, check=False)
    except subprocess.TimeoutExpired:
        return "nvidia-smi does not answer"
    return "; ".join((done.stdout or done.stderr).strip().splitlines()[:4])


# --- tables, one a part -------------------------------------------------------------------------------------------------


def part_text(o: Outcome) -> str:
    """Section of a part, with the last output of a failed process."""
    body = TABLES[o.part.name](o.found) if o.found else "It found nothing."
    head = f"## {o.part.title}\n\nEnded: {o.ended}, {o.seconds:.0f} s."
    return "\n\n".join([head, body, *([f"```\n{o.tail}\n```"] if o.tail else [])])


def tests_text(found: list[dict]) -> str:
    """Counts of test results, and the tests that did not pass."""
    counts = Counter(one["result"] for one in found)
    bad = [f"* {one['test']}: {one['result']}" for one in found if one["result"] != "passed"]
    return "\n".join([", ".join(f"{n} {what}" for what, n in sorted(counts.items())) + ".", *(["", *bad] if bad else [])])


def cell(name: str, form: str = "", scale: float = 1.0):
    """A cell function for a number of a result; empty if it is missing."""
    return lambda one: "" if one.get(name) is None else f"{one[name] * scale if scale != 1.0 else one[name]:{form}}"


def or_failure(fill: Callable[[dict], str]):
    """A cell function that shows a failure in place of the number."""
    return lambda one: one["failure"] if "failure" in one else fill(one)


def error_of(one: dict) -> str:
    """Error of a work, or whether it stands."""
    if "failure" in one:
        return ""
    return f"{100 * one['error']:.2g} %" if one["error"] is not None else "stands" if one["stands"] else "does not stand"


COLUMNS: dict[str, tuple] = {
    "works": (
        ("<work", cell("work")),
        ("tets", cell("tets", ",")),
        ("<setting", cell("setting")),
        ("<arch", cell("arch")),
        ("s/sim. s", or_failure(cell("seconds", ".3g"))),
        ("error", error_of),
        ("inverted", cell("inverted")),
        ("unconverged", cell("unconverged")),
        ("build [s]", cell("build_seconds", ".3g")),
    ),
    "sweeps": (
        ("contacts", cell("contacts", ",")),
        ("colours", cell("colours")),
        ("serial [ms]", cell("serial_ms", ".3g")),
        ("coloured [ms]", cell("coloured_ms", ".3g")),
        ("serial / coloured", lambda one: f"{one['serial_ms'] / one['coloured_ms']:.3g}"),
        ("sweeps", cell("serial_sweeps")),
        ("coloured", cell("coloured_sweeps")),
        ("residual", lambda one: f"{max(one['serial_residual'], one['coloured_residual']):.1e}"),
    ),
    "sizes": (
        ("tets", cell("tets", ",")),
        ("<integrator", cell("integrator")),
        ("<arch", cell("arch")),
        ("step [ms]", or_failure(cell("step_ms", ".3g"))),
        ("ns/tet", lambda one: "" if "failure" in one else f"{1e6 * one['step_ms'] / one['tets']:.3g}"),
        ("Newton/CG", lambda one: "" if "failure" in one else f"{one['newton']}/{one['linear']}"),
        ("unconverged", cell("unconverged")),
        ("fields [MiB]", cell("field_bytes", ".0f", 2.0**-20)),
        ("build [s]", cell("build_seconds", ".3g")),
        ("compile [s]", cell("compile_seconds", ".3g")),
    ),
    "reruns": (
        ("<scene", cell("scene")),
        ("<integrator", cell("integrator")),
        ("runs", cell("reruns")),
        ("largest difference / excursion", cell("spread", ".1e")),
    ),
}
TABLES = {"tests": tests_text} | {name: partial(table, columns=columns) for name, columns in COLUMNS.items()}


# --- the whole ----------------------------------------------------------------------------------------------------------


def write_page(folder: Path, head: str, numbers: dict, outcomes: list[Outcome], waiting: list[Part]) -> None:
    """Write the page and the numbers known so far."""
    parts = [head, *map(part_text, outcomes)]
    if waiting:
        parts.append("Not yet run: " + ", ".join(part.name for part in waiting) + ".")
    write_bytes(folder / "cuda-check.md", ("\n\n".join(parts) + "\n").encode())
    parts = [asdict(o) | {"part": o.part.name, "title": o.part.title} for o in outcomes]
    write_bytes(folder / "cuda-check.json", json_text(numbers | {"parts": parts}).encode())


def check(parts: list[Part], budget: float, folder: Path, arch: str, quick: bool = False) -> list[Outcome]:
    """Run the parts within `budget` seconds, writing the page after each. Raises OutputError."""
    gpu = gpu_name()
    text, numbers = header("GPU check", f"arch {arch}", gpu, packages=("taichi", "numpy", "scipy", "meshio"))
    numbers |= {"arch": arch, "quick": quick, "gpu": gpu}
    end, outcomes = time.monotonic() + budget, []
    for k, part in enumerate(parts):
        later = sum(other.seconds for other in parts[k + 1 :])
        limit = max(end - time.monotonic() - later, min(part.seconds, end - time.monotonic()))
        if limit < 1.0:
            outcomes.append(Outcome(part, "out of time", tail="no time was left to start it"))
        else:
            print(f"{part.name}: at most {limit:.0f} s", file=sys.stderr, flush=True)
            outcomes.append(run_part(part, limit))
        print(f"{part.name}: {outcomes[-1].ended}, {outcomes[-1].seconds:.0f} s", file=sys.stderr, flush=True)
        write_page(folder, text, numbers, outcomes, parts[k + 1 :])
    return outcomes


def main(argv=None) -> int:
    """Check and write the page. Raises OutputError."""
    parser = make_parser("cuda_check", __doc__)
    parser.add_argument("--arch", choices=("cuda", "cpu"), default="cuda", help="cpu tests this benchmark itself")
    parser.add_argument("--budget", type=float, default=BUDGET, metavar="SECONDS", help=f"for all parts (default {BUDGET:.0f})")
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--part", action="append", choices=["tests", *JOBS], help="only this part; may be repeated")
    parser.add_argument("--out", type=Path, default=Path("out/cuda_check"), metavar="DIR", help="default out/cuda_check")
    parser.add_argument("--job", choices=JOBS, help=argparse.SUPPRESS)  # how this command runs one part
    options = parser.parse_args(argv)
    if options.job:
        run_job(options.job, options.arch, options.quick)
        return 0
    parts = [part for part in make_parts(options.arch, options.quick) if options.part is None or part.name in options.part]
    outcomes = check(parts, options.budget, make_folder(options.out), options.arch, options.quick)
    print((options.out / "cuda-check.md").read_text())
    return 0 if all(outcome.ended == "ok" for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
