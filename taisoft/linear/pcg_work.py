"""Vectors and preconditioner of `pcg`."""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.fem.chunks import WHOLE
from taisoft.fem.model import Model
from taisoft.fem.node_graph import EVERYTHING, Subset
from taisoft.linear.block_csr import BLOCK, definite_inverse
from taisoft.linear.coupling import Coupling, has_terms, prepare_terms

RZ, RZ_START, STEP, COUNT, STATUS = range(5)  # indices into `state`
RUNNING, CONVERGED, NEGATIVE, NEGATIVE_PENDING = range(4)  # NEGATIVE_PENDING: found in the present iteration
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
    block: Any = None  # (n_nodes) 12-vectors: P; Gauss-Seidel only
    mirror: Any = None  # (n_nodes) 12-vectors: 2 P - D; Gauss-Seidel only
    n_chunks: Count = 1  # of `pcg_gauss_seidel`
    chunk_shift: Count = WHOLE  # a chunk has 2^chunk_shift nodes
    divided: bool = False  # whether the half-rows of matrices are those of a divided sweep
    subset: Subset = EVERYTHING  # nodes that form the system

    @property
    def in_chunks(self) -> bool:
        """Whether Gauss-Seidel passes the system's nodes chunk by chunk."""
        return self.divided and not self.subset.restricted

    def is_shared(self, coupling: Coupling) -> bool:
        """Whether several threads may share the chunks of one parity."""
        return self.in_chunks and (coupling.width == 0 or coupling.place is not None)

    def has_last(self, coupling: Coupling) -> bool:
        """Whether some nodes are passed after all chunks, see `sweep_order`."""
        return self.is_shared(coupling) and coupling.width > 0


@dataclass(frozen=True)
class LinearResult:
    """Outcome of a solve."""

    iterations: int
    converged: bool
    negative: bool  # whether negative curvature was found
    multigrid: bool = False  # whether multigrid was the preconditioner


def build_pcg(model: Model, arena: FieldArena) -> PcgWork:
    """Allocate the vectors of a solve."""

    def allocate(*names: str, n: int = 3) -> dict[str, Any]:
        return {name: arena.vectors(f"pcg_{name}", model.real, model.n_nodes, n=n) for name in names}

    blocks = ("inverse", "block", "mirror") if model.on_cpu else ("inverse",)
    state, shift = arena.field("pcg_state", ti.f64, 5), model.sweep.shift
    chunks = {"n_chunks": -(-model.n_nodes // 2**shift), "chunk_shift": shift, "divided": shift < WHOLE}
    return PcgWork(**allocate("rhs", "y", "r", "z", "p", "q"), **allocate(*blocks, n=BLOCK), state=state, **chunks)


@ti.func
def precondition(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), i, same_matrix):
    """Set diagonal and preconditioner of node i, unless it has those of the last solve."""
    changed = True
    if ti.static(k.width > 0):
        changed = same_matrix == 0 or has_terms(k, i)
        if changed:
            A.diagonal[i] = prepare_terms(m, k, i)
    if changed:
        w.inverse[i], P = definite_inverse(m, A.diagonal[i], m.free[i])
        if ti.static(m.on_cpu):
            w.block[i] = P
            w.mirror[i] = 2.0 * P - A.diagonal[i]


@ti.func
def dot64(a, b):
    """a . b in f64."""
    return ti.cast(a, ti.f64).dot(ti.cast(b, ti.f64))
