"""Coarse correction of `gauss_seidel`: its preconditioner becomes a multigrid V-cycle, at little more memory.

With the matrices there, S = (P + L)^-1, and B = (L + E) T of a coarse space T (`coarse_space`), a V-cycle that
starts with a forward sweep from 0, corrects by the coarse space and ends with a backward sweep is, for P = D and E = 0,
    M^-1 = S^T (P + B C B^T) S,
since the residual after the forward sweep x = S r is -L^T x, and A and the coarse correction c enter the backward sweep as
-L c alone. Here C is a V-cycle of `multigrid` for T^T A T. So an iteration is one of `gauss_seidel` with P s replaced by
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
from taisoft.linear.gauss_seidel import start, sum_of_chunks, take_step
from taisoft.linear.multigrid import Multigrid
from taisoft.linear.pcg_work import RUNNING, STATUS, LinearResult, PcgWork, begin_with, dot64, end_iteration
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
        self, model: Model, A: BlockCsr, work: PcgWork, tolerance: float, max_iterations: int, stiffness: float = 1.0
    ) -> LinearResult:
        """Solve for work.y given work.rhs, for all nodes and without coupling terms.

        stiffness: factor of the stiffness in A over that in the matrix this was built from. If rounding keeps the
        preconditioner from being positive definite, the solve ends without convergence.
        """
        self._iterate(model, A, work, tolerance, stiffness, begin=True)
        while (result := work.result(max_iterations)) is None:
            self._iterate(model, A, work, tolerance, stiffness, begin=False)
        return result

    def _iterate(self, model: Model, A: BlockCsr, work: PcgWork, tolerance: float, stiffness: float, begin: bool) -> None:
        cycle = self.cycle
        sweep_and_restrict(model, A, self.space, work, cycle.right, begin)
        if begin or work.state.host[STATUS] == RUNNING:
            cycle.cycle()
            correct(model, A, self.space, work, cycle.solution, 1.0 / stiffness, tolerance, int(begin))


@ti.func
def _times_half(model: ti.template(), A: ti.template(), c, i, half: ti.template(), x: ti.template()):
    """((L + E) x)_i for half 0, ((L + E)^T x)_i for half 1, within chunk c of a loop."""
    row = i + half * model.n_nodes
    y = partial_row_times(model, A, c, A.row_start[row], A.row_start[row + 1], x)
    if ti.static(A.crossed):
        other = i + (1 - half) * model.n_nodes
        y += partial_row_times(model, A, c, A.apart_start[other], A.row_start[other + 1], x)
    return y


@kernel
def sweep_and_restrict(
    model: ti.template(), A: ti.template(), space: ti.template(), work: ti.template(), right: ti.template(), begin: ti.template()
):
    """Begin a solve, or take a step along p; then set right = B^T s, which overwrites p."""
    if ti.static(begin):
        start(model, A, NO_COUPLING, work, 0.0, 0, True)
    else:
        take_step(model, A, NO_COUPLING, work, True)
    ti.loop_config(serialize=model.serial)
    for task in range(work.n_chunks * model.spread):
        if task % model.spread == 0:
            c = task // model.spread
            first, end = chunk_range(model, NO_COUPLING, work, c, False)
            for i in range(first, end):
                work.p[i] = model.free[i] * _times_half(model, A, c, i, 1, work.r)
    ti.loop_config(serialize=model.serial)
    for k in range(space.n_coarse):
        force, moment = ti.Vector.zero(model.real, 3), ti.Vector.zero(model.real, 3)
        for at in range(space.start[k], space.start[k + 1]):
            i = space.node[at]
            force += work.p[i]
            moment += space.arm[i].cross(work.p[i])
        for r in ti.static(range(3)):
            right[k][r], right[k][3 + r] = force[r], moment[r]


@ti.func
def _correct_chunk(model: ti.template(), A: ti.template(), work: ti.template(), scale, c):
    """Add B solution to P s, with T solution in p. Return r.z."""
    rz = ti.cast(0.0, ti.f64)
    first, end = chunk_range(model, NO_COUPLING, work, c, False)
    for i in range(first, end):
        t = work.q[i] + ti.cast(scale, model.real) * _times_half(model, A, c, i, 0, work.p)
        work.q[i] = t
        rz += dot64(work.r[i], t)
    return rz


@kernel
def correct(
    model: ti.template(),
    A: ti.template(),
    space: ti.template(),
    work: ti.template(),
    solution: ti.template(),
    scale: ti.f64,
    tolerance: ti.f64,
    begin: ti.i32,
):
    """Add B solution to P s, which overwrites p, and end the iteration. begin: 1 before the first iteration, else 0."""
    ti.loop_config(serialize=model.serial)
    for i in range(model.n_nodes):
        k, u = space.aggregate[i], ti.Vector.zero(model.real, 3)
        if k >= 0:
            x = solution[k]
            u = model.free[i] * (ti.Vector([x[0], x[1], x[2]]) + ti.Vector([x[3], x[4], x[5]]).cross(space.arm[i]))
        work.p[i] = u
    ti.loop_config(serialize=model.serial)
    for task in range(work.n_chunks * model.spread):
        if task % model.spread == 0:
            c = task // model.spread
            model.state.partial[c, OTHER_SUM] = _correct_chunk(model, A, work, scale, c)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if begin == 1:
            begin_with(work, tolerance, sum_of_chunks(model, work, OTHER_SUM))
        else:
            end_iteration(work, tolerance, sum_of_chunks(model, work, OTHER_SUM))
