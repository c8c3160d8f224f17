"""Newton's method for a stage with contacts: each step linearises elasticity and solves the frictional problem on that matrix.

The problem on the fixed matrix needs no elements: `Newton` solves it as an augmented Lagrangian, inexactly, from the impulses so
far. Its way is a direction for the true stage, judged by |r| and else by the slope of the augmented Lagrangian with the impulses
found as multipliers. Where the matrix is indefinite, a projected one takes its place; where that leads nowhere, a few steps
minimise the true stage under multipliers instead. What a slow step leaves on few nodes is solved there first (`elimination`).
"""

import math
from dataclasses import dataclass, replace

from taisoft.dynamics.elimination import eliminate
from taisoft.dynamics.frictional import INDEFINITE, LINEAR, MULTIPLIERS, NORM, ROUNDING, SOLVED, VERDICT
from taisoft.dynamics.frictional import SOLVES as SOLVES_DONE
from taisoft.dynamics.line_search import choose_start, search
from taisoft.dynamics.multipliers import MAX_MULTIPLIERS
from taisoft.dynamics.newton import FALL, SLOW_STEP, Newton
from taisoft.dynamics.residual import AGAIN
from taisoft.dynamics.stage_result import StageResult, relative
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.launching import PUBLIC

SOLVES, FORCING = 60, 0.3  # linear solves of one frictional problem, and their tolerance
LATER_FORCING = 0.01  # the least tolerance of those after the first, which move a whole body no more
SHARE, LAW_SHARE = 0.1, 0.1  # of what the stage has left of |r| and of the laws' residual: what such a problem is solved to,
LEAST_SHARE, LEAST_LAW_SHARE = 0.3, 0.8  # or these of the tolerances: a whole step on the true stage keeps what was reached
BALANCE = 0.03  # laws need not hold better than so many times the relative |r| that is asked for: the next matrix undoes that
SHARE_OF_ONE = 0.3  # of the |r| asked for that ends the steps under one multiplier: new ones at an old |r| overshoot
LINEARISED_SOLVES, LINEARISED_FORCING = 400, 0.1  # linear solves of a linearised stage, and their tolerance
STALLED, PATIENCE = 0.9, 3  # share of |r| that a step leaves which stalls; so many times as many solves after that
FALLBACK = 6  # steps on the true stage
HIDING = 4.0  # times the floor of |r|: where the motion of a whole body may be what is left of it


@dataclass(frozen=True)
class Frictional:
    """What a solve of a linearised stage did. negative: its matrix is indefinite."""

    solves: int
    linear: int
    multipliers: int
    negative: bool
    converged: bool
    r: float


def solve_linear(system: StageSystem, problem: Stage, r: float, scale: float) -> Frictional:
    """Solve a linearised stage from (|r|, scale), on one thread in one launch."""
    if not system.model.serial or PUBLIC:  # Taichi itself takes no more than 64 arguments
        newton = Newton(system, problem)
        result = newton.run(r, scale, fresh=True)
        return Frictional(newton.newton, newton.linear, newton.multipliers, newton.negative, result.converged, newton.r)
    loop = system.solve_frictional(problem, r, system.rounding.of_stage(problem.c, problem.beta))
    counts = (int(loop[place]) for place in (SOLVES_DONE, LINEAR, MULTIPLIERS))
    return Frictional(*counts, loop[VERDICT] == INDEFINITE, loop[VERDICT] == SOLVED, float(loop[NORM]))


