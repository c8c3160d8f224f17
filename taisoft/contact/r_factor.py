"""The r-factor strategy: how large a share of the r-factors a sweep dares, and what is done when it was too much.

The share starts at 1. A look at the residual after some sweeps either keeps the impulses as the last good ones, and lets the share
recover, or, where the residual has grown, brings the last good ones back and lowers the share, but never below LEAST: a share
that goes to zero would look like convergence (report, algorithm 2, lines 12 to 16).
"""

import taichi as ti

from taisoft.contact.problem import GOOD, HISTORY, LOOKS, RESIDUAL, STEP, SWEEPS

SHRINK = 0.6  # of the share after a rise
RECOVER = 1.05  # of the share after a fall
LEAST = 1e-2
GROWTH = 1.2  # a rise of the residual by less is no divergence: Gauss-Seidel is not monotone


@ti.func
def begin(p: ti.template()):
    """The impulses that a solve starts from are its first good ones; state[RESIDUAL] is theirs."""
    for c in range(p.count[0]):
        p.good[c] = p.r[c]
    p.state[GOOD], p.state[STEP], p.state[SWEEPS] = p.state[RESIDUAL], 1.0, 0.0
    p.history[0] = p.state[RESIDUAL]
    p.state[LOOKS] = 1.0


@ti.func
def look(p: ti.template()):
    """Judge the impulses by state[RESIDUAL]. Returns 1 where the good ones came back, so that w must be found anew."""
    found, good = p.state[RESIDUAL], p.state[GOOD]
    k = ti.cast(p.state[LOOKS], ti.i32)
    if k < HISTORY:
        p.history[k] = found
    p.state[LOOKS] += 1.0
    back = 0
    if found <= GROWTH * good or good == 0.0:
        for c in range(p.count[0]):
            p.good[c] = p.r[c]
        p.state[GOOD] = found
        p.state[STEP] = ti.min(1.0, RECOVER * p.state[STEP])
    else:  # a residual that is not a number comes here too
        back = 1
        for c in range(p.count[0]):
            p.r[c] = p.good[c]
        p.state[RESIDUAL] = good
        p.state[STEP] = ti.max(LEAST, SHRINK * p.state[STEP])
    return back
