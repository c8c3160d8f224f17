"""Frictional problem of a linearised stage: min over s of s.A s / 2 + g.s + sum_c psi_c(lambda - R u(s)), A fixed.

Linear solves and multiplier updates of the augmented Lagrangian, adaptation of R, and Anderson acceleration of the fixed-point
iteration.

An update sets the multiplier to the resulting impulse p = prox(lambda - R u), and the friction disk's radius to friction times
its normal part: a fixed-point iteration lambda -> p. R stays while the laws' residual falls. Otherwise it is doubled after a
multiplier that took one step, and halved after one that took many, or if that residual rose: with a large R each multiplier
nearly solves the problem with frozen disks, and that iteration need not converge. Without friction there are no disks, and a
large R only makes linear solves harder: R then doubles after a few steps, too, and up to `Goal.max_r_scale`. Contacts on both
sides of a fold around a spike need this: their impulses must grow far before the fold opens. Several such contacts at one node
depend on each other but for a part in 1e7. If a problem leaves the laws open, the stage's next one therefore begins with its R.
Once they hold, R falls.
Source: Alart and Curnier 1991 for the laws as a prox; the loop is that of the method of multipliers.

Most problems, and the impacts before a step, need few multipliers. If disks and normal impulses keep changing each other
slowly, each multiplier may leave 98 % of the laws' residual. So after `Goal.plain` of them (at once if |r| is only
rounding) R becomes R_EXTRAPOLATED and stays, and multipliers are extrapolated from the last two
(Anderson 1965, in the form of Walker and Ni 2011): with f = p - lambda, the new one is p - sum t_i (p_i+1 - p_i), where t
minimises |f - sum t_i (f_i+1 - f_i)|, each entry divided by the square root of its r-factor. Without friction, problems after
one that left the laws open are not extrapolated (`FrictionalProblems`).
"""

import math
from typing import NamedTuple

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.prox import dvec
from taisoft.dynamics.contact_terms import PAST, open_disk
from taisoft.dynamics.stage_system import StageSystem

FIRST_R, MAX_R_FRICTIONLESS = 1.0, 1000.0  # R over the r-factors at first; its upper bound without friction
PLAIN = 25  # updates of the multipliers before they are extrapolated
MAX_EXTRAPOLATION = 100.0  # in steps
PARALLEL = 1e-12  # squared sine between two changes below which the older one is ignored


class Goal(NamedTuple):
    """To what a frictional problem is solved."""

    norm: float  # |r| [N s]
    law: float  # residual of the contact laws
    inner: float  # |r| that ends the steps under one multiplier, whatever PROGRESS [N s]
    forcing: float  # tolerance of the first linear solve,
    later: float = 0.0  # and its minimum for the others
    plain: int = PLAIN
    max_solves: int = 60
    r_scale: float = FIRST_R
    max_r_scale: float = MAX_R_FRICTIONLESS


class Solution(NamedTuple):
    """Solution of a frictional problem. negative: its matrix is indefinite; direct: it was solved directly."""

    solves: int
    linear: int
    updates: int  # of the multipliers
    negative: bool
    converged: bool
    r: float
    r_scale: float = FIRST_R  # R over the r-factors at its end
    direct: bool = False


