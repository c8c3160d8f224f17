"""All measured pages and figures, then the manual's tables.

taisoft bench figures [--only NAME] [--quick] [--results DIR] [--logs DIR]

Runs the benchmarks one after the other in separate processes and writes their pages into benchmarks/results, named after the
machine; their output goes to DIR/NAME.log. A benchmark that fails or misses a limit does not stop the next one. Run nothing else
meanwhile: the table shows the load at each start. A full run takes about three hours on two cores; --only runs single parts. Exit
status: 0, or 1 if a benchmark ended with another status.
"""

import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from taisoft.machine import load_average
from taisoft.output.folder import make_folder

from .document import RESULTS, default_out, load_text, table
from .runner import make_parser, progress

BENCHMARKS = (
    *("references", "elasticity", "collision", "contact", "order", "scaling", "peers", "hard", "report", "startup", "launches"),
    *("gym", "laws", "pictures", "window", "gpu"),
)
ENDINGS = {"order": (".json", ".png"), "scaling": (".json", ".png"), "report": ("",)}  # of files; a folder has none; else .json
NO_QUICK = ("references",)


@dataclass
class Outcome:
    """How a benchmark ended. load: of the machine at its start."""

    name: str
    status: int
    seconds: float
    load: float | None


def command(name: str, quick: bool, results: Path) -> list[str]:
    """Command line of a benchmark, with files named after the machine."""
    made = [sys.executable, "-m", "taisoft", "bench", name, *(["--quick"] if quick and name not in NO_QUICK else [])]
    for ending in ENDINGS.get(name, (".json",)):
        made += ["--plot" if ending == ".png" else "--out", str(results / default_out("cpu", name, ending).name)]
    return made


def make(names: Iterable[str], quick: bool, results: Path, logs: Path) -> list[Outcome]:
    """Run the benchmarks, printing each as it ends."""
    ended = []
    for name in names:
        load, start = load_average(), time.monotonic()
        with open(logs / f"{name}.log", "wb") as log:
            done = subprocess.run(
                command(name, quick, results), stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, check=False
            )
        ended.append(Outcome(name, done.returncode, time.monotonic() - start, load))
        progress(f"{name}: status {done.returncode}, {ended[-1].seconds:.0f} s")
    return ended


def main(argv=None) -> int:
    """Run the benchmarks. Raises OutputError."""
    parser = make_parser("figures", __doc__)
    parser.add_argument(
        "--only", action="append", choices=BENCHMARKS, metavar="NAME", help=f"one of {', '.join(BENCHMARKS)}; repeatable"
    )
    parser.add_argument("--quick", action="store_true", help="small cases; give --results too, the manual takes no quick ones")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR", help="default benchmarks/results")
    parser.add_argument("--logs", type=Path, default=Path("out/figures"), metavar="DIR", help="default out/figures")
    options = parser.parse_args(argv)
    if options.quick and options.results == RESULTS:
        parser.error("--quick needs --results: benchmarks/results holds whole results only")
    results, logs = make_folder(options.results).resolve(), make_folder(options.logs)
    ended = make(options.only or BENCHMARKS, options.quick, results, logs)
    if results == RESULTS:
        done = subprocess.run([sys.executable, "-m", "taisoft", "bench", "manual"], stdin=subprocess.DEVNULL, check=False)
        ended.append(Outcome("manual", done.returncode, 0.0, load_average()))
    columns = [("<benchmark", "{.name}"), ("exit status", "{.status}"), ("seconds", "{.seconds:.0f}")]
    print(table(ended, [*columns, ("load at its start", lambda one: load_text(one.load))]))
    return 0 if all(one.status == 0 for one in ended) else 1


if __name__ == "__main__":
    sys.exit(main())
