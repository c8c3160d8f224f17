"""Hard cases: 26 settings that break solvers, and how many of their variants are solved.

taisoft bench hard [--case ID] [--quick] [--references] [--arch cpu|cuda] [--budget SECONDS] [--keep DIR] [--out [FILE.json]]
taisoft bench hard --judge FILE.json

A case is run in all its variants: laws, integrators, precisions, starts. Each has an end that it must come to, by the catalogue
and by physics: ok, degraded by what the setting itself brings about, refused before a step is done, or stopped later. Solved is
what ended so and kept all its limits. Each variant is a process of its own, so that its peak memory is its own; wall time is
that of its steps without compiling, the time of a step is the median. A limit is measured, analytic or proposed; of a proposed
one that an honest baseline replaces the table shows both. Error: the largest distance of a node, at about 20 times of the run,
to the same run in f64 with an eighth of the step, over the case's size; "-" where that run would take long (--references runs
them all) or has no shape to compare. --keep holds finished runs in DIR, and the same command goes on from there. --judge runs
nothing: it judges stored results by what is asked today, and writes FILE.json and its page anew. Exit status: 0 all asked
variants are solved, 1 some are not, or were not run.
"""

import argparse
import json
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path

from taisoft.cli import Signals
from taisoft.errors import OutputError
from taisoft.machine import load_average
from taisoft.output.files import FolderLock, make_folder
from taisoft.study.output import NoStore, Store
from taisoft.study.workers import serve

from .document import RESULTS, Document, check_out, default_out, header, header_text
from .hard_cases import CASES
from .hard_runs import Row, Runner, answer, stored
from .hard_table import page

DAY = 86_400.0  # [s]
TITLE = "Hard cases"


def chosen(case: str | None, quick: bool) -> list[Row]:
    """The rows of a case, or of all; quick: only variants that are cheap."""
    return [
        Row(one, variant)
        for one in CASES
        if case in (None, one.id)
        for variant in one.variants
        if not quick or variant.name in one.quick
    ]


def measured(rows: list[Row], options: argparse.Namespace, document: Document) -> dict:
    """Run the rows and print what is found. Returns the numbers. Raises OutputError."""
    text, numbers = header(TITLE, f"arch {options.arch}")
    document.add(text)
    end = time.monotonic() + options.budget
    with Signals("ending; runs that are finished are kept") as signals, ExitStack() as stack:
        store = NoStore()
        if options.keep is not None:
            folder = make_folder(options.keep)
            stack.enter_context(closing(FolderLock(folder)))
            store = Store(folder)
        signals.run_began()
        runner = Runner(options.arch, store, lambda: end - time.monotonic(), signals.requested, _say)
        runner.measure(rows, options.references)
    for text in (*page(rows), *store.damaged):
        document.add(text)
    return numbers | {
        "arch": options.arch,
        "quick": options.quick,
        "load_at_the_end": load_average(),
        "rows": [row.data() for row in rows],
    }


def judged(path: Path, document: Document) -> tuple[list[Row], dict]:
    """Stored results, judged by what is asked today. Returns the rows and the numbers. Raises OutputError."""
    try:
        numbers = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} cannot be read: {error}") from error
    rows = stored(numbers)
    document.add(header_text(TITLE, numbers, f"arch {numbers['arch']}"))
    for text in page(rows):
        document.add(text)
    return rows, numbers | {"rows": [row.data() for row in rows]}


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main(argv=None) -> int:
    """Measure and print. Raises OutputError."""
    first, _, rest = __doc__.partition("\n")
    parser = argparse.ArgumentParser(prog="taisoft bench hard", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--case", choices=[case.id for case in CASES], metavar="ID", help="only this one, such as M1")
    parser.add_argument("--quick", action="store_true", help="a few variants that are cheap")
    parser.add_argument("--references", action="store_true", help="references of all variants that can have one")
    parser.add_argument("--arch", choices=("cpu", "cuda"), default="cpu", help="where to compute (default cpu)")
    parser.add_argument("--budget", type=float, default=DAY, metavar="SECONDS", help="what is not begun by then is left out")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep finished runs there, and take up those that it holds")
    parser.add_argument(
        "--out",
        type=Path,
        nargs="?",
        const=RESULTS,
        metavar="FILE.json",
        help="write FILE.json and FILE.md too; without a name into benchmarks/results, named after the machine",
    )
    parser.add_argument("--judge", type=Path, metavar="FILE.json", help="judge stored results anew instead; goes alone")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)  # how this command runs one variant
    options = parser.parse_args(argv)
    if options.child:
        serve(answer)
    if options.judge is not None and options != argparse.Namespace(**vars(parser.parse_args([])) | {"judge": options.judge}):
        parser.error("--judge goes alone")
    out = options.judge or (default_out(options.arch, "hard") if options.out == RESULTS else options.out)
    check_out(out, ".json")
    document = Document()
    if options.judge is not None:
        rows, numbers = judged(options.judge, document)
    else:
        rows = chosen(options.case, options.quick)
        numbers = measured(rows, options, document)
    if out is not None:
        document.write(out, numbers)
    return 1 if any(row.faults for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
