"""Newton's method for a stage with contacts: each step linearises elasticity and solves the frictional problem on that matrix.

The problem on the fixed matrix needs no elements: `Newton` solves it as an augmented Lagrangian, inexactly, from the impulses so
far. Its way is a direction for the true stage, judged by |r| and else by the slope of the augmented Lagrangian with the impulses
found as multipliers. Where the matrix is indefinite, a few steps minimise the true stage under multipliers instead.
"""

import math
from dataclasses import replace

from taisoft.dynamics.line_search import search
from taisoft.dynamics.newton import FALL, R_SCALE, ROUNDING, Newton
from taisoft.dynamics.residual import AGAIN
from taisoft.dynamics.stage_result import StageResult
from taisoft.dynamics.stage_system import Stage, StageSystem

SOLVES, FORCING = 60, 0.3  # linear solves of one frictional problem, and their tolerance
SHARE, LAW_SHARE = 0.1, 0.1  # of what the stage has left of |r| and of the laws' residual: what such a problem is solved to,
LEAST_SHARE = 0.3  # or this share of the tolerances
LINEARISED_SOLVES = 400  # linear solves of a linearised stage
FALLBACK = 6  # steps on the true stage
HIDING = 10.0  # times the floor of |r|: where the motion of a whole body may be what is left of it


class ContactNewton:
    """Newton steps of a stage with contacts: each linearises elasticity, and solves its contact problem on the fixed matrix."""

    def __init__(self, system: StageSystem, stage: Stage):
        self.system, self.stage = system, stage
        self.floor = system.rounding.of_stage(stage.c, stage.beta)
        self.newton = self.linear = self.multipliers = 0
        self.rounding = self.tight = False

    def run(self, fresh: bool) -> StageResult:
        """From the first iterate on. fresh: the matrix is formed there."""
        system, stage = self.system, self.stage
        system.r_scale = R_SCALE
        self.r, self.scale = system.evaluate(new_multipliers=True)
        least = self.r
        while not self._done() and self.newton < stage.max_newton and math.isfinite(self.r):
            if not fresh:
                system.form_matrix()
            fresh = False
            previous = self.r
            inner = self._solve_contacts()
            self.newton += 1
            if inner.negative:
                r, scale = system.leave_linear(taken=False)
                steps = Newton(system, replace(stage, max_newton=FALLBACK, contact_tolerance=math.inf))
                steps.run(r, scale, fresh=True)
                self.newton, self.linear = self.newton + steps.newton - 1, self.linear + steps.linear
                self.r, self.scale, moved = steps.r, steps.scale, steps.newton > 0
            else:
                self.r, self.scale = system.leave_linear()
                moved = self.r < FALL * least
                if not moved:  # also where it is not a number
                    system.evaluate(AGAIN, 0.0)
                    self.r, self.scale, moved = search(system, FALL * least)
            least = min(least, self.r)
            self.rounding = self.r <= ROUNDING * self.floor and self.r > 0.5 * previous and self.tight
            if not moved:
                break
        return StageResult(
            self.newton, self.linear, self.r / self.scale if self.scale > 0.0 else self.r,
            self._done() and math.isfinite(self.r), self.rounding or self.r <= self.floor, self.multipliers,
            system.contact_residual,
        )  # fmt: skip

    def _done(self) -> bool:
        enough = self.r <= self.stage.tolerance * self.scale or self.rounding
        return enough and self.system.laws_hold(self.stage.contact_tolerance, self.floor)

    def _solve_contacts(self) -> Newton:
        """The contact problem on the matrix at hand, to a share of what the stage has left."""
        system, stage = self.system, self.stage
        system.linearise()
        enough = max(SHARE * self.r, LEAST_SHARE * stage.tolerance * self.scale)
        law = max(LAW_SHARE * system.contact_residual, LEAST_SHARE * stage.contact_tolerance)
        # where the rounding of stiff stress hides the motion of a whole body in |r|, only tight solves get that motion right
        self.tight = self.r <= HIDING * self.floor
        problem = replace(
            stage, tolerance=enough / self.scale if self.scale > 0.0 else 0.0, contact_tolerance=law, max_newton=SOLVES,
            linear_tolerance=stage.linear_tolerance or (min(stage.tolerance, FORCING) if self.tight else FORCING),
        )  # fmt: skip
        inner = Newton(system, problem, inner=True)
        inner.run(self.r, self.scale, fresh=True)
        self.linear, self.multipliers = self.linear + inner.linear, self.multipliers + inner.multipliers
        system.r_scale = R_SCALE
        return inner


def solve(system: StageSystem, stage: Stage) -> StageResult:
    """Solve a stage from the present v. x_hat, v_hat, the targets and the contacts are set by the caller."""
    fresh = system.begin(stage)
    if system.n_contacts == 0:
        newton = Newton(system, stage)
        return newton.run_once() if stage.linearised else newton.run(*system.evaluate(), fresh)
    return solve_linearised(system, stage) if stage.linearised else ContactNewton(system, stage).run(fresh)


def solve_linearised(system: StageSystem, stage: Stage) -> StageResult:
    """The frictional problem alone, at the present state; of a projected matrix where its own is indefinite."""
    problem, linear = replace(stage, max_newton=LINEARISED_SOLVES), 0
    r, scale = system.evaluate(new_multipliers=True)
    for projected in (False, True):
        system.linearise()
        newton = Newton(system, problem, inner=True)
        result = newton.run(r, scale, fresh=True)
        linear += newton.linear
        if not newton.negative or projected:
            break
        r, scale = system.leave_linear(taken=False)
        system.form_matrix(projected=True)
    return replace(result, linear_iterations=linear)
