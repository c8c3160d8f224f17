"""Momentum, and the strategy of the r-factors: what happens to the impulses between two sweeps.

Nesterov momentum follows any kind of sweep. The next one starts from the extrapolated impulses
    y = prox(x + (t - 1)/t' (x - x_before)),   t' = (1 + sqrt(1 + 4 t^2)) / 2,
and t is reset to 1 if the sweep from y went backwards, (y - x).F^-1 (x - x_before) > 0, F the r-factors. With friction the
problem is not a minimisation, so convergence is not guaranteed; the r-factor strategy restores the best impulses after a failure.
On the problems of Siconos' collection Gauss-Seidel with momentum reaches 1e-6 in 20 to 670 sweeps; without, it is at 3e-5 after
1000.

The r-factor strategy adapts the fraction of the r-factors that a sweep uses, from 1 at the start. A residual check after some
sweeps saves the impulses if they are the best so far and lets the fraction recover. If the residual exceeds MAX_GROWTH times the
best one, or has not improved for PATIENCE sweeps, the best impulses are restored and the fraction is lowered, but never below
MIN_FRACTION: a fraction that tends to zero would look like convergence (report, algorithm 2, lines 12 to 16). Smaller growth is
accepted: neither Gauss-Seidel nor momentum is monotone, and restoring costs more than waiting.
Sources: Nesterov 1983; O'Donoghue and Candes 2015 for the restart.
"""

import taichi as ti

from taisoft.contact.problem import (
    AGE,
    BEST,
    CHECKS,
    HISTORY,
    MOMENTUM,
    RESIDUAL,
    STEP,
    SWEEPS,
    VERDICT,
    WEIGHT,
    natural_map,
    residual_of,
)
from taisoft.contact.prox import prox

# Sums of powers of two: the same numbers in f32 and f64
SHRINK = 0.75  # of the fraction when impulses are restored
RECOVER = 1.125  # of the fraction when the residual falls
MIN_FRACTION = 0.0078125
MAX_GROWTH = 10.0
PATIENCE = 200.0  # sweeps
SAVE, CONTINUE, RESTORE = range(3)  # verdicts


@ti.func
def residual_terms(problem: ti.template(), c, first):
    """`natural_map` of contact c; find out whether it is idle, unless it is the first check."""
    found = natural_map(problem, c)
    problem.sweep.idle[c] = int(first == 0 and (found == 0.0).all())
    return found


@ti.func
def move_on(problem: ti.template(), c):
    """Extrapolate the impulse of contact c by the weight."""
    x = problem.r[c]
    problem.r[c] = prox(x + problem.sweep.state[WEIGHT] * (x - problem.sweep.previous[c]), problem.friction[c])
    problem.sweep.previous[c] = x


@ti.func
def restart_test(problem: ti.template(), c):
    """Contribution of contact c to (y - x).F^-1 (x - x_before): y is `sweep_start`, x is `r`, x_before is `previous`."""
    x, f = problem.r[c], problem.factor[c]
    backward, forward = problem.sweep.sweep_start[c] - x, x - problem.sweep.previous[c]
    n = ti.select(f[0] > 0.0, 1.0 / f[0], 0.0)
    t = ti.select(f[1] > 0.0, 1.0 / f[1], 0.0)
    return n * backward[0] * forward[0] + t * (backward[1] * forward[1] + backward[2] * forward[2])


@ti.func
def set_weight(problem: ti.template(), total):
    """Set the weight to (t - 1)/t' times the strategy's fraction, or 0 to restart. total: sum of `restart_test`."""
    t = problem.sweep.state[MOMENTUM]
    problem.sweep.state[MOMENTUM], problem.sweep.state[WEIGHT] = 1.0, 0.0
    if not total > 0.0:
        problem.sweep.state[MOMENTUM] = 0.5 * (1.0 + ti.sqrt(1.0 + 4.0 * t * t))
        problem.sweep.state[WEIGHT] = problem.sweep.state[STEP] * (t - 1.0) / problem.sweep.state[MOMENTUM]


@ti.func
def judge(problem: ti.template(), sums, first, sweeps):
    """Set the residual and the verdict from the sums of `natural_map` over the contacts."""
    problem.sweep.state[RESIDUAL] = residual_of(sums)
    if first == 1:
        _begin(problem)
    else:
        _accept_or_reject(problem, sweeps)


@ti.func
def _begin(problem: ti.template()):
    """Initialise a solve; state[RESIDUAL] is that of the initial impulses, the first best ones.

    If it is 1 or more, they are no better than zero impulses and are not saved. (A first sweep from zero yields small impulses,
    whose residual can be far above 1, since it is relative to them.)
    """
    problem.sweep.state[BEST], problem.sweep.state[STEP], problem.sweep.state[SWEEPS] = problem.sweep.state[RESIDUAL], 1.0, 0.0
    if not problem.sweep.state[RESIDUAL] < 1.0:
        problem.sweep.state[BEST] = ti.cast(ti.math.inf, ti.f64)
    problem.sweep.state[AGE], problem.sweep.state[MOMENTUM], problem.sweep.state[VERDICT] = 0.0, 1.0, SAVE
    _record(problem)


@ti.func
def _record(problem: ti.template()):
    """Append state[RESIDUAL] to the history of this launch."""
    k = ti.cast(problem.sweep.state[CHECKS], ti.i32)
    if k < HISTORY:
        problem.sweep.history[k] = problem.sweep.state[RESIDUAL]
    problem.sweep.state[CHECKS] += 1.0


@ti.func
def _accept_or_reject(problem: ti.template(), sweeps):
    """Set state[VERDICT] from state[RESIDUAL] after the given number of sweeps."""
    residual, best = problem.sweep.state[RESIDUAL], problem.sweep.state[BEST]
    _record(problem)
    problem.sweep.state[SWEEPS] += sweeps
    problem.sweep.state[AGE] += sweeps
    problem.sweep.state[VERDICT] = CONTINUE
    if residual < best:
        problem.sweep.state[VERDICT] = SAVE
        problem.sweep.state[BEST], problem.sweep.state[AGE] = residual, 0.0
        problem.sweep.state[STEP] = ti.min(1.0, RECOVER * problem.sweep.state[STEP])
    elif not (residual <= MAX_GROWTH * best and problem.sweep.state[AGE] <= PATIENCE):  # also if the residual is not a number
        problem.sweep.state[VERDICT] = RESTORE
        problem.sweep.state[RESIDUAL], problem.sweep.state[AGE], problem.sweep.state[MOMENTUM] = best, 0.0, 1.0
        problem.sweep.state[STEP] = ti.max(MIN_FRACTION, SHRINK * problem.sweep.state[STEP])


@ti.func
def apply_verdict(problem: ti.template(), c):
    """Save or restore the impulse of contact c by the verdict."""
    if problem.sweep.state[VERDICT] == SAVE:
        problem.sweep.best[c] = problem.r[c]
    elif problem.sweep.state[VERDICT] == RESTORE:
        problem.sweep.idle[c] = 0
        problem.r[c] = problem.sweep.best[c]
        problem.sweep.previous[c] = problem.sweep.best[c]
