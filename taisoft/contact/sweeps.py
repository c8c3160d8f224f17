"""Sweep until the residual is small: on one thread in one kernel, or in parallel loops.

solver: the module of a solver, with
    relaxation(p, c, with_momentum)   fraction of its r-factors that contact c uses; with_momentum: 0 or 1,
    sweep(p)                          one sweep on this thread; the old r is left in `sweep_start`,
    sweep_parallel(p, colours)        the same on all threads, called from the host.
On a CPU one thread is faster: it takes 0.15 us per contact and sweep. A parallel loop costs some 30 us to start, a sweep has two
to twenty of them, and memory bandwidth limits two threads to little more than the speed of one.
"""

from types import ModuleType

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact import momentum, r_factor
from taisoft.contact.problem import (
    BEST,
    CHANGED,
    CHECKS,
    CHUNKS,
    RESIDUAL,
    SIZE,
    ContactProblem,
    find_velocities,
    gather_velocity,
    natural_map,
    residual,
    residual_of,
)


@ti.func
def refresh(p: ti.template()):
    """Recompute w from the impulses, on this thread."""
    if ti.static(not p.matrix):
        for i in range(p.n_nodes):
            p.w[i] = gather_velocity(p, i)


# --- on one thread ----------------------------------------------------------------------------------------------------


@ti.func
def _begin(p: ti.template(), solver: ti.template(), with_momentum):
    refresh(p)
    p.state[RESIDUAL] = residual(p)
    r_factor.begin(p)
    for c in range(p.count[0]):
        p.relaxation[c] = solver.relaxation(p, c, with_momentum)
        p.previous[c] = p.r[c]
        p.best[c] = p.r[c]


@ti.func
def _extrapolate(p: ti.template()):
    total = ti.cast(0.0, ti.f64)
    for c in range(p.count[0]):
        total += momentum.restart_test(p, c)
    weight = momentum.momentum_weight(p, total)
    for c in range(p.count[0]):
        momentum.extrapolate_impulse(p, c, weight)


@kernel
def run_serial(
    p: ti.template(),
    solver: ti.template(),
    first: ti.i32,
    sweeps: ti.i32,
    every: ti.i32,
    tolerance: ti.f64,
    with_momentum: ti.i32,
):
    """Run up to `sweeps` sweeps with a residual check after each `every`; first: 1 at the start of a solve."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        p.state[CHECKS] = 0.0
        if first == 1:
            _begin(p, solver, with_momentum)
        done = 0
        while done < sweeps and not p.state[RESIDUAL] <= tolerance:
            n = ti.min(every, sweeps - done)
            for _k in range(n):
                solver.sweep(p)
                if with_momentum == 1:
                    _extrapolate(p)
                refresh(p)
            done += n
            p.state[RESIDUAL] = residual(p)
            r_factor.accept_or_reject(p, ti.cast(n, ti.f64))
            for c in range(p.count[0]):
                r_factor.apply_verdict(p, c)
            if p.state[RESIDUAL] == p.state[BEST]:
                refresh(p)


# --- on all threads ---------------------------------------------------------------------------------------------------


@kernel
def _begin_parallel(p: ti.template(), solver: ti.template(), with_momentum: ti.i32):
    for c in range(p.count[0]):
        p.relaxation[c] = solver.relaxation(p, c, with_momentum)
        p.previous[c] = p.r[c]


@ti.func
def _sum_chunk(p: ti.template(), k):
    """Sum the terms of chunk k, in order."""
    n = p.count[0]
    total = ti.Vector([0.0, 0.0], ti.f64)
    for c in range(k * n // CHUNKS, (k + 1) * n // CHUNKS):
        total += p.term[c]
    p.partial[k] = total


@ti.func
def _total(p: ti.template()):
    total = ti.Vector([0.0, 0.0], ti.f64)
    for k in range(CHUNKS):
        total += p.partial[k]
    return total


@kernel
def _check(p: ti.template(), first: ti.i32, sweeps: ti.i32):
    """Check the residual and save or restore the impulses; w must be up to date."""
    for c in range(p.count[0]):
        d, s = natural_map(p, c)
        p.term[c] = [d, s]
    for k in range(CHUNKS):
        _sum_chunk(p, k)
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
    for k in range(CHUNKS):
        _sum_chunk(p, k)
    ti.loop_config(serialize=True)
    for _ in range(1):
        p.state[CHANGED] = momentum.momentum_weight(p, _total(p)[0])
    for c in range(p.count[0]):
        momentum.extrapolate_impulse(p, c, p.state[CHANGED])


def run_parallel(
    p: ContactProblem, solver: ModuleType, first: int, sweeps: int, every: int, tolerance: float, with_momentum: int
) -> None:
    """As `run_serial`, on all threads; the host reads the residual."""
    p.state[CHECKS] = 0.0
    if first:
        find_velocities(p)
        _begin_parallel(p, solver, with_momentum)
        _check(p, 1, 0)
    done, colours = 0, int(p.count[1])
    while done < sweeps and not p.state[RESIDUAL] <= tolerance:
        n = min(every, sweeps - done)
        for _ in range(n):
            solver.sweep_parallel(p, colours)
            if with_momentum:
                _extrapolate_parallel(p)
            find_velocities(p)
        done += n
        _check(p, 0, n)
        if p.state[RESIDUAL] == p.state[BEST]:
            find_velocities(p)
