"""Newton's method for an implicit stage, and, under multipliers, for one with contacts.

A step solves with the unprojected matrix by conjugate gradients; where these meet negative curvature, the direction leads along
it (`linear.pcg`). How far it goes `line_search` says. CG's tolerance follows Newton's progress (Eisenstat and Walker 1996,
choice 2). What a slow step leaves on few nodes is solved there first, see `elimination`.
Contacts make an augmented Lagrangian of the stage, minimised per multiplier down to PROGRESS times what that left of |r|, and
no further than |r| is small enough, unless `tolerance_of_one` or extrapolation ask for more, see `multipliers`.

Convergence: |r| <= tolerance * scale, scale = |c M (v - v_hat)| + beta (|f_el| + |f_ext|) on the free axes, impulses in r, and
the residual of the contact laws, |p - prox(p - f u)| / |p| with f = 1 / (J diag(A)^-1 J^T), within its own tolerance. A residual
below a few times the rounding of the forces (at rest) that a Newton step no longer halves is rounding, which moves nothing by
more than that of a strain, and ends the stage as converged, its residual told as it is. In statics the scale is the applied load
(without any: the constraint forces), and rounding above the tolerance is not convergence.
"""

import math
from collections.abc import Callable
from typing import Any

from taisoft.dynamics.frictional import PROGRESS, ROUNDING
from taisoft.dynamics.line_search import search
from taisoft.dynamics.multipliers import FINER, MAX_MULTIPLIERS, PAST, R_EXTRAPOLATED, R_SCALE, next_scale
from taisoft.dynamics.residual import ELASTIC_STAGE, IMPACT, LINEARISED, STEP
from taisoft.dynamics.stage_result import StageResult, relative
from taisoft.dynamics.stage_system import Stage, StageSystem

LINEAR_LIMIT = 0.01  # true relative residual of a linearly implicit step above which it has failed
MAX_FORCING, RISEN_FORCING = 0.1, 3e-2  # CG's loosest tolerance, and that after a step that raised |r|
STATIC_FORCING = 1e-2  # and in statics, where a loose solve leaves a slender body stretched for the next step to mend
SLOW = 0.2  # a step that leaves more of |r| than this asks for a new matrix,
SERVES = {False: 1, True: 3}  # which serves at least so many; with contacts most of what changes is what touches
SLOW_STEP = 0.1  # a step that leaves more of |r| asks for elimination
FALL = 0.9  # with contacts, share of the least |r| so far below which a step needs no look at its slope


