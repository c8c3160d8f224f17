"""One implicit stage as a system of equations: fields, residual and matrix, including contacts.

Unknown v (with x = x_hat + beta v), residual on the free axes
    r(v) = c M (v - v_hat) - beta (f_el(x) + f_loads + M g - a M v - b K_d v) - J^T p,
matrix c M + beta a M + beta^2 K(x) + beta b K_d + J^T D J. Without contacts these are the gradient and Hessian of
    Phi(v) = c/2 |v - v_hat|^2_M + psi(x) - loads.x - M g.x + beta/2 v.(a M + b K_d) v,
with contacts those of the augmented Lagrangian, see `contact_terms`. c = 1 for a time step, 0 for statics (v is then a
displacement). K is unprojected.
"""

import math
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download, upload
from taisoft.backend.blas import one_thread
from taisoft.contact.problem import find_factors
from taisoft.dynamics import rigid_balance
from taisoft.dynamics.contact_terms import (
    KEEP,
    NO_CONTACTS,
    OF_IMPULSES,
    TO_IMPULSES,
    StageContacts,
    begin_contacts,
    build_stage_contacts,
    predict,
    return_to_base,
    save_diagonal,
    update_impulses,
)
from taisoft.dynamics.direct import DirectSolver
from taisoft.dynamics.frame_factors import set_frame_factors
from taisoft.dynamics.linear_solver import LinearSolver
from taisoft.dynamics.linearised import advance, begin_linearised, end_linearised, find_step_length, update_multipliers
from taisoft.dynamics.multipliers import Multipliers
from taisoft.dynamics.newton_budget import NewtonBudget
from taisoft.dynamics.pieces import Pieces
from taisoft.dynamics.rigid_balance import (
    AFTER,
    BEFORE,
    SOLVED,
    correct_rigid_motion,
    equalise,
    measure_pieces,
    turn_forces,
    undo_factors,
)
from taisoft.dynamics.rounding import RoundingFloor
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.stage import (
    AGAIN,
    ELASTIC_STAGE,
    IMPACT,
    LINEARISED,
    STAY,
    STEP,
    Stage,
    StageWork,
    StepContacts,
    begin_stage,
    form_residual,
    move,
    set_direction_to_rest,
)
from taisoft.fem.dependents import place_dependents
from taisoft.fem.state import (
    END_SLOPE,
    HAS_FRICTION,
    IMPULSE_SQUARE,
    LAW,
    LINEAR_COUNT,
    LINEAR_STATUS,
    N_NORMS,
    N_SCALARS,
    NORMS,
    START_SLOPE,
    WORST_GAP,
)
from taisoft.linear import block_csr, gauss_seidel, pcg
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.jacobi import JACOBI
from taisoft.linear.pcg_work import LinearResult, build_pcg, result_of
from taisoft.linear.sweep_order import find_last
from taisoft.linear.volumes import VolumeSystem, restore_volumes, save_volumes, step_with_volumes

# Nodes from which threads share linear solves with contacts, and nodes per contact. Two cubes on two threads: no gain at 16,000
# nodes, a quarter of the step at 60,000. Contacts themselves stay on one thread: piles with 2 to 3 nodes per contact lose time
SHARED_FROM, NODES_PER_CONTACT = 25_000, 8


