"""First- and second-order tets: error against time over refinements, in statics.

taisoft bench order [--quick] [--case NAME] [--arch cpu|cuda] [--out FILE.json] [--plot FILE.png]

Computed in f64. Every case is solved on several meshes with linear tets (order 1) and quadratic tets (order 2, four quadrature
points; some with fourteen). A time is the median of whole solutions from the rest shape with compiled kernels; long ones are
not repeated. Spread is the interquartile range over the median. Errors are relative, the largest of the measured numbers; "< "
marks errors below the reference's uncertainty. The time to 1 % error is interpolated between two meshes in the logarithms; if
all meshes lie on one side of 1 % it is a bound, marked > or <=. Exit status: 0, or 1 if a limit is not met. --quick has only
the hanging beam, unless another case is named, two meshes per order and no limits. A full run takes about ten minutes on two
cores. `taisoft study SCENE --order 1,2 --refine 0,1,2` measures the motion of any scene so.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.errors import OutputError, SimulationError, TaisoftError
from taisoft.machine import Timing, summarise
from taisoft.output.tables import percent, spread_of

from .charts import Panel, write_plot
from .document import Document, Limit, begin, table
from .order_cases import CASES, HANGING, LINEAR, POINTS, QUADRATIC, Case, Element
from .reference_cases.record import label
from .runner import make_parser, parse_options, progress, repeated, timed, without_warnings

ROUNDS, ROUND_SECONDS, MIN_ROUNDS = 15, 1.0, 3  # a solution is repeated this often, or until its runs have taken this long
QUICK_ROUNDS, QUICK_MESHES = 1, 2
ENOUGH_SECONDS = 4.0  # a solution that takes longer is not repeated
TOLERANCE = 1e-6  # of |residual| / |load|
GOAL = 0.01  # error whose times are compared
MIN_SPEEDUP = 20.0  # time of the hanging beam to that error, order 1 over order 2
ELASTICA_LIMIT = 0.005  # error of order 2 on its finest mesh
LEAST_ERROR = 1e-12  # replaces zero errors in logarithms
SURE = 1e-5  # the lowest error drawn, for exact references
COMPARED = {1: LINEAR, 2: QUADRATIC}
DEFAULT_DEGREE = dict(COMPARED.values())  # quadrature of the compared elements
STYLES = {"order 1": (LINEAR, "o-"), "order 2, 4 points": (QUADRATIC, "s-"), "order 2, 14 points": ((2, 4), "^:")}


# --- runs ---------------------------------------------------------------------------------------------------------------


@dataclass
class Row:
    """One element on one mesh. rounds: wall seconds per solution; error: largest relative error of the measured numbers."""

    case: str
    law: str
    order: int
    degree: int | None
    cells: tuple
    tets: int = 0
    nodes: int = 0
    measured: list[float] = field(default_factory=list)
    error: float | None = None
    newton: int = 0
    linear: int = 0
    rounds: list[float] = field(default_factory=list)
    compile_seconds: float = 0.0
    field_bytes: int = 0
    failure: str = ""

    @property
    def element(self) -> Element:
        """Order and degree."""
        return self.order, self.degree

    @property
    def timing(self) -> Timing | None:
        """Of a solution [s]; None where it was never timed."""
        return summarise(self.rounds) if self.rounds else None

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"seconds": self.timing and asdict(self.timing)}


def measure_mesh(case: Case, element: Element, cells: tuple, quick: bool, arch: str) -> Row:
    """Solve a case on a mesh, and time its solution; the row records a failure."""
    progress(f"{case.name}: order {element[0]}, {POINTS[element]} points, {label(cells)}")
    row = Row(case.name, case.law, *element, tuple(cells))
    try:
        with without_warnings():  # order 1 bends too little on coarse meshes, which is measured here
            scene = case.build(cells, element)
        body, settings = scene.bodies[0], {"newton_tolerance": TOLERANCE, "precision": "f64", "arch": arch}
        row.tets, row.nodes = body.mesh.n_tets, len(body.rest_positions)
        with ts.Simulator(scene, dt=1.0, integrator="static", **settings) as sim:
            report, seconds = timed(sim.step)
            row.newton, row.linear = report.newton_iterations, report.linear_iterations
            row.field_bytes, row.compile_seconds = sum(sim.field_bytes.values()), sim.compile_seconds
            if not report.converged or report.n_inverted:
                raise SimulationError(f"not converged: the residual is {report.residual:.1e} of the load")
            row.measured = case.read(body, sim).tolist()
            row.error = float(np.abs(np.array(row.measured) / np.array(case.reference.values) - 1.0).max())
            rounds = (QUICK_ROUNDS, ROUND_SECONDS, 1) if quick else (ROUNDS, ROUND_SECONDS, MIN_ROUNDS)
            row.rounds = [seconds] if seconds > ENOUGH_SECONDS else repeated(lambda: (sim.reset(), sim.step()), *rounds)
    except TaisoftError as error:
        row.failure = str(error)
    return row


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
    """Times of both orders to an error in one case; None where they are unknown."""

    case: str
    law: str
    goal: float
    reach: dict[int, Reach | None]

    @property
    def ratio(self) -> float | None:
        """Time of order 1 over that of order 2, where both are interpolated."""
        slow, fast = self.reach[1], self.reach[2]
        return slow.seconds / fast.seconds if slow and fast and slow.bound == fast.bound == "=" else None

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"ratio": self.ratio and {"median": self.ratio}}


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


def claimed(row: Row, case: Case) -> float:
    """The row's error, at least the reference's uncertainty."""
    return max(row.error, case.reference.uncertainty)


def timed_rows(rows: list[Row], element: Element) -> list[Row]:
    """The rows of an element with an error and a time."""
    return [row for row in rows if row.element == element and row.error is not None and row.rounds]


def compare(case: Case, rows: list[Row], goal: float = GOAL) -> Comparison:
    """Times to an error; unknown below the reference's uncertainty."""
    reach: dict[int, Reach | None] = {}
    for order, element in COMPARED.items():
        own = timed_rows(rows, element) if goal > case.reference.uncertainty else []
        reach[order] = time_to([claimed(row, case) for row in own], [row.timing.median for row in own], goal)
    return Comparison(case.name, case.law, goal, reach)


