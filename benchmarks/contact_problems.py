"""Contact solvers on frictional contact problems of rigid scenes: residual after 10, 100 and 1000 sweeps, and cost to 1e-6.

A section of `taisoft bench contact`. The problems are from Siconos' test data, in shared/contact_problems beside the repository;
residuals of plain serial Gauss-Seidel are the yardstick. Cost is relative to 1000 sweeps of plain Gauss-Seidel: time, measured in
turn, and floating-point operations (18 per block of W and sweep, 2/3 n^3 for a dense factorisation, the fill for a sparse one).
Verdicts: Gauss-Seidel may be at most twice the yardstick; the best solver of every problem must reach 1e-6 at less than the cost
of those sweeps, in operations and in time.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from taisoft.backend.runtime import open_runtime
from taisoft.contact import api, augmented_lagrangian
from taisoft.contact.colouring import colour_greedy, matrix_graph, store
from taisoft.contact.solve import solve

from .runner import patched

PROBLEMS = Path(__file__).resolve().parents[1].parent / "shared" / "contact_problems"
SWEEPS = (10, 100, 1000)
GOAL = 1e-6
NONE = 1e-12  # residuals below are rounding
PLAIN = "gauss_seidel, plain"
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
SWEEPERS = {  # name -> (method, momentum)
    PLAIN: ("gauss_seidel", False),
    "gauss_seidel": ("gauss_seidel", True),
    "coloured_gauss_seidel": ("coloured_gauss_seidel", True),
    "jacobi, plain": ("jacobi", False),
    "jacobi": ("jacobi", True),
    "hybrid, plain": ("hybrid", False),
    "hybrid": ("hybrid", True),
}
HEADINGS = ("problem", "contacts", "solver", "10", "100", "1000", "to 1e-6", "time", "operations", "verdict")


@dataclass(frozen=True)
class Problem:
    """W (3k,3k), b (3k,), mu (k,)."""

    name: str
    W: sp.csr_matrix
    b: np.ndarray
    mu: np.ndarray

    @property
    def sweep_cost(self) -> int:
        """Operations of a sweep of Gauss-Seidel: its products, and about 40 for a prox."""
        return 18 * len(self.W.tobsr((3, 3)).indices) + 40 * len(self.mu)


@dataclass(frozen=True)
class Row:
    """One solver on one problem.

    residuals: after 10, 100, 1000 sweeps (outer iterates of the augmented Lagrangian; "auto" sweeps 100 times, then those).
    iterations: until 1e-6, None where it is not reached. time, operations: until then, over that of 1000 plain sweeps.
    """

    problem: str
    contacts: int
    solver: str
    residuals: tuple[float, float, float]
    iterations: int | None
    time: float
    operations: float
    verdict: str = ""

    @property
    def cost(self) -> float:
        return max(self.time, self.operations)

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells for HEADINGS."""
        reached = self.iterations is not None
        cost = (str(self.iterations), f"{self.time:.2f}", f"{self.operations:.3f}") if reached else ("-", "-", "-")
        residuals = (f"{r:.1e}" for r in self.residuals)
        return self.problem, str(self.contacts), self.solver, *residuals, *cost, self.verdict


def load(name: str) -> Problem:
    """Load a shared problem."""
    data = np.load(PROBLEMS / f"{name}.npz")
    n = 3 * int(data["n_contacts"])
    W = sp.csr_matrix((data["val"], (data["row"], data["col"])), shape=(n, n))
    return Problem(name, W, np.asarray(data["b"], float), np.asarray(data["mu"], float))