class StageSystem:
    """Matrix and vectors of the implicit stages of one model, and of their contacts."""

    BALANCED = 4.0  # |r|_p over s_p of a piece, times the tolerance and the root of their number: a converged piece has less
    NEARLY = 0.1  # of the tolerance: |r|_p over s_p below which a component counts less in linear solves
    FOLLOWING = 1e-2  # tolerance of the linear solve for the first iterate of a static stage with prescribed nodes
    # [s] of a block times a vector in an iteration with contacts, and of what a linear solve or an update of multipliers takes
    # beside its iterations, measured on one core
    ITERATION, CALLS = 3e-9, 5e-5
    VOLUME_PASSES = 2  # corrections of the first iterate, each of which leaves errors of second order

    def __init__(
        self, simulation: SimulationState, contact: StepContacts, x_start: Any = None, multipliers: Multipliers | None = None
    ):
        """x_start: (n_nodes) 3-vectors f64, positions at the start of the step.

        multipliers: of cavities of given volume and inextensible tendons, if there are any.
        """
        model, arena, prescribed = simulation.model, simulation.arena, simulation.dirichlet.prescribed_nodes
        self.model, self.step_contacts, self.x_start, self.multipliers = model, contact, x_start, multipliers
        self.pieces = Pieces(simulation, arena)
        self.matrix: BlockCsr = block_csr.build_block_csr(model, arena)
        self.damper = block_csr.sibling(self.matrix, model, arena, "damping") if model.stiffness_damping else None
        n, k = model.n_nodes, len(prescribed)
        self.work = StageWork(
            x_hat=arena.vectors("x_hat", ti.f64, n),
            v_hat=arena.vectors("v_hat", ti.f64, n),
            base=arena.vectors("x_base", ti.f64, n),
            residual=arena.vectors("residual", model.real, n),
            prescribed_nodes=arena.field("stage_moved", ti.i32, k, prescribed.astype(np.int32)) if k else None,
            prescribed_axes=arena.vectors("stage_moved_axes", ti.i32, k) if k else None,
            targets=arena.vectors("stage_targets", ti.f64, k) if k else None,
            prescribed_acceleration=arena.vectors("prescribed_acceleration", ti.f64, k) if k and model.consistent else None,
            n_prescribed=k,
            change=arena.vectors("change", ti.f64, n),
            moved=arena.vectors("moved", ti.f64, n),
            damper=self.damper,
            pieces=self.pieces.work,
            pcg=build_pcg(model, arena),
        )
        self.rounding = RoundingFloor(model, simulation.runtime.eps, self.pieces)
        self.floor = 0.0  # rounding floor of |r| of the present stage
        self.unbalanced = 0.0, ""  # largest relative residual of a piece at the last `balances_pieces`, and its name
        self.linear_solver = LinearSolver(model, self.matrix, self.work.pcg, self.form)
        self.budget = NewtonBudget()
        self._direct = DirectSolver(model, self.matrix, self.work.x_hat) if multipliers is None and model.on_cpu else None
        self.kind = self._nonlinear_kind = ELASTIC_STAGE  # the latter without LINEARISED
        self.scale = 0.0  # that |r| is relative to, at its last evaluation
        self.r_scale = 1.0  # R over the r-factors
        self._status = np.zeros(N_SCALARS)  # the scalars of the model's state as they were last read
        self._rejects_direct = False  # whether a direct solve of this stage was rejected: others would be, too
        self.n_direct = self.n_in_vain = 0  # frictional problems in a row solved directly, and trials of iterations since
        self._contact_arena = FieldArena()
        self._storage: StageContacts | None = None  # storage for the contacts of this step
        self.contacts = NO_CONTACTS  # of the present stage
        self._volumes: VolumeSystem | None = None  # whose iterates keep the volumes of patches
        self._same_matrix = False  # whether the matrix is that of the last linear solve of this stage
        self._may_share = True  # whether threads may share linear solves with its contacts: if they are few

    # --- state ----------------------------------------------------------------------------------------------------

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of the fields allocated for contacts and multigrid."""
        direct = self._direct.field_bytes if self._direct else {}
        return self._contact_arena.bytes | self.linear_solver.field_bytes | direct

    def release(self) -> None:
        """Free their memory."""
        self._contact_arena.release()
        self.linear_solver.free()
        if self._direct:
            self._direct.release()

    def snapshot(self) -> dict:
        """Return what persists between stages: rounding floor, reactions, and the choice of the linear solver."""
        own = {"residual": self.work.residual.to_numpy(), "linear_solver": self.linear_solver.snapshot()}
        own["direct"] = np.array([self.n_direct, self.n_in_vain])
        return self.rounding.snapshot() | own

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self.rounding.restore(kept)
        upload([(self.work.residual, kept["residual"])])
        self.linear_solver.restore(kept["linear_solver"])
        self.n_direct, self.n_in_vain = map(int, kept["direct"])

    def forget(self) -> None:
        """Discard what was learned of the choice of solvers, after the state was set."""
        self.linear_solver.forget()
        self.n_direct = self.n_in_vain = 0

    def numbers_changed(self) -> None:
        """Update for changed gravity or material numbers."""
        self.rounding.measure()
        self.linear_solver.numbers_changed()

    def _allocate_contacts(self) -> None:
        """Allocate storage for the contacts of this step."""
        if self._storage is None or self._storage.problem is not self.step_contacts.problem:
            arena, shared = FieldArena(), self.work.pcg.divided and self.model.n_nodes >= SHARED_FROM
            self._storage = build_stage_contacts(arena, self.model, self.step_contacts.problem, self.x_start, shared)
            self._contact_arena.release()
            self._contact_arena = arena

    # --- a stage --------------------------------------------------------------------------------------------------

    @property
    def n_contacts(self) -> int:
        """Contacts of the present stage."""
        return self.step_contacts.n_contacts if self.contacts.any else 0

    @property
    def is_static(self) -> bool:
        """Whether the stage has no inertia."""
        return self.stage.c == 0.0

    @property
    def is_balanced(self) -> bool:
        """Whether |r| was within the stage's tolerance at its last evaluation."""
        return math.sqrt(self._status[NORMS]) <= self.stage.tolerance * self.scale

    @property
    def contact_residual(self) -> float:
        """Residual of the contact laws at the last evaluation."""
        return float(self._status[LAW]) if self.contacts.any else 0.0

    @property
    def frictionless(self) -> bool:
        """Whether no contact of the stage has friction."""
        return self._status[HAS_FRICTION] == 0.0

    def impulses_are_rounding(self) -> bool:
        """Return whether impulses are below the rounding of the momenta of the bodies, and gaps hold: bodies that drift together
        barely touch."""
        mass, v = download([self.model.mass, self.work.v_hat])
        least = self.rounding.eps * self.pieces.momenta(mass.astype(np.float64), v).min()
        return bool(self._status[IMPULSE_SQUARE] <= least**2 and self._status[WORST_GAP] <= self.stage.contact_tolerance)

    @property
    def slopes(self) -> tuple[float, float]:
        """(r.y at the start of the step, r.y at its end); negative: descent."""
        start = float(self._status[START_SLOPE]) + (self.multipliers.slope_change if self.multipliers is not None else 0.0)
        return start, float(self._status[END_SLOPE])

    @property
    def multipliers_hold(self) -> bool:
        """Whether cavities and tendons have the given volumes and lengths, or are not the concern of the present solve."""
        return self.multipliers is None or not self.multipliers.penalised or self.multipliers.hold

    def begin(self, stage: Stage) -> bool:
        """Begin a stage at its first iterate; with contacts, form the matrix, which the r-factors depend on.

        Nearly incompressible bodies with mean dilatation get a first iterate that keeps their volumes, from the matrix at the
        start of the step. Return whether the matrix is formed.
        """
        m, start, self._volumes = self.model, self.work, None
        if stage.c > 0.0 and not stage.linearised and self.step_contacts.n_contacts == 0:
            self._volumes = self.linear_solver.volumes()
        volumes = self._volumes
        if volumes is not None:
            self.stage = stage
            if self.multipliers is not None:
                self.multipliers.measure()
            self.form_matrix()
            self.linear_solver.prepare(self.stage.beta)
            save_volumes(m, volumes)
        begin_stage(m, start, stage.beta, stage.prescribed_fraction)
        for _ in range(self.VOLUME_PASSES if volumes is not None else 0):
            restore_volumes(m, volumes, start.x_hat, stage.beta)
        self._begin(stage, ELASTIC_STAGE)
        return volumes is not None or self.contacts.any

    def follow(self, v: np.ndarray, beta: float) -> np.ndarray:
        """Return velocities (n_nodes, 3) at which all nodes follow the given ones of constrained nodes for a time beta [s], as in
        linear elasticity without contacts. v: (n_nodes, 3) [m/s], 0 on the free axes."""
        m, w, free = self.model, self.work, self.model.free.to_numpy()
        self.stage, self.contacts = Stage(0.0, beta, beta, self.FOLLOWING), NO_CONTACTS
        self.form(True, self._proximal(), beta)
        upload([(w.pcg.y, v)])
        block_csr.multiply(m, self.matrix, w.pcg.y, w.pcg.q)
        upload([(w.pcg.rhs, -free * w.pcg.q.to_numpy())])
        self.linear_solver.solve(self.stage, self.FOLLOWING)
        return v + free * w.pcg.y.to_numpy()

    def move_to_velocities(self) -> None:
        """Begin the stage again at the present v, with the present impulses and multipliers."""
        begin_stage(self.model, self.work, self.stage.beta, self.stage.prescribed_fraction)
        self._begin(self.stage, ELASTIC_STAGE)

    @property
    def keeps_volumes(self) -> bool:
        """Whether steps go by `step_with_volumes`."""
        return self._volumes is not None

    def begin_impact(self, stage: Stage) -> StageContacts:
        """Begin the impact before a step, and form the matrix."""
        self._volumes = None
        self._begin(stage, IMPACT)
        return self.contacts

    def _begin(self, stage: Stage, kind: int) -> None:
        self.stage, self.kind, self._nonlinear_kind, self.r_scale, self.contacts = stage, kind, kind, 1.0, NO_CONTACTS
        self._rejects_direct = False
        self.floor, self.unbalanced = self.rounding.of_stage(stage.c, stage.beta), (0.0, "")
        if self.pieces.several:
            self.pieces.forget_weights()
        if self.step_contacts.n_contacts > 0:
            self.begin_contacts()
            self.form_matrix_and_factors(projected=kind == IMPACT)

    def begin_contacts(self) -> None:
        """Begin the contacts of the step in the present stage."""
        self._allocate_contacts()
        if self._direct is not None:
            self._direct.rows_changed()
        self.contacts, stage = self._storage, self.stage
        impact, offset = self.kind == IMPACT, self.step_contacts.contact_offset
        self._may_share = self.model.on_cpu and NODES_PER_CONTACT * self.n_contacts <= self.model.n_nodes
        begin_contacts(self.model, self.work, self.contacts, impact, stage.beta, stage.dt, offset, stage.contact_tolerance)
        if self.work.pcg.has_last(self.contacts.coupling):
            find_last(self.model, self.matrix, self.contacts.coupling, self.work.pcg)

    def renew_contacts(self) -> bool:
        """Take the contacts' geometry at the present iterate, see `contact_geometry`; return whether it changed.

        A linearised step has one iterate: its geometry is that where the nodes would be at its end without forces. If it changed,
        (|r|, scale) must be evaluated again.
        """
        if self.stage.linearised:
            predict(self.model, self.work, self.contacts, self.stage.beta)
        changed = self.step_contacts.renew(self.x_start, self.contacts.displacement)
        if self.stage.linearised:
            return_to_base(self.model, self.work)
        before, grows = self.contacts, self.step_contacts.problem is not self.contacts.problem
        if not (changed or grows):
            return False
        base, *laws = download([before.coupling.base, before.work.multiplier, before.work.radius]) if grows else (None,)
        self.begin_contacts()
        if grows:  # set the displacements in the new storage, the diagonal, and the multipliers
            upload([(self.contacts.coupling.base, base)])
            for array, values in zip((self.contacts.work.multiplier, self.contacts.work.radius), laws):
                array.from_numpy(values, 0)
            move(self.model, self.work, self.contacts, self.kind, STAY, 1.0, self.stage.c, self.stage.beta)
        self._same_matrix = False  # its rows are, but not those of the contacts' terms
        if changed:
            self.find_factors()
        else:  # room alone must not change results
            self.evaluate(None)
        return changed

    def evaluate(self, mode: int | None = STAY, step_length: float = 1.0, new_multipliers: int = KEEP) -> tuple[float, float]:
        """Return (|r|, scale) after `move` in a mode; None: x and the elastic forces are unchanged.

        new_multipliers: see `update_impulses`.
        """
        self._evaluate(mode, step_length, new_multipliers)
        return self._norm_and_scale(self.stage.c, self.stage.beta)

    def _evaluate(self, mode: int | None, step_length: float, new_multipliers: int) -> None:
        m, w, k, stage = self.model, self.work, self.contacts, self.stage
        if mode is not None:
            move(m, w, k, self.kind, mode, step_length, stage.c, stage.beta)
            if self.multipliers is not None:
                self.multipliers.measure()
        self.pieces.upload_weights()
        if k.any:
            update_impulses(m, k, new_multipliers, stage.beta, self.r_scale)
        form_residual(m, w, self.matrix, k, self.kind, stage.beta)

    def evaluate_start(self) -> tuple[float, float]:
        """Return (|r|, scale) of the first iterate, with its weights of pieces."""
        self._evaluate(STAY, 1.0, TO_IMPULSES)
        if self.pieces.several and self.kind == ELASTIC_STAGE and self._weigh(only_finite=True):
            self._evaluate(None, 1.0, KEEP)
        return self._norm_and_scale(self.stage.c, self.stage.beta)

    def _weigh(self, only_finite: bool = False) -> bool:
        """Set the weights of pieces and the rounding floor, and find the least balanced piece; return whether that was done.

        only_finite: not if |r| is not finite.
        """
        stage, floor = self.stage, self.rounding.of_pieces(self.stage.c, self.stage.beta)
        measure_pieces(self.model, self.work, self.pieces.work, stage.beta)
        norms = np.sqrt(self.pieces.work.norms.to_numpy()).T
        if only_finite and not np.isfinite(norms[0]).all():
            return False
        self.unbalanced = self.pieces.weigh(norms, floor, stage.beta, stage.tolerance, self.is_static and self.step_contacts.idle)
        self.floor = math.sqrt((floor**2 * self.pieces.weights).sum())
        return True

    def balances_pieces(self) -> bool:
        """Return whether each piece has converged, once |r| has; otherwise its weights are new, and so are |r| and scale."""
        if not self.pieces.several or self.kind != ELASTIC_STAGE or self.stage.linearised:
            return True
        self._weigh()
        return self.unbalanced[0] <= self.BALANCED * math.sqrt(self.pieces.work.n) * self.stage.tolerance

    def least_balanced(self) -> tuple[float, str]:
        """Return the largest relative residual of a piece, and its name; (0, "") if there is one piece, or the stage is none."""
        balanced = self.balances_pieces()
        return (0.0, "") if balanced else self.unbalanced

    def balance_rigid_motion(self) -> None:
        """Balance free components as a whole, see `pieces`; the elastic forces are those at the end, or of the linearisation."""
        stage, m, w = self.stage, self.model, self.work
        if stage.c == 0.0 or not self.pieces.any_free():
            return
        x = self.contacts.x_linear if stage.linearised else m.state.x
        correct_rigid_motion(
            m, w, self.pieces.work, self.contacts, x, rigid_balance.LINEARISED if stage.linearised else SOLVED, stage.beta
        )

    def begin_linearised_step(self) -> tuple[float, float]:
        """Begin a linearised step without contacts by the rigid motion of its free components; return (|r|, scale)."""
        m, w, p, beta = self.model, self.work, self.pieces.work, self.stage.beta
        found = self.evaluate_start()
        if not self.pieces.any_free():
            return found
        correct_rigid_motion(m, w, p, NO_CONTACTS, m.state.x, BEFORE, beta)
        found = self.evaluate(None)
        turn_forces(m, w, p, beta)
        return found

    def take_linearised_step(self) -> tuple[float, float]:
        """Take the whole step along y; return (|r|, scale)."""
        m, w = self.model, self.work
        if not self.pieces.any_free():
            return self.evaluate(STEP)
        correct_rigid_motion(m, w, self.pieces.work, NO_CONTACTS, m.state.x, AFTER, self.stage.beta)
        return self.evaluate(STAY)

    def step_with_volumes(self, acceptable: float) -> tuple[float, float] | None:
        """Step along y on a curve to the volumes of nearly incompressible bodies that y leads to in first order.

        A straight step that rotates tets changes their volumes, and so |r|, by its square times lambda. Return (|r|, scale) if
        |r| is below `acceptable`; otherwise None, at the state before.
        """
        m, w = self.model, self.work
        if not self.keeps_volumes:
            return None
        self.linear_solver.prepare(self.stage.beta)  # multigrid may have solved
        step_with_volumes(m, self.matrix, self._volumes, w.base, w.pcg.y, w.x_hat, self.stage.beta)
        found = self.evaluate(STAY)
        if found[0] < acceptable:
            return found
        self.evaluate(AGAIN, 0.0)
        if self.multipliers is not None:
            self.multipliers.slope_change = 0.0  # the residual has the changed multipliers now
        return None

    def evaluate_at_rest(self) -> tuple[float, float]:
        """Return (|r|, scale) at v = 0 on the free axes; a step of length 0 leads back."""
        set_direction_to_rest(self.model, self.work)
        return self.evaluate(STEP)

    def linearise(self) -> None:
        """Make the elastic forces linear, by the current matrix."""
        begin_linearised(self.model, self.work, self.contacts)
        self.kind = LINEARISED

    def advance(self, r_scale: float) -> float:
        """Move a linearised stage along y to zero slope, with R over the r-factors; return |r| there."""
        self.r_scale = r_scale
        find_step_length(self.model, self.work, self.matrix, self.contacts, self.stage.beta, r_scale)
        advance(self.model, self.work, self.contacts, self.stage.beta, r_scale)
        return math.sqrt(self._read()[NORMS])

    @property
    def by_team(self) -> bool:
        """Whether a team does the linear solves."""
        return self.work.pcg.by_team

    def step_by_team(self, tolerance: float, r_scale: float) -> tuple[LinearResult, float]:
        """`solve_linear`, then `advance` unless there is negative curvature; return the former's result, and |r|.

        One reading tells whether the solve has ended and where it led.
        """
        most, found, begins = pcg.iteration_limit(self.model), None, 1
        while found is None:
            arguments = self.contacts.coupling, self.work.pcg, tolerance, int(self._same_matrix), begins, most
            pcg.run_team(self.model, self.matrix, JACOBI, *arguments)
            r, begins = self.advance(r_scale), 0
            found = result_of(int(self._status[LINEAR_COUNT]), int(self._status[LINEAR_STATUS]), most)
        self._same_matrix = True
        return found, r

    def update_multipliers(self, r_scale: float, to_impulses: bool) -> float:
        """Set R over the r-factors of a linearised stage, and the multipliers to the impulses if `to_impulses`; return |r|."""
        self.r_scale = r_scale
        update_multipliers(self.model, self.work, self.contacts, int(to_impulses), self.stage.beta, r_scale)
        return math.sqrt(self._read()[NORMS])

    @property
    def patience(self) -> float:
        """Duration [s] of iterations on a frictional problem after which a direct solve is expected to have been faster."""
        direct = self._direct
        if direct is None or self._rejects_direct or (seconds := direct.seconds(self.contacts)) > direct.WORTH:
            return math.inf
        return seconds

    def duration_of(self, iterations: float, n: int) -> float:
        """Expected duration [s] of n linear solves and updates of multipliers, with that number of iterations in all."""
        return iterations * self.ITERATION * (2 * self.matrix.n_edges + self.model.n_nodes) + n * self.CALLS

    def solve_directly(self, tolerance: float, after: bool) -> tuple[int, bool, float] | None:
        """Move a linearised stage to the solution of its frictional problem, see `direct`; None if that does not apply.

        tolerance: of the laws' residual; after: whether iterations were tried before. If it does not apply then, it is not tried
        again in this stage. Returns (iterations, converged, |r|); raises numpy.linalg.LinAlgError as `DirectSolver.prepare`.
        """
        direct = self._direct
        if direct is None or self._rejects_direct:
            return None
        found, most = None, max(tolerance, self.contact_residual)
        aim = min(tolerance, self.stage.contact_tolerance)  # which costs little more than a loose one, and saves a solve
        how = self.stage.linearised, aim, self.budget.is_out_of_time
        with one_thread():
            if is_prepared := direct.prepare(self.contacts):
                found = direct.solve(self.contacts, self.stage.beta, tolerance, most, *how)
        self._rejects_direct = found is None and (after or not is_prepared)
        return found

    @property
    def is_rigid(self) -> bool:
        """Whether there are rigid bodies alone, whose problems are solved directly at once."""
        return self._direct is not None and self._direct.is_rigid

    def end_linearised(self, accept: bool = True, solved: bool = True) -> tuple[float, float]:
        """Restore nonlinear elastic forces; return (|r|, scale). y is then the velocity change since linearisation, base its x.

        accept: keep the new state; otherwise restore that of that time. solved: keep its impulses, so that |r| does not contain
        what the laws miss; otherwise the multipliers are updated once more.
        """
        end_linearised(self.model, self.work, self.contacts, int(accept), self.stage.beta)
        self.kind = self._nonlinear_kind
        return self.evaluate(AGAIN, float(accept), OF_IMPULSES if solved else TO_IMPULSES)

    def end_once(self, direct: bool) -> None:
        """End a stage that was linearised once. direct: whether its frictional problem was solved directly."""
        self.balance_rigid_motion()
        if direct:
            self.end_linearised()
        elif self.model.has_dependents:  # linearised steps move only the nodes that they depend on
            place_dependents(self.model)

    def _norm_and_scale(self, c: float, beta: float) -> tuple[float, float]:
        """Return (|r|, scale) from the norms of `form_residual`."""
        norms = self._read()[NORMS : NORMS + N_NORMS]
        r, inertia, elastic, external, held = (math.sqrt(square) for square in norms)
        if c == 0.0 and not self._presses():
            self.scale = beta * external if external > 0.0 else held
        else:
            self.scale = inertia + beta * (elastic + external)
        return r, self.scale

    def _read(self) -> np.ndarray:
        """Read the scalars that kernels have left."""
        self._status = self.model.state.scalars.to_numpy()
        return self._status

    def _presses(self) -> bool:
        """Whether any contact of the stage has an impulse."""
        return self.n_contacts > 0 and bool(download([self.contacts.problem.r], self.n_contacts)[0][:, 0].any())

    def form_matrix(self, projected: bool = False) -> None:
        """Form the matrix at the present state, without J^T D J, which the linear solve adds."""
        self.form(projected, self.stage.c or self._proximal(), self.stage.beta)
        self._same_matrix = False
        self._rejects_direct &= not projected  # for an indefinite matrix it was
        if self.contacts.any:
            save_diagonal(self.model, self.matrix, self.contacts)

    def _proximal(self) -> float:
        """The fraction of M in the matrix of a static stage, which its residual does not have.

        It keeps the matrix definite where contacts alone hold a body, and vanishes with the imbalance of such bodies. Newton's
        method then converges as fast as it does without. Source: Yamashita, Fukushima 2001, on Levenberg and Marquardt's method.
        """
        if not self.is_loose:
            return 0.0
        free, residual = download([self.model.free, self.work.residual])
        return self.pieces.proximal(free * residual, self.stage.beta, self.rounding.eps)

    @property
    def is_loose(self) -> bool:
        """Whether constraints leave some component a rigid motion."""
        return self.pieces.any_loose()

    def form(self, projected: bool, c: float, beta: float) -> None:
        """Form the matrix of c and beta at the present positions."""
        self.linear_solver.matrix_changed()
        if self._direct is not None:
            self._direct.matrix_changed()
        block_csr.assemble(self.model, self.matrix, projected)
        if self.multipliers is not None:
            self.multipliers.upload(self.multipliers.values)
        block_csr.to_system(self.model, self.matrix, self.damper or self.matrix, int(projected), c, beta)
        if self.multipliers is not None and self.multipliers.penalised:
            self.multipliers.upload(self.multipliers.effective)

    def form_matrix_and_factors(self, projected: bool = False) -> None:
        """Form the matrix and the contacts' r-factors, which stay fixed until their geometry is renewed."""
        self.form_matrix(projected)
        self.find_factors()

    def find_factors(self) -> None:
        """Set the contacts' r-factors by the matrix formed last."""
        find_factors(self.contacts.problem)
        if self.model.has_rigid_tets and self.model.on_cpu:
            set_frame_factors(self.model, self.matrix, self.contacts.coupling.base, self.contacts.problem)

    def solve_linear(self, tolerance: float) -> LinearResult:
        """Solve for y of pcg from its right side.

        Without contacts all components are solved in equal norms; those whose residual is far below the tolerance count less.
        """
        m, work, pieces = self.model, self.work.pcg, self.pieces
        if not self.contacts.any:
            if pieces.several:
                pieces.upload_weights()
                equalise(m, self.matrix, work, pieces.work, (self.NEARLY * self.stage.tolerance) ** 2)
            solution = self.linear_solver.solve(self.stage, tolerance)
            if pieces.several:
                undo_factors(m, work, pieces.work)
            return solution
        terms, same, limit = self.contacts.coupling, self._same_matrix, pcg.iteration_limit(m)
        if m.on_cpu:
            solution = gauss_seidel.solve(m, self.matrix, work, tolerance, limit, terms, same, self._may_share)
        else:
            solution = pcg.solve(m, self.matrix, JACOBI, work, tolerance, limit, terms, same)
        self._same_matrix = True
        return solution

    def warm_up(self) -> None:
        """Launch the kernels that only stages with contacts and hard ones need, once; the state is then invalid."""
        self.form_matrix(projected=True)
        self.linear_residual()  # multiplies by the matrix, as multigrid does
        if self.step_contacts.idle:
            return
        self.begin_contacts()
        self.form_matrix_and_factors()
        self.evaluate_start()
        self.linearise()
        self.solve_linear(1.0)
        self.advance(self.r_scale)
        self.update_multipliers(self.r_scale, to_impulses=True)
        if self._direct is not None:
            self._direct.warm_up(self.contacts, self.stage.beta)
        self.end_linearised()
        self.balance_rigid_motion()

    def last_correction(self) -> float:
        """Return the largest displacement by y, the last change of v [m]."""
        (y,) = download([self.work.pcg.y])
        return self.stage.beta * float(np.linalg.norm(y, axis=1).max())

    # --- other queries ---------------------------------------------------------------------------------------------

    def assemble_damper(self) -> None:
        """Assemble K_d, the projected K at the present x, for the new step."""
        if self.damper is not None:
            self.linear_solver.release()  # its matrix contains K_d
            block_csr.assemble(self.model, self.damper, True)

    def linear_residual(self) -> float:
        """Return the true |rhs - A y| / |rhs|: in f32 CG's recursive residual can fall while the true one stays."""
        block_csr.multiply(self.model, self.matrix, self.work.pcg.y, self.work.pcg.q)
        rhs, free, q = download([self.work.pcg.rhs, self.model.free, self.work.pcg.q])
        rhs = rhs.astype(np.float64)
        size = float(np.linalg.norm(rhs))
        return float(np.linalg.norm(rhs - free * q)) / size if size > 0.0 else 0.0

    def held_residual(self) -> np.ndarray:
        """Return the residual on the constrained axes, 0 on free ones, (n_nodes, 3)."""
        free, residual = download([self.model.free, self.work.residual])
        return (1.0 - free.astype(np.float64)) * residual
