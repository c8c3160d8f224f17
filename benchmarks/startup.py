"""Start-up: how long a user waits before the first steps, with and without compiled kernels at hand.

taisoft bench startup [--quick] [--baseline FOLDER] [--out FILE.json]

A beam of 540 tets in explicit steps, and a cube of 320 tets on a block in implicit steps with contacts, each to its tenth step:
cold (a new process, an empty cache of kernels), warm (a new process, the same cache), and warm with another mesh size. In one
process: the first simulator, a second one of the same structure, and one of another size. Also three static solves of the beam,
nine that find Young's modulus from a sag, what changes of an open simulator cost, and the memory that twenty simulators leave
behind. Times are wall and CPU seconds, those of a whole process with Python's start; a warm one is the median over rounds.
--baseline: another version's folder, measured in the same run with its own cache; the limits compare with it, those of how fast
kernels are (a beam of 34,560 tets) by the median over rounds that alternate. Exit status: 0, or 1 where a limit is not met or a
process failed.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import taisoft
from taisoft.errors import SimulationError
from taisoft.output.tables import markdown
from taisoft.timing import load_average

from .document import Document, check_out, header
from .elasticity_table import Limit, limit_table

CHILD = Path(__file__).with_name("startup_child.py")
SIZES = {"beam": (3, 6), "cube": (4, 6)}  # cells, and those of another size
ROUNDS, TIMES = 3, 20
SPEED_CELLS, SPEED_ROUNDS = 12, 5
SLOWER = {"symplectic_euler step": 1.2, "implicit_euler step": 1.25, "energies": 1.15}  # than the baseline, at most
HERE = Path(taisoft.__file__).resolve().parents[1]


class Version:
    """A version of taisoft, run in processes of its own with a cache of kernels of its own."""

    def __init__(self, folder: Path, cache: Path):
        self.folder, self.cache = folder, cache

    def run(self, *task: str | int) -> tuple[dict, dict]:
        """What a child found, and wall and CPU seconds of its process. Raises SimulationError where it failed."""
        paths = {"PYTHONPATH": str(self.folder), "XDG_CACHE_HOME": str(self.cache)}
        used, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = subprocess.run(
            [sys.executable, str(CHILD), *map(str, task)], env=os.environ | paths, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        wall, now = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
            raise SimulationError(f"{self.folder}: task {' '.join(map(str, task))} ended with status {done.returncode}: {last}")
        cpu = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
        return json.loads(done.stdout.splitlines()[-1]), {"wall": wall, "cpu": cpu}

    def files(self) -> set[Path]:
        """What lies in the cache."""
        return {path for path in self.cache.rglob("*.tic*") if path.is_file()}


def measure(version: Version, quick: bool) -> dict:
    """All figures of a version."""
    found: dict = {}
    for name, (cells, other) in SIZES.items():
        print(f"{version.folder.name}: {name}", file=sys.stderr, flush=True)
        found[name] = own = {"cold": version.run("first", name, cells)[1]}
        own["warm"] = median([version.run("first", name, cells)[1] for _ in range(1 if quick else ROUNDS)])
        before = version.files()
        own["warm, other size"] = median([version.run("first", name, other)[1]])
        own["new files"] = len(version.files() - before)
        own["one process"] = version.run("again", name, cells, other)[0]
        own["memory"] = version.run("grow", name, cells, 2 if quick else TIMES)[0]
    print(f"{version.folder.name}: statics", file=sys.stderr, flush=True)
    found["statics"] = version.run("statics", 3)[0]
    found["identify"] = version.run("identify", 3)[0]
    found["settings"] = version.run("settings", 4)[0]
    return found


def measure_speed(versions: list[Version], quick: bool) -> list[dict[str, list[float]]]:
    """Of each version, times [s] by round: the versions take turns, since the machine's speed changes."""
    found: list[dict[str, list[float]]] = [{what: [] for what in SLOWER} for _ in versions]
    for _ in range(1 if quick else SPEED_ROUNDS):
        for version, times in zip(versions, found):
            for what, seconds in version.run("speed", 2 if quick else SPEED_CELLS)[0].items():
                times[what].append(seconds)
    return found


def median(times: list[dict]) -> dict:
    """Of wall and CPU seconds, with the range of the first."""
    middle = {key: float(np.median([one[key] for one in times])) for key in ("wall", "cpu")}
    return middle | {"range": [min(one["wall"] for one in times), max(one["wall"] for one in times)]}


def table(found: dict[str, dict]) -> str:
    """A row for each thing a user waits for, two columns for each version."""
    rows = []
    for name in SIZES:
        for what in ("cold", "warm", "warm, other size"):
            rows.append((f"{name}, {what}", *[cell(one[name][what]) for one in found.values()]))
        for what in ("first", "second", "other size"):
            rows.append((f"{name}, {what} in one process", *[cell(one[name]["one process"][what]) for one in found.values()]))
    for k, what in enumerate(("first", "second", "third")):
        rows.append((f"static solve, {what}", *[cell(one["statics"][str(k)]) for one in found.values()]))
    rows.append(("nine static solves", *[cell(one["identify"]) for one in found.values()]))
    return markdown(("wall (CPU) [s]", *found), rows, left=(0,))


