"""Frictional problem of a linearised stage on one thread: multipliers, linear solves and step lengths in one launch.

The algorithm is that of `newton.Newton`, which drives the same functions from the host for parallel loops and on CUDA. The
number of CG iterations per launch is limited, so that Ctrl-C takes effect; `loop` holds the state between launches.

Multiplier updates of the augmented Lagrangian, adaptation of R, and Anderson acceleration of the fixed-point iteration.

An update sets the multiplier to the resulting impulse p = prox(lambda - R u), and the friction disk's radius to friction times
its normal part: a fixed-point iteration lambda -> p. R stays while the laws' residual falls. Otherwise it is doubled after a
multiplier that took one step, and halved after one that took many, or if that residual rose: with a large R each multiplier
nearly solves the problem with frozen disks, and that iteration need not converge. Without friction there are no disks, and a
large R only makes linear solves harder: R then doubles after a few steps, too, and up to MAX_R_FRICTIONLESS. Contacts on both
sides of a fold around a spike need this: their impulses must grow far before the fold opens. Several such contacts at one node
depend on each other but for a part in 1e7. The next problem of a stage therefore begins where the last one left the laws open.
Once they hold, R falls.
Source: Alart and Curnier 1991 for the laws as a prox; the loop is that of the method of multipliers.

Most problems, and the impacts before a step, need few multipliers. If disks and normal impulses keep changing each other
slowly, each multiplier may leave 98 % of the laws' residual. So after EXTRAPOLATION_START of them (`ContactNewton`: at once if
|r| is only rounding) R becomes R_EXTRAPOLATED and stays, and multipliers are extrapolated from the last two
(Anderson 1965, in the form of Walker and Ni 2011): with f = p - lambda, the new one is p - sum t_i (p_i+1 - p_i), where t
minimises |f - sum t_i (f_i+1 - f_i)|, each entry divided by the square root of its r-factor. Problems of a Newton iteration that
stalls are never extrapolated: redundant contacts exchange impulses slowly there, which R up to MAX_R_SCALE speeds up.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.problem import RESIDUAL
from taisoft.contact.prox import dvec
from taisoft.dynamics.contact_terms import N_LIMITS, N_LOOP, PAST, open_disk, set_multiplier, sum_residual, update_contact
from taisoft.dynamics.linearised import contact_slope, move_node_along, node_residual, node_slope, step_length
from taisoft.linear.pcg_gauss_seidel import iterate_serial, start_serial
from taisoft.linear.pcg_work import NEGATIVE
from taisoft.linear.pcg_work import RUNNING as PCG_RUNNING

R_SCALE, MIN_R_SCALE, MAX_R_SCALE, MANY_STEPS = 1.0, 0.3, 100.0, 5  # R over the r-factors: start, bounds; steps that halve it
MAX_R_FRICTIONLESS = 1000.0  # the upper bound without friction
R_STALLED, MAX_R_STALLED = 1000.0, 1e5  # smallest first value and upper bound without friction, where the laws stalled before
EASED = 0.25  # factor on R without friction once the laws hold, so that the linear solves become easier
LAW_INCREASE, STEADY = 1.2, 4.0  # times the previous laws' residual: above it R is halved, if larger than STEADY
LAW_DECREASE = 0.8  # times the previous laws' residual: below it R stays
MAX_MULTIPLIERS = 200
EXTRAPOLATION_START = 25  # multipliers
R_EXTRAPOLATED = 5.0  # R over the r-factors from then on: iterations vary little from 5 to 7 and increase outside
FINER = 0.1  # times the |r| that ends the steps under one multiplier, from then on
MAX_EXTRAPOLATION = 100.0  # maximum extrapolation, in steps
PARALLEL = 1e-12  # squared sine between two changes below which the older one is ignored


@ti.pyfunc
def next_scale(scale, law, before, n_steps, frictionless, max_r, law_tolerance):
    """Return R over the r-factors for new multipliers.

    law, before: residual of the laws now and at the last update; n_steps: steps since. A rising residual means that friction
    disks and normal impulses increase each other. frictionless: 1 if there are no disks, so that a large R only makes the linear
    solves harder; max_r, law_tolerance: then the upper bound of R, and the residual below which the laws hold.
    """
    new = scale
    if frictionless == 1 and law <= law_tolerance:
        new = ti.max(R_SCALE, EASED * scale)
    elif frictionless == 0 and law > LAW_INCREASE * before and scale > STEADY:
        new = 0.5 * scale
    elif law > LAW_DECREASE * before:
        if n_steps <= 1 or (frictionless == 1 and n_steps < MANY_STEPS):
            new = ti.min(max_r if frictionless == 1 else MAX_R_SCALE, 2.0 * scale)
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


ROUNDING = 4.0  # times the floor: |r| that may be rounding, as strains grow (up to 2.8 times was measured, in a thin sheet)
PROGRESS = 0.3  # fraction of |r| after a multiplier update to which the inner steps reduce it

# indices into `loop`: |r|, R over the r-factors, the laws' residual at the last multiplier update, target of |r| since,
# |r| before the last step, steps since the update; totals of linear solves, their iterations, multipliers; 1 if |r| is rounding,
# 1 within a linear solve, its iterations so far, 1 if the matrix is that of the last solve, loop status, stored updates
(
    NORM,
    SCALE,
    LAW_RESIDUAL,
    INNER_TARGET,
    PREVIOUS,
    STEPS,
    SOLVES,
    LINEAR,
    MULTIPLIERS,
    AT_ROUNDING,
    IN_SOLVE,
    SOLVE_ITERATIONS,
    SAME_MATRIX,
    STATUS,
    REMEMBERED,
) = range(N_LOOP)
RUNNING, SOLVED, FAILED, INDEFINITE = range(4)
# indices into `limits`: |r| [N s] that ends the loop, that ends the steps under one multiplier, rounding floor; laws' residual
# that ends the loop, tolerance of linear solves; maximum linear solves, CG iterations per solve and per launch; multipliers
# before extrapolation; minimum tolerance of later solves; 1 if no contact has friction, upper bound of R then
(
    TARGET,
    INNER_TOLERANCE,
    FLOOR,
    LAW_TOLERANCE,
    LINEAR_TOLERANCE,
    MAX_SOLVES,
    MAX_CG_ITERATIONS,
    MAX_WORK,
    EXTRAPOLATE_AFTER,
    LATER_TOLERANCE,
    FRICTIONLESS,
    MAX_R,
) = range(N_LIMITS)


@ti.func
def _update_residual(m: ti.template(), s: ti.template(), k: ti.template(), beta, r_scale):
    """Compute impulses, blocks and the laws' residual at the present x; return |r| on the free axes."""
    for c in range(k.problem.count[0]):
        update_contact(m, k, c, beta, r_scale)
    sum_residual(k, 0, 1)
    square = ti.cast(0.0, ti.f64)
    for i in range(m.n_nodes):
        square += node_residual(m, s, k, i)
    return ti.sqrt(square)


