"""First- and second-order tets: error against time over refinements, in statics and in one motion.

taisoft bench order [--quick] [--case NAME] [--arch cpu|cuda] [--out FILE.json] [--plot FILE.png]

Computed in f64. Every case is solved on several meshes with linear tets (order 1) and quadratic tets (order 2, four quadrature
points; some with fourteen). A time is the median over rounds of the whole solution from the rest shape with compiled kernels; the
first launches are timed separately, as "compile". Spread is the interquartile range over the median. Errors are relative, the
largest of the measured numbers; "< " marks errors below the reference's uncertainty. The time to 1 % error is interpolated
between two meshes in the logarithms; if all meshes lie on one side of 1 % it is a bound, marked > or <=. Exit status: 0, or 1 if
a limit is not met. --quick has only the hanging beam, unless another case is named, two meshes per order and no limits. A full
run takes about ten minutes on two cores.
"""

import math
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from taisoft.backend.runtime import open_runtime
from taisoft.errors import OutputError
from taisoft.machine import Timing, summarise
from taisoft.output.tables import percent, require_matplotlib, save, spread_of, ticks

from .document import Document, Limit, begin, table
from .order_cases import CASES, HANGING, LINEAR, QUADRATIC, Case, Reference
from .order_runs import Row, measure_case
from .reference_cases.record import label
from .runner import make_parser, parse_options

ROUNDS, QUICK_ROUNDS, QUICK_MESHES = 5, 1, 2
GOALS = (0.1, 0.03, 0.01)  # errors whose times are compared
GOAL = GOALS[-1]  # the error of the summary
MIN_SPEEDUP = 20.0  # time of the hanging beam to that error, order 1 over order 2
ELASTICA_LIMIT = 0.005  # error of order 2 on its finest mesh
LEAST_ERROR = 1e-12  # replaces zero errors in logarithms
DEFAULT_DEGREE = {1: None, 2: 2}  # quadrature of the compared elements
STYLES = {  # (order, degree) -> label, colour, marker, line
    (1, None): ("order 1", "#d55e00", "o", "-"),
    (2, 2): ("order 2, 4 points", "#0072b2", "s", "-"),
    (2, 4): ("order 2, 14 points", "#009e73", "^", ":"),
}
COLUMNS, PANEL = 3, (4.2, 3.2)  # panels in a row, their size in inches
SURE = 1e-5  # the lowest error drawn, for exact references


# --- times to an error --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reach:
    """Time to an error [s]. bound: "=" interpolated; "<=" the coarsest mesh is below the error; ">" the finest is above."""

    seconds: float
    bound: str

    def __str__(self) -> str:
        return f"{'' if self.bound == '=' else self.bound + ' '}{self.seconds:.3g} s"


@dataclass(frozen=True)
class Comparison:
    """Times of both orders to an error in one case. ratio: order 1 over order 2, of every round; bound: "=", ">", "<" or "?"."""

    case: str
    law: str
    goal: float
    reach: dict[int, Reach | None]
    ratio: Timing | None
    bound: str

    def texts(self) -> tuple[str, str, str, str]:
        """Both times, the ratio and its spread."""
        times = (str(self.reach[order] or "-") for order in DEFAULT_DEGREE)
        if self.ratio is None:
            return *times, "-", ""
        return *times, f"{'' if self.bound == '=' else self.bound + ' '}{self.ratio.median:.3g}", percent(spread_of(self.ratio))


def time_to(errors: Sequence[float], seconds: Sequence[float], goal: float) -> Reach | None:
    """Time from which the error stays below the goal; errors (k,) and times (k,) [s] of meshes from coarse to fine.

    Interpolated in the logarithms between the last mesh above the goal and the next; never extrapolated. None without meshes.
    """
    if not len(errors):
        return None
    above = [k for k, error in enumerate(errors) if error > goal]
    if not above:
        return Reach(seconds[0], "<=")
    k = above[-1]
    if k == len(errors) - 1:
        return Reach(seconds[k], ">")
    t = math.log(errors[k] / goal) / math.log(errors[k] / max(errors[k + 1], LEAST_ERROR))
    return Reach(math.exp((1 - t) * math.log(seconds[k]) + t * math.log(seconds[k + 1])), "=")


def claimed(row: Row, reference: Reference) -> float:
    """The row's error, at least the reference's uncertainty."""
    return max(row.error, reference.uncertainty)


def chain(rows: list[Row], order: int) -> list[Row]:
    """The rows of an order with its default quadrature, an error and a time."""
    return [r for r in rows if (r.order, r.degree) == (order, DEFAULT_DEGREE[order]) and r.error is not None and r.rounds]