# --- tables and limits --------------------------------------------------------------------------------------------------


def row_table(rows: list[Row], case: Case) -> str:
    """A row per mesh; failures below."""

    def error(row: Row) -> str:
        if row.error is None:
            return "-"
        return ("< " if row.error < case.reference.uncertainty else "") + f"{100 * claimed(row, case):.3g}"

    columns = (
        ("<law", "{.law}"),
        ("order", "{.order}"),
        ("points", lambda row: str(POINTS[row.element])),
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
    """A row per case."""
    columns = [("<case", "{.case}"), ("<law", "{.law}")]
    columns += [(f"order {order}", lambda c, order=order: str(c.reach[order] or "-")) for order in COMPARED]
    return table(comparisons, [*columns, ("order 1 / order 2", lambda c: f"{c.ratio:.3g}" if c.ratio else "-")])


def find_limits(comparisons: list[Comparison], rows: list[Row]) -> list[Limit]:
    """Limits on the ratio of the hanging beam and on the errors of order 2 against the elastica."""
    limits = []
    for c in comparisons:
        if c.case == HANGING:
            what = f"{c.case}: order 1's time to {c.goal:.0%} error / order 2's"
            limits.append(Limit(what, c.ratio or math.nan, MIN_SPEEDUP, at_least=True))
    for name in dict.fromkeys(row.case for row in rows if row.case.startswith("elastica")):
        own = [row for row in rows if row.case == name and row.element == QUADRATIC]
        value = math.nan if not own or own[-1].error is None else 100 * own[-1].error
        limits.append(Limit(f"{name}: error of order 2, finest mesh [%]", value, 100 * ELASTICA_LIMIT))
    return limits


def draw(cases: list[Case], rows: list[Row], path: Path) -> None:
    """Write a PNG with a panel per case. Raises OutputError."""
    panels = []
    for case in cases:
        panel = Panel(f"{case.title}, {case.law}", "time of a solution [s]", "error [%]", "xy")
        for colour, (name, (element, line)) in enumerate(STYLES.items()):
            if own := timed_rows([row for row in rows if row.case == case.name], element):
                errors = [100 * max(claimed(row, case), SURE) for row in own]
                panel.curve([row.timing.median for row in own], errors, name, colour, line)
        panel.level("y", 100 * GOAL, f"{GOAL:.0%} error")
        if case.reference.uncertainty:
            panel.level("y", 100 * case.reference.uncertainty, "the reference's own error", ls=":")
        panels += [panel] if panel.curves else []
    if not panels:
        raise OutputError(f"{path}: there is nothing to draw, since no mesh has an error")
    write_plot(path, panels)


# --- the whole ----------------------------------------------------------------------------------------------------------


def measure(case: Case, quick: bool, arch: str, document: Document) -> list[Row]:
    """Measure and print a case; in a quick run the first meshes of the two compared elements."""
    meshes = {element: case.meshes[element][:QUICK_MESHES] for element in COMPARED.values()} if quick else case.meshes
    rows = [measure_mesh(case, element, cells, quick, arch) for element, chain in meshes.items() for cells in chain]
    reference = case.reference
    values = ", ".join(f"{x:.7g}" for x in reference.values)
    compared_with = f"{case.quantity}; reference: {values}, uncertainty {reference.uncertainty:.2%}; {reference.source}."
    document.add(f"## {case.name}: {case.title}, {case.law}\n\n{compared_with}\n\n{row_table(rows, case)}")
    return rows


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError if the arch is not available."""
    names = [case.name for case in CASES]
    parser = make_parser("order", __doc__)
    parser.add_argument("--quick", action="store_true", help="two meshes per order, one round")
    parser.add_argument("--case", choices=names, metavar="NAME", help=f"only this one of {', '.join(names)}")
    options = parse_options(parser, argv, "error against time, a panel per case")
    name = options.case or (HANGING if options.quick else None)
    document, numbers = begin("First- and second-order tets: error against time")
    cases, rows, comparisons = [case for case in CASES if name in (None, case.name)], [], []
    for case in cases:
        own = measure(case, options.quick, options.arch, document)
        rows += own
        comparisons.append(compare(case, own))
    document.add(f"## Time to {GOAL:.0%} error\n\n" + compare_table(comparisons))
    numbers |= {"precision": "f64", "references": {case.name: case.reference for case in cases}}
    numbers |= {"rows": rows, "comparisons": comparisons}
    limits = [] if options.quick else find_limits(comparisons, rows)
    return document.finish(options, numbers, limits, lambda path: draw(cases, rows, path))


if __name__ == "__main__":
    sys.exit(main())
