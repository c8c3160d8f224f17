"""Contact solvers on frictional contact problems of rigid scenes: residual after 10, 100 and 1000 iterations, and time to 1e-6.

A section of `taisoft bench contact`. The problems are from Siconos' test data, in shared/contact_problems beside the
repository; `solve_contact_problem` solves them by the augmented Lagrangian and "auto", of which 10, 100 and 1000 are
iterations. Cost is the time over that of 1000 sweeps of plain Gauss-Seidel, in turn. Verdicts: Gauss-Seidel may have at most
twice the residuals of the plain one, the yardstick; the best solver of every problem must reach 1e-6 at less than the cost of
those sweeps.
"""

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy.sparse as sp

import taisoft as ts
from taisoft.backend.runtime import open_runtime
from taisoft.contact import SOLVERS, api
from taisoft.contact.colouring import colour_greedy, matrix_graph, store
from taisoft.contact.solve import SolveResult, solve

from .document import table

PROBLEMS = Path(__file__).resolve().parents[1].parent / "shared" / "contact_problems"
ITERATIONS = (10, 100, 1000)
GOAL, NONE = 1e-6, 1e-12  # residuals below NONE are rounding
SERIAL = "gauss_seidel"
YARDSTICK = {
    "BoxesStack1-i100000-32": (3e-2, 2e-3, 3e-5),
    "Capsules-i100-889": (8e-3, 2e-4, 3e-5),
    "Capsules-i125-1213": (6e-3, 2e-4, 4e-5),
    "Confeti-ex03-Fc3D-SBM": (4e-3, 2e-10, NONE),
    "Confeti-ex13-4contact-Fc3D-SBM": (4e-12, NONE, NONE),
    "NESpheres_10_1": (1e-4, 1e-10, NONE),
    "OneObject-i100000-499": (5e-2, 2e-3, 4e-6),
    "Rover1039": (3e-2, 6e-4, 1e-10),
    "Rover4396": (7e-3, 4e-11, NONE),
}


@dataclass(frozen=True)
class Row:
    """A solver on a problem. residuals: after ITERATIONS; iterations, cost: until GOAL, None where it is not reached."""

    problem: str
    contacts: int
    solver: str
    residuals: tuple[float, float, float]
    iterations: int | None
    cost: float | None
    verdict: str = ""


def load(name: str) -> tuple[sp.csr_matrix, np.ndarray, np.ndarray]:
    """W (3k,3k), b (3k,) and mu (k,) of a shared problem."""
    data = np.load(PROBLEMS / f"{name}.npz")
    n = 3 * int(data["n_contacts"])
    W = sp.csr_matrix((data["val"], (data["row"], data["col"])), shape=(n, n))
    return W, np.asarray(data["b"], float), np.asarray(data["mu"], float)


def seconds(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median time of each call; the calls run in turn, once before to compile."""
    spent: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            spent[name].append(time.perf_counter() - start)
    return {name: float(np.median(s[1:])) for name, s in spent.items()}


def rows_of(name: str, repeats: int) -> list[Row]:
    """All solvers on a problem, with verdicts."""
    W, b, mu = load(name)
    most, rows = ITERATIONS[-1], []

    def on_host(method: str, goal: float, limit: int) -> api.ContactSolution:
        return ts.solve_contact_problem(W, b, mu, method, goal, limit)

    with api._problem(W, b, mu) as p:
        store(p, colour_greedy(matrix_graph(W)))
        orders = {True: p.sweep.order.to_numpy(), False: np.arange(p.capacity, dtype=np.int32)}

        def sweep(method: str, goal: float, limit: int, momentum: bool = True) -> SolveResult:
            p.sweep.order.from_numpy(orders[method == "coloured_gauss_seidel"])
            p.r.fill(0.0)
            return solve(p, method, goal, limit, momentum=momentum)

        solvers = {method: partial(sweep if method in SOLVERS else on_host, method) for method in api.METHODS}
        calls = {method: partial(call, GOAL, most) for method, call in solvers.items()}
        took = seconds({**calls, "unit": partial(sweep, SERIAL, -1.0, most, momentum=False)}, repeats)
        for method, call in solvers.items():
            residuals, found = tuple(call(0.1 * NONE, n).residual for n in ITERATIONS), calls[method]()
            ended = (found.iterations, took[method] / took["unit"]) if found.converged else (None, None)
            rows.append(Row(name, len(mu), method, residuals, *ended))
    best = min((row for row in rows if row.cost is not None), key=lambda row: row.cost, default=None)
    return [replace(row, verdict=verdict_of(row, row is best, best is None)) for row in rows]


def verdict_of(row: Row, is_best: bool, is_lost: bool) -> str:
    """Verdict on a row. is_lost: whether no solver reaches GOAL."""
    found = [f"FAIL: nothing reaches {GOAL:g}"] if is_lost else []
    if row.solver == SERIAL:
        kept = all(residual <= 2.0 * limit for residual, limit in zip(row.residuals, YARDSTICK[row.problem]))
        found.append("yardstick: pass" if kept else "yardstick: FAIL")
    if is_best:
        found.append("best: pass" if row.cost <= 1.0 else "best: FAIL")
    return ", ".join(found)


def missing(names: tuple[str, ...] = tuple(YARDSTICK)) -> str | None:
    """Why the problems cannot be solved, or None."""
    absent = [name for name in names if not (PROBLEMS / f"{name}.npz").is_file()]
    return f"contact problems are absent from {PROBLEMS}: {', '.join(absent)}" if absent else None


def row_table(rows: list[Row]) -> str:
    """A row per problem and solver."""
    columns = [("<problem", "{.problem}"), ("contacts", "{.contacts}"), ("<solver", "{.solver}")]
    columns += [(str(n), lambda row, k=k: f"{row.residuals[k]:.1e}") for k, n in enumerate(ITERATIONS)]
    columns += [
        (f"to {GOAL:g}", lambda row: "-" if row.iterations is None else str(row.iterations)),
        ("cost", lambda row: "-" if row.cost is None else f"{row.cost:.2f}"),
        ("<verdict", "{.verdict}"),
    ]
    return table(rows, columns)


def summary(rows: list[Row]) -> str:
    """A line per solver: on how many problems it reaches GOAL, and its largest cost there."""
    lines = []
    for solver in dict.fromkeys(row.solver for row in rows):
        costs = [row.cost for row in rows if row.solver == solver]
        able = [cost for cost in costs if cost is not None]
        lines.append(f"* {solver}: {GOAL:g} on {len(able)} of {len(costs)} problems, cost at most {max(able, default=0):.2f}")
    return "\n".join(lines)


def measure(names: tuple[str, ...], repeats: int) -> list[Row]:
    """All rows of these problems, in f64 on the processor; no other runtime may be open."""
    with closing(open_runtime("cpu", "f64", "the benchmark of contact problems")):
        return [row for name in names for row in rows_of(name, repeats)]
