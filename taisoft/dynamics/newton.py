"""Newton's method of an implicit stage, with or without contacts, in time or in statics.

An iteration linearises elasticity, with the unprojected matrix, and finds a direction: without contacts by one linear solve, by
conjugate gradients, which follow negative curvature; with contacts by solving the frictional problem on that matrix (`friction`),
which needs no elements. A matrix on which that problem has no minimum is replaced by a projected one. The full step is taken if
|r| falls enough; else `search` finds its length by the slope of the merit function, with contacts that of the augmented
Lagrangian under the new impulses: opening and closing contacts, and tets that invert, can increase |r| in one step and decrease
it in the next.

Solves are inexact: CG's tolerance follows Newton's progress (Eisenstat and Walker 1996, choice 2), frictional problems are solved
to a fraction of the stage's residuals.

Convergence: |r| <= tolerance * scale, scale = |c M (v - v_hat)| + beta (|f_el| + |f_ext|) on the free axes, impulses in r, and
the residual of the contact laws, |p - prox(p - f u)| / |p| with f = 1 / (J diag(A)^-1 J^T), within its own tolerance. A residual
below a few times the rounding of the forces (at rest) that a Newton step no longer halves is rounding. It corresponds to strains
of rounding size, so the stage ends as converged and reports its actual residual. In statics the scale is the applied load
(without any: the constraint forces), and rounding above the tolerance is not convergence.

A converged iterate must pass checks: the balance of each piece, given volumes and lengths, the work of rebounds. One that fails
changes the running problem, and the iterations go on. Whether the way there is free is checked outside: see `implicit`.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from taisoft.dynamics.constraints import correct, solve_constrained
from taisoft.dynamics.contact_terms import KEEP, TO_IMPULSES
from taisoft.dynamics.friction import Friction, Goal, Solution
from taisoft.dynamics.frictional_problems import FrictionalProblems
from taisoft.dynamics.results import StageResult, relative
from taisoft.dynamics.search import search
from taisoft.dynamics.stage import AGAIN, ELASTIC_STAGE, IMPACT, STAY, Stage
from taisoft.dynamics.stage_system import StageSystem
from taisoft.linear.pcg_work import LinearResult


class Newton:
    """Newton's method of one stage."""

    FAR = 0.5  # |r| over its scale at the first iterate above which v = 0 is tried
    # with contacts: of the smallest |r| so far; iterations in a row that do not reach that; with a projected matrix, which creeps
    # where a shorter part would not, iterations count twice
    DECREASE, PROJECTED, MAX_SLOW = 0.9, 0.5, 6
    MAX_CORRECTIONS = 20  # of given volumes and lengths, where they are not part of the linear solve
    # linear solves without contacts: CG's maximum tolerance, after a step that increased |r|, and in statics, where a loose solve
    # leaves a slender body stretched for the next step to correct
    MAX_FORCING, INCREASE_FORCING, STATIC_FORCING = 0.1, 3e-2, 1e-2
    # fraction of |r| above which what a step leaves requires a new matrix: without contacts, with contacts, and with curved
    # steps, whose first matrix is that of the step's start and whose solves are longer
    REBUILD_RATIO, REBUILD_ROWS, REBUILD_VOLUMES = 0.2, 0.1, 0.01
    NEAR = 100.0  # times the tolerance: |r| that a direct solve leaves below which its factor serves once more
    LINEAR_LIMIT = 0.01  # relative true residual above which a linearised stage without contacts has failed
    LINEARISED_SOLVES, LINEARISED_FORCING = 400, 0.1  # maximum linear solves of one with contacts, and their tolerance

    def __init__(self, system: StageSystem, stage: Stage, check: Callable[[], bool] | None = None):
        """check: of a converged iterate, may change the problem."""
        self.system, self.stage, self.check, self.has_rows = system, stage, check, system.n_contacts > 0
        is_constrained = system.multipliers is not None and system.multipliers.penalised
        self._solve_linear = partial(solve_constrained, system) if is_constrained else system.solve_linear
        self.max_forcing = self.MAX_FORCING if stage.c > 0.0 else self.STATIC_FORCING
        self.newton = self.linear = self.multigrid = self.updates = self.n_corrections = 0
        self.most, self.is_projected = stage.max_newton, False  # the latter of the last iteration
        self.n_uses, self.keeps = 0, False  # iterations with the present matrix; whether its factor serves another problem
        self.solved = self.solved_before = math.inf  # |r| that the last two direct solves left, with the geometry that they had
        self.problems = FrictionalProblems(system, stage)

    def run(self, fresh: bool) -> StageResult:
        """Solve from the present state. fresh: whether the matrix is formed there."""
        system, stage, is_accepted = self.system, self.stage, False
        self.r, self.scale = system.evaluate_start()
        self._start_at_rest()
        self._restart()
        while True:
            if self.has_rows and self.newton and stage.renews and system.renew_contacts():
                self._evaluate_again()
            if self._has_converged():
                if is_accepted := self._passes_checks():
                    break
                fresh = fresh and not self.has_rows
            if not self._may_go_on():
                break
            if not (fresh or self._keeps_factor()) or self._needs_matrix():
                if system.kind == ELASTIC_STAGE:
                    system.form_matrix()
                self.n_uses = 0
            self.n_uses += 1
            moved = self._iterate_rows() if self.has_rows else self._iterate()
            self._find_rounding()
            if not moved and self.n_uses == 1 and not (self.keeps or self._has_converged()):
                break
            fresh = moved and (not self.has_rows or self._keeps_matrix())
            decrease = self.PROJECTED if self.is_projected else self.DECREASE
            is_slow = not (self._is_balanced or self.r < decrease * self.lowest)
            self.n_slow = self.n_slow + 1 + self.is_projected if is_slow else 0
            self.lowest = min(self.lowest, self.r)
            if not self._has_converged() and system.budget.is_out_of_time():
                break
        return self._result(is_accepted)

    def _start_at_rest(self) -> None:
        """Start from v = 0 if |r| is smaller there than at a first iterate far from balance.

        Motion that stiffness or contacts stop within the step, as of light bodies and of inverted tets, is far from balance.
        """
        system = self.system
        if system.is_static or system.kind != ELASTIC_STAGE or self.r <= self.FAR * self.scale:
            return
        at_rest = system.evaluate_at_rest()
        if not at_rest[0] < self.r and math.isfinite(self.r):
            self.r, self.scale = system.evaluate(AGAIN, 0.0)
            return
        self.r, self.scale = at_rest
        if self.has_rows:
            system.form_matrix_and_factors()
            self.r, self.scale = system.evaluate(None)

    # --- progress -----------------------------------------------------------------------------------------------------------

    def _restart(self) -> None:
        """Reset the progress, for a new or changed problem."""
        self.lowest, self.previous, self.forcing, self.n_slow = self.r, 0.0, self.max_forcing, 0
        self.rounding = False  # |r| is only rounding

    def _evaluate_again(self, mode: int | None = None) -> None:
        """Evaluate a changed problem, and begin anew from there."""
        self.r, self.scale = self.system.evaluate(mode, new_multipliers=TO_IMPULSES if self.has_rows else KEEP)
        self._restart()

    def _may_go_on(self) -> bool:
        """Whether there are iterations left, and progress."""
        ends = self.n_slow >= self.MAX_SLOW if self.has_rows else self.rounding and self.system.multipliers_hold
        has_iterations = self.newton < self.most and self.system.budget.left > 0
        return has_iterations and math.isfinite(self.r) and not ends

    @property
    def _is_balanced(self) -> bool:
        """Whether |r| has converged; with contacts, only their laws may remain then."""
        return self.r <= self.stage.tolerance * self.scale

    def _has_converged(self) -> bool:
        system = self.system
        if not self.has_rows:
            # statics without load has no scale to compare the rounding with
            is_rounding = self.rounding and (self.stage.c > 0.0 or self.scale <= system.floor)
            return (self._is_balanced or is_rounding) and system.multipliers_hold
        if system.contact_residual <= self.stage.contact_tolerance:
            return self._is_balanced or self.rounding
        return self.r <= system.floor and system.impulses_are_rounding()

    @property
    def _is_unloaded(self) -> bool:
        """Whether all forces of a static stage are rounding, so that nothing is a scale for it."""
        return self.stage.c == 0.0 and max(self.r, self.scale) <= self.system.floor

    def _find_rounding(self) -> None:
        """Find out whether |r| is only rounding after an iteration. Statics continues down to the floor."""
        near = self.r <= (Friction.ROUNDING if self.stage.c > 0.0 else 1.0) * self.system.floor
        stalls = self.r > 0.5 * self.previous and (not self.has_rows or self.problems.tight)
        # a direct solve is tight; what it begins with may be due to new geometry
        self.rounding = near and (stalls or (self.r == self.solved and self.solved > 0.5 * self.solved_before))

    def _passes_checks(self) -> bool:
        """Whether a converged iterate passes all checks. If not, the running problem has changed, or the iterations end."""
        system, m = self.system, self.system.multipliers
        if system.kind == IMPACT:
            return True
        if not system.balances_pieces():
            self.r, self.scale = system.evaluate(None)
            self._restart()
            return False
        if m is not None and not m.penalised and not m.hold:
            changed = self.newton < self.most and self.n_corrections < self.MAX_CORRECTIONS and self._correct_volumes()
            self.most = self.newton + self.stage.max_newton if changed else 0
            return False
        if self.check is not None and not self.check():
            self._evaluate_again()
            self.most = self.newton + self.stage.max_newton
            return False
        return True

    def _correct_volumes(self) -> bool:
        """Change given volumes' and lengths' multipliers, and v along with them; return whether that was possible."""
        n, changed = correct(self.system)
        self.linear, self.n_corrections = self.linear + n, self.n_corrections + 1
        if changed:
            self.system.move_to_velocities()
            self._evaluate_again(STAY)
        return changed

    def _count(self, n: int = 1) -> None:
        self.newton += n
        self.system.budget.spend(n)

    def _result(self, converged: bool) -> StageResult:
        system = self.system
        return StageResult(
            self.newton,
            round(self.linear),
            0.0 if self._is_unloaded and converged else relative(self.r, self.scale),
            converged and math.isfinite(self.r),
            self.rounding or self.r <= system.floor,
            self.updates,
            system.contact_residual,
            (0.0, "") if converged else system.least_balanced(),
            self.multigrid,
            correction=system.last_correction() if system.budget.ran_out and not converged else 0.0,
        )

    # --- an iteration -------------------------------------------------------------------------------------------------------

    def _needs_matrix(self) -> bool:
        """Whether a matrix that is formed is used up."""
        ratio = self.REBUILD_VOLUMES if self.system.keeps_volumes else self.REBUILD_RATIO
        return not self.has_rows and self.r > ratio * self.previous > 0.0

    def _keeps_matrix(self) -> bool:
        """Whether the next frictional problem takes the matrix of the last one, if that was solved by iterations.

        Not in statics, where it leads from one equilibrium to others.
        """
        is_usable = self.solved == math.inf and not (self.is_projected or self.system.is_static)
        return is_usable and self.r <= self.REBUILD_ROWS * self.previous

    def _keeps_factor(self) -> bool:
        """Whether the next frictional problem takes the factor of the last one, which led near enough."""
        near = self.NEAR * self.stage.tolerance * self.scale
        is_slow = self.keeps and self.solved > self.REBUILD_RATIO * self.solved_before
        near = max(near, Friction.ROUNDING * self.system.floor)
        self.keeps = self.solved <= near and not (is_slow or self.is_projected)
        return self.keeps

    def _iterate(self) -> bool:
        """Solve for a direction and step along it; return whether the state moved."""
        solution = self._solve_linear(self._linear_tolerance())
        self._add(solution)
        self._count()
        accept = self.previous = self.r
        if self.system.is_static or solution.negative:  # a lower |r| may be at a maximum of the energy
            accept = self.system.floor
        self.r, self.scale, moved = search(self.system, accept)
        return moved

    def _add(self, solution: LinearResult) -> None:
        self.linear, self.multigrid = self.linear + solution.iterations, self.multigrid + solution.multigrid

    def _linear_tolerance(self) -> float:
        """CG's tolerance by Newton's progress: Eisenstat and Walker's choice 2, with their safeguard.

        A step that bends a slender body increases |r| by stretching it; a loose solve would then only undo that stretch.
        """
        if self.stage.linear_tolerance is not None:
            return self.stage.linear_tolerance
        target, before = self.stage.tolerance * self.scale, self.previous
        if before == 0.0:
            self.forcing = self.max_forcing
        elif self.r > before:
            self.forcing = min(self.INCREASE_FORCING, self.max_forcing)
        else:
            wanted, safeguard = 0.9 * (self.r / before) ** 2, 0.9 * self.forcing**2
            self.forcing = min(self.max_forcing, max(wanted, safeguard if safeguard > 0.1 else 0.0))
        # the last solve need not go far below Newton's tolerance; |r| may be below it while given volumes and lengths do not hold
        tolerance = max(self.forcing, 0.1 * target / self.r if self.r > target else 0.1, 1e-12)
        # if rounding of stiff stress hides the rigid motion in |r|, only a tight solve gets that motion right
        return min(tolerance, self.stage.tolerance) if self.system.floor > target else tolerance

    def _add_friction(self, found: Solution) -> Solution:
        self.linear, self.updates = self.linear + found.linear, self.updates + found.updates
        return found

    def _iterate_rows(self) -> bool:
        """Solve the frictional problem and step to its solution; return whether the state moved."""
        system, accept, self.previous = self.system, self.DECREASE * self.lowest, self.r
        system.linearise()
        goal = self.problems.goal(self.r, self.scale, self._is_balanced)
        found = self._add_friction(Friction.solve(system, goal, self.r, self.problems.is_direct))
        self.is_projected = found.negative
        if found.negative:  # the problem has no minimum
            system.end_linearised(accept=False)
            system.form_matrix(projected=True)
            self._count()
            system.linearise()
            found = self._add_friction(Friction.solve(system, goal, self.r))
        self._count()
        self.problems.learn(goal, found)
        if found.negative:
            self.r, self.scale = system.end_linearised(accept=False)
            return False
        self.r, self.scale = system.end_linearised(solved=found.direct or (found.converged and not system.is_static))
        self.solved_before, self.solved = self.solved, self.r if found.direct else math.inf
        if self.r < accept:
            return True
        system.evaluate(AGAIN, 0.0)
        self.r, self.scale, moved = search(system, accept)
        if not moved:  # nor do the impulses change
            self.r, self.scale = system.end_linearised(accept=False)
            self.solved = math.inf
        return moved

    # --- linearised stages --------------------------------------------------------------------------------------------------

    def run_once(self) -> StageResult:
        """Solve a linearised stage: once, and again where a check has changed the problem. No volumes and lengths are given."""
        while True:
            solved = self._solve_rows_once() if self.has_rows else self._solve_once()
            if not solved or self._passes_checks():
                return self._result(solved)

    def _solve_once(self) -> bool:
        """Take one full step, of a stage without contacts; return whether the solve converged."""
        system, stage, solved = self.system, self.stage, True
        self.r, self.scale = system.begin_linearised_step()
        self._restart()
        if self._is_balanced:
            system.work.pcg.y.fill(0.0)
        else:
            # no later step corrects this solve
            tolerance = stage.linear_tolerance or min(self._linear_tolerance(), stage.tolerance)
            for projected in (False, True):  # an indefinite quadratic form has no minimum
                system.form_matrix(projected)
                solution = self._solve_linear(tolerance)
                self._add(solution)
                if not solution.negative:
                    break
            solved = solution.converged and system.linear_residual() <= self.LINEAR_LIMIT
            self._count()
        self.r, self.scale = system.take_linearised_step()
        return solved

    def _solve_rows_once(self) -> bool:
        """Solve the frictional problem at the present state; on a projected matrix if its own is indefinite."""
        system, stage = self.system, self.stage
        if stage.renews:
            system.renew_contacts()
        self.r, self.scale = system.evaluate_start()
        self._restart()
        for projected in (False, True):
            system.linearise()
            norm = stage.tolerance * self.scale
            forcing = stage.linear_tolerance or self.LINEARISED_FORCING
            solves = min(self.LINEARISED_SOLVES, system.budget.left)
            goal = Goal(norm, stage.contact_tolerance, norm, forcing, max_solves=solves)
            found = self._add_friction(Friction.solve(system, goal, self.r, self.problems.is_direct))
            self.problems.count(goal, found)
            self._count(found.solves)
            if not found.negative or projected:
                break
            self.r, self.scale = system.end_linearised(accept=False)
            system.form_matrix(projected=True)
        self.r = found.r
        system.end_once(found.direct)
        return found.converged


def solve(system: StageSystem, stage: Stage, check: Callable[[], bool] | None = None) -> StageResult:
    """Solve a stage from the present v. The caller sets x_hat, v_hat, the targets and the contacts.

    check: of a converged iterate; where it fails, it has changed the problem, and the iterations go on.
    """
    fresh = system.begin(stage)
    newton = Newton(system, stage, check)
    if not stage.linearised:
        result = newton.run(fresh)
    elif system.budget.left:
        result = newton.run_once()
    else:
        return StageResult(0.0, 0, relative(*system.evaluate()), False, False)
    if not stage.linearised:
        system.balance_rigid_motion()
    if (multipliers := system.multipliers) is not None:
        result = replace(result, converged=result.converged and multipliers.hold)
        if result.converged:
            multipliers.end()
    return result
