"""Start-up: waiting time before the first steps, with and without cached kernels.

taisoft bench startup [--quick] [--baseline FOLDER] [--out [FILE.json]]

A beam of 540 tets in explicit steps, and cubes of 320 tets in implicit steps with contacts, one on a block, one on a half-space
("plane"), each to its tenth step: cold (a new process, an empty kernel cache), warm (a new process, the same cache), and warm
with a new size. In one process: the first simulator, a second one of the same structure, and one of another size. Also three
static solves of the beam, nine that find Young's modulus from a sag, what changes of an open simulator cost, the launches and
accesses by the host of a step, the kernels that sheets on a block compile from 224 to 2,144 surface triangles (from 1,500 on, the
search for contacts runs on all threads: other kernels), and the resident memory that twenty simulators leave behind, and four
closed ones of a cube of 53,240 tets to which something refers. Times are wall and CPU seconds, those of processes with Python's
start; they are medians over rounds, with their range. --baseline: folder of another version, measured in turn with its own cache.
The limits compare with it, by the median of the ratio over rounds, also the speed of kernels (a beam of 34,560 tets, landing
sheets). It then takes about eight minutes. Exit status: 0, or 1 if a limit is not met or a process failed.
"""

import json
import re
import resource
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from . import startup_child
from .document import Limit, begin, table
from .runner import HERE, make_parser, parse_options, progress, run_python
from .startup_child import CALLS, CHANGES, COUNTS, SPEED, WAITING

SIZES = {"beam": (3, 4, 5, 6), "cube": (4, 5, 6, 7), "plane": (4, 5, 6, 7)}  # cells, and those of another size in each round
TIMES, QUICK_TIMES = 20, 2
SPEED_ROUNDS = 5
TASKS = (  # in processes of their own, and those of --quick
    (("statics", 3), ("changes", 4), ("calls", 3, 4, 4), ("surfaces", 6, 7, 21, 22), ("keep", 22, 4)),
    (("statics", 3), ("changes", 4), ("calls", 1, 2, 2), ("surfaces", 6, 7, 21, 22), ("keep", 6, 2)),
)
SPEED_TASK = (("speed", 12, 12, 24), ("speed", 2, 12, 24))
UNITS = {WAITING: "wall (CPU) [s]", COUNTS: "count", CALLS: "a step, mean", CHANGES: "cube with contacts [ms]", SPEED: "ms"}
LIMITS = {  # pattern of rows -> limit; at 1,964 triangles other kernels search
    r"cube, cold": 15.0,
    r".+: kernels compiled, (second|other size|284 triangles|2,144 triangles)": 0,
    r".+: new files in the cache, other size": 0,
    r".*growth of resident memory .+": 10.0,
}
OVER_BASELINE = {  # pattern of rows -> limit of the ratio
    r".+, second in one process": 0.1,
    r".+, warm, other size": 0.5,
    r"(beam|cube|plane), warm": 1.1,
    r"static solve, second": 0.15,
    r"nine static solves": 0.1,
    r"symplectic_euler step": 1.2,
    r"implicit_euler step": 1.25,
    r"energies|force differential|(search|contact step), .+": 1.15,
}


@dataclass
class Version:
    """A version of taisoft in a folder. cache: folder of its compiled kernels; found: section -> row -> values by round."""

    folder: Path
    cache: Path
    found: dict[str, dict[str, list]] = field(default_factory=dict)

    def add(self, section: str, row: str, value) -> None:
        """Add the value of a round."""
        self.found.setdefault(section, {}).setdefault(row, []).append(value)

    def run(self, *task: str | int) -> tuple[float, float]:
        """Run a task of the child and add its values. Returns wall and CPU seconds of its process. Raises SimulationError."""
        used, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        what = f"{self.folder}: task {' '.join(map(str, task))}"
        lines = run_python(what, startup_child.__file__, *task, folder=self.folder, cache=self.cache)
        wall, now = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        for section, rows in json.loads(lines[-1]).items():
            for row, value in rows.items():
                self.add(section, row, value)
        return wall, now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime

    def files(self) -> set[Path]:
        """Files in the cache."""
        return {path for path in self.cache.rglob("*.tic*") if path.is_file()}