def cell(times: dict) -> str:
    """Wall and CPU seconds."""
    return f"{times['wall']:.3g} ({times['cpu']:.3g})"


def settings_table(found: dict[str, dict]) -> str:
    """What changes of an open simulator cost."""
    versions = list(found.values())
    rows = [(what, *[f"{1e3 * one['settings'][what]:.2f}" for one in versions]) for what in versions[0]["settings"]]
    return markdown(("cube with contacts, wall [ms]", *found), rows, left=(0,))


def speed_table(found: dict[str, dict]) -> str:
    """How fast kernels are, with the range over rounds."""
    rows = []
    for what in SLOWER:
        cells = []
        for one in found.values():
            times = 1e3 * np.array(one["speed"][what])
            cells.append(f"{np.median(times):.3g} ({times.min():.3g} to {times.max():.3g})")
        rows.append((what, *cells))
    return markdown(("beam, wall [ms]", *found), rows, left=(0,))


def count_table(found: dict[str, dict]) -> str:
    """Kernels compiled, files in the cache, memory."""
    rows = []
    for name in SIZES:
        for what in ("first", "second", "other size"):
            counts = [one[name]["one process"][what]["compiled"] for one in found.values()]
            rows.append((f"{name}: kernels compiled, {what}", *["unknown" if n is None else str(n) for n in counts]))
        rows.append((f"{name}: new files, warm, other size", *[str(one[name]["new files"]) for one in found.values()]))
        growths = [one[name]["memory"]["end"] - one[name]["memory"]["start"] for one in found.values()]
        rows.append((f"{name}: growth of memory over {TIMES} simulators [MB]", *[f"{growth:.1f}" for growth in growths]))
    return markdown(("count", *found), rows, left=(0,))


def find_limits(now: dict, old: dict | None) -> list[Limit]:
    """What start-up must keep."""
    limits = [Limit("cube: cold, from process start to the tenth step [s]", now["cube"]["cold"]["wall"], 15.0)]
    for name in SIZES:
        one = now[name]["one process"]
        for what in ("second", "other size"):
            limits.append(Limit(f"{name}: kernels compiled, {what}", one[what]["compiled"], 0))
        limits.append(Limit(f"{name}: new files in the cache, other size", now[name]["new files"], 0))
        memory = now[name]["memory"]
        limits.append(Limit(f"{name}: growth of memory over {TIMES} simulators [MB]", memory["end"] - memory["start"], 10.0))
        if old:
            ratio = one["second"]["wall"] / old[name]["one process"]["second"]["wall"]
            limits.append(Limit(f"{name}: second simulator over the baseline's", ratio, 0.1))
            ratio = now[name]["warm, other size"]["wall"] / old[name]["warm, other size"]["wall"]
            limits.append(Limit(f"{name}: warm, other size, over the baseline's", ratio, 0.5))
    if old:
        ratio = now["statics"]["1"]["wall"] / old["statics"]["1"]["wall"]
        limits.append(Limit("second static solve over the baseline's", ratio, 0.15))
        limits.append(Limit("nine static solves over the baseline's", now["identify"]["wall"] / old["identify"]["wall"], 0.1))
        for what, most in SLOWER.items():
            ratios = np.array(now["speed"][what]) / np.array(old["speed"][what])
            limits.append(Limit(f"{what} over the baseline's", float(np.median(ratios)), most))
    return limits


def main(argv=None) -> int:
    """Measure and print. Raises SimulationError where a process fails, OutputError where a file cannot be written."""
    first, _, rest = __doc__.partition("\n")
    parser = argparse.ArgumentParser(prog="taisoft bench startup", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--quick", action="store_true", help="one round, two simulators for memory, no limit")
    parser.add_argument("--baseline", type=Path, metavar="FOLDER", help="another version of taisoft to compare with")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write FILE.json and FILE.md too")
    options = parser.parse_args(argv)
    check_out(options.out, ".json")
    document, (text, numbers) = Document(), header("Start-up", "arch cpu")
    document.add(text)
    with tempfile.TemporaryDirectory() as caches:
        folders = {label: folder for label, folder in (("baseline", options.baseline), ("this version", HERE)) if folder}
        versions = {label: Version(one.resolve(), Path(caches) / label.replace(" ", "_")) for label, one in folders.items()}
        found = {label: measure(version, options.quick) for label, version in versions.items()}
        for one, speed in zip(found.values(), measure_speed(list(versions.values()), options.quick)):
            one["speed"] = speed
    document.add("## Waiting\n\n" + table(found))
    document.add("## Counts\n\n" + count_table(found))
    document.add("## Changes\n\n" + settings_table(found))
    document.add("## Speed\n\n" + speed_table(found))
    limits = [] if options.quick else find_limits(found["this version"], found.get("baseline"))
    if limits:
        document.add("## Limits\n\n" + limit_table(limits))
    if options.out:
        numbers |= {"quick": options.quick, "load_at_the_end": load_average(), "limits": [limit.record() for limit in limits]}
        document.write(options.out, numbers | found)
    return 0 if all(limit.met for limit in limits) else 1


if __name__ == "__main__":
    sys.exit(main())