def compare(case: Case, rows: list[Row], reference: Reference, goal: float = GOAL) -> Comparison:
    """Times to an error, and their ratio in each complete round; unknown below the reference's uncertainty."""
    chains = {order: chain(rows, order) for order in DEFAULT_DEGREE}
    errors = {order: [claimed(r, reference) for r in found] for order, found in chains.items()}

    def reach(order: int, seconds: list[float]) -> Reach | None:
        return time_to(errors[order], seconds, goal) if goal > reference.uncertainty else None

    times = {order: reach(order, [r.timing.median for r in found]) for order, found in chains.items()}
    bound = _ratio_bound(times[1], times[2])
    if bound == "?":
        return Comparison(case.name, case.law, goal, times, None, bound)
    ratios = []
    for k in range(min(len(r.rounds) for found in chains.values() for r in found)):
        slow, fast = (reach(order, [r.rounds[k] for r in found]).seconds for order, found in chains.items())
        ratios.append(slow / fast)
    return Comparison(case.name, case.law, goal, times, summarise(ratios), bound)


def _ratio_bound(slow: Reach | None, fast: Reach | None) -> str:
    """Kind of the ratio slow / fast: "=", a lower bound ">", an upper bound "<", or unknown "?"."""
    if slow is None or fast is None:
        return "?"
    at_least = slow.bound in "=>" and fast.bound in ("=", "<=")
    at_most = slow.bound in ("=", "<=") and fast.bound in "=>"
    return {(True, True): "=", (True, False): ">", (False, True): "<", (False, False): "?"}[at_least, at_most]


# --- tables and limits --------------------------------------------------------------------------------------------------


def row_table(rows: list[Row], reference: Reference) -> str:
    """A row per mesh; failures below."""

    def error(row: Row) -> str:
        if row.error is None:
            return "-"
        return ("< " if row.error < reference.uncertainty else "") + f"{100 * claimed(row, reference):.3g}"

    columns = (
        ("<law", "{.law}"),
        ("order", "{.order}"),
        ("points", "{.points}"),
        ("<cells", lambda row: label(row.cells)),
        ("tets", "{.tets:,}"),
        ("nodes", "{.nodes:,}"),
        ("measured", lambda row: ", ".join(f"{x:.6g}" for x in row.measured) or "-"),
        ("error [%]", error),
        ("Newton", "{.newton}"),
        ("CG", "{.linear:,}"),
        ("solve [s]", lambda row: f"{row.timing.median:.4g}" if row.rounds else "-"),
        ("spread", lambda row: percent(spread_of(row.timing)) if row.rounds else ""),
        ("rounds", lambda row: str(len(row.rounds) or "-")),
        ("compile [s]", "{.compile_seconds:.1f}"),
        ("fields [MB]", lambda row: f"{row.field_bytes / 1e6:.1f}"),
    )
    return table(rows, columns, [f"order {r.order}, {label(r.cells)}: {r.failure}" for r in rows if r.failure])


def compare_table(comparisons: list[Comparison]) -> str:
    """A row per case and error."""
    columns = [("<case", "{.case}"), ("<law", "{.law}"), ("error", "{.goal:.0%}")]
    for k, heading in enumerate(("order 1", "order 2", "order 1 / order 2", "spread")):
        columns.append((heading, lambda c, k=k: c.texts()[k]))
    return table(comparisons, columns)


def find_limits(comparisons: list[Comparison], rows: list[Row]) -> list[Limit]:
    """Limits on the ratio of the hanging beam and on the errors of order 2 against the elastica."""
    limits = []
    for c in comparisons:
        if c.case == HANGING and c.goal == GOAL:
            known = c.ratio is not None and c.bound in "=>"
            what = f"{c.case}: order 1's time to {c.goal:.0%} error / order 2's"
            value, spread = (c.ratio.median, spread_of(c.ratio)) if known else (math.nan, None)
            limits.append(Limit(what, value, MIN_SPEEDUP, spread, at_least=True))
    for name in dict.fromkeys(row.case for row in rows if row.case.startswith("elastica")):
        own = [row for row in rows if row.case == name and (row.order, row.degree) == (2, DEFAULT_DEGREE[2])]
        value = math.nan if not own or own[-1].error is None else 100 * own[-1].error
        limits.append(Limit(f"{name}: error of order 2, finest mesh [%]", value, 100 * ELASTICA_LIMIT))
    return limits


# --- the picture --------------------------------------------------------------------------------------------------------


def draw(cases: list[tuple[Case, list[Row], Reference]], path: Path) -> None:
    """Write a PNG with a panel per case. Raises OutputError."""
    require_matplotlib()
    from matplotlib import pyplot

    cases = [found for found in cases if any(r.error is not None and r.rounds for r in found[1])]
    if not cases:
        raise OutputError(f"{path}: there is nothing to draw, since no mesh has an error")
    columns = min(COLUMNS, len(cases))
    lines = math.ceil(len(cases) / columns)
    size = PANEL[0] * columns, PANEL[1] * lines + 0.5
    figure, grid = pyplot.subplots(lines, columns, figsize=size, squeeze=False, layout="constrained")
    for panel in grid.flat[len(cases) :]:
        panel.set_visible(False)
    drawn: dict = {}
    for panel, (case, rows, reference) in zip(grid.flat, cases):
        drawn |= _panel(panel, case, rows, reference)
    figure.legend(drawn.values(), drawn.keys(), loc="outside upper center", ncols=min(len(drawn), 2 * columns), frameon=False)
    figure.supxlabel("time of a solution [s], median of the rounds")
    figure.supylabel("error [%]")
    save(figure, path)


