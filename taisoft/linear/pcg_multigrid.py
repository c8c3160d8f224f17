"""Conjugate gradients whose preconditioner is a multigrid V-cycle, for `pcg` on the CPU at little more memory.

With the matrices of `pcg_gauss_seidel`, S = (P + L)^-1, and B = (L + E) T of a coarse space T (`coarse_space`), a V-cycle that
starts with a forward sweep from 0, corrects by the coarse space and ends with a backward sweep is, for P = D and E = 0,
    M^-1 = S^T (P + B C B^T) S,
since the residual after the forward sweep x = S r is -L^T x, and A and the coarse correction c enter the backward sweep as
-L c alone. Here C is a V-cycle of `multigrid` for T^T A T. So an iteration is one of `pcg_gauss_seidel` with P s replaced by
    P s + B C B^T s,   s = S r.
Both sweeps, the product A p and the residual cost the reading of A once, B C B^T costs it once more: B is not stored, since it
would hold nearly as many numbers as L. M is positive definite for every B, also if C is that of an earlier matrix, and if A is
not positive definite. If the time step has changed since, C is divided by the factor of the stiffness beta^2 K, which dominates
where the coarse space matters.
"""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.fem.model import Model
from taisoft.fem.state import OTHER_SUM
from taisoft.linear.block_csr import BlockCsr, partial_row_times
from taisoft.linear.coarse_space import build_coarse_space
from taisoft.linear.coupling import NO_COUPLING
from taisoft.linear.multigrid import Multigrid
from taisoft.linear.pcg_gauss_seidel import begin_with, end_iteration, start_parallel, sum_of_chunks, take_step
from taisoft.linear.pcg_work import CONVERGED, COUNT, NEGATIVE_PENDING, RUNNING, RZ, STATUS, LinearResult, PcgWork, dot64
from taisoft.linear.sweep_order import chunk_range


class CoarseCorrection:
    """T and C of a matrix: the preconditioner without what belongs to the sweeps."""

    def __init__(self, m: Model, A: BlockCsr, start: np.ndarray, column: np.ndarray, x: np.ndarray, free: np.ndarray):
        """A: positive definite on the free axes; start (n_nodes + 1), column: its rows, with their diagonals.

        x: (n_nodes, 3) positions [m]; free: (n_nodes, 3) bool. Raises numpy.linalg.LinAlgError if A is not positive definite,
        as far as the factorisations show.
        """
        self._arena = FieldArena()
        self.space, coarse, modes = build_coarse_space(m, A, start, column, x, free, self._arena)
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
        space, cycle, scale = self.space, self.cycle, 1.0 / stiffness
        start_parallel(m, A, NO_COUPLING, w, tolerance, 0)
        restrict(m, A, space, w, cycle.right)
        cycle.cycle()
        correct(m, A, space, w, cycle.solution, scale, tolerance, 1)
        while w.state[STATUS] == RUNNING and w.state[COUNT] < max_iterations and w.state[RZ] > 0.0:
            step_and_restrict(m, A, space, w, cycle.right)
            if w.state[STATUS] == NEGATIVE_PENDING:
                break
            cycle.cycle()
            correct(m, A, space, w, cycle.solution, scale, tolerance, 0)
        status, rz = int(w.state[STATUS]), float(w.state[RZ])
        converged = status == CONVERGED and rz >= 0.0
        return LinearResult(int(w.state[COUNT]), converged, status not in (RUNNING, CONVERGED))


@ti.func
def _times_half(m: ti.template(), A: ti.template(), c, i, half: ti.template(), x: ti.template()):
    """((L + E) x)_i for half 0, ((L + E)^T x)_i for half 1, within chunk c of a loop."""
    row = i + half * m.n_nodes
    y = partial_row_times(m, A, c, A.row_start[row], A.row_start[row + 1], x)
    if ti.static(A.crossed):
        other = i + (1 - half) * m.n_nodes
        y += partial_row_times(m, A, c, A.apart_start[other], A.row_start[other + 1], x)
    return y


@ti.func
def _set_right(m: ti.template(), A: ti.template(), space: ti.template(), w: ti.template(), right: ti.template()):
    """right = B^T s, in loops at the top level of a kernel; overwrites p."""
    ti.loop_config(serialize=m.serial)
    for task in range(w.n_chunks * m.spread):
        if task % m.spread == 0:
            c = task // m.spread
            first, end = chunk_range(m, NO_COUPLING, w, c, False)
            for i in range(first, end):
                w.p[i] = m.free[i] * _times_half(m, A, c, i, 1, w.r)
    ti.loop_config(serialize=m.serial)
    for k in range(space.n_coarse):
        force, moment = ti.Vector.zero(m.real, 3), ti.Vector.zero(m.real, 3)
        for at in range(space.start[k], space.start[k + 1]):
            i = space.node[at]
            force += w.p[i]
            moment += space.arm[i].cross(w.p[i])
        for r in ti.static(range(3)):
            right[k][r], right[k][3 + r] = force[r], moment[r]


@kernel
def restrict(m: ti.template(), A: ti.template(), space: ti.template(), w: ti.template(), right: ti.template()):
    """right = B^T s."""
    _set_right(m, A, space, w, right)


@kernel
def step_and_restrict(m: ti.template(), A: ti.template(), space: ti.template(), w: ti.template(), right: ti.template()):
    """Run both sweeps, take the step along p and set right = B^T s."""
    take_step(m, A, NO_COUPLING, w)
    _set_right(m, A, space, w, right)


@ti.func
def _correct_chunk(m: ti.template(), A: ti.template(), w: ti.template(), scale, c):
    """Add B solution to P s, with T solution in p. Return r.z."""
    rz = ti.cast(0.0, ti.f64)
    first, end = chunk_range(m, NO_COUPLING, w, c, False)
    for i in range(first, end):
        t = w.q[i] + ti.cast(scale, m.real) * _times_half(m, A, c, i, 0, w.p)
        w.q[i] = t
        rz += dot64(w.r[i], t)
    return rz


@ti.func
def _correct_chunks(m: ti.template(), A: ti.template(), space: ti.template(), w: ti.template(), solution: ti.template(), scale):
    """Add B solution to P s, in loops at the top level of a kernel; overwrites p. Partial sums: OTHER_SUM of r.z."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        k, u = space.aggregate[i], ti.Vector.zero(m.real, 3)
        if k >= 0:
            x = solution[k]
            u = m.free[i] * (ti.Vector([x[0], x[1], x[2]]) + ti.Vector([x[3], x[4], x[5]]).cross(space.arm[i]))
        w.p[i] = u
    ti.loop_config(serialize=m.serial)
    for task in range(w.n_chunks * m.spread):
        if task % m.spread == 0:
            c = task // m.spread
            m.state.partial[c, OTHER_SUM] = _correct_chunk(m, A, w, scale, c)


@kernel
def correct(
    m: ti.template(),
    A: ti.template(),
    space: ti.template(),
    w: ti.template(),
    solution: ti.template(),
    scale: ti.f64,
    tolerance: ti.f64,
    begin: ti.i32,
):
    """Add B solution to P s, and end the iteration. begin: 1 before the first iteration, 0 at the end of one."""
    _correct_chunks(m, A, space, w, solution, scale)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if begin == 1:
            begin_with(w, tolerance, sum_of_chunks(m, w, OTHER_SUM))
        else:
            end_iteration(m, w, tolerance)
