"""Newton's method for an implicit stage; with contacts, inside an augmented Lagrangian loop.

Each step solves with the unprojected matrix by conjugate gradients; at negative curvature the direction follows it
(`linear.pcg`). The step length is found by `search`. CG's tolerance follows Newton's progress (Eisenstat and Walker 1996,
choice 2). If a slow step leaves a residual on few nodes, these are solved separately first, see `elimination`.
With contacts, inner solves are inexact: the augmented Lagrangian is minimised until |r| is PROGRESS times its value after the
multiplier update, or small enough, unless extrapolation requires a smaller |r|, see `friction`.

Convergence: |r| <= tolerance * scale, scale = |c M (v - v_hat)| + beta (|f_el| + |f_ext|) on the free axes, impulses in r, and
the residual of the contact laws, |p - prox(p - f u)| / |p| with f = 1 / (J diag(A)^-1 J^T), within its own tolerance. A residual
below a few times the rounding of the forces (at rest) that a Newton step no longer halves is rounding. It corresponds to strains
of rounding size, so the stage ends as converged and reports its actual residual. In statics the scale is the applied load
(without any: the constraint forces), and rounding above the tolerance is not convergence.

The line search goes by the slope of the merit function along a step, since opening and closing contacts, and tets that invert,
can increase |r| in one step and decrease it in the next. A step that ends on a steep rise is shortened by secants, one that ends
on a steep descent is doubled. Nearly incompressible bodies with mean dilatation first try a curved step (`step_with_volumes`).
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from taisoft.dynamics.constraints import solve_constrained
from taisoft.dynamics.contact_terms import KEEP, TO_IMPULSES
from taisoft.dynamics.friction import PAST, Friction, extrapolate_multipliers
from taisoft.dynamics.results import StageResult, relative
from taisoft.dynamics.stage import AGAIN, ELASTIC_STAGE, IMPACT, STEP, Stage
from taisoft.dynamics.stage_system import StageSystem
from taisoft.linear.pcg_work import LinearResult

FLAT, STEEP = 0.5, 0.3  # of the initial slope: rise that shortens a step; descent that doubles it
TRIES, LONGEST = 20, 1024.0  # trial step lengths, and the longest
FAR = 0.5  # |r| over scale at the first iterate above which v = 0 is tried


class Newton:
    """Newton steps and multiplier updates of a stage."""

    LINEAR_LIMIT = 0.01  # relative true residual above which a linearly implicit step has failed
    MAX_FORCING, INCREASE_FORCING = 0.1, 3e-2  # CG's maximum tolerance, and that after a step that increased |r|
    STATIC_FORCING = 1e-2  # maximum in statics, where a loose solve leaves a slender body stretched for the next step to correct
    REBUILD_RATIO = 0.2  # a step that leaves a larger fraction of |r| requires a new matrix,
    REBUILD_VOLUMES = 0.01  # with `step_with_volumes`, whose first matrix is that of the step's start and whose solves are longer
    # minimum steps per matrix, without and with contacts; with them mostly the active contacts change
    MIN_USES = {False: 1, True: 3}
    ELIMINATION_RATIO = 0.1  # a step that leaves a larger fraction of |r| requires elimination
    DECREASE = 0.9  # with contacts, fraction of the smallest |r| so far below which a step is accepted without its slope

    def __init__(self, system: StageSystem, stage: Stage, eliminate: "Callable[[StageSystem, Stage, float], Any] | None" = None):
        """eliminate: as `elimination.eliminate`, called after slow steps; None: no elimination."""
        self.system, self.stage, self.eliminate = system, stage, eliminate
        self._counts = not system.work.pcg.subset.restricted  # in the step's budget; else the caller does
        is_constrained = self._counts and system.multipliers is not None and system.multipliers.penalised
        self._solve_linear = partial(solve_constrained, system) if is_constrained else system.solve_linear
        self.max_forcing = self.MAX_FORCING if stage.c > 0.0 else self.STATIC_FORCING
        self.newton = self.linear = self.multigrid = self.multipliers = self.n_remembered = 0
        self.eliminated = 0.0  # Newton iterations on few nodes, times their fraction of all nodes
        self.rounding = False  # |r| is only rounding

    def run(self, r: float, scale: float, fresh: bool) -> StageResult:
        """Solve from the present state, whose (|r|, scale) is given. fresh: whether the matrix is formed there."""
        system, n_uses = self.system, 0
        rebuild_ratio = self.REBUILD_VOLUMES if system.keeps_volumes else self.REBUILD_RATIO
        self.r, self.scale, self.has_contacts = r, scale, system.n_contacts > 0
        self.law_residual = math.inf  # the laws' residual at the last multiplier update
        self._begin_multiplier()
        converged = False
        while True:
            if self._inner_done():
                if self._has_converged():
                    if converged := system.balances_pieces():
                        break
                    self._begin_again()
                elif not self._update_multipliers():
                    break
                continue
            if self.newton >= self.stage.max_newton or (self._counts and not system.budget.left):
                break
            if not fresh or (n_uses >= self.MIN_USES[self.has_contacts] and self.r > rebuild_ratio * self.previous):
                if system.kind == ELASTIC_STAGE:
                    system.form_matrix()
                fresh, n_uses = True, 0
            n_uses += 1
            moved = self._step()
            if not math.isfinite(self.r) or not (moved or n_uses > 1):
                break
            fresh = moved and not self._eliminate()
        system.r_scale = Stage.first_r_scale  # initial value of the next solve
        return self._result(converged or (self._inner_done() and self._has_converged() and system.balances_pieces()))

    def _begin_again(self) -> None:
        """Go on from |r| in new weights, in which it has not converged."""
        self.r, self.scale = self.system.evaluate(None)
        self.rounding = False
        self._begin_multiplier()

    def _begin_multiplier(self) -> None:
        """Set the target of |r| and reset the progress after a multiplier update."""
        self.inner_target, self.lowest, self.previous, self.forcing, self.n_inner = (
            Friction.PROGRESS * self.r,
            self.r,
            0.0,
            self.max_forcing,
            0,
        )

    def _inner_done(self) -> bool:
        """Return whether |r| is small enough for the present multipliers."""
        target = self._target()
        if not self.has_contacts or self.stage.keeps_multipliers:
            return (self.r <= target or self.rounding) and self.system.multipliers_hold
        laws_hold = self.system.contact_residual <= self.stage.contact_tolerance
        # in an impact whose laws hold, only the momenta remain to be balanced
        inner = (Friction.FINER if self.multipliers >= self.stage.extrapolate_after else 1.0) * self.stage.tolerance * self.scale
        inner_target = 0.0 if laws_hold and self.system.kind == IMPACT else max(inner, self.inner_target)
        return self.r <= (max(target, inner_target) if laws_hold else inner_target) or self.rounding

    def _target(self) -> float:
        return max(self.stage.tolerance * self.scale, self.stage.absolute_tolerance)

    def _has_converged(self) -> bool:
        """Return whether the stage has converged."""
        if not (self.r <= self._target() or (self.has_contacts and self.r <= self.system.floor)):
            # statics without load has no scale to compare the rounding with
            if not (self.rounding and (self.stage.c > 0.0 or self.scale <= self.system.floor)):
                return False
        return self.system.contact_residual <= self.stage.contact_tolerance

    def _update_multipliers(self) -> bool:
        """Update the multipliers; return False if their maximum number is reached."""
        if not self.has_contacts or self.stage.keeps_multipliers or self.multipliers >= Friction.MAX_MULTIPLIERS:
            return False
        system, law, extrapolating = self.system, self.system.contact_residual, self.multipliers >= self.stage.extrapolate_after
        if extrapolating:
            extrapolate_multipliers(system.contacts, self.n_remembered)
            system.r_scale, self.n_remembered = Friction.R_EXTRAPOLATED, min(self.n_remembered + 1, PAST)
        else:
            bounds = self.stage.max_r_scale, self.stage.contact_tolerance
            system.r_scale = Friction.next_scale(
                system.r_scale, law, self.law_residual, self.n_inner, system.frictionless, *bounds
            )
        self.law_residual, self.multipliers, self.rounding = law, self.multipliers + 1, False
        self.r, self.scale = system.evaluate(None, new_multipliers=KEEP if extrapolating else TO_IMPULSES)
        self._begin_multiplier()
        return True

    def _step(self) -> bool:
        """Solve for a direction and step along it; return whether the state moved."""
        system = self.system
        solution = self._solve_linear(self._linear_tolerance())
        self._count_linear(solution)
        self.newton, self.n_inner = self.newton + 1, self.n_inner + 1
        if self._counts:
            system.budget.spend()
        self.previous = self.r
        self.r, self.scale, moved = search(system, self._acceptable_residual(solution.negative))
        self.lowest = min(self.lowest, self.r)
        # statics continues down to the floor
        near_floor = self.r <= (Friction.ROUNDING if self.stage.c > 0.0 else 1.0) * self.system.floor
        self.rounding = near_floor and self.r > 0.5 * self.previous
        return moved

    def _count_linear(self, solution: LinearResult) -> None:
        self.linear, self.multigrid = self.linear + solution.iterations, self.multigrid + solution.multigrid

    def _eliminate(self) -> bool:
        """Solve the few nodes that dominate |r| after a slow step; return whether there were any."""
        if self.eliminate is None or self.r <= self.ELIMINATION_RATIO * self.previous or self._inner_done():
            return False
        if (found := self.eliminate(self.system, self.stage, self.r)) is None:
            return False
        self.eliminated, self.linear = self.eliminated + found.newton, self.linear + found.linear
        self.r, self.scale = self.system.evaluate(None)
        self.lowest = min(self.lowest, self.r)
        return True

    def _acceptable_residual(self, negative: bool) -> float:
        """Return |r| below which a full step is accepted without checking its slope."""
        if self.stage.c == 0.0 or negative:  # a lower |r| may be at a maximum of the energy
            return self.system.floor
        return self.DECREASE * self.lowest if self.has_contacts else self.r

    def _linear_tolerance(self) -> float:
        """Return CG's tolerance by Newton's progress: Eisenstat and Walker's choice 2, with their safeguard.

        A step that bends a slender body increases |r| by stretching it; a loose solve would then only undo that stretch.
        """
        if self.stage.linear_tolerance is not None:
            return self.stage.linear_tolerance
        target = self._target()
        if self.previous == 0.0:
            self.forcing = self.max_forcing
        elif self.r > self.previous:
            self.forcing = min(self.INCREASE_FORCING, self.max_forcing)
        else:
            wanted, safeguard = 0.9 * (self.r / self.previous) ** 2, 0.9 * self.forcing**2
            self.forcing = min(self.max_forcing, max(wanted, safeguard if safeguard > 0.1 else 0.0))
        # the last solve need not go far below Newton's tolerance; |r| may be below it while given volumes and lengths do not hold
        tolerance = max(self.forcing, 0.1 * target / self.r if self.r > target else 0.1, 1e-12)
        # if rounding of stiff stress hides the rigid motion in |r|, only a tight solve gets that motion right
        return min(tolerance, self.stage.tolerance) if self.system.floor > target else tolerance

    def _result(self, converged: bool) -> StageResult:
        r, system = self.r, self.system
        return StageResult(
            self.newton + self.eliminated,
            round(self.linear),
            relative(r, self.scale),
            converged and math.isfinite(r),
            self.rounding or r <= self.system.floor,
            self.multipliers,
            system.contact_residual,
            unbalanced=(0.0, "") if converged else system.least_balanced(),
            multigrid_solves=self.multigrid,
        )

    def solve_once(self) -> StageResult:
        """Take one full step without line search, of a linearised stage without contacts; it converges if the solve does."""
        system = self.system
        self.has_contacts, self.previous = False, 0.0
        self.r, self.scale = system.begin_linearised_step()
        solved = True
        if self.r > self.stage.tolerance * self.scale:
            # no later step corrects this solve
            tolerance = self.stage.linear_tolerance or min(self._linear_tolerance(), self.stage.tolerance)
            for projected in (False, True):  # an indefinite quadratic form has no minimum
                system.form_matrix(projected)
                solution = self._solve_linear(tolerance)
                self._count_linear(solution)
                if not solution.negative:
                    break
            solved = solution.converged and system.linear_residual() <= self.LINEAR_LIMIT
            self.newton = 1
            system.budget.spend()
        else:
            system.work.pcg.y.fill(0.0)
        self.r, self.scale = system.take_linearised_step()
        return self._result(solved)


def choose_start(system: StageSystem, r: float, scale: float) -> tuple[float, float, bool]:
    """Start from v = 0 if |r| is smaller there than at the first iterate, whose (|r|, scale) is given.

    Return (|r|, scale) there, and whether it is v = 0; then y points back to the first iterate, a good first direction on the
    matrix formed at v = 0. If tets oscillate many times in a step, as inverted ones do, continuing their motion is far from
    balance. Statics keeps its start.
    """
    if r <= FAR * scale or system.is_static:
        return r, scale, False
    system.set_direction_to_rest()
    trial = system.evaluate(STEP)
    if trial[0] < r or not math.isfinite(r):
        system.negate_direction()
        return *trial, True
    return *system.evaluate(AGAIN, 0.0), False


def search(system: StageSystem, acceptable: float) -> tuple[float, float, bool]:
    """Search the step length; return (|r|, scale, success). acceptable: |r| below which the slope is not checked.

    The straight step is searched if there is no curved one, or if that leaves more than `acceptable`.
    """
    if (found := system.step_with_volumes(acceptable)) is not None:
        return *found, True
    r, scale = system.evaluate(STEP)
    length, low, at_low, high, at_high = 1.0, 0.0, system.slopes[0], math.inf, math.inf
    slope = at_low
    for _ in range(TRIES):
        rise = system.slopes[1]
        too_far = not rise <= -FLAT * slope  # also if it is not a number
        if r < acceptable or (slope < 0.0 and not too_far and (rise >= STEEP * slope or length >= min(0.4 * high, LONGEST))):
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
