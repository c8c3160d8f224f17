"""Tables of `order.py`: a row a mesh, and the time in which each order reaches an error, read off between two meshes."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from taisoft.output.tables import markdown, percent, spread_of
from taisoft.timing import Timing, summarise

from .elasticity_table import Limit
from .order_cases import HANGING, Case, Reference
from .order_runs import Row
from .reference_cases.record import label

GOALS = (0.1, 0.03, 0.01)  # errors whose times are told
GOAL = GOALS[-1]  # the one that cases are summed up by
WANTED_RATIO = 20.0  # of the hanging beam's times to that error, order 1 over order 2
ELASTICA_LIMIT = 0.005  # error of order 2 on its finest mesh
LEAST_ERROR = 1e-12  # what no error at all counts as among logarithms
DEFAULT_DEGREE = {1: None, 2: 2}  # of the quadrature of the elements that are compared


@dataclass(frozen=True)
class Reach:
    """Time to an error [s]. bound: "=" read off between two meshes; "<=" the coarsest is below it; ">" the finest is above."""

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

    def record(self) -> dict:
        """As plain data."""
        reach = {order: None if r is None else asdict(r) for order, r in self.reach.items()}
        return asdict(self) | {"reach": reach}

    def texts(self) -> tuple[str, str, str, str]:
        """Both times, the ratio and its spread."""
        times = (str(self.reach[order] or "-") for order in DEFAULT_DEGREE)
        if self.ratio is None:
            return *times, "-", ""
        return *times, f"{'' if self.bound == '=' else self.bound + ' '}{self.ratio.median:.3g}", percent(spread_of(self.ratio))


def time_to(errors: Sequence[float], seconds: Sequence[float], goal: float) -> Reach | None:
    """When meshes, coarse to fine, with these errors (k,) and times (k,) [s] get down to an error for good.

    Straight in the logarithms between the last mesh above the goal and the next one; never beyond a mesh. None without
    meshes.
    """
    if not len(errors):
        return None
    above = [k for k, error in enumerate(errors) if error > goal]
    if not above:
        return Reach(seconds[0], "<=")
    k = above[-1]
    if k == len(errors) - 1:
        return Reach(seconds[k], ">")
    share = math.log(errors[k] / goal) / math.log(errors[k] / max(errors[k + 1], LEAST_ERROR))
    return Reach(math.exp((1 - share) * math.log(seconds[k]) + share * math.log(seconds[k + 1])), "=")


def claimed(row: Row, reference: Reference) -> float:
    """The row's error, but not below what the reference is good to."""
    return max(row.error, reference.uncertainty)


def chain(rows: list[Row], order: int) -> list[Row]:
    """The rows of an order, with its default quadrature, that have an error and a time."""
    return [r for r in rows if (r.order, r.degree) == (order, DEFAULT_DEGREE[order]) and r.error is not None and r.rounds]


def compare(case: Case, rows: list[Row], reference: Reference, goal: float = GOAL) -> Comparison:
    """Times to an error, and their ratio in each round that all meshes took part in; unknown below what can be claimed."""
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
    """What is known of slow / fast: "=", a lower bound ">", an upper bound "<", or nothing "?"."""
    if slow is None or fast is None:
        return "?"
    at_least = slow.bound in "=>" and fast.bound in ("=", "<=")
    at_most = slow.bound in ("=", "<=") and fast.bound in "=>"
    return {(True, True): "=", (True, False): ">", (False, True): "<", (False, False): "?"}[at_least, at_most]


def row_table(rows: list[Row], reference: Reference) -> str:
    """A row a mesh; what failed is told below."""
    lines = []
    for row in rows:
        t = row.timing
        lines.append(
            (
                row.law,
                str(row.order),
                str(row.points),
                label(row.cells),
                f"{row.tets:,}",
                f"{row.nodes:,}",
                ", ".join(f"{x:.6g}" for x in row.measured) or "-",
                _error(row, reference),
                str(row.newton),
                f"{row.linear:,}",
                "-" if t is None else f"{t.median:.4g}",
                "" if t is None else percent(spread_of(t)),
                "-" if t is None else str(t.repeats),
                f"{row.compile_seconds:.1f}",
                f"{row.field_bytes / 1e6:.1f}",
            )
        )
    headings = (
        "law",
        "order",
        "points",
        "cells",
        "tets",
        "nodes",
        "measured",
        "error [%]",
        "Newton",
        "CG",
        "solve [s]",
        "spread",
        "rounds",
        "compile [s]",
        "fields [MB]",
    )
    notes = [f"* order {r.order}, {label(r.cells)}: {r.failure}" for r in rows if r.failure]
    return markdown(headings, lines, left=(0, 3)) + ("\n\n" + "\n".join(notes) if notes else "")


def _error(row: Row, reference: Reference) -> str:
    if row.error is None:
        return "-"
    below = row.error < reference.uncertainty
    return ("< " if below else "") + f"{100 * claimed(row, reference):.3g}"


def compare_table(comparisons: list[Comparison]) -> str:
    """A row a case and error."""
    lines = [(c.case, c.law, f"{c.goal:.0%}", *c.texts()) for c in comparisons]
    headings = ("case", "law", "error", "order 1", "order 2", "order 1 / order 2", "spread")
    return markdown(headings, lines, left=(0, 1))


def find_limits(comparisons: list[Comparison], rows: list[Row]) -> list[Limit]:
    """The wanted ratio of the hanging beam, and the errors of order 2 against the elastica."""
    limits = []
    for c in comparisons:
        if c.case == HANGING and c.goal == GOAL:
            known = c.ratio is not None and c.bound in "=>"
            what = f"{c.case}: order 1's time to {c.goal:.0%} error / order 2's"
            value, spread = (c.ratio.median, spread_of(c.ratio)) if known else (math.nan, None)
            limits.append(Limit(what, value, WANTED_RATIO, spread, at_least=True))
    for name in dict.fromkeys(row.case for row in rows if row.case.startswith("elastica")):
        own = [row for row in rows if row.case == name and (row.order, row.degree) == (2, DEFAULT_DEGREE[2])]
        value = math.nan if not own or own[-1].error is None else 100 * own[-1].error
        limits.append(Limit(f"{name}: error of order 2, finest mesh [%]", value, 100 * ELASTICA_LIMIT))
    return limits
