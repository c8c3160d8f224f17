"""Newton's method for an implicit stage with contacts: an augmented Lagrangian round the elastic iterations.

Per multiplier: minimise Phi(v) + sum_c psi_c(lambda - R (J v + b)) by the same Newton steps as without contacts, the friction
disks frozen; then lambda = prox(lambda - R (J v + b)), and the disks open as far as its normal parts say. The minimisation
need not go far: to a share of what the multiplier left. The stage has converged when the elastic residual, with the impulses in
it, is within its tolerance and the residual of the contact laws,
    |p - prox(p - f u)| / |p|,   f = 1 / (J diag(A)^-1 J^T),
is within that of the contacts. Both are told as they are.
Linearly implicit steps do the same with elastic forces linearised at x_n: a quadratic problem with contacts.
Source: Alart and Curnier 1991 for the laws as a prox; the loop is that of the method of multipliers.
"""

import math

import numpy as np

from taisoft.contact.problem import RESIDUAL, find_factors
from taisoft.fields import FieldArena
from taisoft.model import Model
from taisoft.scalars import END_SLOPE, START_SLOPE
from taisoft.stepping.contact import ContactStep
from taisoft.stepping.contact_stage import (
    IMPACT,
    SHARE,
    STAY,
    STEP,
    StageContacts,
    build_stage_contacts,
    form_pressed_residual,
    keep_diagonal,
    keep_linear,
    move,
    press,
)
from taisoft.stepping.impact import SPREAD, apply_impact, begin_impact, holding_work, let_go, measure_impact, start_from
from taisoft.stepping.newton import MAX_FORCING, SLOW, StageResult, StageSolver, _forcing, count_all, merge, stalled
from taisoft.stepping.stage import begin_stage, form_residual
from taisoft.transfer import upload

# R over the r-factors at the start of a stage, at least and at most. A larger one means fewer multipliers but more and harder
# Newton steps: it doubles after a multiplier that took one, and is halved after one that took many.
STIFFNESS, SOFTEST, STIFFEST, MANY = 5.0, 3.0, 100.0, 5
PROGRESS = 0.3  # share of what a new multiplier left of |r| that the Newton steps bring it down to
FALL = 0.9  # share of the least |r| so far below which a step needs no look at its slope
FLAT = 0.5  # of the slope at its start: a step that ends on a steeper rise has gone too far
TRIES = 12  # of a step's length
KEPT = 3  # Newton steps that a matrix serves at least: most of what changes is what touches
MAX_MULTIPLIERS = 200
IMPACT_TOLERANCE = 1e-3  # of the contact laws' residual in an impact: what it leaves undone the step after it does


