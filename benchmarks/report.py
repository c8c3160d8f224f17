"""The report's figures and experiments repeated: its claims, our measurements and a verdict, on one page.

taisoft bench report [--quick] [--arch cpu|cuda] [--only NAME] [--out DIR]

The page is DIR/README.md, with pictures and all numbers (report.json) beside it. Scenes are ours, since the report gives few
sizes and neither its machine nor its materials. The search and the contact solve are judged by the numbers of `taisoft bench
collision` and `taisoft bench contact` in benchmarks/results, which are run first if they are not there; the rest is measured
here. The numbers decide whether a claim holds; a part agrees, disagrees or partly agrees. Times are medians without
compilation; spread is the interquartile range over the median. Exit status: 0, or 1 if a part could not be measured; verdicts
do not matter. --quick has fewer scenes, sizes and rounds, and measures everything; it and --only write files only with --out. A
full run takes about six minutes on two cores.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.machine import load_average
from taisoft.output.folder import make_folder
from taisoft.output.report import json_text
from taisoft.output.tables import require_matplotlib

from .document import default_out, header, load_text
from .report_parts import bound, demos, phases, points, search, solvers
from .report_parts.page import Extent, Part, numbers_of, part_text, short_text, summary_table
from .runner import add_arch, make_parser


def judged(benchmark: str, judge: Callable[[dict], Part]) -> Callable[[Extent], Part]:
    """What makes a part of the numbers of another benchmark."""

    def measure(extent: Extent) -> Part:
        numbers = numbers_of(benchmark, extent.quick, extent.arch)
        part = judge(numbers)
        part.method += f" The numbers are those of `taisoft bench {benchmark}`, {numbers['date']}."
        return part

    return measure


PARTS: dict[str, Callable[[Extent], Part]] = {
    "demos": demos.measure,
    "phases": judged("contact", phases.phases),
    "points": points.measure,
    "reduction": judged("collision", search.reduction),
    "broad": judged("collision", search.broad),
    "cells": judged("collision", search.cells),
    "colours": judged("contact", solvers.colours),
    "solvers": judged("contact", solvers.solvers),
    "bound": bound.measure,
}
PAGE, NUMBERS = "README.md", "report.json"


def measure_part(name: str, extent: Extent) -> Part:
    """Measure an experiment; the part records a failure."""
    begin = time.perf_counter()
    try:
        part = PARTS[name](extent)
    except ts.TaisoftError as error:
        part = Part(name, name, "-", "", failure=str(error))
    part.seconds = time.perf_counter() - begin
    return part


def page_text(head: str, numbers: dict, parts: list[Part]) -> str:
    """The whole page."""
    opening = (
        f"{head}\nload {load_text(numbers['load_at_the_end'])} at the end; {numbers['seconds']:.0f} s in all, "
        f"{numbers['compile_seconds']:.0f} s of them "
        f"compiling{'; a quick run, with fewer scenes, sizes and rounds' if numbers['quick'] else ''}.\n\nMade by `taisoft bench "
        "report`; nothing on this page is written by hand. Claims are the report's in our words; the numbers decide whether they "
        "hold. Times are medians; spread is the interquartile range over the median."
    )
    return "\n\n".join([opening, summary_table(parts), *map(part_text, parts), short_text(parts)]) + "\n"


def write(folder: Path, head: str, numbers: dict, parts: list[Part]) -> None:
    """Write the page, its pictures and its numbers. Raises OutputError."""
    for part in parts:
        for name, data in part.pictures.items():
            write_bytes(folder / name, data)
    write_bytes(folder / PAGE, page_text(head, numbers, parts).encode())
    numbers = numbers | {"parts": [part.record() for part in parts]}
    write_bytes(folder / NUMBERS, json_text(numbers).encode())


def main(argv=None) -> int:
    """Measure and write. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("report", __doc__)
    add_arch(parser)
    parser.add_argument("--quick", action="store_true", help="fewer scenes, sizes and rounds")
    parser.add_argument("--only", choices=tuple(PARTS), metavar="NAME", help=f"one of {', '.join(PARTS)}")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default of a full run: benchmarks/results/report-<machine>")
    options = parser.parse_args(argv)
    folder = options.out or (None if options.quick or options.only else default_out(options.arch, "report", suffix=""))
    require_matplotlib("the page's plots")
    if folder is not None and not os.access(make_folder(folder), os.W_OK):  # before minutes of measuring
        raise OutputError(f"cannot write to the folder {folder}")
    head, numbers = header("The report, measured again", options.arch)
    begin, compiled = time.perf_counter(), compile_clock()
    parts = []
    for name in [options.only] if options.only else PARTS:
        parts.append(measure_part(name, Extent(options.quick, options.arch)))
        print(part_text(parts[-1]) + "\n", flush=True)
    numbers |= {"arch": options.arch, "quick": options.quick, "load_at_the_end": load_average()}
    numbers |= {"seconds": time.perf_counter() - begin, "compile_seconds": compile_clock() - compiled}
    if folder is not None:
        write(folder, head, numbers, parts)
        print(f"written: {folder / PAGE}")
    return 1 if any(part.failure for part in parts) else 0


if __name__ == "__main__":
    sys.exit(main())