class ContactNewton:
    """Newton steps of a stage with contacts: each linearises elasticity, and solves its contact problem on the fixed matrix."""

    def __init__(self, system: StageSystem, stage: Stage):
        self.system, self.stage = system, stage
        self.floor = system.rounding.of_stage(stage.c, stage.beta)
        self.newton = self.linear = self.multipliers = 0
        self.eliminated = 0.0  # Newton iterations on few nodes, by their share
        self.rounding = self.tight = self.stalls = False
        self.has_direction = False  # y is a good first direction on the matrix at hand

    def run(self) -> StageResult:
        """From the first iterate on, where the matrix has been formed."""
        system, stage = self.system, self.stage
        self.r, self.scale, self.has_direction = choose_start(system, *system.evaluate(new_multipliers=True))
        if self.has_direction:  # what was formed at the first iterate is void
            system.form_matrix_and_factors()
            self.r, self.scale = system.evaluate(None)
        least, stalled = self.r, 0
        while not self._done() and self.newton < stage.max_newton and math.isfinite(self.r):
            if self.newton > 0:
                system.form_matrix()
            previous, law = self.r, system.contact_residual
            only_laws = self._is_balanced
            inner, moved = self._solve_contacts(), False
            self.newton += 1
            if not inner.negative:
                self.r, self.scale = system.leave_linear()
                moved = self.r < FALL * least
                if not moved:  # also where it is not a number
                    system.evaluate(AGAIN, 0.0)
                    self.r, self.scale, moved = search(system, FALL * least)
            if not moved:
                moved = self._fall_back()
                if not (inner.negative or self.tight):
                    # where friction goes round and round, a shorter step helps, and more of these do not
                    moved &= self.r < FALL * least or (only_laws and system.contact_residual < FALL * law)
            # where redundant contacts hand impulses on to each other by little, only plain multipliers and a large R lead far
            stalled += self.r > STALLED * least
            self.stalls = stalled >= 2
            if moved and self.r > SLOW_STEP * previous and not self._done():
                self._eliminate()
            least = min(least, self.r)
            self.rounding = self.r <= ROUNDING * self.floor and self.r > 0.5 * previous and self.tight
            if not moved:
                break
        return StageResult(
            self.newton + round(self.eliminated), round(self.linear), relative(self.r, self.scale),
            self._done() and math.isfinite(self.r), self.rounding or self.r <= self.floor, self.multipliers,
            system.contact_residual,
        )  # fmt: skip

    def _fall_back(self) -> bool:
        """A few steps on the true stage from where it was linearised; whether there was any."""
        system, stage = self.system, self.stage
        self.r, self.scale = system.leave_linear(taken=False)
        laws = stage.contact_tolerance if self._is_balanced else math.inf
        steps = Newton(system, replace(stage, max_newton=FALLBACK, contact_tolerance=laws))
        steps.run(self.r, self.scale, fresh=True)
        self.newton += max(0, steps.newton - 1)  # the first is on the matrix at hand
        self.linear, self.multipliers = self.linear + steps.linear, self.multipliers + steps.multipliers
        self.r, self.scale = system.evaluate(None, new_multipliers=True)
        return steps.newton > 0

    def _eliminate(self) -> None:
        """Solve what a slow step left on few nodes."""
        if self._is_balanced:
            return
        found = eliminate(self.system, self.stage, self.r)
        if found is not None:
            self.eliminated, self.linear = self.eliminated + found.newton, self.linear + found.linear
            self.r, self.scale = self.system.evaluate(None, new_multipliers=True)

    @property
    def _is_balanced(self) -> bool:
        """Whether |r| is fine, so that the contact laws alone are left."""
        return self.r <= self.stage.tolerance * self.scale

    def _done(self) -> bool:
        return (self._is_balanced or self.rounding) and self.system.contact_residual <= self.stage.contact_tolerance

    def _solve_contacts(self) -> "Frictional":
        """The contact problem on the matrix at hand, where that is indefinite on a projected one."""
        inner = self._solve_on_matrix()
        if inner.negative:
            self.r, self.scale = self.system.leave_linear(taken=False)
            self.system.form_matrix(projected=True)
            self.newton += 1
            inner = self._solve_on_matrix()
        return inner

    def _solve_on_matrix(self) -> "Frictional":
        """The contact problem on the matrix at hand, to a share of what the stage has left."""
        system, stage = self.system, self.stage
        system.linearise()
        enough = max(SHARE * self.r, LEAST_SHARE * stage.tolerance * self.scale)
        tolerance = enough / self.scale if self.scale > 0.0 else 0.0
        # where the rounding of stiff stress hides the motion of a whole body in |r|, only a tight solve gets that motion right,
        # the first, and impulses only settle where |r| follows them down
        self.tight = self.r <= HIDING * self.floor
        law = LEAST_LAW_SHARE * stage.contact_tolerance
        if not self._is_balanced:
            law = max(law, BALANCE * tolerance)
        problem = replace(
            stage, tolerance=tolerance,
            contact_tolerance=max(LAW_SHARE * system.contact_residual, law),
            tolerance_of_one=0.0 if self.tight else SHARE_OF_ONE * tolerance,
            extrapolate_after=MAX_MULTIPLIERS if self.stalls else 0 if self.tight else stage.extrapolate_after,
            max_newton=PATIENCE * SOLVES if self.stalls else SOLVES,
            linear_tolerance=stage.linear_tolerance or (min(stage.tolerance, FORCING) if self.tight else FORCING),
            later_tolerance=0.0 if stage.linear_tolerance else LATER_FORCING,
        )  # fmt: skip
        inner = solve_linear(system, problem, self._first_residual(), self.scale)
        self.linear, self.multipliers = self.linear + inner.linear, self.multipliers + inner.multipliers
        return inner

    def _first_residual(self) -> float:
        """|r| where a solve begins, of the stage that has just been linearised."""
        system = self.system
        if not self.has_direction:
            return self.r
        self.has_direction = False
        r, _ = system.advance()
        if math.isfinite(r) and system.has_advanced_to_a_root:
            return r
        r, _ = system.leave_linear(taken=False)
        system.linearise()
        return r


def solve(system: StageSystem, stage: Stage) -> StageResult:
    """Solve a stage from the present v, or from v = 0, see `choose_start`.

    x_hat, v_hat, the targets and the contacts are set by the caller.
    """
    system.begin(stage)
    if system.n_contacts == 0:
        newton = Newton(system, stage, eliminate=eliminate)
        if stage.linearised:
            return newton.run_once()
        r, scale, _ = choose_start(system, *system.evaluate())
        return newton.run(r, scale, fresh=False)
    return solve_linearised(system, stage) if stage.linearised else ContactNewton(system, stage).run()


def solve_linearised(system: StageSystem, stage: Stage) -> StageResult:
    """The frictional problem alone, at the present state; of a projected matrix where its own is indefinite."""
    tolerance = stage.linear_tolerance or LINEARISED_FORCING
    problem, linear = replace(stage, max_newton=LINEARISED_SOLVES, linear_tolerance=tolerance), 0
    r, scale = system.evaluate(new_multipliers=True)
    for projected in (False, True):
        system.linearise()
        found = solve_linear(system, problem, r, scale)
        linear += found.linear
        if not found.negative or projected:
            break
        r, scale = system.leave_linear(taken=False)
        system.form_matrix(projected=True)
    low = found.r <= system.rounding.of_stage(stage.c, stage.beta)
    return StageResult(
        found.solves, linear, relative(found.r, scale), found.converged, low, found.multipliers, system.contact_residual,
    )  # fmt: skip
