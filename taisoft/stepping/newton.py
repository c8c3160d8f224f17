"""Newton's method for one implicit stage, shared by every implicit integrator and the static solve.

Unknown v (with x = x_hat + beta v), residual on the free axes
    r(v) = c M (v - v_hat) - beta (f_el(x) + f_loads + M g - a M v - b K_d v),
system (c + beta a) M + beta^2 K(x) + beta b K_d, the gradient and second derivative of
    Phi(v) = c/2 |v - v_hat|^2_M + psi(x) - loads.x - M g.x + beta/2 v.(a M + b K_d) v.
c = 1 for a time step, 0 for statics (v is then a displacement). A full step that lowers |r| is taken; otherwise Phi
decides by backtracking. K is unprojected; negative curvature in CG asks for the projected one. CG's tolerance follows
Newton's progress (Eisenstat and Walker 1996, choice 2).
Convergence: |r| <= tolerance * scale, scale = |c M (v - v_hat)| + beta (|f_el| + |f_ext|) on the free axes. The rounding of F
makes forces of its own; a residual below a few of those (the floor, at rest) that a Newton step no longer halves is rounding,
which moves nothing by more than that of a strain, and ends the stage as converged, its residual told as it is. In statics the
scale is the applied load (without any: the constraint forces), and rounding above the tolerance is not convergence.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import taichi as ti

from taisoft.elasticity import measure
from taisoft.fields import FieldArena
from taisoft.linear import block_csr, pcg
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.coupling import NO_COUPLING
from taisoft.model import Model
from taisoft.scalars import ELASTIC, GRAVITY, POTENTIAL, START_SLOPE
from taisoft.stepping.stage import StageWork, begin_stage, form_residual, stage_terms, start_step, try_step
from taisoft.transfer import download, upload

MAX_BACKTRACKS = 30  # halvings: below 1e-9 of a step nothing but rounding is left
SLOW = 0.2  # a step that leaves more of |r| than this asks for a new matrix
LINEAR_LIMIT = 0.01  # true relative residual of a linearly implicit step above which it has failed
MAX_FORCING = 0.1  # CG's loosest tolerance
ROUNDING = 4.0  # times the floor: what rounding may leave, as strains grow (up to 2.8 times was seen, in a thin sheet)
UNSEEN = 1e-10  # share of Phi below which small strains round it: F - I cancels
RISEN_FORCING = 3e-2  # CG's tolerance after a step that lowered Phi but raised |r|
SUFFICIENT = 1e-4  # Armijo's share of the predicted decrease


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


def _forcing(last: float, r: float, previous: float) -> float:
    """CG's tolerance from Newton's progress: Eisenstat and Walker's choice 2, with their safeguard.

    A step that bends a slender body raises |r| by stretching it; a loose solve would then only undo that stretch.
    """
    if previous == 0.0:
        return MAX_FORCING
    if r > previous:
        return RISEN_FORCING
    wanted, guard = 0.9 * (r / previous) ** 2, 0.9 * last**2
    return min(MAX_FORCING, max(wanted, guard if guard > 0.1 else 0.0))


def stalled(r: float, previous: float, floor: float, c: float) -> bool:
    """Whether a Newton step from |r| = previous has left rounding; statics go on down to the floor."""
    return r <= (ROUNDING if c > 0.0 else 1.0) * floor and r > 0.5 * previous


class StageSolver:
    """Owns the matrix and the vectors of implicit stages over one model."""

    def __init__(self, model: Model, arena: FieldArena, eps: float, moved: np.ndarray):
        self.model, self.eps = model, eps
        self.matrix: BlockCsr = block_csr.build_block_csr(model, arena, model.real)
        self.damper = (
            block_csr.sibling(self.matrix, model, arena, model.real, "damping") if model.stiffness_damping else None
        )
        n, k = model.n_nodes, len(moved)
        self.pcg = pcg.build_pcg(model, arena)
        self.work = StageWork(
            x_hat=arena.vectors("x_hat", ti.f64, n), v_hat=arena.vectors("v_hat", model.real, n),
            base=arena.vectors("x_base", ti.f64, n), residual=arena.vectors("residual", model.real, n),
            moved=arena.field("stage_moved", ti.i32, k, moved.astype(np.int32)) if k else None,
            moved_axes=arena.vectors("stage_moved_axes", ti.i32, k) if k else None,
            targets=arena.vectors("stage_targets", ti.f64, k) if k else None,
            led_acceleration=arena.vectors("led_acceleration", ti.f64, k) if k and model.consistent else None,
            n_moved=k, change=arena.vectors("change", ti.f64, n), damper=self.damper,
        )  # fmt: skip
        self.coupling = NO_COUPLING  # what the system holds beside the matrix
        self._norms = np.zeros(5)
        self.update_material()

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of fields outside of the simulator's own memory: none without contacts."""
        return {}

    def release(self) -> None:
        """Give such memory back."""

    def update_material(self) -> None:
        """Recompute the rounding floor: the nodal forces of a strain as large as its rounding, the momenta of that of x."""
        m = self.model
        volume, Dm_inv, constants, body, x, mass = download([m.volume, m.Dm_inv, m.law_constants, m.block_body, m.x, m.mass])
        volume, Dm_inv, mass = (a.astype(np.float64) for a in (volume, Dm_inv, mass))
        stiff = np.abs(constants[:, :2]).sum(axis=1)[body]
        g = np.sqrt((Dm_inv**2).sum(axis=1))
        if m.points is not None:  # the gradients of quadratic shape functions are larger
            steepest = float(np.abs(m.points.to_numpy()[:, 1:]).max())
            for group in m.groups:
                g[group.first : group.last] *= steepest if group.order == 2 else 1.0
        largest = float(np.abs(x).max())
        strain = self.eps + np.finfo(np.float64).eps * largest * g  # of F, and of the f64 positions it is formed from
        squares = (stiff[:, None] * volume * g * strain) ** 2
        self.rounding_force = float(np.sqrt(squares.sum()))
        self.rounding_by_body = np.sqrt(np.bincount(body, squares.sum(axis=1)))
        # and of v = (x - x_hat) / beta: |M| times the rounding of x, to be divided by beta
        self.rounding_of_x = 4.0 * float(np.finfo(np.float64).eps) * largest
        self.rounding_mass = float(np.linalg.norm(mass) * self.rounding_of_x)

    def snapshot(self) -> dict:
        """What lives between stages: the rounding, which tells of the state where numbers last changed, and the reactions."""
        return {
            "rounding_force": self.rounding_force, "rounding_mass": self.rounding_mass, "rounding_of_x": self.rounding_of_x,
            "rounding_by_body": self.rounding_by_body, "residual": self.work.residual.to_numpy(),
        }  # fmt: skip

    def restore(self, kept: dict) -> None:
        """Back to what `snapshot` told."""
        self.rounding_force, self.rounding_mass = float(kept["rounding_force"]), float(kept["rounding_mass"])
        self.rounding_of_x, self.rounding_by_body = float(kept["rounding_of_x"]), np.array(kept["rounding_by_body"])
        upload([(self.work.residual, kept["residual"])])

    def held_residual(self) -> np.ndarray:
        """(n_nodes, 3) residual on the constrained axes, 0 on free ones."""
        free, residual = download([self.model.free, self.work.residual])
        return (1.0 - free.astype(np.float64)) * residual

    def assemble_damper(self) -> None:
        """K_d = projected K at the present x, for the step that begins."""
        if self.damper is not None:
            block_csr.assemble(self.model, self.damper, True)

    def _evaluate(self, c: float, beta: float) -> tuple[float, float]:
        """(|r|, scale) at the present v and x."""
        form_residual(self.model, self.work, self.pcg, c, beta, self._norms)
        return self._sizes(c, beta)

    def _sizes(self, c: float, beta: float) -> tuple[float, float]:
        """(|r|, scale) from the norms that the residual's kernel told."""
        r, inertia, elastic, external, held = (math.sqrt(square) for square in self._norms)
        if c == 0.0:
            return r, beta * external if external > 0.0 else held
        return r, inertia + beta * (elastic + external)

    def _objective(self, c: float, beta: float) -> float:
        m = self.model
        measure(m)
        scalars = m.scalars.to_numpy()
        energy = float(scalars[ELASTIC] + scalars[GRAVITY])
        if c == 0.0 and not m.loaded and not m.damped:  # no other terms
            return energy
        stage_terms(m, self.work, c, beta)
        return energy + m.scalars[POTENTIAL]

    def _form_system(self, c: float, beta: float, projected: bool) -> None:
        block_csr.assemble(self.model, self.matrix, projected)
        block_csr.to_system(self.model, self.matrix, self.damper or self.matrix, c, beta)

    def _direction(self, tolerance: float) -> pcg.LinearResult:
        m = self.model
        return pcg.solve(m, self.matrix, self.pcg, tolerance, max(1000, 30 * m.n_nodes), self.coupling)

    def solve(
        self, c: float, beta: float, tolerance: float, max_newton: int, linear_tolerance: float | None = None,
        by_energy: bool = False, led_share: float = 1.0,
    ) -> StageResult:  # fmt: skip
        """Solve the stage from the present v. x_hat, v_hat and the targets are set by the caller; led_share: `begin_stage`.

        by_energy: every step must lower Phi (statics); otherwise a lower |r| is enough. max_newton = 1 takes one full
        step without looking back (linearly implicit); it has converged when its linear solve has.
        """
        self._phi: float | None = None  # Phi at the present state, where it is known
        begin_stage(self.model, self.work, beta, led_share)
        r, scale = self._evaluate(c, beta)
        floor = beta * self.rounding_force + c * self.rounding_mass / beta
        newton = linear = 0
        needs_projection, forcing, previous, fresh = False, MAX_FORCING, 0.0, False
        solved, rounding = True, False
        while not r <= tolerance * scale and newton < max_newton:
            wanted = linear_tolerance
            if wanted is None:
                forcing = _forcing(forcing, r, previous)
                # the last solve need not go far below what Newton asks for
                wanted = max(forcing, 0.1 * tolerance * scale / r, 1e-12)
                if max_newton == 1 or floor > tolerance * scale:
                    # nobody corrects a single solve; and where the rounding of stiff stress hides the motion of the
                    # whole body in |r|, only a tight solve gets that motion right
                    wanted = min(wanted, tolerance)
            # the matrix is kept while it still serves: assembling costs as much as some ten CG iterations
            if not fresh or by_energy or r > SLOW * previous:
                self._form_system(c, beta, needs_projection)
                fresh = True
            answer = self._direction(wanted)
            linear += answer.iterations
            if answer.negative and not needs_projection:
                needs_projection = True
                self._form_system(c, beta, True)
                answer = self._direction(wanted)
                linear += answer.iterations
            solved = answer.converged and (max_newton > 1 or self._linear_residual() <= LINEAR_LIMIT)
            previous = r
            r, scale, moved = self._advance(c, beta, r, scale, max_newton == 1, by_energy, floor)
            newton += 1
            if stalled(r, previous, floor, c):
                rounding = True  # nothing but rounding is left
                break
            if not moved:
                if needs_projection:
                    break
                needs_projection, fresh = True, False  # the unprojected direction did not go downhill
        if max_newton == 1:
            converged = solved
        else:  # statics without any load have nothing to compare the rounding with
            converged = r <= tolerance * scale or (rounding and (c > 0.0 or scale <= floor))
        relative = r / scale if scale > 0.0 else r
        return StageResult(newton, linear, relative, bool(converged and np.isfinite(r)), bool(rounding or r <= floor))

    def _linear_residual(self) -> float:
        """|rhs - A y| / |rhs| as it really is: in f32 CG's own residual can fall while the true one stays."""
        block_csr.multiply(self.model, self.matrix, self.pcg.y, self.pcg.q)
        rhs, free, q = download([self.pcg.rhs, self.model.free, self.pcg.q])
        rhs = rhs.astype(np.float64)
        size = float(np.linalg.norm(rhs))
        return float(np.linalg.norm(rhs - free * q)) / size if size > 0.0 else 0.0

    def _advance(self, c: float, beta: float, r: float, scale: float, blind: bool, by_energy: bool, floor: float):
        """Take the step in pcg.y as far as it helps; returns (|r|, scale, moved)."""
        m, w, y = self.model, self.work, self.pcg.y
        if by_energy and self._phi is None:
            self._phi = self._objective(c, beta)
        start_step(m, w, y, beta)
        start = self._phi
        if not by_energy:
            new_r, new_scale = self._evaluate(c, beta)
            if blind or new_r < r or new_r <= floor:
                return new_r, new_scale, True
            try_step(m, w, y, 0.0, beta)
            start = self._objective(c, beta)
            try_step(m, w, y, 1.0, beta)
        share, slope = 1.0, m.scalars[START_SLOPE]
        # Phi's own rounding: the elastic terms of f32 forces are only good to eps, so tiny rises are not rises
        slack = 10.0 * np.finfo(np.float64).eps * abs(start)
        unseen = UNSEEN * abs(start)
        if by_energy and -unseen < slope < 0.0:  # Phi cannot show so small a decrease: |r| decides
            new_r, new_scale = self._evaluate(c, beta)
            value = self._objective(c, beta)
            if new_r < r and value <= start + unseen:
                self._phi = value
                return new_r, new_scale, True
        for _ in range(MAX_BACKTRACKS):
            value = self._objective(c, beta)
            if np.isfinite(value) and value <= start + SUFFICIENT * share * slope + slack and slope < 0.0:
                self._phi = value
                new_r, new_scale = self._evaluate(c, beta)
                return new_r, new_scale, True
            share *= 0.5
            try_step(m, w, y, share, beta)
        try_step(m, w, y, 0.0, beta)
        r, scale = self._evaluate(c, beta)
        return r, scale, False
