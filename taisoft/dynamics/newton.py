"""Newton's method for an implicit stage: one loop for time steps and statics, and one round it for contacts.

A step solves with the unprojected matrix by conjugate gradients; where these meet negative curvature, the direction leads along
it (`linear.pcg`). It is judged by the slope of the merit along it: cut back by secants where it ends on a steep rise, doubled
while it still falls steeply. CG's tolerance follows Newton's progress (Eisenstat and Walker 1996, choice 2).

With contacts each step linearises elasticity and solves the frictional problem on that fixed matrix, which needs no elements:
an augmented Lagrangian of the same steps. Per multiplier lambda the stage is minimised with the friction disks frozen, down to
PROGRESS times what the multiplier left; then lambda = prox(lambda - R u), and the disks open as far as its normal parts say.
R doubles after a multiplier that took one step, and is halved after one that took many. Where the matrix is indefinite, a few
steps minimise the true stage under multipliers instead.
Source: Alart and Curnier 1991 for the laws as a prox; the inner loop is that of the method of multipliers.

Convergence: |r| <= tolerance * scale, scale = |c M (v - v_hat)| + beta (|f_el| + |f_ext|) on the free axes, impulses in r, and
the residual of the contact laws, |p - prox(p - f u)| / |p| with f = 1 / (J diag(A)^-1 J^T), within its own tolerance. A residual
below a few times the rounding of the forces (at rest) that a Newton step no longer halves is rounding, which moves nothing by
more than that of a strain, and ends the stage as converged, its residual told as it is. In statics the scale is the applied load
(without any: the constraint forces), and rounding above the tolerance is not convergence.
"""

import math
from dataclasses import dataclass, replace

from taisoft.dynamics.residual import AGAIN, ELASTIC_STAGE, IMPACT, LINEARISED, STEP
from taisoft.dynamics.stage_system import Stage, StageSystem

ROUNDING = 4.0  # times the floor: what rounding may leave, as strains grow (up to 2.8 times was seen, in a thin sheet)
LINEAR_LIMIT = 0.01  # true relative residual of a linearly implicit step above which it has failed
MAX_FORCING, RISEN_FORCING = 0.1, 3e-2  # CG's loosest tolerance, and that after a step that raised |r|
SLOW = 0.2  # a step that leaves more of |r| than this asks for a new matrix,
SERVES = {False: 1, True: 3}  # which serves at least so many; with contacts most of what changes is what touches
FLAT, STEEP = 0.5, 0.3  # of the slope at its start: a rise that is too far; a fall on which a step is doubled
TRIES, LONGEST = 20, 1024.0  # of a step's length
FALL = 0.9  # with contacts, share of the least |r| so far below which a step needs no look at its slope
PROGRESS = 0.3  # share of what a new multiplier left of |r| that the Newton steps bring it down to
R_SCALE, SOFTEST, STIFFEST, MANY = 1.0, 0.3, 100.0, 5  # R over the r-factors at first and its bounds; steps that are many
MAX_MULTIPLIERS = 200
INNER_SOLVES, INNER_FORCING = 60, 0.3  # of the contact problem on a fixed matrix
INNER_SHARE, INNER_LAW, LEAST_SHARE = 0.1, 0.1, 0.3
FALLBACK = 6  # Newton steps on the true problem where the matrix is indefinite


@dataclass(frozen=True)
class StageResult:
    """What a solve did. Without contacts they have converged at 0 iterations."""

    newton_iterations: int
    linear_iterations: int
    residual: float  # relative
    converged: bool  # with the contacts
    at_rounding: bool  # the residual is at the rounding of the forces
    contact_iterations: int = 0  # multipliers
    contact_residual: float = 0.0


def merge(results: list[StageResult]) -> StageResult:
    """The parts of one step: iterations in all, the worst residuals."""
    return StageResult(
        sum(r.newton_iterations for r in results), sum(r.linear_iterations for r in results),
        max(r.residual for r in results), all(r.converged for r in results), all(r.at_rounding for r in results),
        sum(r.contact_iterations for r in results), max(r.contact_residual for r in results),
    )  # fmt: skip


