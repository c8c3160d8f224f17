"""Start-up: how long a user waits before the first steps, with and without compiled kernels at hand.

taisoft bench startup [--quick] [--baseline FOLDER] [--out FILE.json]

A beam of 540 tets in explicit steps, and a cube of 320 tets on a block in implicit steps with contacts, each to its tenth step:
cold (a new process, an empty cache of kernels), warm (a new process, the same cache), and warm with a mesh size not had before.
In one process: the first simulator, a second one of the same structure, and one of another size. Also three static solves of the
beam, nine that find Young's modulus from a sag, what changes of an open simulator cost, the kernels that sheets on a block
compile from 224 to 2,144 surface triangles (from 1,500 on, the search for contacts runs on all threads: other kernels), and the
resident memory that twenty simulators leave behind, and four closed ones of a cube of 53,240 tets to which something refers.
Times are wall and CPU seconds, those of a whole process with Python's start; a warm one is the median over rounds.
--baseline: another version's folder, measured in turns in the same run with its own cache; the limits compare with it, those of
warm processes and of how fast kernels are (a beam of 34,560 tets, sheets that land) by the median of the ratio over rounds. It
takes about eight minutes then. Exit status: 0, or 1 where a limit is not met or a process failed.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from taisoft.timing import load_average

from .document import Document, check_out, header
from .elasticity_table import limit_table
from .startup_table import OTHER, SLOWER, count_table, find_limits, settings_table, speed_table, table
from .versions import HERE, Version

CHILD = Path(__file__).with_name("startup_child.py")
SIZES = {"beam": (3, 4, 5, 6), "cube": (4, 5, 6, 7)}  # cells, and those of another size in each round
TIMES = 20
SPEED_CELLS, SPEED_SHEETS, SPEED_ROUNDS = 12, (12, 24), 5
# in processes of their own: task -> its arguments, and those of --quick
TASKS = {
    "statics": ((3,), (3,)),
    "identify": ((3,), (3,)),
    "settings": ((4,), (4,)),
    "surfaces": ((6, 7, 21, 22), (6, 7, 21, 22)),
    "keep": ((22, 4), (6, 2)),
}


def ask(version: Version, *task: str | int) -> tuple[dict, dict]:
    """What a child found, and wall and CPU seconds of its process. Raises SimulationError where it failed."""
    used, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    lines = version.run(CHILD, *task)
    wall, now = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime
    return json.loads(lines[-1]), {"wall": wall, "cpu": cpu}


def measure(versions: list[Version], quick: bool) -> list[dict]:
    """All figures of each version: the versions take turns, since the machine's speed changes."""
    found: list[dict] = [{} for _ in versions]
    for name in SIZES:
        for own, waiting in zip(found, measure_waiting(versions, name, quick)):
            own[name] = waiting
    for what, task in TASKS.items():
        tell(what)
        for own, version in zip(found, versions):
            own[what] = ask(version, what, *task[quick])[0]
    for own, speed in zip(found, measure_speed(versions, quick)):
        own["speed"] = speed
    return found


def measure_waiting(versions: list[Version], name: str, quick: bool) -> list[dict]:
    """Of each version, what processes that simulate one scene take, leave on disk, and keep in memory.

    Each round takes another mesh size: a version that compiles for every size is warm at one that it has had.
    """
    cells, *others = SIZES[name]
    tell(f"{name}, cold")
    found = [{"cold": ask(version, "first", name, cells)[1], "warm": [], OTHER: [], "new files": []} for version in versions]
    for other in others[:1] if quick else others:
        tell(f"{name}, warm, then {other} cells")
        for own, version in zip(found, versions):
            own["warm"].append(ask(version, "first", name, cells)[1])
        for own, version in zip(found, versions):
            before = version.files()
            own[OTHER].append(ask(version, "first", name, other)[1])
            own["new files"].append(len(version.files() - before))
    tell(f"{name}, one process")
    for own, version in zip(found, versions):
        own |= {what: median(own[what]) for what in ("warm", OTHER)}
        own["one process"] = ask(version, "again", name, cells, others[0])[0]
        own["memory"] = ask(version, "grow", name, cells, 2 if quick else TIMES)[0]
    return found


def measure_speed(versions: list[Version], quick: bool) -> list[dict[str, list[float]]]:
    """Of each version, times [s] by round."""
    found: list[dict[str, list[float]]] = [{what: [] for what in SLOWER} for _ in versions]
    for k in range(1 if quick else SPEED_ROUNDS):
        tell(f"speed, round {k + 1}")
        for version, times in zip(versions, found):
            for what, seconds in ask(version, "speed", 2 if quick else SPEED_CELLS, *SPEED_SHEETS)[0].items():
                times[what].append(seconds)
    return found


def median(times: list[dict]) -> dict:
    """Of wall and CPU seconds, with the wall seconds of each round."""
    middle = {key: float(np.median([one[key] for one in times])) for key in ("wall", "cpu")}
    return middle | {"walls": [one["wall"] for one in times]}


def tell(what: str) -> None:
    """What is being measured, to who waits."""
    print(what, file=sys.stderr, flush=True)


def main(argv=None) -> int:
    """Measure and print. Raises SimulationError where a process fails, OutputError where a file cannot be written."""
    first, _, rest = __doc__.partition("\n")
    parser = argparse.ArgumentParser(prog="taisoft bench startup", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--quick", action="store_true", help="one round, small meshes, two simulators for memory, no limit")
    parser.add_argument("--baseline", type=Path, metavar="FOLDER", help="another version of taisoft to compare with")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write FILE.json and FILE.md too")
    options = parser.parse_args(argv)
    check_out(options.out, ".json")
    document, (text, numbers) = Document(), header("Start-up", "arch cpu")
    document.add(text)
    with tempfile.TemporaryDirectory() as caches:
        folders = {label: folder for label, folder in (("this version", HERE), ("baseline", options.baseline)) if folder}
        versions = [Version(one.resolve(), Path(caches) / label.replace(" ", "_")) for label, one in folders.items()]
        found = dict(zip(folders, measure(versions, options.quick)))
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