@ti.func
def _advance(m: ti.template(), s: ti.template(), A: ti.template(), k: ti.template(), beta, r_scale):
    """Move to zero slope, as `linearised.advance`."""
    slope, curvature = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for i in range(m.n_nodes):
        slope_i, curvature_i = node_slope(m, s, A, k, 0, i)
        slope += slope_i
        curvature += curvature_i
    linear_slope = slope
    for c in range(k.problem.count[0]):
        linear_slope += contact_slope(s, k, c, beta)
    a = step_length(k, linear_slope, curvature, slope, r_scale, 0, 1)
    for i in range(m.n_nodes):
        move_node_along(m, s, k, i, a, beta)


@kernel
def solve_frictional(m: ti.template(), s: ti.template(), A: ti.template(), k: ti.template(), beta: ti.f64):
    """Continue from the state in `loop` of k.work, within its `limits`."""
    p, limits, loop = ti.static((k.problem, k.work.limits, k.work.loop))
    ti.loop_config(serialize=True)
    for _ in range(1):
        r, scale, previous_law, target, floor = loop[NORM], loop[SCALE], loop[LAW_RESIDUAL], limits[TARGET], limits[FLOOR]
        inner_target, previous, n_steps, rounding = loop[INNER_TARGET], loop[PREVIOUS], loop[STEPS], loop[AT_ROUNDING]
        work, max_work, max_cg, status = 0, ti.cast(limits[MAX_WORK], ti.i32), ti.cast(limits[MAX_CG_ITERATIONS], ti.i32), RUNNING
        while status == RUNNING and work < max_work:
            renewed, moved = False, False
            law = p.state[RESIDUAL]
            extrapolating = loop[MULTIPLIERS] >= limits[EXTRAPOLATE_AFTER]
            inner_tolerance = limits[INNER_TOLERANCE] * (FINER if extrapolating else 1.0)
            laws_hold, inner_done = law <= limits[LAW_TOLERANCE], r <= ti.max(inner_tolerance, inner_target) or rounding == 1.0
            if loop[IN_SOLVE] == 0.0 and (inner_done or (laws_hold and r <= target)):
                if laws_hold and (r <= ti.max(target, floor) or rounding == 1.0):
                    status = SOLVED
                elif loop[MULTIPLIERS] >= MAX_MULTIPLIERS:
                    status = FAILED
                else:
                    if extrapolating:
                        extrapolate(k, ti.cast(loop[REMEMBERED], ti.i32))
                        scale, loop[REMEMBERED] = R_EXTRAPOLATED, ti.min(loop[REMEMBERED] + 1.0, PAST)
                    else:
                        frictionless = ti.cast(limits[FRICTIONLESS], ti.i32)
                        scale = next_scale(scale, law, previous_law, n_steps, frictionless, limits[MAX_R], limits[LAW_TOLERANCE])
                        for c in range(p.count[0]):
                            set_multiplier(k, c)
                    previous_law = law
                    previous, n_steps, renewed = 0.0, 0.0, True
                    loop[MULTIPLIERS] = loop[MULTIPLIERS] + 1.0
                work += 1
            elif loop[IN_SOLVE] == 0.0 and loop[SOLVES] >= limits[MAX_SOLVES]:
                status = FAILED
            else:
                if loop[IN_SOLVE] == 0.0:
                    start_serial(m, A, k.coupling, s.pcg, ti.cast(loop[SAME_MATRIX], ti.i32))
                    loop[SAME_MATRIX] = 1.0
                    loop[SOLVE_ITERATIONS] = 0.0
                n = ti.min(max_work - work, max_cg - ti.cast(loop[SOLVE_ITERATIONS], ti.i32))
                tolerance = limits[LINEAR_TOLERANCE]
                if loop[SOLVES] > 0.0:
                    tolerance = ti.max(tolerance, limits[LATER_TOLERANCE])
                count, stop = iterate_serial(m, A, k.coupling, s.pcg, n, tolerance)
                loop[SOLVE_ITERATIONS] = loop[SOLVE_ITERATIONS] + count
                loop[LINEAR] = loop[LINEAR] + count
                work += count + 1
                loop[IN_SOLVE] = 0.0
                if stop == PCG_RUNNING and loop[SOLVE_ITERATIONS] < max_cg:
                    loop[IN_SOLVE] = 1.0
                else:
                    loop[SOLVES] = loop[SOLVES] + 1.0
                    n_steps += 1.0
                    previous = r
                    if stop == NEGATIVE:
                        status = INDEFINITE
                    else:
                        _advance(m, s, A, k, beta, scale)
                        moved = True
            if renewed or moved:
                r = _update_residual(m, s, k, beta, scale)
                rounding = 1.0 if moved and r <= ROUNDING * floor and r > 0.5 * previous else 0.0
                if renewed:
                    inner_target = PROGRESS * r
                elif not r < ti.math.inf:
                    status = FAILED
        loop[NORM], loop[SCALE], loop[LAW_RESIDUAL] = r, scale, previous_law
        loop[INNER_TARGET], loop[PREVIOUS], loop[STEPS], loop[AT_ROUNDING], loop[STATUS] = (
            inner_target,
            previous,
            n_steps,
            rounding,
            status,
        )
