"""Multiplier updates of the augmented Lagrangian, adaptation of R, and Anderson acceleration of the fixed-point iteration.

An update sets the multiplier to the resulting impulse p = prox(lambda - R u), and the friction disk's radius to friction times
its normal part: a fixed-point iteration lambda -> p. R stays while the laws' residual falls. Otherwise it is doubled after a
multiplier that took one step, and halved after one that took many, or if that residual rose: with a large R each multiplier
nearly solves the problem with frozen disks, and that iteration need not converge.
Source: Alart and Curnier 1991 for the laws as a prox; the loop is that of the method of multipliers.

Most problems, and the impacts before a step, need few multipliers. If disks and normal impulses keep changing each other
slowly, each multiplier may leave 98 % of the laws' residual. So after EXTRAPOLATE_AFTER of them (`ContactNewton`: at once if |r|
is only rounding) R becomes R_EXTRAPOLATED and stays, and multipliers are extrapolated from the last two
(Anderson 1965, in the form of Walker and Ni 2011): with f = p - lambda, the new one is p - sum t_i (p_i+1 - p_i), where t
minimises |f - sum t_i (f_i+1 - f_i)|, each entry divided by the square root of its r-factor. Problems of a Newton iteration that
stalls are never extrapolated: redundant contacts exchange impulses slowly there, which R up to MAX_R_SCALE speeds up.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.prox import dvec
from taisoft.dynamics.contact_terms import PAST, open_disk

R_SCALE, MIN_R_SCALE, MAX_R_SCALE, MANY_STEPS = 1.0, 0.3, 100.0, 5  # R over the r-factors: start, bounds; steps that halve it
LAW_INCREASE, STEADY = 1.2, 4.0  # times the previous laws' residual: above it R is halved, if larger than STEADY
LAW_DECREASE = 0.8  # times the previous laws' residual: below it R stays
MAX_MULTIPLIERS = 200
EXTRAPOLATE_AFTER = 25  # multipliers
R_EXTRAPOLATED = 5.0  # R over the r-factors from then on: iterations vary little from 5 to 7 and increase outside
FINER = 0.1  # times the |r| that ends the steps under one multiplier, from then on
MAX_EXTRAPOLATION = 100.0  # maximum extrapolation, in steps
PARALLEL = 1e-12  # squared sine between two changes below which the older one is ignored


@ti.pyfunc
def next_scale(scale, law, before, n_steps):
    """Return R over the r-factors for new multipliers.

    law, before: residual of the laws now and at the last update; n_steps: steps since. A rising residual means that friction
    disks and normal impulses increase each other.
    """
    new = scale
    if law > LAW_INCREASE * before and scale > STEADY:
        new = 0.5 * scale
    elif law > LAW_DECREASE * before:
        if n_steps <= 1:
            new = ti.min(MAX_R_SCALE, 2.0 * scale)
        elif n_steps >= MANY_STEPS:
            new = ti.max(MIN_R_SCALE, 0.5 * scale)
    return new


@ti.func
def extrapolate(k: ti.template(), n_remembered):
    """Set the multipliers to impulses extrapolated from the last n_remembered updates, 0 to PAST; store this one."""
    p, w = ti.static((k.problem, k.work))
    first, second = _coefficients(k, n_remembered)
    for c in range(p.count[0]):
        r, last, last_but_one = p.r[c], w.past_impulse[PAST * c], w.past_impulse[PAST * c + 1]
        w.past_impulse[PAST * c], w.past_impulse[PAST * c + 1] = r, last
        w.past_change[PAST * c], w.past_change[PAST * c + 1] = r - w.multiplier[c], w.past_change[PAST * c]
        if n_remembered > 0:
            r -= first * (r - last)
        if n_remembered > 1:
            r -= second * (last - last_but_one)
        r[0] = ti.max(r[0], 0.0)
        w.multiplier[c] = r
        open_disk(k, c)


@ti.func
def _coefficients(k: ti.template(), n_remembered):
    """Return the coefficients (t_1, t_2) of the last two changes."""
    p, w = ti.static((k.problem, k.work))
    dot = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0], ti.f64)  # a.a, a.b, b.b, a.f, b.f
    if n_remembered > 0:
        for c in range(p.count[0]):
            f, last = p.r[c] - w.multiplier[c], w.past_change[PAST * c]
            a, b = f - last, dvec(0.0)
            if n_remembered > 1:
                b = last - w.past_change[PAST * c + 1]
            for i in ti.static(range(3)):
                factor = p.factor[c][ti.static(min(i, 1))]
                if factor > 0.0:
                    dot += ti.Vector([a[i] * a[i], a[i] * b[i], b[i] * b[i], a[i] * f[i], b[i] * f[i]]) / factor
    first, second = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    determinant = dot[0] * dot[2] - dot[1] * dot[1]
    if determinant > PARALLEL * dot[0] * dot[2]:
        first = (dot[3] * dot[2] - dot[4] * dot[1]) / determinant
        second = (dot[4] * dot[0] - dot[3] * dot[1]) / determinant
    elif dot[0] > 0.0:
        first = dot[3] / dot[0]
    if not (ti.abs(first) < MAX_EXTRAPOLATION and ti.abs(second) < MAX_EXTRAPOLATION):
        first, second = 0.0, 0.0
    return first, second


@kernel
def extrapolate_multipliers(k: ti.template(), n_remembered: ti.i32):
    """Call `extrapolate` in a launch of its own."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        extrapolate(k, n_remembered)
