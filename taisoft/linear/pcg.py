"""Preconditioned conjugate gradients for A y = rhs on the free axes, A a `BlockCsr` that holds the whole system.

Serial, in one kernel launch (a launch an iteration would cost more than the iteration): symmetric Gauss-Seidel as
preconditioner, two to three times fewer iterations than block-Jacobi, at the price of one product by Eisenstat's trick.
Parallel, for many tets and on CUDA: block-Jacobi, whose residual is read every few iterations.
Vectors are in the model's precision, sums in f64 and in a fixed order. Both stop on sqrt(r.z) relative to the start, z the
preconditioned residual, and on a direction p of negative curvature (p.Ap <= 0), which is reported: y is then the iterate so far
plus min(r.z / |p.Ap|, FARTHEST) p, a direction along which a function with this gradient and this second derivative falls.
Diagonal blocks that are not positive definite are replaced by the sums of their rows' absolute values in the preconditioner,
which is positive definite then.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.fields import FieldArena
from taisoft.linear.block_csr import BLOCK, BlockCsr
from taisoft.linear.coupling import NO_COUPLING, Coupling
from taisoft.model import Model
from taisoft.subset import EVERYTHING, Subset

SERIAL_WORK = 40_000_000  # block products per launch: about 0.2 s, so that Ctrl-C is heard
PARALLEL_BATCH = 8  # iterations between two looks at the residual
RZ, RZ_START, STEP, COUNT, STOP = range(5)  # places in `state`
RUNNING, CONVERGED, NEGATIVE, LEAVING = range(4)  # LEAVING: within an iteration that has met negative curvature
SINGULAR = 1e-12  # determinant over the product of the diagonal, below which a block counts as singular
FARTHEST = 10.0  # steps along a direction of negative curvature: the caller's line search goes on from there


@dataclass(frozen=True, eq=False)
class PcgWork:
    """Vectors of a solve; (n_nodes) 3-vectors unless said otherwise."""

    rhs: Any
    y: Any  # the solution
    r: Any  # residual; serial: (P + L)^-1 of it
    z: Any  # preconditioned residual; serial: (P + L)^T p
    p: Any  # direction
    q: Any  # A p; serial: (P + L)^-1 of it
    inverse: Any  # (n_nodes) 12-vectors: of P, the diagonal blocks D of A or what stands for them, 0 on constrained axes
    block: Any  # (n_nodes) 12-vectors: P; serial only
    mirror: Any  # (n_nodes) 12-vectors: 2 P - D; serial only
    state: Any  # (5) f64
    subset: Subset = EVERYTHING  # of the nodes


@dataclass(frozen=True)
class LinearResult:
    """What a solve did."""

    iterations: int
    converged: bool
    negative: bool  # negative curvature was met


def build_pcg(model: Model, arena: FieldArena) -> PcgWork:
    """Allocate the vectors of a solve."""
    names = ("rhs", "y", "r", "z", "p", "q")
    vectors = {name: arena.vectors(f"pcg_{name}", model.real, model.n_nodes) for name in names}
    blocks = {
        name: arena.vectors(f"pcg_{name}", model.real, model.n_nodes, n=BLOCK) if model.serial or name == "inverse" else None
        for name in ("inverse", "block", "mirror")
    }
    return PcgWork(**vectors, **blocks, state=arena.field("pcg_state", ti.f64, 5))


def most_iterations(m: Model) -> int:
    """After which a solve is given up."""
    return max(1000, 30 * m.n_nodes)


def batch_of(m: Model, A: BlockCsr) -> int:
    """Iterations of a serial launch."""
    return max(1, SERIAL_WORK // (2 * A.n_edges + m.n_nodes))


def solve(
    m: Model, A: BlockCsr, w: PcgWork, tolerance: float, max_iterations: int, coupling: Coupling = NO_COUPLING,
    same_matrix: bool = False,
) -> LinearResult:  # fmt: skip
    """Fill w.y from w.rhs. tolerance: sqrt(r.z) relative to the start.

    coupling: terms beside A, whose own diagonal is then in coupling.base; A.diagonal is set to that of both.
    w.subset: the nodes whose rows and unknowns make the system; w.r, w.p and w.q are 0 on all others.
    same_matrix: A is that of the last solve, terms are between the same nodes: rows without terms keep their preconditioner.
    """
    from taisoft.linear import pcg_parallel, pcg_serial

    method = pcg_serial if m.serial else pcg_parallel
    batch = batch_of(m, A) if m.serial else PARALLEL_BATCH
    done = 0
    while True:
        done, stop = method.iterate(m, A, coupling, w, min(batch, max_iterations - done), tolerance, done == 0, same_matrix)
        if stop != RUNNING or done >= max_iterations:
            return LinearResult(done, stop == CONVERGED, stop == NEGATIVE)


@ti.func
def precondition(m: ti.template(), w: ti.template(), i, D):
    """P of node i from its diagonal block D (12): its inverse over the free axes, for Gauss-Seidel itself and 2 P - D, too."""
    free, P = m.free[i], D
    B = ti.Matrix.zero(ti.f64, 3, 3)  # in f64, so that blocks much stiffer one way than another are inverted too
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            both = free[r] * free[c]
            B[r, c] = both * D[4 * c + r] + (1.0 - both if ti.static(r == c) else 0.0)
    minor = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
    det, size = B.determinant(), B[0, 0] * B[1, 1] * B[2, 2]
    if not (B[0, 0] > 0.0 and minor > 0.0 and det > SINGULAR * size):
        P = ti.Vector([0.0 for _ in ti.static(range(BLOCK))], m.real)
        for r in ti.static(range(3)):
            d = ti.max(abs(B[r, 0]) + abs(B[r, 1]) + abs(B[r, 2]), 1e-30)
            for c in ti.static(range(3)):
                B[r, c] = d if ti.static(r == c) else 0.0
            P[5 * r] = ti.cast(d, m.real)
    C = B.inverse()
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            w.inverse[i][4 * c + r] = free[r] * free[c] * ti.cast(C[r, c], m.real)
    if ti.static(m.serial):
        w.block[i] = P
        w.mirror[i] = 2.0 * P - D


@ti.func
def dot64(a, b):
    """a . b in f64."""
    return ti.cast(a, ti.f64).dot(ti.cast(b, ti.f64))


@ti.func
def total(m: ti.template(), column: ti.template()):
    """Sum of a column of the partial sums, in order."""
    s = ti.cast(0.0, ti.f64)
    for c in range(m.chunks):
        s += m.state.partial[c, column]
    return s