class Newton:
    """Newton steps of a stage under multipliers that are renewed; where that is linear, of its contact problem alone."""

    def __init__(
        self, system: StageSystem, stage: Stage,
        eliminate: "Callable[[StageSystem, Stage, float], Any] | None" = None,
    ):  # fmt: skip
        """eliminate: as `elimination.eliminate`, for steps that leave much; None: there is none."""
        self.system, self.stage, self.eliminate = system, stage, eliminate
        self.inner = system.kind == LINEARISED  # an indefinite matrix is then left to the caller
        self.floor = system.rounding.of_stage(stage.c, stage.beta)
        self.loosest = MAX_FORCING if stage.c > 0.0 else STATIC_FORCING
        self.newton = self.linear = self.multipliers = self.known = 0
        self.eliminated = 0.0  # Newton iterations on few nodes, by their share
        self.rounding = self.negative = False  # nothing but rounding is left of |r|; negative curvature was met

    def run(self, r: float, scale: float, fresh: bool) -> StageResult:
        """From the present state, whose (|r|, scale) is given. fresh: the matrix is formed there."""
        system, served = self.system, 0
        self.r, self.scale, self.touching = r, scale, system.n_contacts > 0
        self.law = math.inf  # the laws' residual when the multipliers were last renewed
        self._aim()
        while True:
            if self._near():
                if self._done() or not self._multiply():
                    break
                continue
            if self.newton >= self.stage.max_newton:
                break
            if not fresh or (served >= SERVES[self.touching] and self.r > SLOW * self.previous):
                if system.kind == ELASTIC_STAGE:
                    system.form_matrix()
                fresh, served = True, 0
            served += 1
            moved = self._step()
            if not math.isfinite(self.r) or not (moved or served > 1) or (self.inner and self.negative):
                break
            fresh = moved and not self._eliminate()
        system.r_scale = R_SCALE  # the next solve finds its own
        return self._result(self._near() and self._done())

    def _aim(self) -> None:
        """The multipliers are new: what |r| is to be brought down to with them."""
        self.goal, self.least, self.previous, self.forcing, self.taken = PROGRESS * self.r, self.r, 0.0, self.loosest, 0

    def _near(self) -> bool:
        """Whether the multipliers have done what they can."""
        enough = self._target()
        if not self.touching or self.stage.keeps_multipliers:
            return self.r <= enough or self.rounding
        lawful = self.system.contact_residual <= self.stage.contact_tolerance
        # in an impact whose laws hold only the momenta are left to balance
        of_one = (FINER if self.multipliers >= self.stage.extrapolate_after else 1.0) * self.stage.enough_of_one * self.scale
        goal = 0.0 if lawful and self.system.kind == IMPACT else max(of_one, self.goal)
        return self.r <= (max(enough, goal) if lawful else goal) or self.rounding

    def _target(self) -> float:
        return max(self.stage.tolerance * self.scale, self.stage.absolute_tolerance)

    def _done(self) -> bool:
        """Whether the stage has converged."""
        if not (self.r <= self._target() or (self.touching and self.r <= self.floor)):
            # statics without any load have nothing to compare the rounding with
            if not (self.rounding and (self.stage.c > 0.0 or self.scale <= self.floor)):
                return False
        return self.system.contact_residual <= self.stage.contact_tolerance

    def _multiply(self) -> bool:
        """Renew the multipliers; False where that has been done too often."""
        if not self.touching or self.stage.keeps_multipliers or self.multipliers >= MAX_MULTIPLIERS:
            return False
        system, law, extrapolating = self.system, self.system.contact_residual, self.multipliers >= self.stage.extrapolate_after
        if extrapolating:
            system.extrapolate_multipliers(self.known)
            system.r_scale, self.known = R_EXTRAPOLATED, min(self.known + 1, PAST)
        else:
            system.r_scale = next_scale(system.r_scale, law, self.law, self.taken)
        self.law, self.multipliers, self.rounding = law, self.multipliers + 1, False
        self.r, self.scale = system.evaluate(None, new_multipliers=not extrapolating)
        self._aim()
        return True

    def _step(self) -> bool:
        """A linear solve and a step along its direction; whether that led anywhere."""
        system = self.system
        answer = system.direction(self._linear_tolerance())
        self.linear += answer.iterations
        self.newton, self.taken = self.newton + 1, self.taken + 1
        self.previous, self.negative = self.r, self.negative or answer.negative
        if self.inner and answer.negative:
            return False
        if self.inner:
            (self.r, self.scale), moved = system.advance(), True
        else:
            self.r, self.scale, moved = search(system, self._enough(answer.negative))
        self.least = min(self.least, self.r)
        # statics go on down to the floor
        low = self.r <= (ROUNDING if self.stage.c > 0.0 else 1.0) * self.floor
        self.rounding = low and self.r > 0.5 * self.previous
        return moved

    def _eliminate(self) -> bool:
        """Solve what a slow step left on few nodes; whether there was such."""
        if self.eliminate is None or self.r <= SLOW_STEP * self.previous or self._near():
            return False
        if (found := self.eliminate(self.system, self.stage, self.r)) is None:
            return False
        self.eliminated, self.linear = self.eliminated + found.newton, self.linear + found.linear
        self.r, self.scale = self.system.evaluate(None)
        self.least = min(self.least, self.r)
        return True

    def _enough(self, negative: bool) -> float:
        """|r| below which the end of a whole step needs no look at its slope."""
        if self.stage.c == 0.0 or negative:  # a lower |r| may be one on a hill
            return self.floor
        return FALL * self.least if self.touching else self.r

    def _linear_tolerance(self) -> float:
        """CG's tolerance by Newton's progress: Eisenstat and Walker's choice 2, with their safeguard.

        A step that bends a slender body raises |r| by stretching it; a loose solve would then only undo that stretch.
        """
        if self.stage.linear_tolerance is not None:
            return max(self.stage.linear_tolerance, self.stage.later_tolerance if self.newton > 0 else 0.0)
        enough = self._target()
        if self.previous == 0.0:
            self.forcing = self.loosest
        elif self.r > self.previous:
            self.forcing = min(RISEN_FORCING, self.loosest)
        else:
            wanted, guard = 0.9 * (self.r / self.previous) ** 2, 0.9 * self.forcing**2
            self.forcing = min(self.loosest, max(wanted, guard if guard > 0.1 else 0.0))
        # the last solve need not go far below what Newton asks for
        tolerance = max(self.forcing, 0.1 * enough / self.r, 1e-12)
        # where the rounding of stiff stress hides the motion of the whole body in |r|, only a tight solve gets that motion right
        return min(tolerance, self.stage.tolerance) if self.floor > enough else tolerance

    def _result(self, converged: bool) -> StageResult:
        r, system = self.r, self.system
        return StageResult(
            self.newton + round(self.eliminated), round(self.linear), relative(r, self.scale), converged and math.isfinite(r),
            self.rounding or r <= self.floor, self.multipliers, system.contact_residual,
        )  # fmt: skip

    def run_once(self) -> StageResult:
        """One whole step without looking back, of a linearised stage without contacts: it has converged when the solve has."""
        system = self.system
        self.touching, self.previous = False, 0.0
        self.r, self.scale = system.evaluate()
        solved = True
        if self.r > self.stage.tolerance * self.scale:
            # no later step corrects a single solve
            tolerance = self.stage.linear_tolerance or min(self._linear_tolerance(), self.stage.tolerance)
            for projected in (False, True):  # of an indefinite matrix there is no least value to go to
                system.form_matrix(projected)
                answer = system.direction(tolerance)
                self.linear += answer.iterations
                if not answer.negative:
                    break
            solved = answer.converged and system.linear_residual() <= LINEAR_LIMIT
            self.r, self.scale = system.evaluate(STEP)
            self.newton = 1
        return self._result(solved)
