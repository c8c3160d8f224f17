"""The r-factor strategy: how large a share of the r-factors a sweep dares, and what is done when it was too much.

The share starts at 1. A look at the residual after some sweeps keeps the best impulses so far and lets the share recover, or,
where the residual has risen RISE times above theirs or has found nothing better for PATIENCE sweeps, brings them back and lowers
the share, but never below LEAST: a share that goes to zero would look like convergence (report, algorithm 2, lines 12 to
16). A smaller rise is let pass: neither Gauss-Seidel nor momentum is monotone, and going back costs more than waiting.
"""

import taichi as ti

from taisoft.contact.problem import AGE, GOOD, HISTORY, LOOKS, MOMENTUM, RESIDUAL, STEP, SWEEPS, VERDICT

# Sums of powers of two, so that they are the same numbers in f32 and f64 runs
SHRINK = 0.75  # of the share after a rise
RECOVER = 1.125  # of the share after a fall
LEAST = 0.0078125
RISE = 10.0
PATIENCE = 200.0  # sweeps
KEEP, PASS, BACK = range(3)  # verdicts


@ti.func
def record(p: ti.template()):
    """state[RESIDUAL] into the history of this launch."""
    k = ti.cast(p.state[LOOKS], ti.i32)
    if k < HISTORY:
        p.history[k] = p.state[RESIDUAL]
    p.state[LOOKS] += 1.0


@ti.func
def begin(p: ti.template()):
    """A solve begins; state[RESIDUAL] is that of the impulses it starts from, its first good ones.

    With a residual of 1 they are no better than none, and there is nothing to go back to: small impulses, with which a sweep
    from none begins, can have a residual far above 1, which is relative to them.
    """
    p.state[GOOD], p.state[STEP], p.state[SWEEPS] = p.state[RESIDUAL], 1.0, 0.0
    if not p.state[RESIDUAL] < 1.0:
        p.state[GOOD] = ti.cast(ti.math.inf, ti.f64)
    p.state[AGE], p.state[MOMENTUM], p.state[VERDICT] = 0.0, 1.0, KEEP
    record(p)


@ti.func
def accept_or_reject(p: ti.template(), sweeps):
    """After so many sweeps: state[VERDICT] on the impulses, by state[RESIDUAL]."""
    found, good = p.state[RESIDUAL], p.state[GOOD]
    record(p)
    p.state[SWEEPS] += sweeps
    p.state[AGE] += sweeps
    verdict = PASS
    if found < good:
        verdict = KEEP
        p.state[GOOD], p.state[AGE] = found, 0.0
        p.state[STEP] = ti.min(1.0, RECOVER * p.state[STEP])
    elif not (found <= RISE * good and p.state[AGE] <= PATIENCE):  # a residual that is not a number comes here too
        verdict = BACK
        p.state[RESIDUAL], p.state[AGE], p.state[MOMENTUM] = good, 0.0, 1.0
        p.state[STEP] = ti.max(LEAST, SHRINK * p.state[STEP])
    p.state[VERDICT] = verdict


@ti.func
def apply_verdict(p: ti.template(), c):
    """What the verdict asks of contact c."""
    if p.state[VERDICT] == KEEP:
        p.good[c] = p.r[c]
    elif p.state[VERDICT] == BACK:
        p.r[c] = p.good[c]
        p.trial[c] = p.good[c]