def measure(versions: list[Version], quick: bool) -> None:
    """Measure everything for each version, with the versions in turn, since the machine's speed varies.

    Each round uses another mesh size, since a version that compiles for every size is warm at sizes used before.
    """
    for name, (cells, *others) in SIZES.items():
        progress(f"{name}, cold")
        for version in versions:
            version.add(WAITING, f"{name}, cold", version.run("first", name, cells))
        for other in others[: 1 if quick else None]:
            progress(f"{name}, warm, then {other} cells")
            for version in versions:
                version.add(WAITING, f"{name}, warm", version.run("first", name, cells))
            for version in versions:
                before = version.files()
                version.add(WAITING, f"{name}, warm, other size", version.run("first", name, other))
                version.add(COUNTS, f"{name}: new files in the cache, other size", len(version.files() - before))
        progress(f"{name}, one process")
        for version in versions:
            version.run("again", name, cells, others[0])
            version.run("grow", name, cells, QUICK_TIMES if quick else TIMES)
    for task in (*TASKS[quick], *[SPEED_TASK[quick]] * (1 if quick else SPEED_ROUNDS)):
        progress(task[0])
        for version in versions:
            version.run(*task)


# --- tables and limits --------------------------------------------------------------------------------------------------


def middle(values: list) -> float:
    """Median over rounds, of wall seconds where there are CPU seconds too."""
    return float(np.median(np.array(values)[..., 0] if np.ndim(values) > 1 else values))


def cell(values: list | None) -> str:
    """Median and range over rounds; of waiting, medians of wall and CPU seconds; "unknown" where a version does not count."""
    if values is None or np.isnan(values).any():
        return "unknown"
    if np.ndim(values) > 1:
        return "{:.3g} ({:.3g})".format(*np.median(values, axis=0))
    text = f"{np.median(values):,.4g}"
    return text if min(values) == max(values) else f"{text} ({min(values):.3g} to {max(values):.3g})"


def section_table(section: str, versions: dict[str, Version]) -> str:
    """The rows of a section, a column per version."""
    rows = dict.fromkeys(row for version in versions.values() for row in version.found.get(section, {}))
    columns = [(f"<{UNITS[section]}", "{}")]
    columns += [(name, lambda row, v=version: cell(v.found.get(section, {}).get(row))) for name, version in versions.items()]
    return table(rows, columns)


def find_limits(now: Version, old: Version | None) -> list[Limit]:
    """Limits on start-up, and relative to the baseline's times."""
    limits = []
    for section, rows in now.found.items():
        for row, values in rows.items():
            if limit := [limit for pattern, limit in LIMITS.items() if re.fullmatch(pattern, row)]:
                limits.append(Limit(row, max(values) if section == COUNTS else middle(values), limit[0]))
            if old and (limit := [limit for pattern, limit in OVER_BASELINE.items() if re.fullmatch(pattern, row)]):
                ratios = [middle([a]) / middle([b]) for a, b in zip(values, old.found[section][row])]
                limits.append(Limit(f"{row}, over the baseline's", float(np.median(ratios)), limit[0]))
    return limits


def main(argv=None) -> int:
    """Measure and print. Raises SimulationError if a process fails, OutputError if a file cannot be written."""
    parser = make_parser("startup", __doc__)
    parser.add_argument("--quick", action="store_true", help="one round, small meshes, two simulators for memory, no limit")
    parser.add_argument("--baseline", type=Path, metavar="FOLDER", help="another version of taisoft to compare with")
    options = parse_options(parser, argv, arch=False)
    document, numbers = begin("Start-up", "arch cpu")
    with tempfile.TemporaryDirectory() as caches:
        folders = {label: folder for label, folder in (("this version", HERE), ("baseline", options.baseline)) if folder}
        versions = {label: Version(one.resolve(), Path(caches) / label.replace(" ", "_")) for label, one in folders.items()}
        measure(list(versions.values()), options.quick)
    for section in UNITS:
        document.add(f"## {section}\n\n{section_table(section, versions)}")
    limits = [] if options.quick else find_limits(versions["this version"], versions.get("baseline"))
    return document.finish(options, numbers | {label: version.found for label, version in versions.items()}, limits)


if __name__ == "__main__":
    sys.exit(main())
