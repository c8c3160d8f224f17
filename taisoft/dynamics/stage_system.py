"""One implicit stage as a system of equations: its fields, its residual, its matrix, and what contacts add to them.

Unknown v (with x = x_hat + beta v), residual on the free axes
    r(v) = c M (v - v_hat) - beta (f_el(x) + f_loads + M g - a M v - b K_d v) - J^T p,
matrix c M + beta a M + beta^2 K(x) + beta b K_d + J^T D J: without contacts the gradient and second derivative of
    Phi(v) = c/2 |v - v_hat|^2_M + psi(x) - loads.x - M g.x + beta/2 v.(a M + b K_d) v,
with them of the augmented Lagrangian, see `contact_terms`. c = 1 for a time step, 0 for statics (v is then a displacement).
K is unprojected.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import taichi as ti

from taisoft.contact.problem import RESIDUAL, find_factors
from taisoft.dynamics import frictional, multipliers
from taisoft.dynamics.contact_terms import NO_CONTACTS, StageContacts, begin_contacts, build_stage_contacts, keep_diagonal, press
from taisoft.dynamics.linearised import LONGEST, advance, keep_linear, leave_linear
from taisoft.dynamics.residual import AGAIN, ELASTIC_STAGE, IMPACT, LINEARISED, STAY, form_residual, move
from taisoft.dynamics.rounding import RoundingFloor
from taisoft.dynamics.stage import StageWork, begin_stage, negate_direction, set_direction_to_rest
from taisoft.dynamics.subset_lists import SubsetLists
from taisoft.fields import FieldArena
from taisoft.linear import block_csr, pcg
from taisoft.linear.block_csr import BlockCsr
from taisoft.model import Model
from taisoft.scalars import END_SLOPE, START_SLOPE, STEP_LENGTH
from taisoft.subset import EVERYTHING
from taisoft.transfer import download, upload

if TYPE_CHECKING:
    from taisoft.dynamics.contact import ContactStep
    from taisoft.dynamics.no_contacts import NoContacts


@dataclass(frozen=True)
class Stage:
    """What is to be solved. tolerance: |r| over scale; contact_tolerance: the residual of the contact laws."""

    c: float  # 1: a time step; 0: statics
    beta: float  # [s]
    dt: float  # [s] of the step
    tolerance: float
    contact_tolerance: float = math.inf
    max_newton: int = 50
    linear_tolerance: float | None = None  # of every linear solve; None: adaptive
    linearised: bool = False  # elastic forces are linear from the first iterate on
    prescribed_share: float = 1.0  # see `begin_stage`
    tolerance_of_one: float | None = None  # as `tolerance`, of the steps under one multiplier; None: the same
    absolute_tolerance: float = 0.0  # |r| [N s] that ends the stage, too, whatever the scale
    keeps_multipliers: bool = False  # the multipliers at hand are not renewed
    extrapolate_after: int = multipliers.EXTRAPOLATE_AFTER  # multipliers
    later_tolerance: float = 0.0  # lower bound on linear_tolerance after the first solve

    @property
    def enough_of_one(self) -> float:
        """|r| over scale that ends the steps under one multiplier."""
        return self.tolerance if self.tolerance_of_one is None else self.tolerance_of_one


class StageSystem:
    """Owns the matrix and the vectors of implicit stages over one model, and of their contacts."""

    def __init__(
        self, model: Model, arena: FieldArena, eps: float, prescribed: np.ndarray,
        contact: "ContactStep | NoContacts", x_start: Any = None,
    ):  # fmt: skip
        """prescribed: nodes that follow a path. x_start: (n_nodes) 3-vectors f64, positions at the start of the step."""
        self.model, self.contact, self.x_start = model, contact, x_start
        self.matrix: BlockCsr = block_csr.build_block_csr(model, arena, model.real)
        self.damper = block_csr.sibling(self.matrix, model, arena, model.real, "damping") if model.stiffness_damping else None
        n, k = model.n_nodes, len(prescribed)
        self.work = StageWork(
            x_hat=arena.vectors("x_hat", ti.f64, n), v_hat=arena.vectors("v_hat", model.real, n),
            base=arena.vectors("x_base", ti.f64, n), residual=arena.vectors("residual", model.real, n),
            prescribed_nodes=arena.field("stage_moved", ti.i32, k, prescribed.astype(np.int32)) if k else None,
            prescribed_axes=arena.vectors("stage_moved_axes", ti.i32, k) if k else None,
            targets=arena.vectors("stage_targets", ti.f64, k) if k else None,
            prescribed_acceleration=arena.vectors("prescribed_acceleration", ti.f64, k) if k and model.consistent else None,
            n_prescribed=k, change=arena.vectors("change", ti.f64, n), damper=self.damper, pcg=pcg.build_pcg(model, arena),
        )  # fmt: skip
        self.rounding = RoundingFloor(model, eps)
        self.kind = ELASTIC_STAGE
        self.scale = 0.0  # that |r| is measured by, where it was last formed
        self.r_scale = 1.0  # R over the r-factors
        self._contact_arena = FieldArena()
        self._room: StageContacts | None = None  # for the contacts of this step
        self._k = NO_CONTACTS  # what the present stage has
        self._whole, self._restricted = self.work, None  # what `work` is where all nodes move, and where some do
        self._lists: SubsetLists | None = None
        self._same_matrix = False  # as in the last linear solve of this stage
        self.norms = np.zeros(5)  # what `form_residual` tells

    # --- its life -------------------------------------------------------------------------------------------------

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of the fields that come with contacts and with steps that are hard to solve."""
        return self._contact_arena.bytes | (self._lists.field_bytes if self._lists else {})

    def release(self) -> None:
        """Give their memory back."""
        self._contact_arena.release()
        if self._lists:
            self._lists.release()

    def snapshot(self) -> dict:
        """What lives between stages: the rounding and the reactions."""
        return self.rounding.snapshot() | {"residual": self.work.residual.to_numpy()}

    def restore(self, kept: dict) -> None:
        """Back to what `snapshot` told."""
        self.rounding.restore(kept)
        upload([(self.work.residual, kept["residual"])])

    def _fit(self) -> None:
        """Room for the contacts of this step."""
        if self._room is None or self._room.found is not self.contact.found:
            arena = FieldArena()
            self._room = build_stage_contacts(arena, self.model, self.contact.found, self.x_start)
            self._contact_arena.release()
            self._contact_arena = arena

    # --- a stage --------------------------------------------------------------------------------------------------

    @property
    def n_contacts(self) -> int:
        """Contacts of the present stage."""
        return int(self._k.problem.count[0]) if self._k.any else 0

    @property
    def is_static(self) -> bool:
        """Whether the stage has no inertia."""
        return self.stage.c == 0.0

    @property
    def contact_residual(self) -> float:
        """Of the contact laws, where the residual was last formed."""
        return float(self._k.problem.state[RESIDUAL]) if self._k.any else 0.0

    @property
    def slopes(self) -> tuple[float, float]:
        """(r.y where the step began, r.y where it has led): negative is downhill."""
        scalars = self.model.state.scalars
        return scalars[START_SLOPE], scalars[END_SLOPE]

    def begin(self, stage: Stage) -> None:
        """Take up a stage at its first iterate; with contacts its matrix is formed, on which the r-factors rest."""
        begin_stage(self.model, self.work, stage.beta, stage.prescribed_share)
        self._begin(stage, ELASTIC_STAGE)

    def begin_impact(self, stage: Stage) -> StageContacts:
        """Take up the impact before a step; the matrix is formed."""
        self._begin(stage, IMPACT)
        return self._k

    def _begin(self, stage: Stage, kind: int) -> None:
        self.stage, self.kind, self.r_scale, self._k = stage, kind, multipliers.R_SCALE, NO_CONTACTS
        self.restrict(None)
        if self.contact.n_contacts == 0:
            return
        self._fit()
        self._k, impact = self._room, kind == IMPACT
        begin_contacts(self.work, self._k, impact, stage.beta, stage.dt, np.array(self.contact.gap_targets))
        self.form_matrix_and_factors(projected=impact)

    def evaluate(self, how: int | None = STAY, step_length: float = 1.0, new_multipliers: bool = False) -> tuple[float, float]:
        """(|r|, scale) where `move` goes; None: x is where it was, and so are the elastic forces.

        new_multipliers: the impulses are made the multipliers first, and the friction disks opened as far as these say.
        """
        m, w, k, stage = self.model, self.work, self._k, self.stage
        if how is not None:
            move(m, w, k, self.kind, how, step_length, stage.c, stage.beta)
        if k.any:
            press(m, k, int(new_multipliers), stage.beta, self.r_scale)
        form_residual(m, w, self.matrix, k, self.kind, stage.beta, self.norms)
        return self._sizes(stage.c, stage.beta)

    def extrapolate_multipliers(self, known: int) -> None:
        """Multipliers from the impulses and so many renewals before; impulses and residual are still the old ones."""
        multipliers.extrapolate_multipliers(self._k, known)

    def set_direction_to_rest(self) -> None:
        """A whole step along y leads to v = 0."""
        set_direction_to_rest(self.model, self.work)

    def negate_direction(self) -> None:
        """y = -y."""
        negate_direction(self.model, self.work)

    @property
    def lists(self) -> SubsetLists:
        """What touches each node, made when it is first asked for."""
        if self._lists is None:
            self._lists = SubsetLists(self.model, self.matrix)
        return self._lists

    def restrict(self, nodes: np.ndarray | None) -> None:
        """Move some nodes alone from here on, ascending: the matrix must be formed anew, and has their rows; None: all nodes."""
        self.work = self._whole
        if nodes is None:
            return
        subset, cg = self.lists.subset(nodes), self.work.pcg
        for field in (cg.r, cg.p, cg.q):  # rows of the subset reach other nodes, where the solve finds no change
            field.fill(0.0)
        if self._restricted is None:
            self._restricted = replace(self._whole, pcg=replace(cg, subset=subset))
        self.work = self._restricted

    def linearise(self) -> None:
        """From here on elastic forces are linear, by the matrix at hand."""
        keep_linear(self.model, self.work, self._k)
        self.kind = LINEARISED

    def advance(self) -> tuple[float, float]:
        """(|r|, scale) where the slope along y vanishes, of a linearised stage."""
        stage = self.stage
        advance(self.model, self.work, self.matrix, self._k, stage.beta, self.r_scale, self.norms)
        return self._sizes(stage.c, stage.beta)

    @property
    def has_advanced_to_a_root(self) -> bool:
        """Whether the slope vanished somewhere along y: it need not where the matrix is indefinite."""
        return self.model.state.scalars[STEP_LENGTH] < LONGEST

    def solve_frictional(self, problem: Stage, r: float, floor: float) -> np.ndarray:
        """The loop of a linearised stage from |r| on, in launches that Ctrl-C can come between: see `frictional`."""
        m, A, loop, limits = self.model, self.matrix, np.zeros(15), np.zeros(10)
        loop[[frictional.NORM, frictional.SCALE, frictional.LAW, frictional.GOAL, frictional.SAME]] = (
            r, multipliers.R_SCALE, math.inf, frictional.PROGRESS * r, self._same_matrix,
        )  # fmt: skip
        # in the order of their places
        limits[:] = (
            problem.tolerance * self.scale, problem.enough_of_one * self.scale, floor, problem.contact_tolerance,
            problem.linear_tolerance, problem.max_newton, pcg.most_iterations(m), pcg.batch_of(m, A),
            problem.extrapolate_after, problem.later_tolerance,
        )  # fmt: skip
        while loop[frictional.VERDICT] == frictional.RUNNING:
            frictional.solve_frictional(m, self.work, A, self._k, problem.beta, limits, loop)
        self._same_matrix = bool(loop[frictional.SAME])
        return loop

    def leave_linear(self, taken: bool = True) -> tuple[float, float]:
        """Elastic forces are themselves again: (|r|, scale), y the way since the stage was linearised, base where that was.

        taken: the state is what was found, its impulses the multipliers; otherwise state and multipliers are those of then.
        """
        leave_linear(self.model, self.work, self._k, int(taken), self.stage.beta)
        self.kind = ELASTIC_STAGE
        return self.evaluate(AGAIN, float(taken), new_multipliers=True)

    def _sizes(self, c: float, beta: float) -> tuple[float, float]:
        """(|r|, scale) from the norms that the residual's kernel told."""
        r, inertia, elastic, external, held = (math.sqrt(square) for square in self.norms)
        if c == 0.0:
            self.scale = beta * external if external > 0.0 else held
        else:
            self.scale = inertia + beta * (elastic + external)
        return r, self.scale

    def form_matrix(self, projected: bool = False) -> None:
        """The matrix where the stage stands, without J^T D J, which the linear solve adds."""
        m, stage, subset = self.model, self.stage, self.work.pcg.subset
        block_csr.assemble(m, self.matrix, subset, projected)
        block_csr.to_system(m, self.matrix, self.damper or self.matrix, subset, stage.c, stage.beta)
        self._same_matrix = False
        if self._k.any:
            keep_diagonal(m, self.matrix, self._k, subset)

    def form_matrix_and_factors(self, projected: bool = False) -> None:
        """The matrix and the r-factors of the contacts, which stay for the stage."""
        self.form_matrix(projected)
        find_factors(self._k.problem)

    def direction(self, tolerance: float) -> pcg.LinearResult:
        """y of pcg from -r."""
        m, w = self.model, self.work
        answer = pcg.solve(
            m, self.matrix, w.pcg, tolerance, pcg.most_iterations(m), self._k.coupling, self._same_matrix
        )  # fmt: skip
        self._same_matrix = True
        return answer

    # --- what others ask -------------------------------------------------------------------------------------------

    def assemble_damper(self) -> None:
        """K_d = projected K at the present x, for the step that begins."""
        if self.damper is not None:
            block_csr.assemble(self.model, self.damper, EVERYTHING, True)

    def linear_residual(self) -> float:
        """|rhs - A y| / |rhs| as it really is: in f32 CG's own residual can fall while the true one stays."""
        block_csr.multiply(self.model, self.matrix, self.work.pcg.y, self.work.pcg.q)
        rhs, free, q = download([self.work.pcg.rhs, self.model.free, self.work.pcg.q])
        rhs = rhs.astype(np.float64)
        size = float(np.linalg.norm(rhs))
        return float(np.linalg.norm(rhs - free * q)) / size if size > 0.0 else 0.0

    def held_residual(self) -> np.ndarray:
        """(n_nodes, 3) residual on the constrained axes, 0 on free ones."""
        free, residual = download([self.model.free, self.work.residual])
        return (1.0 - free.astype(np.float64)) * residual
