"""Many runs: the same bits from any number of workers, in any order and after a kill, and how long they take.

taisoft bench many [--quick] [--rounds N] [--out [FILE.json]]

`ts.run_many` of 64 cubes that slide to rest and 200 rollouts of a soft leg with two tendons (`benchmarks/many_cases.py`), each
with one worker of one thread; with one worker for each core; the latter in another order; with a worker killed in the middle; and
with the whole process killed in the middle and the call repeated. SHA-256 of all results. Wall times include starting
the processes, whose kernels are cached, and are medians over --rounds (default 1). It takes about five minutes.
Exit status: 1 if any SHA-256 differs, or if two or more cores take more than 0.6 of the time of one worker.
"""

import argparse
import os
import signal
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.machine import THREADS, usable_cores
from taisoft.processes import start_python

from .document import Limit, begin, table
from .many_cases import rollout, slide
from .runner import make_parser, parse_options, patched, progress

PARTS = {
    "sliding cubes": (slide, [{"friction": mu, "speed": v} for mu in np.linspace(0.2, 0.9, 8) for v in np.linspace(0.6, 2.0, 8)]),
    "leg rollouts": (rollout, [{"seed": seed} for seed in range(200)]),
}
QUICK_RUNS = 6
RATIO = 0.6  # greatest wall time with all cores over that of one worker with one thread
CLEAN_SECONDS = 5.0  # in which processes must end after their caller was killed
CHILD = ("-m", "taisoft", "bench", "many", "--child")


def run(name: str, n: int, workers: int, shuffled: bool = False, out: Path | None = None) -> tuple[ts.Results, float]:
    """Results and wall seconds of the first n runs of a part."""
    make, parameters = PARTS[name]
    parameters = parameters[:n]
    if shuffled:
        parameters = [parameters[k] for k in np.random.default_rng(0).permutation(len(parameters))]
    start = time.perf_counter()
    results = ts.run_many(make, parameters, workers=workers, out=out, progress=False)
    seconds = time.perf_counter() - start
    if results.counts().keys() & {"failed", "left out"}:
        raise SimulationError(f"{name}: {results!r}")
    return results, seconds


def killed(name: str, n: int, workers: int, whole: bool, folder: Path) -> tuple[str, int]:
    """The digest after a kill in the middle, and how many rows were finished then. whole: of the caller, else of a worker."""
    process = start_python(*CHILD, name, str(n), str(workers), str(folder))
    try:
        while (done := len(list((folder / "runs").glob("*.json")))) < n // 2:
            if process.poll() is not None:
                raise SimulationError(f"{name}: the process ended with {done} rows")
            time.sleep(0.02)
        below = children(process.pid)
        if len(below) != workers:
            raise SimulationError(f"{name}: {len(below)} worker processes, not {workers}")
        os.kill(process.pid if whole else below[0], signal.SIGKILL)
        if not whole and process.wait():
            raise SimulationError(f"{name}: the process ended with status {process.returncode}")
        if whole:
            process.wait()
            end = time.monotonic() + CLEAN_SECONDS
            while any(Path(f"/proc/{pid}").exists() for pid in below):
                if time.monotonic() > end:
                    raise SimulationError(f"{name}: worker processes outlive their caller")
                time.sleep(0.02)
    finally:
        process.kill()
        process.wait()
    return run(name, n, workers, out=folder)[0].digest(), done


def children(pid: int) -> list[int]:
    """The child processes of a process."""
    found = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(word) for path in found for word in path.read_text().split()]


def measure(name: str, n: int, rounds: int) -> dict:
    """Digests by how the part was run, and wall seconds."""
    workers = len(usable_cores())
    run(name, 1, 1)  # compiles kernels, if need be
    found: dict = {"runs": n, "workers": workers, "one": [], "all": [], "digests": {}}
    ways = {"one worker": ("one", 1, False), "all cores": ("all", workers, False), "another order": ("all", workers, True)}
    for _ in range(rounds):
        for how, (where, number, shuffled) in ways.items():
            results, seconds = run(name, n, number, shuffled)
            progress(f"{name}, {how}: {seconds:.1f} s")
            found[where].append(seconds)
            if found["digests"].setdefault(how, results.digest()) != results.digest():
                found["digests"][f"{how}, again"] = results.digest()
    for how, whole in (("a worker killed", False), ("killed and called again", True)):
        with tempfile.TemporaryDirectory() as folder:
            digest, done = killed(name, n, workers, whole, Path(folder) / "out")
        progress(f"{name}, {how} after {done} runs")
        found["digests"][how] = digest
        found[how] = done
    return found


def wall_limits(parts: dict[str, dict], quick: bool) -> list[Limit]:
    """Limits on digests and on what workers gain."""
    limits = []
    for name, found in parts.items():
        limits.append(Limit(f"{name}: different SHA-256", len(set(found["digests"].values())), 1))
        if not quick and found["workers"] > 1:
            limits.append(Limit(f"{name}: wall time over that of one worker", ratio(found), RATIO))
    return limits


def ratio(found: dict) -> float:
    """Wall time with all cores over that of one worker."""
    return median(found["all"]) / median(found["one"])


def main(argv=None) -> int:
    """Measure and judge. Raises SimulationError if a run fails."""
    parser = make_parser("many", __doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_RUNS} runs of each, without a limit on the time")
    parser.add_argument("--rounds", type=int, default=1, metavar="N", help="times that each is timed (default 1)")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)  # what is killed: part, runs, workers, folder
    options = parse_options(parser, argv, arch=False)
    if options.child:
        name, n, workers, folder = options.child
        run(name, int(n), int(workers), out=Path(folder))
        return 0
    with patched(os, "environ", os.environ | {THREADS: "1"}):
        document, numbers = begin("Many runs", "one thread for each worker")
        parts = {n: measure(n, QUICK_RUNS if options.quick else len(PARTS[n][1]), max(1, options.rounds)) for n in PARTS}
    columns = (
        ("<runs of", "{[0]}"),
        ("number", "{[1][runs]}"),
        ("one worker [s]", lambda part: f"{median(part[1]['one']):.1f}"),
        ("all cores [s]", lambda part: f"{median(part[1]['all']):.1f}"),
        ("workers", "{[1][workers]}"),
        ("ratio", lambda part: f"{ratio(part[1]):.2f}"),
    )
    document.add("## Wall times\n\n" + table(parts.items(), columns))
    shas = [(name, how, sha) for name, found in parts.items() for how, sha in found["digests"].items()]
    document.add("## Results\n\n" + table(shas, (("<runs of", "{[0]}"), ("<how", "{[1]}"), ("<SHA-256 of all results", "{[2]}"))))
    return document.finish(options, numbers | {"parts": parts}, wall_limits(parts, options.quick))


if __name__ == "__main__":
    sys.exit(main())
