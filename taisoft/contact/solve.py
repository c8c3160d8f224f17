"""Solvers by name, and one way to run any of them."""

from dataclasses import dataclass, field
from importlib import import_module

import taichi as ti

from taisoft.contact import SOLVERS, gauss_seidel
from taisoft.contact.problem import GOOD, HISTORY, LOOKS, RESIDUAL, SWEEPS, ContactProblem, find_velocities
from taisoft.contact.sweeps import run_parallel, run_serial
from taisoft.runtime import kernel

VISITS = 1_000_000  # contacts visited in a launch: about 0.1 s, so that Ctrl-C is heard
EVERY = 5  # sweeps between two looks at the residual, which costs as much as a sweep
RULES = {name: import_module(f"taisoft.contact.{name}") for name in SOLVERS}


@dataclass(frozen=True)
class SolveResult:
    """What a contact solve did. residual: of the impulses it left; history: that of each look, the start's first."""

    iterations: int
    residual: float
    converged: bool
    history: list[float] = field(default_factory=list)


@kernel
def _bring_back(p: ti.template()):
    """The best impulses become the present ones."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.r[c] = p.good[c]


def solve(
    p: ContactProblem, method: str, tolerance: float, max_iterations: int, every: int = EVERY, history: bool = False,
    momentum: bool = True,
) -> SolveResult:  # fmt: skip
    """Solve the problem from the impulses that it holds; the best ones found are left in it.

    method: one of SOLVERS; the coloured one wants the contacts grouped, see `colouring`. tolerance: of the residual.
    max_iterations: sweeps. every: sweeps between looks. history: whether the result tells the residual of each look. momentum:
    False for the plain method.
    """
    rule = RULES[method]
    # Gauss-Seidel has no parallel form: on a problem with parallel loops it runs on one thread all the same
    run = run_serial if p.serial or rule is gauss_seidel else run_parallel
    batch = max(1, min(HISTORY - 1, VISITS // max(1, int(p.count[0])) // every)) * every
    left, first, told = max_iterations, 1, []
    while True:
        n = min(batch, left)
        run(p, rule, first, n, every, tolerance, int(momentum))
        left, first = left - n, 0
        residual = float(p.state[RESIDUAL])
        if history:
            told += p.history.to_numpy(int(p.state[LOOKS])).tolist()
        if left == 0 or residual <= tolerance:
            break
    good = float(p.state[GOOD])
    if good < residual or residual != residual:
        _bring_back(p)
        find_velocities(p)
        residual = good
    return SolveResult(int(p.state[SWEEPS]), residual, residual <= tolerance, told)
