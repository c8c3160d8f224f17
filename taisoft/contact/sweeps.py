"""Sweeps until the residual is small: on one thread in one kernel, or in parallel loops.

rule: the module of a solver, with
    share(p, c, beyond)         share of its r-factors that contact c takes; beyond: 1 with momentum,
    sweep(p)                    one sweep on this thread: r from what r was, which is left in `guess`,
    sweep_at_once(p, colours)   the same on all threads, called from the host.
On a CPU one thread wins: 0.15 us a contact and sweep, where a parallel loop costs some 30 us to start, a sweep takes two to
twenty of them, and memory feeds two threads little better than one.
"""

from types import ModuleType

import taichi as ti

from taisoft.contact import momentum, r_factor
from taisoft.contact.problem import (
    CHANGED,
    GOOD,
    LOOKS,
    PARTS,
    RESIDUAL,
    SIZE,
    ContactProblem,
    find_velocities,
    gather_velocity,
    natural_map,
    residual,
    residual_of,
)
from taisoft.runtime import kernel


@ti.func
def refresh(p: ti.template()):
    """w from the impulses, on this thread."""
    if ti.static(not p.matrix):
        for i in range(p.n_nodes):
            p.w[i] = gather_velocity(p, i)


# --- on one thread ----------------------------------------------------------------------------------------------------


@ti.func
def _begin(p: ti.template(), rule: ti.template(), beyond):
    refresh(p)
    p.state[RESIDUAL] = residual(p)
    r_factor.begin(p)
    for c in range(p.count[0]):
        p.relaxation[c] = rule.relaxation(p, c, beyond)
        p.trial[c] = p.r[c]
        p.good[c] = p.r[c]


@ti.func
def _extrapolate(p: ti.template()):
    total = ti.cast(0.0, ti.f64)
    for c in range(p.count[0]):
        total += momentum.restart_test(p, c)
    beyond = momentum.momentum_weight(p, total)
    for c in range(p.count[0]):
        momentum.extrapolate_impulse(p, c, beyond)


@kernel
def run_serial(
    p: ti.template(), rule: ti.template(), first: ti.i32, sweeps: ti.i32, every: ti.i32, tolerance: ti.f64, beyond: ti.i32
):
    """Up to that many sweeps, a look at the residual after `every`; first, beyond: 1 where the solve begins, with momentum."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        p.state[LOOKS] = 0.0
        if first == 1:
            _begin(p, rule, beyond)
        done = 0
        while done < sweeps and not p.state[RESIDUAL] <= tolerance:
            n = ti.min(every, sweeps - done)
            for _k in range(n):
                rule.sweep(p)
                if beyond == 1:
                    _extrapolate(p)
                refresh(p)
            done += n
            p.state[RESIDUAL] = residual(p)
            r_factor.accept_or_reject(p, ti.cast(n, ti.f64))
            for c in range(p.count[0]):
                r_factor.apply_verdict(p, c)
            if p.state[RESIDUAL] == p.state[GOOD]:
                refresh(p)


# --- on all threads ---------------------------------------------------------------------------------------------------


@kernel
def _begin_at_once(p: ti.template(), rule: ti.template(), beyond: ti.i32):
    for c in range(p.count[0]):
        p.relaxation[c] = rule.relaxation(p, c, beyond)
        p.trial[c] = p.r[c]


@ti.func
def _add_part(p: ti.template(), k):
    """The terms of part k, in order."""
    n = p.count[0]
    total = ti.Vector([0.0, 0.0], ti.f64)
    for c in range(k * n // PARTS, (k + 1) * n // PARTS):
        total += p.term[c]
    p.part[k] = total


@ti.func
def _total(p: ti.template()):
    total = ti.Vector([0.0, 0.0], ti.f64)
    for k in range(PARTS):
        total += p.part[k]
    return total


@kernel
def _look(p: ti.template(), first: ti.i32, sweeps: ti.i32):
    """Judge the impulses; w is up to date."""
    for c in range(p.count[0]):
        d, s = natural_map(p, c)
        p.term[c] = [d, s]
    for k in range(PARTS):
        _add_part(p, k)
    ti.loop_config(serialize=True)
    for _ in range(1):
        sums = _total(p)
        p.state[CHANGED], p.state[SIZE] = sums[0], sums[1]
        p.state[RESIDUAL] = residual_of(sums[0], sums[1])
        if first == 1:
            r_factor.begin(p)
        else:
            r_factor.accept_or_reject(p, ti.cast(sweeps, ti.f64))
    for c in range(p.count[0]):
        r_factor.apply_verdict(p, c)


@kernel
def _extrapolate_parallel(p: ti.template()):
    for c in range(p.count[0]):
        p.term[c] = [momentum.restart_test(p, c), 0.0]
    for k in range(PARTS):
        _add_part(p, k)
    ti.loop_config(serialize=True)
    for _ in range(1):
        p.state[CHANGED] = momentum.momentum_weight(p, _total(p)[0])
    for c in range(p.count[0]):
        momentum.extrapolate_impulse(p, c, p.state[CHANGED])


def run_parallel(
    p: ContactProblem, rule: ModuleType, first: int, sweeps: int, every: int, tolerance: float, beyond: int
) -> None:
    """As `run_serial`, on all threads; the host looks at the residual."""
    p.state[LOOKS] = 0.0
    if first:
        find_velocities(p)
        _begin_at_once(p, rule, beyond)
        _look(p, 1, 0)
    done, colours = 0, int(p.count[1])
    while done < sweeps and not p.state[RESIDUAL] <= tolerance:
        n = min(every, sweeps - done)
        for _ in range(n):
            rule.sweep_at_once(p, colours)
            if beyond:
                _extrapolate_parallel(p)
            find_velocities(p)
        done += n
        _look(p, 0, n)
        if p.state[RESIDUAL] == p.state[GOOD]:
            find_velocities(p)