def count_all(result: StageResult, given_up: list[StageResult]) -> StageResult:
    """The result of a step with the iterations of earlier tries at it."""
    work = merge([result, *given_up])
    return replace(
        result, newton_iterations=work.newton_iterations, linear_iterations=work.linear_iterations,
        contact_iterations=work.contact_iterations,
    )  # fmt: skip


def search(system: StageSystem, enough: float) -> tuple[float, float, bool]:
    """Take the step as far as it helps: (|r|, scale, whether it did). enough: |r| that needs no further look.

    Contacts that open and close, and tets that turn, can raise |r| in one step and lower it in the next. The slope of the
    merit tells: a step that ends on a steep rise is cut back by secants, one that ends on a steep fall is doubled.
    """
    r, scale = system.evaluate(STEP)
    length, low, at_low, high, at_high = 1.0, 0.0, system.slopes[0], math.inf, math.inf
    slope = at_low
    for _ in range(TRIES):
        rise = system.slopes[1]
        too_far = not rise <= -FLAT * slope  # also where it is not a number
        if r < enough or (slope < 0.0 and not too_far and (rise >= STEEP * slope or length >= min(0.4 * high, LONGEST))):
            return r, scale, True
        if slope >= 0.0:
            break
        if too_far:
            high, at_high = length, rise
        else:
            low, at_low = length, rise
        if high == math.inf:
            length *= 2.0
        else:
            secant = at_low / (at_low - at_high) if math.isfinite(at_high) else 0.5
            length = low + (high - low) * min(max(secant, 0.1 if low == 0.0 else 0.4), 0.9)
        r, scale = system.evaluate(AGAIN, length)
    r, scale = system.evaluate(AGAIN, 0.0)
    return r, scale, False


class Newton:
    """Newton steps of a stage under multipliers that are renewed; where that is linear, of its contact problem alone."""

    def __init__(self, system: StageSystem, stage: Stage, inner: bool = False):
        self.system, self.stage, self.inner = system, stage, inner
        self.floor = system.rounding.of_stage(stage.c, stage.beta)
        self.newton = self.linear = self.multipliers = 0
        self.rounding = self.negative = False  # nothing but rounding is left of |r|; negative curvature was met

    def run(self, r: float, scale: float, fresh: bool) -> StageResult:
        """From the present state, whose (|r|, scale) is given. fresh: the matrix is formed there."""
        system, served = self.system, 0
        self.r, self.scale, self.touching = r, scale, system.n_contacts > 0
        system.r_scale = R_SCALE
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
            fresh = moved
        return self._result(self._near() and self._done())

    def _aim(self) -> None:
        """The multipliers are new: what |r| is to be brought down to with them."""
        self.goal, self.least, self.previous, self.forcing, self.taken = PROGRESS * self.r, self.r, 0.0, MAX_FORCING, 0

    def _near(self) -> bool:
        """Whether the multipliers have done what they can."""
        enough = self.stage.tolerance * self.scale
        # in an impact whose laws hold only the momenta are left to balance
        lawful = self.system.kind == IMPACT and self.system.contact_residual <= self.stage.contact_tolerance
        return self.r <= (max(enough, self.goal) if self.touching and not lawful else enough) or self.rounding

    def _done(self) -> bool:
        """Whether the stage has converged."""
        stage = self.stage
        if not (self.r <= stage.tolerance * self.scale or (self.touching and self.r <= self.floor)):
            # statics without any load have nothing to compare the rounding with
            if not (self.rounding and (stage.c > 0.0 or self.scale <= self.floor)):
                return False
        return self.system.contact_residual <= stage.contact_tolerance

    def _multiply(self) -> bool:
        """Take the impulses as new multipliers; False where that has been done too often."""
        if not self.touching or self.multipliers >= MAX_MULTIPLIERS:
            return False
        system = self.system
        if self.taken <= 1:
            system.r_scale = min(STIFFEST, 2.0 * system.r_scale)
        elif self.taken >= MANY:
            system.r_scale = max(SOFTEST, 0.5 * system.r_scale)
        self.multipliers, self.rounding = self.multipliers + 1, False
        self.r, self.scale = system.evaluate(None, new_multipliers=True)
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
        if system.kind == LINEARISED:
            (self.r, self.scale), moved = system.advance(), True
        else:
            self.r, self.scale, moved = search(system, self._enough(answer.negative))
        self.least = min(self.least, self.r)
        # statics go on down to the floor
        low = self.r <= (ROUNDING if self.stage.c > 0.0 else 1.0) * self.floor
        self.rounding = low and self.r > 0.5 * self.previous
        return moved

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
            return self.stage.linear_tolerance
        enough = self.stage.tolerance * self.scale
        if self.previous == 0.0:
            self.forcing = MAX_FORCING
        elif self.r > self.previous:
            self.forcing = RISEN_FORCING
        else:
            wanted, guard = 0.9 * (self.r / self.previous) ** 2, 0.9 * self.forcing**2
            self.forcing = min(MAX_FORCING, max(wanted, guard if guard > 0.1 else 0.0))
        # the last solve need not go far below what Newton asks for
        tolerance = max(self.forcing, 0.1 * enough / self.r, 1e-12)
        # where the rounding of stiff stress hides the motion of the whole body in |r|, only a tight solve gets that motion right
        return min(tolerance, self.stage.tolerance) if self.floor > enough else tolerance

    def _result(self, converged: bool) -> StageResult:
        r, system = self.r, self.system
        return StageResult(
            self.newton, self.linear, r / self.scale if self.scale > 0.0 else r, converged and math.isfinite(r),
            self.rounding or r <= self.floor, self.multipliers, system.contact_residual,
        )  # fmt: skip

    def run_once(self) -> StageResult:
        """One whole step without looking back, of a linearised stage without contacts: it has converged when the solve has."""
        system = self.system
        self.touching, self.previous = False, 0.0
        self.r, self.scale = system.evaluate()
        solved = True
        if self.r > self.stage.tolerance * self.scale:
            tolerance = min(self._linear_tolerance(), self.stage.tolerance)  # nobody corrects a single solve
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


