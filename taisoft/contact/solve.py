"""Run a sweep solver by name."""

from dataclasses import dataclass, field
from importlib import import_module

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact import SOLVERS, gauss_seidel
from taisoft.contact.problem import BEST, CHECKS, HISTORY, RESIDUAL, SWEEPS, ContactProblem, find_velocities
from taisoft.contact.sweeps import run_parallel, run_serial

LAUNCH_VISITS = 1_000_000  # contact visits per launch: about 0.1 s, so that Ctrl-C takes effect
CHECK_EVERY = 5  # sweeps between residual checks, each of which costs as much as a sweep
_MODULES = {name: import_module(f"taisoft.contact.{name}") for name in SOLVERS}


@dataclass(frozen=True)
class SolveResult:
    """Result of a contact solve. residual: of the final impulses; history: at each check, beginning with the start."""

    iterations: int
    residual: float
    converged: bool
    history: list[float] = field(default_factory=list)


@kernel
def _restore_best(p: ti.template()):
    """Replace the present impulses by the best ones."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.r[c] = p.best[c]


def solve(
    p: ContactProblem,
    method: str,
    tolerance: float,
    max_iterations: int,
    every: int = CHECK_EVERY,
    history: bool = False,
    momentum: bool = True,
) -> SolveResult:
    """Solve the problem, starting from its impulses and replacing them by the best ones found.

    method: one of SOLVERS; coloured_gauss_seidel requires grouped contacts, see `colouring`. tolerance: bound on the residual.
    max_iterations: sweeps. every: sweeps between residual checks. history: whether to return the residual of each check.
    momentum: False for the plain method.
    """
    solver = _MODULES[method]
    # Gauss-Seidel has no parallel form: it runs on one thread even if the problem has parallel loops
    run = run_serial if p.serial or solver is gauss_seidel else run_parallel
    batch = max(1, min(HISTORY - 1, LAUNCH_VISITS // max(1, int(p.count[0])) // every)) * every
    remaining, first, residuals = max_iterations, 1, []
    while True:
        n = min(batch, remaining)
        run(p, solver, first, n, every, tolerance, int(momentum))
        remaining, first = remaining - n, 0
        residual = float(p.state[RESIDUAL])
        if history:
            residuals += p.history.to_numpy(int(p.state[CHECKS])).tolist()
        if remaining == 0 or residual <= tolerance:
            break
    best = float(p.state[BEST])
    if best < residual or residual != residual:
        _restore_best(p)
        find_velocities(p)
        residual = best
    return SolveResult(int(p.state[SWEEPS]), residual, residual <= tolerance, residuals)
