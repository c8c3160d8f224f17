"""Hard cases: 26 settings that break solvers, and how many of their variants are solved.

taisoft bench hard [--case ID] [--quick] [--references] [--arch cpu|cuda] [--budget SECONDS] [--keep DIR] [--out [FILE.json]]
taisoft bench hard --judge FILE.json

Each case runs in several variants: laws, integrators, precisions, initial states. The catalogue and physics determine how each
variant must end: ok, degraded by what the setting itself causes, refused before the first step, or stopped later. A variant is
solved if it ends so and meets all its limits. Each variant runs in its own process, which makes its peak memory measurable. Wall
time is that of the steps without compilation, step time the median. A limit is measured, analytic or proposed; if another
baseline replaces a proposed limit, the table shows both. Error: the largest distance of a node, at about 20 times, to the same
run in f64 with an eighth of the step, over the case's size; "-" if that run would take long (--references runs all) or has no
comparable shape. --keep stores finished runs in DIR, and the same command resumes there. --judge runs nothing: it compares stored
results with today's limits and rewrites FILE.json and its page. Exit status: 0, or 1 if a variant is not solved or was not run.
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
from taisoft.many.places import serve
from taisoft.many.store import Store
from taisoft.output.files import FolderLock, make_folder

from .document import Document, header, header_text
from .hard_cases import CASES
from .hard_runs import Row, Runner, answer, stored
from .hard_table import page
from .runner import add_arch, add_named_out, make_parser, named_out, progress

DAY = 86_400.0  # [s]
TITLE = "Hard cases"


def chosen(case: str | None, quick: bool) -> list[Row]:
    """The rows of one case or of all; quick: cheap variants only."""
    return [
        Row(one, variant)
        for one in CASES
        if case in (None, one.id)
        for variant in one.variants
        if not quick or variant.name in one.quick
    ]


def measured(rows: list[Row], options: argparse.Namespace, document: Document) -> dict:
    """Run the rows and print the page. Returns the numbers. Raises OutputError."""
    text, numbers = header(TITLE, f"arch {options.arch}")
    document.add(text)
    end = time.monotonic() + options.budget
    with Signals("ending; runs that are finished are kept") as signals, ExitStack() as stack:
        store = Store()
        if options.keep is not None:
            folder = make_folder(options.keep)
            stack.enter_context(closing(FolderLock(folder)))
            store = Store(folder)
        signals.run_began()
        runner = Runner(options.arch, store, lambda: end - time.monotonic(), signals.requested, progress)
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
    """Compare stored results with today's limits. Returns the rows and the numbers. Raises OutputError."""
    try:
        numbers = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} cannot be read: {error}") from error
    rows = stored(numbers)
    document.add(header_text(TITLE, numbers, f"arch {numbers['arch']}"))
    for text in page(rows):
        document.add(text)
    return rows, numbers | {"rows": [row.data() for row in rows]}


def main(argv=None) -> int:
    """Measure and print. Raises OutputError."""
    parser = make_parser("hard", __doc__)
    parser.add_argument("--case", choices=[case.id for case in CASES], metavar="ID", help="only this case, such as M1")
    parser.add_argument("--quick", action="store_true", help="a few cheap variants")
    parser.add_argument("--references", action="store_true", help="references of all variants that can have one")
    add_arch(parser)
    parser.add_argument("--budget", type=float, default=DAY, metavar="SECONDS", help="start no run after this time")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="store finished runs there, and reuse those stored")
    add_named_out(parser)
    parser.add_argument("--judge", type=Path, metavar="FILE.json", help="compare stored results with today's limits; goes alone")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)  # how this command runs one variant
    options = parser.parse_args(argv)
    if options.child:
        serve(answer)
    if options.judge is not None and options != argparse.Namespace(**vars(parser.parse_args([])) | {"judge": options.judge}):
        parser.error("--judge goes alone")
    if options.judge is not None:
        options.out = options.judge
    out, document = named_out(options, "hard"), Document()
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
