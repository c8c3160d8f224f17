"""Start-up: waiting time before the first steps, with and without cached kernels.

taisoft bench startup [--quick] [--baseline FOLDER] [--out FILE.json]

A beam of 540 tets in explicit steps, and cubes of 320 tets in implicit steps with contacts, one on a block, one on a half-space
("plane"), each to its tenth step: cold (a new process, an empty kernel cache), warm (a new process, the same cache), and warm
with a new size. In one process: the first simulator, a second one of the same structure, and one of another size. Also three
static solves of the beam, nine that find Young's modulus from a sag, what changes of an open simulator cost, the launches and
accesses by the host of a step, the kernels that sheets on a block compile from 224 to 2,144 surface triangles (from 1,500 on, the
search for contacts runs on all threads: other kernels), and the resident memory that twenty simulators leave behind, and four
closed ones of a cube of 53,240 tets to which something refers. Times are wall and CPU seconds of whole processes, including
Python's start; warm times are medians over rounds. --baseline: folder of another version, measured in turn with its own cache.
The limits compare with it; those of warm processes and of kernel speed (a beam of 34,560 tets, landing sheets) use the median of
the ratio over rounds. It then takes about eight minutes. Exit status: 0, or 1 if a limit is not met or a process failed.
"""

import json
import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np

from taisoft.output.tables import markdown

from .document import Limit, begin, check_out
from .runner import HERE, make_parser, progress, run_python

CHILD = Path(__file__).with_name("startup_child.py")
SIZES = {"beam": (3, 4, 5, 6), "cube": (4, 5, 6, 7), "plane": (4, 5, 6, 7)}  # cells, and those of another size in each round
TIMES = 20
OTHER = "warm, other size"
SLOWER = {  # maximum time over the baseline's
    "symplectic_euler step": 1.2,
    "implicit_euler step": 1.25,
    "energies": 1.15,
    "force differential": 1.15,
    "search, 704 triangles": 1.15,
    "search, 2,528 triangles": 1.15,
    "contact step, 704 triangles": 1.15,
    "contact step, 2,528 triangles": 1.15,
}
CROSSING = "1,964 triangles"  # the first sheet that is searched by all threads
SCENES, IN_ONE = tuple(SIZES), ("first", "second", "other size")
SPEED_CELLS, SPEED_SHEETS, SPEED_ROUNDS = 12, (12, 24), 5
# in processes of their own: task -> its arguments, and those of --quick
TASKS = {
    "statics": ((3,), (3,)),
    "identify": ((3,), (3,)),
    "settings": ((4,), (4,)),
    "calls": ((3, 4, 4), (1, 2, 2)),
    "surfaces": ((6, 7, 21, 22), (6, 7, 21, 22)),
    "keep": ((22, 4), (6, 2)),
}


@dataclass(frozen=True)
class Version:
    """A version of taisoft in a folder. cache: folder of its compiled kernels."""

    folder: Path
    cache: Path

    def run(self, program: Path, *task: str | int | Path) -> list[str]:
        """The output lines of a program. Raises SimulationError if it fails."""
        what = f"{self.folder}: task {' '.join(map(str, task))}"
        return run_python(what, program, *task, folder=self.folder, cache=self.cache)

    def files(self) -> set[Path]:
        """Files in the cache."""
        return {path for path in self.cache.rglob("*.tic*") if path.is_file()}


def run_child(version: Version, *task: str | int) -> tuple[dict, dict]:
    """The result of a child, and wall and CPU seconds of its process. Raises SimulationError on failure."""
    used, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    lines = version.run(CHILD, *task)
    wall, now = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    return json.loads(lines[-1]), {"wall": wall, "cpu": cpu}


def measure(versions: list[Version], quick: bool) -> list[dict]:
    """Measure everything for each version, with the versions in turn, since the machine's speed varies."""
    found: list[dict] = [{} for _ in versions]
    for name in SIZES:
        for own, waiting in zip(found, measure_waiting(versions, name, quick)):
            own[name] = waiting
    for what, task in TASKS.items():
        progress(what)
        for own, version in zip(found, versions):
            own[what] = run_child(version, what, *task[quick])[0]
    for own, speed in zip(found, measure_speed(versions, quick)):
        own["speed"] = speed
    return found


