"""Serial Gauss-Seidel (report, algorithm 2): contact after contact, each with the impulses of those before it.

All sweeps run in one kernel on one thread, in the order of `ContactProblem.order`.
"""

import taichi as ti

from taisoft.contact import r_factor
from taisoft.contact.problem import (
    RESIDUAL,
    STEP,
    SWEEPS,
    ContactProblem,
    gather_velocity,
    push,
    residual,
    velocity,
)
from taisoft.contact.prox import prox, scaled
from taisoft.runtime import kernel


@ti.func
def relax(p: ti.template(), c, step):
    """One prox of contact c with a share of its r-factors, told to its nodes."""
    r = p.r[c]
    new = prox(r - scaled(step * p.factor[c], velocity(p, c)), p.friction[c])
    push(p, c, new - r)
    p.r[c] = new


@ti.func
def refresh(p: ti.template()):
    """w from the impulses, on this thread."""
    if ti.static(not p.matrix):
        for i in range(p.n_nodes):
            p.w[i] = gather_velocity(p, i)


@kernel
def sweep(p: ti.template(), first: ti.i32, sweeps: ti.i32, every: ti.i32, tolerance: ti.f64):
    """Up to that many sweeps, a look at the residual after `every`; state[RESIDUAL] and state[SWEEPS] tell the end.

    first: 1 where the solve begins.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        if first == 1:
            refresh(p)
            p.state[RESIDUAL] = residual(p)
            r_factor.begin(p)
        done = 0
        while done < sweeps and not p.state[RESIDUAL] <= tolerance:
            step = p.state[STEP]
            n = ti.min(every, sweeps - done)
            for _k in range(n):
                for k in range(p.count[0]):
                    relax(p, p.order[k], step)
            done += n
            refresh(p)  # rounding gathers where changes are added
            p.state[RESIDUAL] = residual(p)
            if r_factor.look(p) == 1:
                refresh(p)
        p.state[SWEEPS] += ti.cast(done, ti.f64)


def run(p: ContactProblem, sweeps: int, every: int, tolerance: float, first: bool) -> None:
    """Sweep on; see `sweep`."""
    sweep(p, int(first), sweeps, every, tolerance)
