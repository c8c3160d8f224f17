"""Frictional problem of a linearised stage: min over s of s.A s / 2 + g.s + sum_c psi_c(lambda - R u(s)), A fixed.

Linear solves and multiplier updates of the augmented Lagrangian, adaptation of R, and Anderson acceleration of the fixed-point
iteration.

An update sets the multiplier to the resulting impulse p = prox(lambda - R u), and the friction disk's radius to friction times
its normal part: a fixed-point iteration lambda -> p. R stays while the laws' residual falls. Otherwise it is doubled after a
multiplier that took one step, and halved after one that took many, or if that residual rose: with a large R each multiplier
nearly solves the problem with frozen disks, and that iteration need not converge. Without friction there are no disks, and a
large R only makes linear solves harder: R then doubles after a few steps, too, and up to `Stage.max_r_scale`. Contacts on both
sides of a fold around a spike need this: their impulses must grow far before the fold opens. Several such contacts at one node
depend on each other but for a part in 1e7. The next problem of a stage therefore begins where the last one left the laws open.
Once they hold, R falls.
Source: Alart and Curnier 1991 for the laws as a prox; the loop is that of the method of multipliers.

Most problems, and the impacts before a step, need few multipliers. If disks and normal impulses keep changing each other
slowly, each multiplier may leave 98 % of the laws' residual. So after `Stage.extrapolate_after` of them (`ContactNewton`: at once
if |r| is only rounding) R becomes R_EXTRAPOLATED and stays, and multipliers are extrapolated from the last two
(Anderson 1965, in the form of Walker and Ni 2011): with f = p - lambda, the new one is p - sum t_i (p_i+1 - p_i), where t
minimises |f - sum t_i (f_i+1 - f_i)|, each entry divided by the square root of its r-factor. Problems of a Newton iteration that
stalls are never extrapolated: redundant contacts exchange impulses slowly there, which R up to MAX_R speeds up.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.prox import dvec
from taisoft.dynamics.contact_terms import PAST, open_disk
from taisoft.dynamics.stage import Stage
from taisoft.dynamics.stage_system import StageSystem

MAX_EXTRAPOLATION = 100.0  # in steps
PARALLEL = 1e-12  # squared sine between two changes below which the older one is ignored


@dataclass(frozen=True)
class FrictionalResult:
    """Result of solving a linearised stage. negative: its matrix is indefinite; direct: iterations did not solve it."""

    solves: int
    linear: int
    multipliers: int
    negative: bool
    converged: bool
    r: float
    r_scale: float = Stage.first_r_scale  # R over the r-factors at its end
    direct: bool = False


class Friction:
    """Solver of frictional problems."""

    PROGRESS = 0.3  # fraction of |r| after a multiplier update to which the inner steps reduce it
    FINER = 0.1  # times the |r| that ends the steps under one multiplier, once multipliers are extrapolated
    ROUNDING = 4.0  # times the floor: |r| that may be rounding, as strains grow (up to 2.8 times was measured, in a thin sheet)
    MAX_MULTIPLIERS = 200
    R_EXTRAPOLATED = 5.0  # R over the r-factors from then on: iterations vary little from 5 to 7 and increase outside
    MIN_R, MAX_R, MANY_STEPS = 0.3, 100.0, 5  # bounds of R over the r-factors; steps that halve it
    EASED = 0.25  # factor on R without friction once the laws hold, so that the linear solves become easier
    LAW_INCREASE, STEADY = 1.2, 4.0  # times the previous laws' residual: above it R is halved, if larger than STEADY
    LAW_DECREASE = 0.8  # times the previous laws' residual: below it R stays

    @classmethod
    def solve(cls, system: StageSystem, problem: Stage, r: float, stalled: bool = False) -> FrictionalResult:
        """Solve from |r| by linear solves, each followed by the step to zero slope, and multiplier updates.

        Directly where that applies, and if these fail. problem: with a linear_tolerance, and its other tolerances relative to the
        system's present scale; stalled: iterations have failed on the stage's last problem.
        """
        if (found := cls._solve_directly(system, problem, r, stalled)) is not None:
            return found
        if problem.first_r_scale != system.r_scale:
            r = system.update_multipliers(problem.first_r_scale, to_impulses=False)
        target, least_inner = problem.tolerance * system.scale, problem.inner_tolerance * system.scale
        scale, law_before, n_steps, n_stored, rounding = problem.first_r_scale, math.inf, 0, 0, False
        solves = linear = multipliers = 0
        inner_target, negative, converged = cls.PROGRESS * r, False, False
        while True:
            law, extrapolating = system.contact_residual, multipliers >= problem.extrapolate_after
            holds = law <= problem.contact_tolerance
            is_inner_done = r <= max(least_inner * (cls.FINER if extrapolating else 1.0), inner_target) or rounding
            if is_inner_done or (holds and r <= target):
                converged = holds and (r <= max(target, system.floor) or rounding)
                if converged or multipliers >= cls.MAX_MULTIPLIERS:
                    break
                if extrapolating:
                    extrapolate_multipliers(system.contacts, n_stored)
                    scale, n_stored = cls.R_EXTRAPOLATED, min(n_stored + 1, PAST)
                else:
                    bounds = problem.max_r_scale, problem.contact_tolerance
                    scale = cls.next_scale(scale, law, law_before, n_steps, system.frictionless, *bounds)
                r = system.update_multipliers(scale, to_impulses=not extrapolating)
                law_before, n_steps, rounding, inner_target, multipliers = law, 0, False, cls.PROGRESS * r, multipliers + 1
            elif solves >= problem.max_newton:
                break
            else:
                found = system.solve_linear(max(problem.linear_tolerance, problem.later_tolerance if solves else 0.0))
                solves, linear, n_steps = solves + 1, linear + found.iterations, n_steps + 1
                if negative := found.negative:
                    break
                before, r = r, system.advance(scale)
                if not r < math.inf:
                    break
                rounding = r <= cls.ROUNDING * system.floor and r > 0.5 * before
        system.r_scale = Stage.first_r_scale
        if not (converged or negative or stalled):
            if (found := cls._solve_directly(system, problem, r, stalled=True)) is not None:
                return replace(found, solves=solves + 1, linear=linear, multipliers=multipliers)
        return FrictionalResult(solves, linear, multipliers, negative, converged, r, scale)

    @staticmethod
    def _solve_directly(system: StageSystem, problem: Stage, r: float, stalled: bool) -> FrictionalResult | None:
        """Return the result of a direct solve, None if that does not apply."""
        try:
            found = system.solve_directly(problem.contact_tolerance, stalled)
        except np.linalg.LinAlgError:
            return FrictionalResult(1, 0, 0, True, False, r)
        if found is None:
            return None
        iterations, converged, r = found
        return FrictionalResult(1, 0, iterations, False, converged, r, direct=True)

    @classmethod
    def next_scale(
        cls, scale: float, law: float, before: float, n_steps: int, frictionless: bool, max_r: float, law_tolerance: float
    ) -> float:
        """Return R over the r-factors for new multipliers.

        law, before: residual of the laws now and at the last update; n_steps: steps since. A rising residual means that friction
        disks and normal impulses increase each other. frictionless: there are no disks, so that a large R only makes the linear
        solves harder; max_r, law_tolerance: then the upper bound of R, and the residual below which the laws hold.
        """
        if frictionless and law <= law_tolerance:
            return max(Stage.first_r_scale, cls.EASED * scale)
        if not frictionless and law > cls.LAW_INCREASE * before and scale > cls.STEADY:
            return 0.5 * scale
        if law > cls.LAW_DECREASE * before:
            if n_steps <= 1 or (frictionless and n_steps < cls.MANY_STEPS):
                return min(max_r if frictionless else cls.MAX_R, 2.0 * scale)
            if n_steps >= cls.MANY_STEPS:
                return max(cls.MIN_R, 0.5 * scale)
        return scale


@ti.func
def _coefficients(contacts: ti.template(), n_remembered):
    """Return the coefficients (t_1, t_2) of the last two changes."""
    rows, work = ti.static((contacts.problem, contacts.work))
    dot = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0], ti.f64)  # a.a, a.b, b.b, a.f, b.f
    if n_remembered > 0:
        for c in range(rows.count[0]):
            f, last = rows.r[c] - work.multiplier[c], work.past_change[PAST * c]
            a, b = f - last, dvec(0.0)
            if n_remembered > 1:
                b = last - work.past_change[PAST * c + 1]
            for i in ti.static(range(3)):
                factor = rows.factor[c][ti.static(min(i, 1))]
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
def extrapolate_multipliers(contacts: ti.template(), n_remembered: ti.i32):
    """Set the multipliers to impulses extrapolated from the last n_remembered updates, 0 to PAST; store this one."""
    rows, work = ti.static((contacts.problem, contacts.work))
    ti.loop_config(serialize=True)
    for _ in range(1):
        first, second = _coefficients(contacts, n_remembered)
        for c in range(rows.count[0]):
            r, last, last_but_one = rows.r[c], work.past_impulse[PAST * c], work.past_impulse[PAST * c + 1]
            work.past_impulse[PAST * c], work.past_impulse[PAST * c + 1] = r, last
            work.past_change[PAST * c], work.past_change[PAST * c + 1] = r - work.multiplier[c], work.past_change[PAST * c]
            if n_remembered > 0:
                r -= first * (r - last)
            if n_remembered > 1:
                r -= second * (last - last_but_one)
            r[0] = ti.max(r[0], 0.0)
            work.multiplier[c] = r
            open_disk(contacts, c)
