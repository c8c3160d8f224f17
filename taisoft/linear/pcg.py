"""Preconditioned conjugate gradients for A y = rhs on the free axes, A a `BlockCsr` that holds the whole system.

On the CPU: symmetric Gauss-Seidel as preconditioner. It needs two to three times fewer iterations than block-Jacobi and, by
Eisenstat's trick, costs no extra product. On one thread all iterations run in one launch, since a launch per iteration would cost
more than the iteration; several threads take a launch per iteration. On CUDA: block-Jacobi, whose residual is read every few
iterations.
Vectors are in the model's precision, sums in f64 and in a fixed order, independent of threads. All stop on sqrt(r.z) relative to
the start, z the preconditioned residual, and on a direction p of negative curvature (p.Ap <= 0), which is reported. y is then the
iterate so far plus min(r.z / |p.Ap|, MAX_NEGATIVE_STEP) p, a descent direction for a function with this gradient and second
derivative. The preconditioner replaces diagonal blocks that are not positive definite by the absolute row sums, which makes it
positive definite.
"""

from taisoft.fem.model import Model
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.coupling import NO_COUPLING
from taisoft.linear.pcg_gauss_seidel import iterate_kernel, iterate_parallel, start_parallel
from taisoft.linear.pcg_jacobi import iterate_jacobi, start_jacobi
from taisoft.linear.pcg_work import CONVERGED, COUNT, NEGATIVE, NEGATIVE_PENDING, RUNNING, STATUS, LinearResult, PcgWork

SERIAL_WORK = 40_000_000  # block products per launch: about 0.2 s, so that Ctrl-C takes effect
SHARED_FROM = 4  # chunks that several threads share: of fewer, one or two have work at a time
JACOBI_BATCH = 8  # iterations between residual checks


def iteration_limit(m: Model) -> int:
    """Maximum iterations of a solve."""
    return max(1000, 30 * m.n_nodes)


def batch_of(m: Model, A: BlockCsr) -> int:
    """Iterations per serial launch."""
    return max(1, SERIAL_WORK // (2 * A.n_edges + m.n_nodes))


def solve(
    m: Model,
    A: BlockCsr,
    w: PcgWork,
    tolerance: float,
    max_iterations: int,
    coupling=NO_COUPLING,
    same_matrix: bool = False,
    may_share: bool = True,
) -> LinearResult:
    """Solve for w.y given w.rhs. tolerance: sqrt(r.z) relative to the start.

    coupling: terms added to A. The diagonal of A alone must then be in coupling.base; A.diagonal is set to that of the sum.
    w.subset: the nodes whose rows and unknowns form the system; w.r, w.p and w.q must be 0 on all others.
    same_matrix: whether A and the nodes of the terms are those of the last solve; rows without terms then keep their
    preconditioner. may_share: whether several threads may share the sweeps; the result is the same.
    """
    done = 0
    while True:
        if not m.on_cpu:
            _take_jacobi_batch(m, A, w, tolerance, min(JACOBI_BATCH, max_iterations - done), coupling, same_matrix, done == 0)
        elif m.serial or not (may_share and w.is_shared(coupling)) or w.n_chunks < SHARED_FROM:
            begin = 0 if done else 1 + same_matrix
            iterate_kernel(m, A, coupling, w, min(batch_of(m, A), max_iterations - done), tolerance, begin)
        else:
            if done == 0:
                start_parallel(m, A, coupling, w, tolerance, int(same_matrix))
            if max_iterations > 0 and w.state[STATUS] == RUNNING:
                iterate_parallel(m, A, coupling, w, tolerance)
        state = w.state.to_numpy()
        done, status = int(state[COUNT]), int(state[STATUS])
        if status != RUNNING or done >= max_iterations:
            return LinearResult(done, status == CONVERGED, status in (NEGATIVE, NEGATIVE_PENDING))


def _take_jacobi_batch(m, A, w, tolerance: float, n: int, coupling, same_matrix: bool, first: bool) -> None:
    if first:
        start_jacobi(m, A, coupling, w, int(same_matrix))
    for _ in range(n):
        iterate_jacobi(m, A, coupling, w, tolerance)
