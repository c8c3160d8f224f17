"""Vectors and preconditioner of `pcg`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, download
from taisoft.fem.model import Model
from taisoft.fem.node_graph import EVERYTHING, Subset
from taisoft.linear.block_csr import BLOCK, BlockCsr, definite_inverse
from taisoft.linear.coupling import Coupling, has_terms, prepare_terms
from taisoft.ranges import owners

RZ, RZ_START, STEP, COUNT, STATUS = range(5)  # indices into `state`
RUNNING, CONVERGED, NEGATIVE, NEGATIVE_PENDING = range(4)  # NEGATIVE_PENDING: found in the present iteration
# Of Gauss-Seidel: most chunks, and 2^this is the least number of their nodes, since rows that couple chunks cost more
CHUNKS, MIN_SHIFT = 16, 11
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
    chunk_shift: Count = 30  # a chunk has 2^chunk_shift nodes
    crossed: bool = False  # whether blocks couple different chunks of one parity
    own_begin: Any = None  # (n_nodes) i32: first entry within its chunk of each left half-row; None without chunks
    own_end: Any = None  # (n_nodes) i32: one past the last of each right half-row
    subset: Subset = EVERYTHING  # nodes that form the system

    def is_divided(self, coupling: Coupling) -> bool:
        """Whether Gauss-Seidel sweeps over chunks of the system's nodes."""
        return self.own_begin is not None and coupling.width == 0 and not self.subset.restricted


@dataclass(frozen=True)
class LinearResult:
    """Outcome of a solve."""

    iterations: int
    converged: bool
    negative: bool  # whether negative curvature was found
    multigrid: bool = False  # whether multigrid was the preconditioner


def build_pcg(model: Model, arena: FieldArena, matrix: BlockCsr) -> PcgWork:
    """Allocate the vectors of a solve."""

    def allocate(*names: str, n: int = 3) -> dict[str, Any]:
        return {name: arena.vectors(f"pcg_{name}", model.real, model.n_nodes, n=n) for name in names}

    blocks = ("inverse", "block", "mirror") if model.on_cpu else ("inverse",)
    state, divided = arena.field("pcg_state", ti.f64, 5), model.chunks > 1 and model.on_cpu
    chunks = _divide(model, arena, matrix) if divided else {}
    return PcgWork(**allocate("rhs", "y", "r", "z", "p", "q"), **allocate(*blocks, n=BLOCK), state=state, **chunks)


def _divide(model: Model, arena: FieldArena, matrix: BlockCsr) -> dict[str, Any]:
    """Divide the rows into chunks of a power of two, whose parity a kernel finds at little cost."""
    shift = max(MIN_SHIFT, ((model.n_nodes - 1) // CHUNKS).bit_length())
    start, column = download([matrix.row_start, matrix.column])
    n = model.n_nodes
    row = owners(np.diff(start)) % n
    apart = (column >> shift) - (row >> shift)
    begin = start[:n] + np.bincount(row[apart < 0], minlength=n)
    end = start[n + 1 :] - np.bincount(row[apart > 0], minlength=n)
    return {
        "n_chunks": -(-model.n_nodes // 2**shift),
        "chunk_shift": shift,
        "crossed": bool(((apart != 0) & (apart % 2 == 0)).any()),
        "own_begin": arena.field("pcg_own_begin", ti.i32, model.n_nodes, begin.astype(np.int32)),
        "own_end": arena.field("pcg_own_end", ti.i32, model.n_nodes, end.astype(np.int32)),
    }


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
