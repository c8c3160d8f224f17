"""The r-factor strategy: adapt the fraction of the r-factors that a sweep uses.

The fraction starts at 1. A residual check after some sweeps saves the impulses if they are the best so far and lets the fraction
recover. If the residual exceeds MAX_GROWTH times the best one, or has not improved for PATIENCE sweeps, the best impulses are
restored and the fraction is lowered, but never below MIN_FRACTION: a fraction that tends to zero would look like convergence
(report, algorithm 2, lines 12 to 16). Smaller growth is accepted: neither Gauss-Seidel nor momentum is monotone, and restoring
costs more than waiting.
"""

import taichi as ti

from taisoft.contact.problem import AGE, BEST, CHECKS, HISTORY, MOMENTUM, RESIDUAL, STEP, SWEEPS, VERDICT

# Sums of powers of two: the same numbers in f32 and f64
SHRINK = 0.75  # of the fraction when impulses are restored
RECOVER = 1.125  # of the fraction when the residual falls
MIN_FRACTION = 0.0078125
MAX_GROWTH = 10.0
PATIENCE = 200.0  # sweeps
SAVE, CONTINUE, RESTORE = range(3)  # verdicts


@ti.func
def record(p: ti.template()):
    """Append state[RESIDUAL] to the history of this launch."""
    k = ti.cast(p.state[CHECKS], ti.i32)
    if k < HISTORY:
        p.history[k] = p.state[RESIDUAL]
    p.state[CHECKS] += 1.0


@ti.func
def begin(p: ti.template()):
    """Initialise a solve; state[RESIDUAL] is that of the initial impulses, the first best ones.

    If it is 1 or more, they are no better than zero impulses and are not saved. (A first sweep from zero yields small impulses,
    whose residual can be far above 1, since it is relative to them.)
    """
    p.state[BEST], p.state[STEP], p.state[SWEEPS] = p.state[RESIDUAL], 1.0, 0.0
    if not p.state[RESIDUAL] < 1.0:
        p.state[BEST] = ti.cast(ti.math.inf, ti.f64)
    p.state[AGE], p.state[MOMENTUM], p.state[VERDICT] = 0.0, 1.0, SAVE
    record(p)


@ti.func
def accept_or_reject(p: ti.template(), sweeps):
    """Set state[VERDICT] from state[RESIDUAL] after the given number of sweeps."""
    residual, best = p.state[RESIDUAL], p.state[BEST]
    record(p)
    p.state[SWEEPS] += sweeps
    p.state[AGE] += sweeps
    verdict = CONTINUE
    if residual < best:
        verdict = SAVE
        p.state[BEST], p.state[AGE] = residual, 0.0
        p.state[STEP] = ti.min(1.0, RECOVER * p.state[STEP])
    elif not (residual <= MAX_GROWTH * best and p.state[AGE] <= PATIENCE):  # also if the residual is not a number
        verdict = RESTORE
        p.state[RESIDUAL], p.state[AGE], p.state[MOMENTUM] = best, 0.0, 1.0
        p.state[STEP] = ti.max(MIN_FRACTION, SHRINK * p.state[STEP])
    p.state[VERDICT] = verdict


@ti.func
def apply_verdict(p: ti.template(), c):
    """Save or restore the impulse of contact c by the verdict."""
    if p.state[VERDICT] == SAVE:
        p.best[c] = p.r[c]
    elif p.state[VERDICT] == RESTORE:
        p.r[c] = p.best[c]
        p.previous[c] = p.best[c]
