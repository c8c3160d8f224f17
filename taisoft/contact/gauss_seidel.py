"""Serial Gauss-Seidel (report, algorithm 2): one contact after another, using the impulses already updated.

All sweeps run in one kernel on one thread, in the order of `ContactProblem.order`.
"""

import taichi as ti

from taisoft.contact import r_factor_bounds as bounds
from taisoft.contact.problem import STEP, add_impulse, velocity
from taisoft.contact.prox import prox, scaled


@ti.func
def relaxation(p: ti.template(), c, with_momentum):
    """Fraction of its r-factors that contact c uses: 1 without momentum; less with it, since it amplifies overshoot."""
    result = ti.cast(1.0, ti.f64)
    if with_momentum == 1:
        result = bounds.sequential(p, c)
    return result


@ti.func
def relax(p: ti.template(), c):
    """Apply one prox step to contact c and add the change of its impulse to its nodes."""
    r = p.r[c]
    p.sweep_start[c] = r
    new = prox(r - scaled(p.state[STEP] * p.relaxation[c] * p.factor[c], velocity(p, c)), p.friction[c])
    add_impulse(p, c, new - r)
    p.r[c] = new


@ti.func
def sweep(p: ti.template()):
    """Relax every contact once, on this thread."""
    for k in range(p.count[0]):
        relax(p, p.order[k])
