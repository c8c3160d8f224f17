"""Conjugate gradients whose preconditioner is a multigrid V-cycle, for `pcg` on the CPU at hardly more memory traffic.

With the matrices of `pcg_gauss_seidel`, S = (P + L)^-1, and B = L T of a coarse space T (`coarse_space`), a V-cycle that starts
with a forward sweep from 0, corrects by the coarse space and ends with a backward sweep is, for P = D and E = 0,
    M^-1 = S^T (P + B C B^T) S,
since the residual after the forward sweep x = S r is -L^T x, and A and the coarse correction c enter the backward sweep as
-L c alone. Here C is a V-cycle of `multigrid` for T^T A T. So an iteration is one of `pcg_gauss_seidel` with P s replaced by
    P s + B C B^T s,   s = S r,
and both sweeps, the product A p and the residual cost the reading of A once. M is positive definite for every B, also if B and C
are those of an earlier matrix, and if A is not positive definite. If the time step has changed since, B C B^T is scaled with the
stiffness beta^2 K, which dominates where the coarse space matters.
"""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.fem.model import Model
from taisoft.fem.state import OTHER_SUM
from taisoft.linear.aggregation import rigid_modes
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.block_rows import block_row_times
from taisoft.linear.coarse_space import build_coarse_space, find_pattern
from taisoft.linear.coupling import NO_COUPLING
from taisoft.linear.multigrid import Multigrid
from taisoft.linear.pcg_gauss_seidel import begin_with, end_iteration, start_parallel, sum_of_chunks, take_step
from taisoft.linear.pcg_work import CONVERGED, COUNT, NEGATIVE_PENDING, RUNNING, RZ, STATUS, LinearResult, PcgWork, dot64
from taisoft.linear.sweep_order import chunk_range


class CoarseCorrection:
    """B C B^T of a matrix: the preconditioner without what belongs to the sweeps."""

    def __init__(self, m: Model, A: BlockCsr, start: np.ndarray, column: np.ndarray, x: np.ndarray, free: np.ndarray):
        """A: positive definite on the free axes; start (n_nodes + 1), column: its rows, with their diagonals.

        x: (n_nodes, 3) positions [m]; free: (n_nodes, 3) bool. Raises numpy.linalg.LinAlgError if A is not positive definite,
        as far as the factorisations show.
        """
        self._arena = FieldArena()
        pattern = find_pattern(m, A, start, column, free)
        self.space, coarse, modes = build_coarse_space(m, A, pattern, rigid_modes(x, free), self._arena)
        self.cycle = Multigrid(coarse, modes, m.real)

    @property
    def n_bytes(self) -> int:
        """Memory of all levels."""
        return self.cycle.n_bytes + sum(self._arena.bytes.values())

    def solve(
        self, m: Model, A: BlockCsr, w: PcgWork, tolerance: float, max_iterations: int, stiffness: float = 1.0
    ) -> LinearResult:
        """Solve for w.y given w.rhs, as `pcg.solve` without coupling and for all nodes.

        stiffness: factor of the stiffness in A over that in the matrix this was built from. If rounding keeps the
        preconditioner from being positive definite, the solve ends without convergence.
        """
        space, cycle = self.space, self.cycle
        start_parallel(m, A, NO_COUPLING, w, tolerance, 0)
        restrict(space, w, cycle.right)
        cycle.cycle()
        start_with_correction(m, space, w, cycle.solution, stiffness, tolerance)
        while w.state[STATUS] == RUNNING and w.state[COUNT] < max_iterations and w.state[RZ] > 0.0:
            step_and_restrict(m, A, space, w, cycle.right)
            if w.state[STATUS] == NEGATIVE_PENDING:
                break
            cycle.cycle()
            correct(m, space, w, cycle.solution, stiffness, tolerance)
        status, rz = int(w.state[STATUS]), float(w.state[RZ])
        converged = status == CONVERGED and rz >= 0.0
        return LinearResult(int(w.state[COUNT]), converged, status not in (RUNNING, CONVERGED))


@ti.func
def _set_right(space: ti.template(), w: ti.template(), right: ti.template()):
    """right = B^T s, in a loop at the top level of a kernel."""
    ti.loop_config(serialize=space.transposed.serial)
    for i in range(space.transposed.n_rows):
        right[i] = block_row_times(space.transposed, i, w.r)


@kernel
def restrict(space: ti.template(), w: ti.template(), right: ti.template()):
    """right = B^T s."""
    _set_right(space, w, right)


@kernel
def step_and_restrict(m: ti.template(), A: ti.template(), space: ti.template(), w: ti.template(), right: ti.template()):
    """Run both sweeps, take the step along p and set right = B^T s."""
    take_step(m, A, NO_COUPLING, w)
    _set_right(space, w, right)


@ti.func
def _correct_chunk(m: ti.template(), space: ti.template(), w: ti.template(), solution: ti.template(), stiffness, c):
    """Add B solution to P s. Return r.z."""
    rz = ti.cast(0.0, ti.f64)
    first, end = chunk_range(m, NO_COUPLING, w, c, False)
    for i in range(first, end):
        change = ti.cast(stiffness, m.real) * block_row_times(space.product, i, solution)
        t = w.q[i] + ti.Vector([change[0], change[1], change[2]])
        w.q[i] = t
        rz += dot64(w.r[i], t)
    return rz


@ti.func
def _correct_chunks(m: ti.template(), space: ti.template(), w: ti.template(), solution: ti.template(), stiffness):
    """Add B solution to P s, in a loop at the top level of a kernel. Partial sums: OTHER_SUM of r.z."""
    ti.loop_config(serialize=m.serial)
    for task in range(w.n_chunks * m.spread):
        if task % m.spread == 0:
            c = task // m.spread
            m.state.partial[c, OTHER_SUM] = _correct_chunk(m, space, w, solution, stiffness, c)


@kernel
def start_with_correction(
    m: ti.template(), space: ti.template(), w: ti.template(), solution: ti.template(), stiffness: ti.f64, tolerance: ti.f64
):
    """Add B solution to P s before the first iteration."""
    _correct_chunks(m, space, w, solution, stiffness)
    ti.loop_config(serialize=True)
    for _ in range(1):
        begin_with(w, tolerance, sum_of_chunks(m, w, OTHER_SUM))


@kernel
def correct(
    m: ti.template(), space: ti.template(), w: ti.template(), solution: ti.template(), stiffness: ti.f64, tolerance: ti.f64
):
    """Add B solution to P s, and end the iteration."""
    _correct_chunks(m, space, w, solution, stiffness)
    ti.loop_config(serialize=True)
    for _ in range(1):
        end_iteration(m, w, tolerance)
