"""Hard cases: 26 settings that break solvers, and how many of their variants are solved.

taisoft bench hard [--only NAME ...] [--quick] [--references] [--arch cpu|cuda] [--budget SECONDS] [--keep DIR]
                   [--out [FILE.json]]
taisoft bench hard --judge FILE.json

Each case runs in several variants: laws, integrators, precisions, initial states. The catalogue and physics determine how each
variant must end: ok, degraded by what the setting itself causes, refused before the first step, or stopped later. A variant is
solved if it ends so and meets all its limits. Each variant runs in its own process, which makes its peak memory measurable.
Wall time is that of the steps without compilation, step time the median. A limit is measured, analytic or proposed. Error: the
largest distance of a node, at about 20 times, to the same run in f64 with an eighth of the step, over the case's size; "-" if
that run would take long (--references runs all) or has no comparable shape. --keep stores finished runs in DIR, and the same
command resumes there. --judge runs nothing: it compares stored results with today's limits and rewrites FILE.json and its page.
Exit status: 0, or 1 if a variant is not solved or was not run.
"""

import argparse
import json
import sys
from pathlib import Path

from taisoft.errors import OutputError

from .document import Document, begin, check_out, header_text
from .hard_cases import VARIANTS
from .hard_runs import Row, answer, measure, stored
from .hard_table import page
from .suite import chosen, runs_of, suite_options, suite_parser

TITLE = "Hard cases"


def stored_numbers(path: Path) -> dict:
    """The numbers in a file of results. Raises OutputError."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} cannot be read: {error}") from error


def main(argv=None) -> int:
    """Measure and print. Raises OutputError."""
    parser = suite_parser("hard", __doc__, "a few cheap variants")
    parser.add_argument("--references", action="store_true", help="references of all variants that can have one")
    parser.add_argument("--judge", type=Path, metavar="FILE.json", help="compare stored results with today's limits; goes alone")
    options = suite_options(parser, argv, answer)
    if options.judge is not None:
        if options != argparse.Namespace(**vars(parser.parse_args([])) | {"judge": options.judge}):
            parser.error("--judge goes alone")
        check_out(options.judge, ".json")
        options.out, numbers, document, damaged = options.judge, stored_numbers(options.judge), Document(), []
        rows = stored(numbers)
        document.add(header_text(TITLE, numbers, f"arch {numbers['arch']}"))
    else:
        asked = {name: one for name, one in VARIANTS.items() if not options.quick or one[1].name in one[0].quick}
        rows = [Row(*one) for one in chosen(parser, options.only, asked).values()]
        document, numbers = begin(TITLE, f"arch {options.arch}")
        with runs_of("hard", options, "hard_cases/*.py", "reference_cases/*.py") as runs:
            measure(rows, runs, options.arch, options.references)
        damaged = runs.store.damaged
    for text in (*page(rows), *damaged):
        document.add(text)
    return document.finish(options, numbers | {"rows": [row.data() for row in rows]}) or int(any(row.faults for row in rows))


if __name__ == "__main__":
    sys.exit(main())
