"""Preconditioned conjugate gradients for A y = rhs on the free axes, A a `BlockCsr` that holds the whole system.

Serial, in one kernel launch (a launch an iteration would cost more than the iteration): symmetric Gauss-Seidel as
preconditioner, two to three times fewer iterations than block-Jacobi, at the price of one product by Eisenstat's trick.
Parallel, for many tets and on CUDA: block-Jacobi, whose residual is read every few iterations.
Vectors are in the model's precision, sums in f64 and in a fixed order. Both stop on sqrt(r.z) relative to the start, z the
preconditioned residual, and on negative curvature (p.Ap <= 0), which is reported: the caller then asks for a projected
matrix.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.fields import FieldArena
from taisoft.linear.block_csr import BLOCK, BlockCsr
from taisoft.linear.coupling import NO_COUPLING, Coupling
from taisoft.model import Model

SERIAL_WORK = 40_000_000  # block products per launch: about 0.2 s, so that Ctrl-C is heard
PARALLEL_BATCH = 8  # iterations between two looks at the residual
RZ, RZ_START, STEP, COUNT, STOP = range(5)  # places in `state`
RUNNING, CONVERGED, NEGATIVE = range(3)


@dataclass(frozen=True, eq=False)
class PcgWork:
    """Vectors of a solve; (n_nodes) 3-vectors unless said otherwise."""

    rhs: Any
    y: Any  # the solution
    r: Any  # residual; serial: (D + L)^-1 of it
    z: Any  # preconditioned residual; serial: (D + L)^T p
    p: Any  # direction
    q: Any  # A p; serial: (D + L)^-1 of it
    inverse: Any  # (n_nodes) 12-vectors: inverse diagonal blocks, 0 on constrained axes
    state: Any  # (5) f64


@dataclass(frozen=True)
class LinearResult:
    """What a solve did."""

    iterations: int
    converged: bool
    negative: bool  # negative curvature was met; y holds the iterate before it


def build_pcg(model: Model, arena: FieldArena) -> PcgWork:
    """Allocate the vectors of a solve."""
    names = ("rhs", "y", "r", "z", "p", "q")
    vectors = {name: arena.vectors(f"pcg_{name}", model.real, model.n_nodes) for name in names}
    inverse = arena.vectors("pcg_inverse", model.real, model.n_nodes, n=BLOCK)
    return PcgWork(**vectors, inverse=inverse, state=arena.field("pcg_state", ti.f64, 5))


def solve(
    m: Model, A: BlockCsr, w: PcgWork, tolerance: float, max_iterations: int, coupling: Coupling = NO_COUPLING
) -> LinearResult:
    """Fill w.y from w.rhs. tolerance: sqrt(r.z) relative to the start.

    coupling: terms beside A, whose own diagonal is then in coupling.base; A.diagonal is set to that of both.
    """
    from taisoft.linear import pcg_parallel, pcg_serial

    method = pcg_serial if m.serial else pcg_parallel
    batch = max(1, SERIAL_WORK // (2 * A.n_edges + m.n_nodes)) if m.serial else PARALLEL_BATCH
    done = 0
    while True:
        done, stop = method.iterate(m, A, coupling, w, min(batch, max_iterations - done), tolerance, done == 0)
        if stop != RUNNING or done >= max_iterations:
            return LinearResult(done, stop == CONVERGED, stop == NEGATIVE)


@ti.func
def inverse_block(m: ti.template(), block, free):
    """Inverse (12) of a diagonal block over the free axes, 0 on the others."""
    inverse = ti.Vector([0.0 for _ in ti.static(range(BLOCK))], m.real)
    B = ti.Matrix.zero(ti.f64, 3, 3)  # in f64, so that blocks much stiffer one way than another are inverted too
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            both = free[r] * free[c]
            B[r, c] = both * block[4 * c + r] + (1.0 - both if ti.static(r == c) else 0.0)
    det = B.determinant()
    solid = B[0, 0] > 0.0 and B[1, 1] > 0.0 and B[2, 2] > 0.0 and det > 1e-12 * B[0, 0] * B[1, 1] * B[2, 2]
    if solid:
        C = B.inverse()
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                inverse[4 * c + r] = free[r] * free[c] * ti.cast(C[r, c], m.real)
    else:
        # a nearly singular or indefinite block (unprojected, compressed): its diagonal still preconditions
        for r in ti.static(range(3)):
            d = abs(B[r, r])
            inverse[5 * r] = free[r] * ti.cast(ti.select(d > 0.0, 1.0 / ti.max(d, 1e-30), 1.0), m.real)
    return inverse


@ti.func
def dot64(a, b):
    """a . b in f64."""
    return ti.cast(a, ti.f64).dot(ti.cast(b, ti.f64))


@ti.func
def total(m: ti.template(), column: ti.template()):
    """Sum of a column of the partial sums, in order."""
    s = ti.cast(0.0, ti.f64)
    for c in range(m.chunks):
        s += m.partial[c, column]
    return s
