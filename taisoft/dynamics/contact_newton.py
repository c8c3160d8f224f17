"""Newton's method for a stage with contacts: each step linearises elasticity and solves the frictional problem on that matrix.

The problem on the fixed matrix needs no elements: `Friction` solves it inexactly as an augmented Lagrangian, from the
current impulses. Its displacement is a direction for the nonlinear stage. A full step is accepted if |r| falls enough; else a
line search uses the slope of the augmented Lagrangian with the new impulses as multipliers. An indefinite matrix is replaced by a
projected one. A problem that stalls is solved directly, as the stage's later ones then are, if it is not too large (`direct`).
Without progress, a few steps minimise the nonlinear stage under multipliers instead. If a slow step leaves a residual on few
nodes, these are solved separately first (`elimination`).
A stage without progress ends early: a shorter substep costs less.
"""

import math
from dataclasses import replace

from taisoft.dynamics.constraints import correct
from taisoft.dynamics.contact_terms import OF_IMPULSES, TO_IMPULSES
from taisoft.dynamics.elimination import eliminate
from taisoft.dynamics.friction import Friction, FrictionalResult
from taisoft.dynamics.newton import Newton, choose_start, search
from taisoft.dynamics.results import StageResult, count_all, relative
from taisoft.dynamics.stage import AGAIN, Stage
from taisoft.dynamics.stage_system import StageSystem
from taisoft.fem.dependents import place_dependents

LINEARISED_SOLVES, LINEARISED_FORCING = 400, 0.1  # maximum linear solves of a linearised stage, and their tolerance
MAX_CORRECTIONS = 20  # of the multipliers of given volumes and lengths, with contacts