def measure_waiting(versions: list[Version], name: str, quick: bool) -> list[dict]:
    """For each version: times, new cache files and memory of processes that simulate one scene.

    Each round uses another mesh size, since a version that compiles for every size is warm at sizes used before.
    """
    cells, *others = SIZES[name]
    progress(f"{name}, cold")
    found = [
        {"cold": run_child(version, "first", name, cells)[1], "warm": [], OTHER: [], "new files": []} for version in versions
    ]
    for other in others[:1] if quick else others:
        progress(f"{name}, warm, then {other} cells")
        for own, version in zip(found, versions):
            own["warm"].append(run_child(version, "first", name, cells)[1])
        for own, version in zip(found, versions):
            before = version.files()
            own[OTHER].append(run_child(version, "first", name, other)[1])
            own["new files"].append(len(version.files() - before))
    progress(f"{name}, one process")
    for own, version in zip(found, versions):
        own |= {what: median(own[what]) for what in ("warm", OTHER)}
        own["one process"] = run_child(version, "again", name, cells, others[0])[0]
        own["memory"] = run_child(version, "grow", name, cells, 2 if quick else TIMES)[0]
    return found


def measure_speed(versions: list[Version], quick: bool) -> list[dict[str, list[float]]]:
    """Kernel times [s] of each version by round."""
    found: list[dict[str, list[float]]] = [{what: [] for what in SLOWER} for _ in versions]
    for k in range(1 if quick else SPEED_ROUNDS):
        progress(f"speed, round {k + 1}")
        for version, times in zip(versions, found):
            for what, seconds in run_child(version, "speed", 2 if quick else SPEED_CELLS, *SPEED_SHEETS)[0].items():
                times[what].append(seconds)
    return found


def median(times: list[dict]) -> dict:
    """Medians of wall and CPU seconds, and the wall seconds of each round."""
    middle = {key: float(np.median([one[key] for one in times])) for key in ("wall", "cpu")}
    return middle | {"walls": [one["wall"] for one in times]}


# --- tables and limits --------------------------------------------------------------------------------------------------


def waiting_table(found: dict[str, dict]) -> str:
    """Waiting times: a row per task, a column per version."""

    def row(label: str, *keys: str) -> tuple[str, ...]:
        times = [reduce(getitem, keys, one) for one in found.values()]
        return label, *(f"{t['wall']:.3g} ({t['cpu']:.3g})" for t in times)

    rows = []
    for name in SCENES:
        rows += [row(f"{name}, {what}", name, what) for what in ("cold", "warm", OTHER)]
        rows += [row(f"{name}, {what} in one process", name, "one process", what) for what in IN_ONE]
    rows += [row(f"static solve, {what}", "statics", str(k)) for k, what in enumerate(("first", "second", "third"))]
    rows.append(row("nine static solves", "identify"))
    return markdown(("wall (CPU) [s]", *found), rows, left=(0,))


def settings_table(found: dict[str, dict]) -> str:
    """Times of changes to an open simulator."""
    versions = list(found.values())
    rows = [(what, *(f"{1e3 * one['settings'][what]:.2f}" for one in versions)) for what in versions[0]["settings"]]
    return markdown(("cube with contacts, wall [ms]", *found), rows, left=(0,))


def call_table(found: dict[str, dict]) -> str:
    """Launches, what they are handed, and accesses by the host, of a step (unknown in old versions)."""
    versions, rows = list(found.values()), []
    for name in SCENES:
        for what in versions[0]["calls"][name]:
            numbers = [one["calls"].get(name, {}).get(what) for one in versions]
            rows.append((f"{name}: {what}", *("unknown" if n is None else f"{n:,.4g}" for n in numbers)))
    return markdown(("a step, mean", *found), rows, left=(0,))


def speed_table(found: dict[str, dict]) -> str:
    """Kernel times, with the range over rounds."""

    def cell(times: np.ndarray) -> str:
        return f"{np.median(times):.3g} ({times.min():.3g} to {times.max():.3g})"

    rows = [(what, *(cell(1e3 * np.array(one["speed"][what])) for one in found.values())) for what in SLOWER]
    return markdown(("wall [ms], median (range over rounds)", *found), rows, left=(0,))


