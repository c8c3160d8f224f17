"""First- beside second-order tets: error against time over refinements, in statics and in one motion.

taisoft bench order [--quick] [--case NAME] [--arch cpu|cuda] [--out FILE.json] [--plot FILE.png]

Computed in f64. Every case is solved on some meshes with linear tets (order 1) and with quadratic ones (order 2, four
quadrature points; some with fourteen). A time is the median over rounds of the whole solution from the rest shape, on
kernels that an earlier solution has compiled; the first launches are told apart, as "compile". Spread is the distance
between the quartiles over the median. Errors are relative, the largest of the numbers read, and "< " marks one below what
the reference is good to. The time to 1 % error is read off between two meshes, straight in the logarithms; where all
meshes lie on one side of 1 % it is a bound, marked > or <=, and nothing is extrapolated. Exit status: 0, or 1 where a limit
is not met. --quick has the hanging beam alone, unless another case is named, two meshes an order and no limit. The whole
takes about ten minutes on two cores.
"""

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

from taisoft.backend.runtime import open_runtime
from taisoft.output.tables import require_matplotlib
from taisoft.timing import load_average

from .document import Document, check_out, header
from .elasticity_table import limit_table
from .order_cases import CASES, HANGING, LINEAR, QUADRATIC, Case, Reference
from .order_plot import draw
from .order_runs import Row, measure_case
from .order_table import GOAL, GOALS, compare, compare_table, find_limits, row_table

ROUNDS, QUICK_ROUNDS, QUICK_MESHES = 5, 1, 2


def case_text(case: Case, rows: list[Row], reference: Reference) -> str:
    """A section: what the case is judged by, and its rows."""
    values = ", ".join(f"{x:.7g}" for x in reference.values) or "none"
    good = f", good to {reference.uncertainty:.2%}" if reference.uncertainty else ""
    told = f"{case.quantity}; reference: {values}{good}; {reference.source}."
    note = f"\nNote: {case.note}." if case.note else ""
    return f"## {case.name}: {case.title}, {case.law}\n\n{told}{note}\n\n{row_table(rows, reference)}"


def chosen_meshes(case: Case, quick: bool) -> dict:
    """The case's meshes for each element; in a quick run the first of the two elements that are compared."""
    if not quick:
        return case.meshes
    return {element: case.meshes[element][:QUICK_MESHES] for element in (LINEAR, QUADRATIC)}


def measure(cases: list[Case], quick: bool, arch: str, document: Document) -> tuple[dict, list]:
    """Everything, printed as it comes. Returns the numbers, and (case, rows, reference) of each case."""
    text, numbers = header("First- and second-order tets: error against time")
    document.add(text)
    found, comparisons = [], []
    runtime = open_runtime(arch, "f64", "the benchmark of orders")
    try:
        for case in cases:
            rows, reference = measure_case(case, chosen_meshes(case, quick), QUICK_ROUNDS if quick else ROUNDS, runtime)
            found.append((case, rows, reference))
            document.add(case_text(case, rows, reference))
            if reference.values:
                comparisons += [compare(case, rows, reference, goal) for goal in GOALS]
                document.add("Time to an error:\n\n" + compare_table(comparisons[-len(GOALS) :]))
    finally:
        runtime.close()
    document.add(f"## Time to {GOAL:.0%} error")
    document.add(compare_table([c for c in comparisons if c.goal == GOAL]))
    limits = [] if quick else find_limits(comparisons, [row for _, rows, _ in found for row in rows])
    if limits:
        document.add("## Limits")
        document.add(limit_table(limits))
    numbers |= {
        "arch": arch,
        "precision": "f64",
        "quick": quick,
        "load_at_the_end": load_average(),
        "references": {case.name: asdict(reference) for case, _, reference in found},
        "rows": [row.record() for _, rows, _ in found for row in rows],
        "comparisons": [c.record() for c in comparisons],
        "limits": [x.record() for x in limits],
    }
    return numbers, found


def parse_options(parser: argparse.ArgumentParser, argv: list[str] | None, drawn: str) -> argparse.Namespace:
    """--arch, --out and --plot, which is to draw what `drawn` says, beside the parser's own options; the files can be written."""
    parser.add_argument("--arch", choices=("cpu", "cuda"), default="cpu", help="where to compute (default cpu)")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write FILE.json and FILE.md too")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help=f"draw {drawn}")
    options = parser.parse_args(argv)
    check_out(options.out, ".json")
    check_out(options.plot, ".png")
    if options.plot:
        require_matplotlib()
    return options


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError where the arch cannot be had."""
    first, _, rest = __doc__.partition("\n")
    names = [case.name for case in CASES]
    parser = argparse.ArgumentParser(prog="taisoft bench order", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--quick", action="store_true", help="two meshes an order, one round")
    parser.add_argument("--case", choices=names, metavar="NAME", help=f"only this one of {', '.join(names)}")
    options = parse_options(parser, argv, "error against time, a panel a case")
    name = options.case or (HANGING if options.quick else None)
    document = Document()
    numbers, found = measure([c for c in CASES if name in (None, c.name)], options.quick, options.arch, document)
    if options.out:
        document.write(options.out, numbers)
    if options.plot:
        draw(found, options.plot)
        print(f"written: {options.plot}")
    return 0 if all(limit["met"] for limit in numbers["limits"]) else 1


if __name__ == "__main__":
    sys.exit(main())