class ContactStageSolver(StageSolver):
    """Implicit stages of a scene with contacts."""

    def __init__(self, model: Model, arena: FieldArena, eps: float, moved: np.ndarray, contact: ContactStep, x_start):
        """x_start: (n_nodes) 3-vectors f64, positions at the start of the step."""
        super().__init__(model, arena, eps, moved)
        self.contact = contact
        self._x_start = x_start
        self._arena = FieldArena()
        self._k: StageContacts | None = None
        self._weighed: tuple[float, float] | None = None  # c and beta of the matrix that the r-factors rest on

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of the fields that grow with the contacts."""
        return self._arena.bytes

    def release(self) -> None:
        """Give their memory back."""
        self._arena.release()

    def update_material(self) -> None:
        """As without contacts; the r-factors rest on the stiffness too."""
        super().update_material()
        self.forget_factors()

    def forget_factors(self) -> None:
        """The r-factors rest on a matrix of other numbers or other free axes."""
        self._weighed = None

    def snapshot(self) -> dict:
        """As without contacts, and the masses of the matrix that the next stage's r-factors rest on."""
        masses = self.contact.problem.inverse_mass.to_numpy() if self._weighed else None
        return super().snapshot() | {"weighed": self._weighed, "inverse_mass": masses}

    def restore(self, kept: dict) -> None:
        """Back to what `snapshot` told; the contacts have been restored."""
        super().restore(kept)
        self._fit()
        self._weighed = None
        if kept["weighed"] is not None:
            upload([(self.contact.problem.inverse_mass, kept["inverse_mass"])])
            c, beta = kept["weighed"]
            self._weighed = float(c), float(beta)

    def _fit(self) -> None:
        """Room for the contacts of this step."""
        if self._k is None or self._k.found is not self.contact.found:
            arena = FieldArena()
            self._k = build_stage_contacts(arena, self.model, self.contact.found, self._x_start)
            self._arena.release()
            self._arena, self._weighed, self.coupling = arena, None, self._k.coupling

    # --- what contacts add to the parts of a Newton step ----------------------------------------------------------

    def _evaluate(
        self, c: float, beta: float, how: int | None = STAY, share: float = 1.0, multiply: bool = False
    ) -> tuple[float, float]:
        """(|r|, scale) where `move` goes; None: x is where it was, and so are the elastic forces. multiply: as `press`."""
        m, w, k = self.model, self.work, self._k
        if how is not None:
            move(m, w, k, self.pcg, self._linear, how, share, c, beta)
        press(m, w, k, self._linear == IMPACT, int(multiply), beta, self._dt, *self.contact.goal, self._stiffness)
        form_pressed_residual(m, w, self.matrix, k, self.pcg, self._linear, beta, self._norms)
        return self._sizes(c, beta)

    def _form_system(self, c: float, beta: float, projected: bool) -> None:
        super()._form_system(c, beta, projected)
        keep_diagonal(self.model, self.matrix, self._k)

    def _go(self, c: float, beta: float, enough: float) -> tuple[float, float, bool]:
        """Take the step in pcg.y as far as it helps; returns (|r|, scale, moved). enough: |r| that needs no further look.

        Contacts that open and close can raise |r| in one step and lower it in the next, round and round. The objective is convex
        along a step but for the elastic part, so its slope tells: a step that ends on a steep rise is cut back by secants.
        """
        scalars = self.model.scalars
        r, scale = self._evaluate(c, beta, STEP)
        slope = scalars[START_SLOPE]
        share, low, at_low, high, at_high = 1.0, 0.0, slope, 1.0, math.inf
        for _ in range(TRIES):
            rise = scalars[END_SLOPE]
            too_far = not rise <= -FLAT * slope  # also where it is not a number
            far_enough = share >= 0.4 * high or rise >= FLAT * slope
            if r < enough or (slope < 0.0 and not too_far and far_enough):
                return r, scale, True
            if slope >= 0.0:
                break
            if too_far:
                high, at_high = share, rise
            else:
                low, at_low = share, rise
            secant = at_low / (at_low - at_high) if math.isfinite(at_high) else 0.5
            share = low + (high - low) * min(max(secant, 0.1 if low == 0.0 else 0.4), 0.9)
            r, scale = self._evaluate(c, beta, SHARE, share)
        r, scale = self._evaluate(c, beta, SHARE, 0.0)
        return r, scale, False

    # --- restitution ------------------------------------------------------------------------------------------------

    def solve_bouncing(
        self, dt: float, tolerance: float, contact_tolerance: float, max_newton: int, linear_tolerance: float | None, linear: bool
    ) -> StageResult:
        """A step of implicit Euler in which surfaces meet with restitution: the impact, then the stage; arguments as there."""
        m, w, tau, out = self.model, self.work, SPREAD * dt, np.zeros(2)
        self._fit()
        self._form_system(1.0, tau, True)
        find_factors(self.contact.problem)
        begin_impact(m, w, self._k, tau, self._norms)
        self._linear, self._dt, self._stiffness, self._weighed = IMPACT, dt, STIFFNESS, None
        impact = self._iterate(
            1.0, tau, tolerance, max(contact_tolerance, IMPACT_TOLERANCE), max_newton, linear_tolerance, True
        )
        measure_impact(m, w, self._k, tau, out)
        slope, curvature = out
        gain = slope + 0.5 * curvature
        share = 1.0 if gain <= 0.0 else max(0.0, -2.0 * slope / curvature)
        slack = -share * (slope + 0.5 * share * curvature)
        apply_impact(m, w, self._k, share)
        if share < 1.0:
            let_go(self.contact.found)
        results = [impact]
        while True:
            start_from(m, w, float(linear))
            results.append(
                self.solve_stage(1.0, dt, dt, tolerance, contact_tolerance, max_newton, linear_tolerance, linear)
            )
            work = holding_work(self._k, dt)
            if work <= slack:
                return count_all(merge([impact, results[-1]]), results[1:-1])
            let_go(self.contact.found)

    # --- the loop -------------------------------------------------------------------------------------------------

    def solve_stage(
        self, c: float, beta: float, dt: float, tolerance: float, contact_tolerance: float, max_newton: int,
        linear_tolerance: float | None, linear: bool, led_share: float = 1.0,
    ) -> StageResult:  # fmt: skip
        """Solve the stage of a step of dt from the present v, contacts as `ContactStep.begin` left them.

        linear: elastic forces linearised at the present x. Without contacts this is `StageSolver.solve`.
        """
        self._linear, self._dt, self._stiffness = False, dt, STIFFNESS
        p = self.contact.problem
        self._fit()
        if p.count[0] == 0:
            self._weighed = None
            r = self.solve(c, beta, tolerance, 1 if linear else max_newton, linear_tolerance, led_share=led_share)
            return StageResult(r.newton_iterations, r.linear_iterations, r.residual, r.converged, r.at_rounding)
        begin_stage(self.model, self.work, beta, led_share)
        fresh = False
        if self._weighed != (c, beta) or linear:
            if linear:
                form_residual(self.model, self.work, self.pcg, c, beta, self._norms)
                keep_linear(self.model, self.work, self._k)
            self._form_system(c, beta, False)
            self._weighed, fresh = (c, beta), True
        find_factors(p)
        self._linear = linear
        return self._iterate(c, beta, tolerance, contact_tolerance, max_newton, linear_tolerance, fresh)

    def _iterate(self, c, beta, tolerance, contact_tolerance, max_newton, linear_tolerance, fresh) -> StageResult:
        state = self.contact.problem.state
        r, scale = self._evaluate(c, beta, multiply=True)
        floor = beta * self.rounding_force + c * self.rounding_mass / beta
        newton = linear = multipliers = served = taken = 0
        needs_projection, forcing, previous, goal, least = False, MAX_FORCING, 0.0, PROGRESS * r, r
        converged = rounding = False
        while True:
            lawful = self._linear == IMPACT and state[RESIDUAL] <= contact_tolerance  # only the momenta are left to balance
            near = r <= (tolerance * scale if lawful else max(tolerance * scale, goal)) or rounding
            if near:  # the multiplier has done what it can
                contact_residual = state[RESIDUAL]
                enough = r <= tolerance * scale or rounding or r <= floor
                if enough and contact_residual <= contact_tolerance:
                    converged = True
                    break
                if multipliers >= MAX_MULTIPLIERS:
                    break
                multipliers += 1
                if taken <= 1:
                    self._stiffness = min(STIFFEST, 2.0 * self._stiffness)
                elif taken >= MANY:
                    self._stiffness = max(SOFTEST, 0.5 * self._stiffness)
                taken = 0
                r, scale = self._evaluate(c, beta, None, multiply=True)
                goal, least, previous, rounding = PROGRESS * r, r, 0.0, False
                continue
            if newton >= max_newton:
                break
            wanted = linear_tolerance
            if wanted is None:
                forcing = _forcing(forcing, r, previous)
                wanted = max(forcing, 0.1 * tolerance * scale / r, 1e-12)
                if floor > tolerance * scale:
                    wanted = min(wanted, tolerance)
            if not self._linear and (not fresh or (served >= KEPT and r > SLOW * previous)):
                self._form_system(c, beta, needs_projection)
                fresh, served = True, 0
            served += 1
            answer = self._direction(wanted)
            linear += answer.iterations
            if answer.negative and not needs_projection:
                needs_projection = True
                self._form_system(c, beta, True)
                answer = self._direction(wanted)
                linear += answer.iterations
            previous = r
            r, scale, moved = self._go(c, beta, FALL * least)
            least = min(least, r)
            newton += 1
            taken += 1
            if not np.isfinite(r):
                break
            if stalled(r, previous, floor, c):
                rounding = True  # nothing but rounding is left
            if not moved:
                if needs_projection or self._linear:
                    break
                needs_projection, fresh = True, False
        relative = r / scale if scale > 0.0 else r
        return StageResult(
            newton, linear, relative, bool(converged and np.isfinite(r)), bool(rounding or r <= floor), multipliers,
            float(state[RESIDUAL]),
        )  # fmt: skip