def count_table(found: dict[str, dict]) -> str:
    """Compiled kernels (unknown in old versions), cache files, memory."""
    versions, rows = list(found.values()), []

    def count(n: int | None) -> str:
        return "unknown" if n is None else str(n)

    for name in SCENES:
        for what in IN_ONE:
            counts = [count(one[name]["one process"][what]["compiled"]) for one in versions]
            rows.append((f"{name}: kernels compiled, {what}", *counts))
        rows.append((f"{name}: new files, {OTHER}, by round", *(", ".join(map(str, one[name]["new files"])) for one in versions)))
        rows.append((growth_of(versions[0], name), *(f"{growth(one[name]['memory']):.1f}" for one in versions)))
    for size in versions[0]["surfaces"]:
        rows.append((f"sheet: kernels compiled, {size}", *(count(one["surfaces"][size]) for one in versions)))
    each = [growth(one["keep"]) / one["keep"]["times"] for one in versions]
    rows.append(("closed simulator that is kept: resident memory [MB]", *(f"{mb:.1f}" for mb in each)))
    return markdown(("count", *found), rows, left=(0,))


def growth(memory: dict) -> float:
    """Growth of resident memory [MB]."""
    return memory["end"] - memory["start"]


def growth_of(one: dict, name: str) -> str:
    """Label of `growth` of a scene."""
    return f"{name}: growth of resident memory over {one[name]['memory']['times']} simulators [MB]"


def find_limits(now: dict, old: dict | None) -> list[Limit]:
    """Limits on start-up."""
    limits = [Limit("cube: cold, from process start to the tenth step [s]", now["cube"]["cold"]["wall"], 15.0)]
    for name in SCENES:
        one = now[name]["one process"]
        for what in ("second", "other size"):
            limits.append(Limit(f"{name}: kernels compiled, {what}", one[what]["compiled"], 0))
        limits.append(Limit(f"{name}: new files in the cache, other size", max(now[name]["new files"]), 0))
        limits.append(Limit(growth_of(now, name), growth(now[name]["memory"]), 10.0))
    _, *later = now["surfaces"]
    for size in later:
        if size != CROSSING:  # there the search uses other kernels
            limits.append(Limit(f"sheet: kernels compiled, {size}", now["surfaces"][size], 0))
    kept = now["keep"]
    limits.append(Limit(f"growth of resident memory over {kept['times']} kept closed simulators [MB]", growth(kept), 10.0))
    return limits + (compare(now, old) if old else [])


def compare(now: dict, old: dict) -> list[Limit]:
    """Limits relative to the baseline's times."""
    limits = []
    for name in SCENES:
        second = [one[name]["one process"]["second"]["wall"] for one in (now, old)]
        limits.append(Limit(f"{name}: second simulator over the baseline's", second[0] / second[1], 0.1))
        for what, limit in ((OTHER, 0.5), ("warm", 1.1)):
            walls = [one[name][what]["walls"] for one in (now, old)]
            limits.append(Limit(f"{name}: {what}, over the baseline's", ratio(*walls), limit))
    static = now["statics"]["1"]["wall"] / old["statics"]["1"]["wall"]
    limits.append(Limit("second static solve over the baseline's", static, 0.15))
    limits.append(Limit("nine static solves over the baseline's", now["identify"]["wall"] / old["identify"]["wall"], 0.1))
    for what, limit in SLOWER.items():
        limits.append(Limit(f"{what} over the baseline's", ratio(now["speed"][what], old["speed"][what]), limit))
    return limits


def ratio(now: list[float], old: list[float]) -> float:
    """Median over rounds of the ratio within each round."""
    return float(np.median(np.array(now) / np.array(old)))


def main(argv=None) -> int:
    """Measure and print. Raises SimulationError if a process fails, OutputError if a file cannot be written."""
    parser = make_parser("startup", __doc__)
    parser.add_argument("--quick", action="store_true", help="one round, small meshes, two simulators for memory, no limit")
    parser.add_argument("--baseline", type=Path, metavar="FOLDER", help="another version of taisoft to compare with")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write FILE.json and FILE.md too")
    options = parser.parse_args(argv)
    check_out(options.out, ".json")
    document, numbers = begin("Start-up", "arch cpu")
    with tempfile.TemporaryDirectory() as caches:
        folders = {label: folder for label, folder in (("this version", HERE), ("baseline", options.baseline)) if folder}
        versions = [Version(one.resolve(), Path(caches) / label.replace(" ", "_")) for label, one in folders.items()]
        found = dict(zip(folders, measure(versions, options.quick)))
    document.add("## Waiting\n\n" + waiting_table(found))
    document.add("## Counts\n\n" + count_table(found))
    document.add("## Launches and accesses by the host\n\n" + call_table(found))
    document.add("## Changes\n\n" + settings_table(found))
    document.add("## Speed\n\n" + speed_table(found))
    limits = [] if options.quick else find_limits(found["this version"], found.get("baseline"))
    return document.finish(options, numbers | found, limits)


if __name__ == "__main__":
    sys.exit(main())
