"""Tables of `order.py`: a row a mesh, and the time in which each order reaches an error, read off between two meshes."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from .elasticity_table import Limit, markdown, percent, spread_of
from .order_cases import HANGING, Case, Reference
from .order_runs import Row
from .reference_cases.record import label
from .timing import Timing, summarise

GOAL = 0.01  # the error whose time is told
WANTED_RATIO = 20.0  # of the hanging beam's times to that error, order 1 over order 2
ELASTICA_LIMIT = 0.005  # error of order 2 on its finest mesh
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
    """Times of both orders to GOAL in one case. ratio: order 1 over order 2, of every round; bound: "=", ">", "<" or "?"."""

    case: str
    law: str
    reach: dict[int, Reach | None]
    ratio: Timing | None
    bound: str

    def record(self) -> dict:
        """As plain data."""
        reach = {order: None if r is None else asdict(r) for order, r in self.reach.items()}
        return asdict(self) | {"reach": reach, "goal": GOAL}


def time_to(errors: Sequence[float], seconds: Sequence[float], goal: float = GOAL) -> Reach | None:
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
    share = math.log(errors[k] / goal) / math.log(errors[k] / errors[k + 1])
    return Reach(math.exp((1 - share) * math.log(seconds[k]) + share * math.log(seconds[k + 1])), "=")


def claimed(row: Row, reference: Reference) -> float:
    """The row's error, but not below what the reference is good to."""
    return max(row.error, reference.uncertainty)


def chain(rows: list[Row], order: int) -> list[Row]:
    """The rows of an order, with its default quadrature, that have an error and a time."""
    return [r for r in rows if (r.order, r.degree) == (order, DEFAULT_DEGREE[order]) and r.error is not None and r.rounds]


def compare(case: Case, rows: list[Row], reference: Reference) -> Comparison:
    """Times to GOAL, and their ratio in each round that all meshes took part in."""
    errors, chains = {}, {order: chain(rows, order) for order in DEFAULT_DEGREE}
    for order, found in chains.items():
        errors[order] = [max(claimed(r, reference), 1e-12) for r in found]
    reach = {o: time_to(errors[o], [r.timing.median for r in found]) for o, found in chains.items()}
    bound = _ratio_bound(reach[1], reach[2])
    if bound == "?":
        return Comparison(case.name, case.law, reach, None, bound)
    rounds = min(len(r.rounds) for found in chains.values() for r in found)
    times = [
        [time_to(errors[o], [r.rounds[k] for r in chains[o]]).seconds for o in DEFAULT_DEGREE] for k in range(rounds)
    ]
    return Comparison(case.name, case.law, reach, summarise(slow / fast for slow, fast in times), bound)


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
        lines.append((
            row.law, str(row.order), str(row.points), label(row.cells), f"{row.tets:,}", f"{row.nodes:,}",
            ", ".join(f"{x:.6g}" for x in row.measured) or "-", _error(row, reference), str(row.newton), f"{row.linear:,}",
            "-" if t is None else f"{t.median:.4g}", "" if t is None else percent(spread_of(t)),
            "-" if t is None else str(t.repeats), f"{row.compile_seconds:.1f}", f"{row.field_bytes / 1e6:.1f}",
        ))  # fmt: skip
    headings = (
        "law", "order", "points", "cells", "tets", "nodes", "measured", "error [%]", "Newton", "CG", "solve [s]", "spread",
        "rounds", "compile [s]", "fields [MB]",
    )  # fmt: skip
    notes = [f"* order {r.order}, {label(r.cells)}: {r.failure}" for r in rows if r.failure]
    return markdown(headings, lines, left=(0, 3)) + ("\n\n" + "\n".join(notes) if notes else "")


def _error(row: Row, reference: Reference) -> str:
    if row.error is None:
        return "-"
    below = row.error < reference.uncertainty
    return ("< " if below else "") + f"{100 * claimed(row, reference):.3g}"


def compare_table(comparisons: list[Comparison]) -> str:
    """A row a case."""
    lines = []
    for c in comparisons:
        sign = "" if c.bound == "=" else f"{c.bound} "
        ratio = ("-", "") if c.ratio is None else (f"{sign}{c.ratio.median:.3g}", percent(spread_of(c.ratio)))
        lines.append((c.case, c.law, *(str(c.reach[order] or "-") for order in DEFAULT_DEGREE), *ratio))
    return markdown(("case", "law", "order 1", "order 2", "ratio", "spread"), lines, left=(0, 1))


def find_limits(comparisons: list[Comparison], rows: list[Row]) -> list[Limit]:
    """The wanted ratio of the hanging beam, and the errors of order 2 against the elastica."""
    limits = []
    for c in comparisons:
        if c.case == HANGING:
            known = c.ratio is not None and c.bound in "=>"
            what = f"{c.case}: order 1's time to {GOAL:.0%} error / order 2's"
            value, spread = (c.ratio.median, spread_of(c.ratio)) if known else (math.nan, None)
            limits.append(Limit(what, value, WANTED_RATIO, spread, at_least=True))
    for name in dict.fromkeys(row.case for row in rows if row.case.startswith("elastica")):
        own = [row for row in rows if row.case == name and (row.order, row.degree) == (2, DEFAULT_DEGREE[2])]
        value = math.nan if not own or own[-1].error is None else 100 * own[-1].error
        limits.append(Limit(f"{name}: error of order 2, finest mesh [%]", value, 100 * ELASTICA_LIMIT))
    return limits
