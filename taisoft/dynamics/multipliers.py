"""How the multipliers of an augmented Lagrangian are renewed, and R with them: Anderson acceleration of a fixed-point iteration.

A multiplier becomes the impulse p = prox(lambda - R u) that it led to, and the friction disk opens as far as that says. That is
a fixed-point iteration lambda -> p. R stays while the laws' residual falls. Else it doubles after a multiplier that took one
step, and is halved after one that took many, or that left more of that residual: with a large R each multiplier nearly solves the
problem with frozen disks, an iteration that need not converge.
Source: Alart and Curnier 1991 for the laws as a prox; the loop is that of the method of multipliers.

Most problems, and the impacts before a step, need a few multipliers. Where disks and normal impulses go on to change each other
by little, each multiplier may leave 98 % of the laws' residual. So after EXTRAPOLATE_AFTER of them (`ContactNewton`: at once
where only rounding is left of |r|) R becomes R_EXTRAPOLATED and stays, and multipliers are extrapolated from the last two
(Anderson 1965, in the form of Walker and Ni 2011): with f = p - lambda, the new one is p - sum t_i (p_i+1 - p_i), where t makes
|f - sum t_i (f_i+1 - f_i)| least, each entry over the square root of its r-factor.
"""

import taichi as ti

from taisoft.contact.prox import dvec
from taisoft.dynamics.contact_terms import PAST, open_disk
from taisoft.runtime import kernel

R_SCALE, SOFTEST, STIFFEST, MANY = 1.0, 0.3, 100.0, 5  # R over the r-factors at first and its bounds; steps that are many
RISEN_LAW, STEADY = 1.2, 4.0  # times the laws' residual of before: R is too large, unless it is below that
FALLEN_LAW = 0.8  # times the laws' residual of before: R serves
MAX_MULTIPLIERS = 200
EXTRAPOLATE_AFTER = 25  # multipliers
R_EXTRAPOLATED = 5.0  # over the r-factors, from then on: iterations vary little from 5 to 7, and are more beside that
FINER = 0.1  # times the |r| that ends the steps under one multiplier, from then on
FARTHEST = 100.0  # that an extrapolation goes, in steps
PARALLEL = 1e-12  # sine squared between two changes below which one says nothing new


@ti.pyfunc
def next_scale(scale, law, before, taken):
    """R over the r-factors for new multipliers. law, before: residual of the laws, and where multipliers were last renewed.

    taken: steps since. A residual that rises tells that friction disks and normal impulses drive each other up.
    """
    new = scale
    if law > RISEN_LAW * before and scale > STEADY:
        new = 0.5 * scale
    elif law > FALLEN_LAW * before:
        if taken <= 1:
            new = ti.min(STIFFEST, 2.0 * scale)
        elif taken >= MANY:
            new = ti.max(SOFTEST, 0.5 * scale)
    return new


@ti.func
def extrapolate(k: ti.template(), known):
    """Impulses, extrapolated from so many renewals before, 0 to PAST, become the multipliers; this one is remembered."""
    p, w = ti.static((k.problem, k.work))
    first, second = _coefficients(k, known)
    for c in range(p.count[0]):
        r, last, last_but_one = p.r[c], w.past_impulse[PAST * c], w.past_impulse[PAST * c + 1]
        w.past_impulse[PAST * c], w.past_impulse[PAST * c + 1] = r, last
        w.past_change[PAST * c], w.past_change[PAST * c + 1] = r - w.multiplier[c], w.past_change[PAST * c]
        if known > 0:
            r -= first * (r - last)
        if known > 1:
            r -= second * (last - last_but_one)
        r[0] = ti.max(r[0], 0.0)
        w.multiplier[c] = r
        open_disk(k, c)


@ti.func
def _coefficients(k: ti.template(), known):
    """(t_1, t_2) of the last change and the one before it."""
    p, w = ti.static((k.problem, k.work))
    dot = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0], ti.f64)  # a.a, a.b, b.b, a.f, b.f
    if known > 0:
        for c in range(p.count[0]):
            f, last = p.r[c] - w.multiplier[c], w.past_change[PAST * c]
            a, b = f - last, dvec(0.0)
            if known > 1:
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
    if not (ti.abs(first) < FARTHEST and ti.abs(second) < FARTHEST):
        first, second = 0.0, 0.0
    return first, second


@kernel
def extrapolate_multipliers(k: ti.template(), known: ti.i32):
    """`extrapolate` in a launch of its own."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        extrapolate(k, known)