class ContactNewton:
    """Newton steps of a stage with contacts: each linearises elasticity and solves the contact problem on the fixed matrix."""

    SOLVES, FORCING = 60, 0.3  # maximum linear solves of a frictional problem, and their tolerance
    LATER_FORCING = 0.01  # minimum tolerance of those after the first, which no longer change rigid motion
    REDUCTION, LAW_REDUCTION = 0.1, 0.1  # fractions of the stage's |r| and laws' residual to which such a problem is solved,
    TOLERANCE_FRACTION, LAW_TOLERANCE_FRACTION = 0.3, 0.8  # or these of the tolerances, which survive a full nonlinear step
    LAW_BALANCE = 0.03  # laws' residual over the required relative |r|; the next matrix would undo more accuracy
    MULTIPLIER_FRACTION = 0.3  # of the required |r|, ends the steps under one multiplier: updates at a large |r| overshoot
    STALLED, STALLED_SOLVES = 0.9, 3  # fraction of |r| left by a stalling step; factor on SOLVES after that
    MAX_SLOW = 6  # Newton iterations in a row that do not lower the smallest |r|; stages that converge have 3 at most, rarely 5
    FALLBACK_STEPS = 6  # steps on the nonlinear stage
    R_STALLED, MAX_R_STALLED = 1000.0, 1e5  # smallest first R and upper bound without friction, where the laws stalled before
    NEAR_FLOOR = 4.0  # times the floor of |r|: below it, |r| may be mostly rigid motion

    def __init__(self, system: StageSystem, stage: Stage):
        self.system, self.stage = system, stage
        self.newton = self.linear = self.multipliers = 0
        self.eliminated = 0.0  # Newton iterations on few nodes, times their fraction of all nodes
        self.rounding = self.tight = self.stalls = False
        self.is_direct = False  # whether the last problem was solved directly, as the next one then is first
        # laws that hold better than they must let |r| converge in fewer steps, where they can
        self.law_aim = min(stage.contact_tolerance, stage.tolerance)
        self.has_direction = False  # y is a good first direction on the current matrix
        self.first_r_scale, self.max_r_scale = Stage.first_r_scale, Stage.max_r_scale  # of the next contact problem

    def run(self) -> StageResult:
        """Solve from the first iterate, where the matrix has been formed."""
        system, stage = self.system, self.stage
        self.r, self.scale, self.has_direction = choose_start(system, *system.evaluate_start())
        if self.has_direction:  # the matrix of the first iterate is invalid
            system.form_matrix_and_factors()
            self.r, self.scale = system.evaluate(None)
        lowest, stalled, n_slow, converged = self.r, 0, 0, False
        while self.newton < stage.max_newton and math.isfinite(self.r) and system.budget.left:
            if renewed := self.newton > 0 and stage.renews and system.renew_contacts():
                self.r, self.scale = system.evaluate(None, new_multipliers=TO_IMPULSES)
                lowest, stalled, n_slow, self.rounding = self.r, 0, 0, False
            if self._has_converged():
                if converged := system.balances_pieces():
                    break
                self.r, self.scale = system.evaluate(None)
                lowest, self.rounding = self.r, False
            if self.newton > 0 and not renewed:
                system.form_matrix()
            previous, law_residual = self.r, system.contact_residual
            only_laws_remain = self._is_balanced
            result, moved = self._solve_contacts(), False
            if result.negative:  # the frictional problem has no minimum
                self.r, self.scale = system.end_linearised(accept=False)
                system.form_matrix(projected=True)
                self._count()
                result = self._solve_contacts()
            self._count()
            if not result.negative:
                # the laws hold less well than forces are balanced; keeping the impulses separates the two
                self.r, self.scale = system.end_linearised(new_multipliers=OF_IMPULSES if result.direct else TO_IMPULSES)
                moved = self.r < Newton.DECREASE * lowest
                if not moved:  # also if it is not a number
                    system.evaluate(AGAIN, 0.0)
                    self.r, self.scale, moved = search(system, Newton.DECREASE * lowest)
            if not moved:
                moved = self._fall_back()
                if not (result.negative or self.tight):
                    # if friction cycles, a shorter time step helps, and more of these steps do not
                    moved &= self.r < Newton.DECREASE * lowest or (
                        only_laws_remain and system.contact_residual < Newton.DECREASE * law_residual
                    )
            # if redundant contacts exchange impulses slowly, only plain multipliers and a large R make progress
            stalled += self.r > self.STALLED * lowest
            self.stalls = stalled >= 2
            is_slow = moved and self.r > Newton.ELIMINATION_RATIO * previous and not (self._has_converged() or self._is_balanced)
            if is_slow and (found := eliminate(system, stage, self.r)) is not None:
                self.eliminated, self.linear = self.eliminated + found.newton, self.linear + found.linear
                self.r, self.scale = system.evaluate(None, new_multipliers=TO_IMPULSES)
            n_slow = 0 if self._is_balanced or self.r < Newton.DECREASE * lowest else n_slow + 1
            lowest = min(lowest, self.r)
            self.rounding = self.r <= Friction.ROUNDING * self.system.floor and self.r > 0.5 * previous and self.tight
            if not moved or n_slow >= self.MAX_SLOW:
                break
        return self._result(converged or (self._has_converged() and math.isfinite(self.r) and system.balances_pieces()))

    def _result(self, converged: bool) -> StageResult:
        return StageResult(
            self.newton + self.eliminated,
            round(self.linear),
            relative(self.r, self.scale),
            converged,
            self.rounding or self.r <= self.system.floor,
            self.multipliers,
            self.system.contact_residual,
            (0.0, "") if converged else self.system.least_balanced(),
        )

    def _count(self) -> None:
        self.newton += 1
        self.system.budget.spend()

    def _fall_back(self) -> bool:
        """Take a few steps on the nonlinear stage from where it was linearised; return whether any step was taken."""
        system, stage = self.system, self.stage
        self.r, self.scale = system.end_linearised(accept=False)
        law_tolerance = stage.contact_tolerance if self._is_balanced else math.inf
        steps = Newton(system, replace(stage, max_newton=self.FALLBACK_STEPS, contact_tolerance=law_tolerance))
        steps.run(self.r, self.scale, fresh=True)
        self.newton += max(0, steps.newton - 1)  # the first uses the current matrix
        self.linear, self.multipliers = self.linear + steps.linear, self.multipliers + steps.multipliers
        self.r, self.scale = system.evaluate(None, new_multipliers=TO_IMPULSES)
        return steps.newton > 0

    @property
    def _is_balanced(self) -> bool:
        """Whether |r| has converged, so that only the contact laws remain."""
        return self.r <= self.stage.tolerance * self.scale

    def _has_converged(self) -> bool:
        if self.system.contact_residual <= self.stage.contact_tolerance:
            return self._is_balanced or self.rounding
        return self.r <= self.system.floor and self.system.impulses_are_rounding()

    def _solve_contacts(self) -> "FrictionalResult":
        """Solve the contact problem on the current matrix, to a fraction of the stage's residuals."""
        system, stage, laws_stalled = self.system, self.stage, self.first_r_scale > Stage.first_r_scale
        system.linearise()
        target = max(self.REDUCTION * self.r, self.TOLERANCE_FRACTION * stage.tolerance * self.scale)
        tolerance = target / self.scale if self.scale > 0.0 else 0.0
        # if rounding of stiff stress hides the rigid motion in |r|, only a tight first solve gets that motion right, and
        # impulses converge only if |r| decreases with them
        self.tight = self.r <= self.NEAR_FLOOR * self.system.floor
        law_tolerance = self.LAW_TOLERANCE_FRACTION * self.law_aim
        if not self._is_balanced:
            law_tolerance = max(law_tolerance, self.LAW_BALANCE * tolerance)
        plain = Friction.MAX_MULTIPLIERS if self.stalls or laws_stalled else 0 if self.tight else stage.extrapolate_after
        problem = replace(
            stage,
            tolerance=tolerance,
            contact_tolerance=max(self.LAW_REDUCTION * system.contact_residual, law_tolerance),
            multiplier_tolerance=0.0 if self.tight else self.MULTIPLIER_FRACTION * tolerance,
            extrapolate_after=plain,
            max_newton=self.STALLED_SOLVES * self.SOLVES if self.stalls else self.SOLVES,
            linear_tolerance=stage.linear_tolerance or (min(stage.tolerance, self.FORCING) if self.tight else self.FORCING),
            later_tolerance=0.0 if stage.linear_tolerance else self.LATER_FORCING,
            first_r_scale=self.first_r_scale,
            max_r_scale=self.max_r_scale,
        )
        result = Friction.solve(system, problem, self._first_residual(), self.is_direct)
        self.is_direct = result.direct
        self.linear, self.multipliers = self.linear + result.linear, self.multipliers + result.multipliers
        if not (result.converged or result.negative):
            self.law_aim = stage.contact_tolerance
        if system.frictionless and not (result.negative or result.direct):
            self._choose_r_scale(result, result.converged or system.contact_residual <= problem.contact_tolerance)
        return result

    def _choose_r_scale(self, result: FrictionalResult, laws_hold: bool) -> None:
        """Choose the first R of the next contact problem without friction. laws_hold: whether the laws held in the last one."""
        self.first_r_scale = Stage.first_r_scale if laws_hold else max(self.R_STALLED, result.r_scale)
        if not laws_hold:
            self.max_r_scale = self.MAX_R_STALLED

    def _first_residual(self) -> float:
        """Return |r| at the start of a solve, of the stage just linearised."""
        system = self.system
        if not self.has_direction:
            return self.r
        self.has_direction = False
        r = system.advance(system.r_scale)
        if math.isfinite(r) and system.found_zero_slope:
            return r
        r, _ = system.end_linearised(accept=False)
        system.linearise()
        return r