class ContactNewton:
    """Newton steps of a stage with contacts: each linearises elasticity, and solves its contact problem on the fixed matrix."""

    def __init__(self, system: StageSystem, stage: Stage):
        self.system, self.stage = system, stage
        self.floor = system.rounding.of_stage(stage.c, stage.beta)
        self.newton = self.linear = self.multipliers = 0
        self.rounding = False

    def run(self, fresh: bool) -> StageResult:
        """From the first iterate on. fresh: the matrix is formed there."""
        system, stage = self.system, self.stage
        self.r, self.scale = self._start()
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
            self.rounding = self.r <= ROUNDING * self.floor and self.r > 0.5 * previous
            if not moved:
                break
        return StageResult(
            self.newton, self.linear, self.r / self.scale if self.scale > 0.0 else self.r,
            self._done() and math.isfinite(self.r), self.rounding or self.r <= self.floor, self.multipliers,
            system.contact_residual,
        )  # fmt: skip

    def _start(self) -> tuple[float, float]:
        """(|r|, scale) at the first iterate: that of lower merit of the one at hand and the state at the start.

        An impact is nearer to the state before it, flight to where the velocity leads.
        """
        system = self.system
        system.r_scale = R_SCALE
        system.stand_still(new_multipliers=True)
        still = system.merit()
        moving = system.go_back()
        return moving if system.merit() <= still else system.stand_still()

    def _done(self) -> bool:
        enough = self.r <= self.stage.tolerance * self.scale or self.rounding or self.r <= self.floor
        return enough and self.system.contact_residual <= self.stage.contact_tolerance

    def _solve_contacts(self) -> Newton:
        """The contact problem on the matrix at hand, to a share of what the stage has left."""
        system, stage = self.system, self.stage
        system.linearise()
        enough = max(INNER_SHARE * self.r, LEAST_SHARE * stage.tolerance * self.scale)
        law = max(INNER_LAW * system.contact_residual, LEAST_SHARE * stage.contact_tolerance)
        inner = Newton(
            system, replace(
                stage, tolerance=enough / self.scale, contact_tolerance=law, linear_tolerance=INNER_FORCING,
                max_newton=INNER_SOLVES,
            ), inner=True,
        )  # fmt: skip
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
    if stage.linearised:
        r, scale = system.evaluate(new_multipliers=True)
        system.linearise()
        return Newton(system, stage).run(r, scale, True)
    return ContactNewton(system, stage).run(fresh)
