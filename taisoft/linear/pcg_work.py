"""Vectors, state and diagonal blocks of conjugate gradients: what `pcg` and `gauss_seidel` share.

Both stop on sqrt(r.z) relative to the start, z the preconditioned residual, and on a direction p of negative curvature
(p.Ap <= 0), which is reported. y is then the iterate so far plus min(r.z / |p.Ap|, MAX_NEGATIVE_STEP) p, a descent direction for
a function with this gradient and second derivative. Vectors are in the model's precision, sums in f64 and in a fixed order,
independent of threads.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.team import Team, make_team
from taisoft.fem.chunks import WHOLE, chunk_entry, chunk_size
from taisoft.fem.model import Model
from taisoft.fem.state import OTHER_SUM
from taisoft.linear.block_csr import BLOCK, definite_inverse
from taisoft.linear.coupling import Coupling, has_terms, prepare_terms

RZ, RZ_START, STEP, COUNT, STATUS = range(5)  # indices into `state`
# NEGATIVE_PENDING: found in the present iteration; FAILED: rounding keeps the preconditioner from being positive definite
RUNNING, CONVERGED, NEGATIVE, NEGATIVE_PENDING, FAILED = range(5)
MOST_BY_TEAM = 2048  # nodes
MAX_NEGATIVE_STEP = 10.0  # multiple of a direction of negative curvature; the caller's line search continues from there


@dataclass(frozen=True, eq=False)
class PcgWork:
    """Vectors of a solve; (n_nodes) 3-vectors unless stated otherwise."""

    rhs: Any
    y: Any  # the solution
    r: Any  # residual; Gauss-Seidel: (P + L)^-1 times it
    z: Any  # preconditioned residual; Gauss-Seidel: (P + L)^T p
    p: Any  # direction
    q: Any  # A p; Gauss-Seidel: (P + L)^-1 times it
    state: Any  # (5) f64
    inverse: Any  # (n_nodes) 12-vectors: of P, the diagonal blocks D of A or their replacements, 0 on constrained axes
    team: Team | None = None  # that solves systems of up to MOST_BY_TEAM nodes on the GPU path
    block: Any = None  # (n_nodes) 12-vectors: P; Gauss-Seidel only
    mirror: Any = None  # (n_nodes) 12-vectors: 2 P - D; Gauss-Seidel only
    n_chunks: Count = 1  # of `gauss_seidel`
    chunk_shift: Count = WHOLE  # a chunk has 2^chunk_shift nodes
    divided: bool = False  # whether the half-rows of matrices are those of a divided sweep

    @property
    def by_team(self) -> bool:
        """Whether a team solves."""
        return self.team is not None

    def result(self, max_iterations: int) -> "LinearResult | None":
        """The outcome of a solve; None if it must go on."""
        state = self.state.to_numpy()
        return result_of(int(state[COUNT]), int(state[STATUS]), max_iterations)

    def is_shared(self, coupling: Coupling) -> bool:
        """Whether several threads may share the chunks of one parity."""
        return self.divided and (not coupling.any or coupling.place is not None)

    def has_last(self, coupling: Coupling) -> bool:
        """Whether some nodes are passed after all chunks, see `sweep_order`."""
        return self.is_shared(coupling) and coupling.any


@dataclass(frozen=True)
class LinearResult:
    """Outcome of a solve."""

    iterations: int
    converged: bool
    negative: bool  # whether negative curvature was found
    multigrid: bool = False  # whether multigrid was the preconditioner


def result_of(count: int, status: int, max_iterations: int) -> LinearResult | None:
    """The outcome of a solve after so many iterations with a status; None if it must go on."""
    if status == RUNNING and count < max_iterations:
        return None
    return LinearResult(count, status == CONVERGED, status in (NEGATIVE, NEGATIVE_PENDING))


def build_pcg(model: Model, arena: FieldArena) -> PcgWork:
    """Allocate the vectors of a solve."""

    def allocate(*names: str, n: int = 3) -> dict[str, Any]:
        return {name: arena.vectors(f"pcg_{name}", model.real, model.n_nodes, n=n) for name in names}

    blocks = ("inverse", "block", "mirror") if model.on_cpu else ("inverse",)
    state, shift = arena.field("pcg_state", ti.f64, 5), model.sweep.shift
    chunks = {"n_chunks": -(-model.n_nodes // 2**shift), "chunk_shift": shift, "divided": shift < WHOLE}
    chunks["team"] = None if model.on_cpu or model.n_nodes > MOST_BY_TEAM else make_team(arena, "pcg")
    return PcgWork(**allocate("rhs", "y", "r", "z", "p", "q"), **allocate(*blocks, n=BLOCK), state=state, **chunks)


@ti.func
def precondition(model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), i, same_matrix):
    """Set diagonal and preconditioner of node i, unless it has those of the last solve."""
    changed = True
    if ti.static(terms.any):
        changed = same_matrix == 0 or has_terms(terms, i)
        if changed:
            A.diagonal[i] = prepare_terms(model, terms, i)
    if changed:
        work.inverse[i], P = definite_inverse(model, A.diagonal[i], model.free[i])
        if ti.static(model.on_cpu):
            work.block[i] = P
            work.mirror[i] = 2.0 * P - A.diagonal[i]


@ti.func
def begin_with(work: ti.template(), tolerance, rz):
    """Set the state before the first iteration from r.z."""
    work.state[RZ], work.state[RZ_START], work.state[STEP], work.state[COUNT] = rz, rz, 0.0, 0.0
    work.state[STATUS] = status_at(tolerance, rz, rz)


@ti.func
def status_at(tolerance, rz, start):
    """Status at r.z, which was `start` at the start."""
    status = RUNNING
    if rz < 0.0:
        status = FAILED
    elif rz <= tolerance * tolerance * start:
        status = CONVERGED
    return status


@ti.func
def step_along(rz, curvature):
    """Return the status and the length of the step along p from r.z and p.Ap."""
    status, step = RUNNING, rz / curvature
    if not curvature > 0.0:
        status, step = NEGATIVE_PENDING, MAX_NEGATIVE_STEP
        if curvature < 0.0:
            step = ti.min(rz, -MAX_NEGATIVE_STEP * curvature) / -curvature
    return status, step


@ti.func
def set_step(work: ti.template(), curvature):
    """Set the length of the step along p from p.Ap."""
    work.state[STATUS], work.state[STEP] = step_along(work.state[RZ], curvature)


@ti.func
def end_iteration(work: ti.template(), tolerance, rz):
    """Set the state after a step from the new r.z. STEP is then the factor of p in the next direction."""
    if work.state[STATUS] == RUNNING:
        work.state[STEP] = rz / work.state[RZ]
        work.state[RZ], work.state[COUNT] = rz, work.state[COUNT] + 1.0
        work.state[STATUS] = status_at(tolerance, rz, work.state[RZ_START])
    elif work.state[STATUS] == NEGATIVE_PENDING:
        work.state[STATUS] = NEGATIVE


@ti.func
def dot64(a, b):
    """a . b in f64."""
    return ti.cast(a, ti.f64).dot(ti.cast(b, ti.f64))


@ti.func
def sum_products(model: ti.template(), work: ti.template()):
    """Partial sums: OTHER_SUM of r.z, of all nodes; a loop at the top level of a kernel."""
    ti.loop_config(serialize=model.serial)
    for task in range(model.chunks * model.spread):
        if task % model.spread == 0:
            c, s = task // model.spread, ti.cast(0.0, ti.f64)
            for at in range(chunk_size(model, c, model.n_nodes)):
                i = chunk_entry(model, c, at, model.n_nodes)
                s += dot64(work.r[i], work.z[i])
            model.state.partial[c, OTHER_SUM] = s