def solve(system: StageSystem, stage: Stage) -> StageResult:
    """Solve a stage from the present v or from v = 0, see `choose_start`.

    The caller sets x_hat, v_hat, the targets and the contacts.
    """
    fresh = system.begin(stage)
    if stage.linearised and not system.budget.left:
        return StageResult(0.0, 0, relative(*system.evaluate()), False, False)
    if system.n_contacts == 0:
        # elimination knows no constraint of all nodes of a cavity or a tendon
        newton = Newton(system, stage, eliminate=eliminate if system.multipliers is None else None)
        if stage.linearised:
            return newton.solve_once()
        r, scale, _ = choose_start(system, *system.evaluate_start())
        result = newton.run(r, scale, fresh)
    elif stage.linearised:
        return solve_linearised(system, stage)
    else:
        result = ContactNewton(system, stage).run()
    system.balance_rigid_motion()
    return result


def correct_multipliers(system: StageSystem, stage: Stage, result: StageResult) -> StageResult:
    """Solve a stage that was solved again with other multipliers until volumes and lengths are those given, if any are."""
    multipliers, discarded, linear = system.multipliers, [], 0
    if multipliers is None:
        return result
    while not multipliers.penalised and result.converged and not multipliers.hold and len(discarded) < MAX_CORRECTIONS:
        iterations, corrected = correct(system)
        linear += iterations
        if not corrected:
            break
        discarded.append(result)
        result = solve(system, stage)
    result = replace(count_all(result, discarded), converged=result.converged and multipliers.hold)
    if result.converged:
        multipliers.end()
    return replace(result, linear_iterations=result.linear_iterations + linear)


def solve_linearised(system: StageSystem, stage: Stage) -> StageResult:
    """Solve the frictional problem alone, at the present state; on a projected matrix if its own is indefinite."""
    tolerance = stage.linear_tolerance or LINEARISED_FORCING
    linear = 0
    if stage.renews:
        system.renew_contacts()
    r, scale = system.evaluate_start()
    for projected in (False, True):
        system.linearise()
        solves = min(LINEARISED_SOLVES, system.budget.left)
        found = Friction.solve(system, replace(stage, max_newton=solves, linear_tolerance=tolerance), r)
        linear += found.linear
        system.budget.spend(found.solves)
        if not found.negative or projected:
            break
        r, scale = system.end_linearised(accept=False)
        system.form_matrix(projected=True)
    system.balance_rigid_motion()
    if found.direct:
        system.end_linearised(new_multipliers=OF_IMPULSES)
    elif system.model.has_dependents:  # linearised steps move only the nodes that they depend on
        place_dependents(system.model)
    at_floor = found.r <= system.floor
    return StageResult(
        found.solves, linear, relative(found.r, scale), found.converged, at_floor, found.multipliers, system.contact_residual
    )