class Friction:
    """Solver of frictional problems."""

    PROGRESS = 0.3  # fraction of |r| after an update of the multipliers to which the steps under it reduce |r|
    FINER = 0.1  # times the |r| that ends the steps under one multiplier, once multipliers are extrapolated
    ROUNDING = 6.0  # times the floor: |r| that may be rounding, as strains grow (4.6 times was measured, in a quadratic cloth)
    MAX_UPDATES = 200
    LEAST_SOLVES = 5  # out of time, too: with 1 energies rise, with 3 bodies are held back thrice as often
    R_EXTRAPOLATED = 5.0  # R over the r-factors from then on: iterations vary little from 5 to 7 and increase outside
    MIN_R, MAX_R, MANY_STEPS = 0.3, 100.0, 5  # bounds of R over the r-factors; steps that halve it
    EASED = 0.25  # factor on R without friction once the laws hold, so that the linear solves become easier
    LAW_INCREASE, STEADY = 1.2, 4.0  # times the previous laws' residual: above it R is halved, if larger than STEADY
    LAW_DECREASE = 0.8  # times the previous laws' residual: below it R stays

    @classmethod
    def solve(cls, system: StageSystem, goal: Goal, r: float, directly: bool = False) -> Solution:
        """Solve from |r| by linear solves, each followed by the step to zero slope, and updates of the multipliers.

        Directly where that applies, and once these have taken longer. directly: at once.
        """
        if (directly or system.is_rigid) and (found := cls._solve_directly(system, goal, r, after=False)) is not None:
            return found
        patience = system.patience
        if goal.r_scale != system.r_scale:
            r = system.update_multipliers(goal.r_scale, to_impulses=False)
        scale, law_before, n_steps, n_stored, rounding = goal.r_scale, math.inf, 0, 0, False
        solves = linear = updates = 0
        inner, negative, converged = cls.PROGRESS * r, False, False
        while math.isfinite(r):
            law, extrapolating = system.contact_residual, updates >= goal.plain
            holds = law <= goal.law
            is_inner_done = rounding or r <= max(goal.inner * (cls.FINER if extrapolating else 1.0), inner)
            if is_inner_done or (holds and r <= goal.norm):
                converged = holds and (rounding or r <= max(goal.norm, system.floor))
                if converged or updates >= cls.MAX_UPDATES:
                    break
                if extrapolating:
                    extrapolate_multipliers(system.contacts, n_stored)
                    scale, n_stored = cls.R_EXTRAPOLATED, min(n_stored + 1, PAST)
                else:
                    scale = cls.next_scale(scale, law, law_before, n_steps, system.frictionless, goal.max_r_scale, goal.law)
                r = system.update_multipliers(scale, to_impulses=not extrapolating)
                law_before, n_steps, rounding, inner, updates = law, 0, False, cls.PROGRESS * r, updates + 1
            elif solves >= goal.max_solves or system.duration_of(linear, solves + updates) > patience:
                break
            elif solves >= cls.LEAST_SOLVES and system.budget.is_out_of_time():
                break
            else:
                tolerance, after = max(goal.forcing, goal.later if solves else 0.0), None
                if system.by_team:
                    found, after = system.step_by_team(tolerance, scale)
                else:
                    found = system.solve_linear(tolerance)
                solves, linear, n_steps = solves + 1, linear + found.iterations, n_steps + 1
                if negative := found.negative:
                    break
                before, r = r, system.advance(scale) if after is None else after
                rounding = r <= cls.ROUNDING * system.floor and r > 0.5 * before
        system.r_scale = FIRST_R
        if not (converged or negative or system.budget.ran_out):
            if (found := cls._solve_directly(system, goal, r, after=True)) is not None:
                return found._replace(solves=solves + 1, linear=linear, updates=updates)
            if patience < math.inf and solves < goal.max_solves:
                found = cls.solve(system, goal._replace(max_solves=goal.max_solves - solves, r_scale=scale), r)
                return found._replace(solves=solves + found.solves, linear=linear + found.linear, updates=updates + found.updates)
        return Solution(solves, linear, updates, negative, converged, r, scale)

    @staticmethod
    def _solve_directly(system: StageSystem, goal: Goal, r: float, after: bool) -> Solution | None:
        """Return the result of a direct solve, None if that does not apply."""
        try:
            found = system.solve_directly(goal.law, after)
        except np.linalg.LinAlgError:
            return Solution(1, 0, 0, True, False, r)
        if found is None:
            return None
        iterations, converged, r = found
        return Solution(1, 0, iterations, False, converged, r, direct=True)

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
            return max(FIRST_R, cls.EASED * scale)
        if not frictionless and law > cls.LAW_INCREASE * before and scale > cls.STEADY:
            return 0.5 * scale
        if law > cls.LAW_DECREASE * before:
            if n_steps <= 1 or (frictionless and n_steps < cls.MANY_STEPS):
                return min(max_r if frictionless else cls.MAX_R, 2.0 * scale)
            if n_steps >= cls.MANY_STEPS:
                return max(cls.MIN_R, 0.5 * scale)
        return scale


@ti.func
def _coefficients(contacts: ti.template(), t, n_remembered):
    """Return the coefficients (t_1, t_2) of the last two changes, to thread t of a team."""
    rows, work = ti.static((contacts.problem, contacts.work))
    dot = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0], ti.f64)  # a.a, a.b, b.b, a.f, b.f
    if n_remembered > 0:
        for j in range(rows.team.share(t, rows.count[0])):
            c = rows.team.term(t, j)
            f, last = rows.r[c] - work.multiplier[c], work.past_change[PAST * c]
            a, b = f - last, dvec(0.0)
            if n_remembered > 1:
                b = last - work.past_change[PAST * c + 1]
            for i in ti.static(range(3)):
                factor = rows.factor[c][ti.static(min(i, 1))]
                if factor > 0.0:
                    dot += ti.Vector([a[i] * a[i], a[i] * b[i], b[i] * b[i], a[i] * f[i], b[i] * f[i]]) / factor
    for k in ti.static(range(5)):
        dot[k] = rows.team.total(t, dot[k])
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
    ti.loop_config(serialize=rows.team.alone, block_dim=rows.team.threads)
    for t in range(rows.team.threads):
        first, second = _coefficients(contacts, t, n_remembered)
        for j in range(rows.team.share(t, rows.count[0])):
            c = rows.team.entry(t, j, rows.count[0])
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