def seconds(calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median time of each call; the calls run in turn, once before to compile."""
    spent: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            spent[name].append(time.perf_counter() - start)
    return {name: float(np.median(s[1:])) for name, s in spent.items()}


@contextmanager
def counted_operations(problem: Problem) -> Iterator[list[int]]:
    """Context that yields a list; its entries sum to the operations of the augmented Lagrangian."""
    operations: list[int] = []
    module, dense = augmented_lagrangian, np.linalg.solve
    sparse, linearise = module.splu, module._linearise

    def count_dense(A, b):
        operations.append(2 * len(A) ** 3 // 3 + 2 * len(A) ** 2)
        return dense(A, b)

    def count_sparse(A):
        made = sparse(A)
        lower, upper = np.diff(made.L.tocsc().indptr), np.diff(made.U.tocsr().indptr)
        operations.append(int(2 * (lower * upper).sum() + 2 * (lower.sum() + upper.sum())))
        return made

    def count_linearise(q, *rest):  # with W' q and the blocks of the linearised equations, 3x3 by 3x3
        operations.append(int(len(q) / problem.W.shape[0] * 4 * problem.sweep_cost))
        return linearise(q, *rest)

    with (
        patched(np.linalg, "solve", count_dense),
        patched(module, "splu", count_sparse),
        patched(module, "_linearise", count_linearise),
    ):
        yield operations


def sweeper_rows(problem: Problem, repeats: int) -> list[Row]:
    """Rows of the sweeping solvers; the first is plain Gauss-Seidel, the unit of time."""
    W, b, mu = problem.W, problem.b, problem.mu
    with api._problem(W, b, mu) as p:
        store(p, colour_greedy(matrix_graph(W)))
        orders = {True: p.sweep.order.to_numpy(), False: np.zeros(p.capacity, dtype=np.int32)}
        orders[False][: len(mu)] = np.arange(len(mu))

        def sweep(method: str, momentum: bool, goal: float = GOAL, most: int = SWEEPS[-1]):
            p.sweep.order.from_numpy(orders[method == "coloured_gauss_seidel"])
            p.r.fill(0.0)
            return solve(p, method, goal, most, momentum=momentum)

        def residual_after(n: int, method: str, momentum: bool) -> float:
            sweep(method, momentum, 0.1 * NONE, n)
            return augmented_lagrangian.find_residual(W, b, mu, p.r.to_numpy()[: len(mu)])

        residuals = {name: tuple(residual_after(n, *how) for n in SWEEPS) for name, how in SWEEPERS.items()}
        found = {name: sweep(*how) for name, how in SWEEPERS.items()}
        calls = {name: partial(sweep, *how) for name, how in SWEEPERS.items()}
        took = seconds({**calls, "1000": lambda: sweep("gauss_seidel", False, -1.0)}, repeats)
    rows = []
    for name, (_, momentum) in SWEEPERS.items():
        done = found[name]
        # the residual after every fifth sweep is a product too; momentum takes about 40 operations a contact
        cost = problem.sweep_cost * 1.2 + (40 * len(mu) if momentum else 0)
        relative = done.iterations * cost / (SWEEPS[-1] * problem.sweep_cost)
        reached = done.iterations if done.converged else None
        rows.append(Row(problem.name, len(mu), name, residuals[name], reached, took[name] / took["1000"], relative))
    return rows


def host_rows(problem: Problem, repeats: int) -> list[Row]:
    """Rows of the augmented Lagrangian and "auto", with 1000 plain sweeps timed again as the unit."""
    W, b, mu, rows = problem.W, problem.b, problem.mu, []
    none, sweeps = np.zeros((len(mu), 3)), SWEEPS[-1]

    def plain():
        with api._problem(W, b, mu) as p:
            return solve(p, "gauss_seidel", -1.0, sweeps, momentum=False)

    def auto(goal: float, most: int):
        with api._problem(W, b, mu) as p:
            swept = solve(p, "gauss_seidel", goal, min(most, api.AUTO_SWEEPS))
            r = p.r.to_numpy()[: len(mu)]
        if swept.converged or most <= api.AUTO_SWEEPS:
            return r, swept.iterations, [swept.residual]
        r, history = augmented_lagrangian.solve(W, b, mu, r, goal, most - swept.iterations)
        return r, swept.iterations, history

    def lagrangian(goal: float, most: int):
        r, history = augmented_lagrangian.solve(W, b, mu, none, goal, most)
        return r, 0, history

    for name, run in (("augmented_lagrangian", lagrangian), ("auto", auto)):
        residuals = tuple(augmented_lagrangian.find_residual(W, b, mu, run(0.1 * NONE, n)[0]) for n in (*SWEEPS[:2], 150))
        with counted_operations(problem) as counted:
            _, swept, history = run(GOAL, SWEEPS[-1])
        took = seconds({"solve": lambda run=run: run(GOAL, SWEEPS[-1]), "1000": plain}, repeats)
        operations = sum(counted) + swept * (1.2 * problem.sweep_cost + 40 * len(mu))
        relative = operations / (SWEEPS[-1] * problem.sweep_cost)
        reached = swept + len(history) - 1 if history[-1] <= GOAL else None
        rows.append(Row(problem.name, len(mu), name, residuals, reached, took["solve"] / took["1000"], relative))
    return rows


def with_verdicts(rows: list[Row]) -> list[Row]:
    """The rows of one problem with verdicts."""
    yardstick = YARDSTICK[rows[0].problem]
    able = [row for row in rows if row.iterations is not None]
    best = min(able, key=lambda row: row.cost).solver if able else None
    judged_rows = []
    for row in rows:
        verdict = []
        if row.solver.startswith("gauss_seidel"):
            kept = all(found <= 2.0 * limit for found, limit in zip(row.residuals, yardstick))
            verdict.append("yardstick: pass" if kept else "yardstick: FAIL")
        if row.solver == best:
            verdict.append("best: pass" if row.cost <= 1.0 else "best: FAIL")
        judged_rows.append(replace(row, verdict=", ".join(verdict)))
    return judged_rows if best else [replace(row, verdict="FAIL: nothing reaches 1e-6") for row in judged_rows]


def compute(names: tuple[str, ...] = tuple(YARDSTICK), repeats: int = 5) -> Iterator[Row]:
    """The rows of these problems."""
    for name in names:
        problem = load(name)
        yield from with_verdicts(sweeper_rows(problem, repeats) + host_rows(problem, repeats))


def missing(names: tuple[str, ...] = tuple(YARDSTICK)) -> str | None:
    """Why the problems cannot be solved, or None."""
    absent = [name for name in names if not (PROBLEMS / f"{name}.npz").is_file()]
    return f"contact problems are absent from {PROBLEMS}: {', '.join(absent)}" if absent else None


def summary(rows: list[Row]) -> str:
    """A line per solver: on how many problems it reaches 1e-6, and its largest cost there."""
    lines = []
    for solver in dict.fromkeys(row.solver for row in rows):
        of = [row for row in rows if row.solver == solver]
        able = [row for row in of if row.iterations is not None]
        cost = ", ".join(f"{name} {max((getattr(r, name) for r in able), default=0):.2f}" for name in ("operations", "time"))
        lines.append(f"* {solver}: 1e-6 on {len(able)} of {len(of)} problems, at most: {cost}")
    return "\n".join(lines)


def measure(names: tuple[str, ...], repeats: int) -> list[Row]:
    """All rows of these problems, in f64 on the processor; no other runtime may be open."""
    with closing(open_runtime("cpu", "f64", "the benchmark of contact problems")):
        return list(compute(names, repeats))
