"""Serial Gauss-Seidel (report, algorithm 2): contact after contact, each with the impulses of those before it.

All sweeps run in one kernel on one thread, in the order of `ContactProblem.order`.
"""

import taichi as ti

from taisoft.contact import r_factor_bounds as bounds
from taisoft.contact.problem import STEP, add_impulse, velocity
from taisoft.contact.prox import prox, scaled


@ti.func
def relaxation(p: ti.template(), c, beyond):
    """Share of its r-factors that contact c takes: all of them without momentum, which forgives no overshooting."""
    result = ti.cast(1.0, ti.f64)
    if beyond == 1:
        result = bounds.sequential(p, c)
    return result


@ti.func
def relax(p: ti.template(), c):
    """One prox of contact c with its share of the r-factors, told to its nodes."""
    r = p.r[c]
    p.guess[c] = r
    new = prox(r - scaled(p.state[STEP] * p.relaxation[c] * p.factor[c], velocity(p, c)), p.friction[c])
    add_impulse(p, c, new - r)
    p.r[c] = new


@ti.func
def sweep(p: ti.template()):
    """Every contact once, on this thread."""
    for k in range(p.count[0]):
        relax(p, p.order[k])
