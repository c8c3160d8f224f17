"""Solvers by name, and one way to run any of them."""

from dataclasses import dataclass, field

import numpy as np

from taisoft.contact import gauss_seidel
from taisoft.contact.problem import HISTORY, LOOKS, RESIDUAL, SWEEPS, ContactProblem

VISITS = 1_000_000  # contacts visited in a launch: about 0.1 s, so that Ctrl-C is heard
EVERY = 5  # sweeps between two looks at the residual, which costs as much as a sweep
SOLVERS = {"gauss_seidel": gauss_seidel}


@dataclass(frozen=True)
class SolveResult:
    """What a contact solve did. residual: see `problem`; history: that of each look, the start's first."""

    iterations: int
    residual: float
    converged: bool
    history: list[float] = field(default_factory=list)


def solve(
    p: ContactProblem, method: str, tolerance: float, max_iterations: int, every: int = EVERY, history: bool = False
) -> SolveResult:
    """Solve the problem from the impulses that it holds; the best ones found are left in it.

    method: one of SOLVERS. tolerance: of the residual. max_iterations: sweeps. every: sweeps between looks.
    """
    solver = SOLVERS[method]
    batch = max(every, VISITS // max(1, int(p.count[0])) // every * every)
    left, first = max_iterations, True
    while True:
        n = min(batch, left)
        solver.run(p, n, every, tolerance, first)
        left, first = left - n, False
        found = p.state.to_numpy()
        if left == 0 or found[RESIDUAL] <= tolerance:
            break
    looks = min(int(found[LOOKS]), HISTORY)
    return SolveResult(
        int(found[SWEEPS]), float(found[RESIDUAL]), bool(found[RESIDUAL] <= tolerance),
        p.history.to_numpy()[:looks].tolist() if history else [],
    )  # fmt: skip
