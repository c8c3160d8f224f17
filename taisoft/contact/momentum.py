"""Momentum for sweeps of any kind: the next one starts beyond where the last has led,

    y = prox(x + (t - 1)/t' (x - x_before)),   t' = (1 + sqrt(1 + 4 t^2)) / 2,

and t goes back to 1 when the sweep from y led back, (y - x).F^-1 (x - x_before) > 0, F the r-factors. Friction makes the problem
no minimisation, so nothing is promised; the r-factor strategy catches what goes wrong. On the problems of Siconos' collection
it makes Gauss-Seidel reach 1e-6 in 20 to 670 sweeps, where plain Gauss-Seidel is at 3e-5 after 1000.
Sources: Nesterov 1983; O'Donoghue and Candes 2015 for the restart.
"""

import taichi as ti

from taisoft.contact.problem import MOMENTUM, STEP
from taisoft.contact.prox import prox


@ti.func
def restart_test(p: ti.template(), c):
    """What contact c adds to (y - x).F^-1 (x - x_before): y is `guess`, x is r, x_before is `trial`."""
    x, f = p.r[c], p.factor[c]
    back, on = p.guess[c] - x, x - p.trial[c]
    n = ti.select(f[0] > 0.0, 1.0 / f[0], 0.0)
    t = ti.select(f[1] > 0.0, 1.0 / f[1], 0.0)
    return n * back[0] * on[0] + t * (back[1] * on[1] + back[2] * on[2])


@ti.func
def momentum_weight(p: ti.template(), total):
    """(t - 1)/t' of the step beyond, times what the r-factor strategy dares; 0 after a restart. total: the sum of `against`."""
    beyond = ti.cast(0.0, ti.f64)
    t = p.state[MOMENTUM]
    if total > 0.0:
        p.state[MOMENTUM] = 1.0
    else:
        p.state[MOMENTUM] = 0.5 * (1.0 + ti.sqrt(1.0 + 4.0 * t * t))
        beyond = p.state[STEP] * (t - 1.0) / p.state[MOMENTUM]
    return beyond


@ti.func
def extrapolate_impulse(p: ti.template(), c, beyond):
    """Impulses of contact c that the next sweep starts from."""
    x = p.r[c]
    p.r[c] = prox(x + beyond * (x - p.trial[c]), p.friction[c])
    p.trial[c] = x