def _panel(panel, case: Case, rows: list[Row], reference: Reference) -> dict:
    """Draw one case; returns label -> handle of its lines."""
    handles = {}
    for (order, degree), (name, colour, marker, line) in STYLES.items():
        own = [r for r in rows if (r.order, r.degree) == (order, degree) and r.error is not None and r.rounds]
        if own:
            seconds = [r.timing.median for r in own]
            errors = [100 * max(claimed(r, reference), SURE) for r in own]
            (handles[name],) = panel.plot(seconds, errors, line, color=colour, marker=marker, ms=5, lw=1.6)
    handles[f"{GOAL:.0%} error"] = panel.axhline(100 * GOAL, color="#555555", lw=0.9, ls="--")
    if reference.uncertainty > 0.0:
        floor = 100 * reference.uncertainty
        handles["below the reference's own error"] = panel.axhspan(floor / 1e3, floor, color="#dddddd", lw=0)
    panel.set(xscale="log", yscale="log", title=f"{case.title}, {case.law}")
    shown = [r for r in rows if r.error is not None and r.rounds]
    errors = [100 * max(claimed(r, reference), SURE) for r in shown] + [100 * GOAL]
    panel.set_ylim(min(errors) / 1.6, max(errors) * 1.6)
    ticks(panel.yaxis, max(errors) / min(errors))
    seconds = [r.timing.median for r in shown]
    panel.set_xlim(min(seconds) / 1.6, max(seconds) * 1.6)
    ticks(panel.xaxis, max(seconds) / min(seconds))
    panel.grid(True, which="major", color="#eeeeee")
    panel.set_axisbelow(True)
    return handles


# --- the whole ----------------------------------------------------------------------------------------------------------


def case_text(case: Case, rows: list[Row], reference: Reference) -> str:
    """Section of a case: its reference and its rows."""
    values = ", ".join(f"{x:.7g}" for x in reference.values) or "none"
    good = f", uncertainty {reference.uncertainty:.2%}" if reference.uncertainty else ""
    compared_with = f"{case.quantity}; reference: {values}{good}; {reference.source}."
    note = f"\nNote: {case.note}." if case.note else ""
    return f"## {case.name}: {case.title}, {case.law}\n\n{compared_with}{note}\n\n{row_table(rows, reference)}"


def chosen_meshes(case: Case, quick: bool) -> dict:
    """The case's meshes per element; in a quick run the first ones of the two compared elements."""
    if not quick:
        return case.meshes
    return {element: case.meshes[element][:QUICK_MESHES] for element in (LINEAR, QUADRATIC)}


def measure(cases: list[Case], quick: bool, arch: str, document: Document) -> tuple[list, list[Comparison]]:
    """Measure and print: (case, rows, reference) of each case, and the comparisons."""
    found, comparisons = [], []
    with closing(open_runtime(arch, "f64", "the benchmark of orders")) as runtime:
        for case in cases:
            rows, reference = measure_case(case, chosen_meshes(case, quick), QUICK_ROUNDS if quick else ROUNDS, runtime)
            found.append((case, rows, reference))
            document.add(case_text(case, rows, reference))
            if reference.values:
                own = [compare(case, rows, reference, goal) for goal in GOALS]
                document.add("Time to an error:\n\n" + compare_table(own))
                comparisons += own
    document.add(f"## Time to {GOAL:.0%} error\n\n" + compare_table([c for c in comparisons if c.goal == GOAL]))
    return found, comparisons


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError if the arch is not available."""
    names = [case.name for case in CASES]
    parser = make_parser("order", __doc__)
    parser.add_argument("--quick", action="store_true", help="two meshes per order, one round")
    parser.add_argument("--case", choices=names, metavar="NAME", help=f"only this one of {', '.join(names)}")
    options = parse_options(parser, argv, "error against time, a panel per case")
    name = options.case or (HANGING if options.quick else None)
    document, numbers = begin("First- and second-order tets: error against time")
    cases = [case for case in CASES if name in (None, case.name)]
    found, comparisons = measure(cases, options.quick, options.arch, document)
    rows = [row for _, rows, _ in found for row in rows]
    numbers |= {"precision": "f64", "references": {case.name: reference for case, _, reference in found}}
    numbers |= {"rows": rows, "comparisons": comparisons}
    limits = [] if options.quick else find_limits(comparisons, rows)
    return document.finish(options, numbers, limits, lambda path: draw(found, path))


if __name__ == "__main__":
    sys.exit(main())
