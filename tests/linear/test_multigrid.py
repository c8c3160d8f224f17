"""Multigrid on the host's matrices, and as the simulator chooses it, in f64: the kernels of a V-cycle are their formulas; a cycle
is symmetric and positive definite; conjugate gradients with it give the solution; implicit steps resume bitwise.
"""

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import taichi as ti

import taisoft as ts
from taisoft.fem.reference import lumped_masses
from taisoft.linear import block_csr, block_rows
from taisoft.linear.aggregation import MODES, rigid_modes
from taisoft.linear.block_rows import BlockRows
from taisoft.linear.multigrid import Multigrid
from tests.backend.lanes import opened
from tests.linear.boxes import assembled, held_box, strip

N = 1500


def to_scipy(rows: BlockRows) -> sp.bsr_matrix:
    """A matrix of the device."""
    blocks = rows.value.to_numpy().astype(np.float64).reshape(-1, rows.columns, rows.lanes)[:, :, : rows.rows].swapaxes(1, 2)
    shape = rows.n_rows * rows.rows, rows.n_columns * rows.columns
    return sp.bsr_matrix((blocks, rows.column.to_numpy(), rows.start.to_numpy()), shape=shape)


def random_matrix(chords: int = 3) -> tuple[sp.bsr_matrix, np.ndarray, np.ndarray]:
    """A positive definite matrix on a ring of nodes with chords, the identity on some axes; rigid modes; free axes (n, 3)."""
    rng = np.random.default_rng(3)
    ends = [np.arange(N), (np.arange(N) + 1) % N]
    ends = np.concatenate([np.stack(ends, axis=1), rng.integers(0, N, (chords * N // 2, 2))])
    ends = ends[ends[:, 0] != ends[:, 1]]
    B = rng.standard_normal((len(ends), 6, 6))
    rows = (3 * ends[:, :, None] + np.arange(3)).reshape(-1, 6)
    entries = (B @ B.swapaxes(1, 2)).reshape(-1)
    at = np.broadcast_arrays(rows[:, :, None], rows[:, None, :])
    A, free = sp.csr_matrix((entries, [part.reshape(-1) for part in at]), shape=(3 * N, 3 * N)), rng.random((N, 3)) < 0.95
    free[:6] = False
    f = sp.diags(1.0 * free.reshape(-1))
    A = (f @ A @ f + sp.identity(3 * N) - f).tobsr((3, 3))
    A.sort_indices()
    return A, rigid_modes(rng.standard_normal((N, 3)), free), free


@pytest.fixture(scope="module")
def wide():
    """A matrix whose band is wide on two levels; its cycle, and the free unknowns."""
    with opened("f64"):
        A, modes, free = random_matrix()
        yield A, Multigrid(A, modes, ti.f64), free.reshape(-1)


def test_the_kernels_of_a_cycle_are_their_formulas(wide):
    """Smoothing steps s: x + s S (r - A x), twice on the way down and, after the correction, in reverse order on the way up."""
    A, cycle, _ = wide
    assert len(cycle.levels) == 2 and cycle.n_bytes > A.data.nbytes
    rng, (first, second) = np.random.default_rng(4), (0.4, 0.7)
    for k, level in enumerate(cycle.levels):
        A, P = to_scipy(level.matrix), to_scipy(level.prolongation)
        n, d = level.matrix.n_rows, level.matrix.rows
        blocks = level.smoother.to_numpy().reshape(n, d, -1)[:, :, :d].swapaxes(1, 2)
        S = sp.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)))
        r, below = rng.standard_normal((n, d)), rng.standard_normal((level.prolongation.n_columns, MODES))
        level.r.host[:, :d], r = r, r.reshape(-1)
        block_rows.descend(level, first, second)
        x = first * (S @ r)
        x = x + second * (S @ (r - A @ x))
        assert np.abs(level.next_r.host[:, :MODES].reshape(-1) - P.T @ (r - A @ x)).max() < 1e-11 * np.abs(r).max()
        level.next_x.host[:, :MODES] = below
        block_rows.ascend(level, first, second)
        x = x + P @ below.reshape(-1)
        for step in (second, first):
            x = x + step * (S @ (r - A @ x))
        assert np.abs(level.other.host[:, :d].reshape(-1) - x).max() < 1e-10 * np.abs(x).max()
        coarse = (P.T @ A @ P).tocsr()
        if k == 0:
            stored = to_scipy(cycle.levels[1].matrix).tocsr()
            used = coarse.diagonal() > 0.0  # the identity elsewhere
            assert abs(stored[used][:, used] - coarse[used][:, used]).max() < 1e-11 * abs(coarse).max()
            assert np.array_equal(stored.diagonal()[~used], np.ones((~used).sum()))
        else:
            b = rng.standard_normal(coarse.shape[0])
            assert np.abs(coarse @ cycle.coarsest.solution(b) - b).max() < 1e-6


def test_a_cycle_is_symmetric_and_positive_definite(wide):
    A, cycle, f = wide
    rng = np.random.default_rng(5)
    a, b = rng.standard_normal((2, len(f))) * f
    Ma, Mb = cycle.apply(a), cycle.apply(b)
    assert abs(a @ Mb - b @ Ma) < 1e-12 * (a @ Ma) and b @ Mb > 0.0 and not Ma[~f].any() and np.abs(Ma[f]).min() > 0.0
    v = a
    for _ in range(30):
        v = f * cycle.apply(A @ v)
        v, growth = v / np.linalg.norm(v), np.linalg.norm(v)
    assert 0.5 < growth < 1.0 + 1e-9  # the largest eigenvalue


def test_a_narrow_band_is_solved_exactly_and_an_indefinite_matrix_refused():
    A, modes, free = random_matrix(chords=0)
    with opened("f64"):
        cycle, b = Multigrid(A, modes, ti.f64), np.random.default_rng(5).standard_normal(free.size)
        assert not cycle.levels and np.abs(A @ cycle.apply(b) - b).max() < 1e-8
        for matrix in (A, random_matrix()[0]):
            with pytest.raises(np.linalg.LinAlgError):
                Multigrid((matrix - 200.0 * sp.identity(A.shape[0])).tobsr((3, 3)), modes, ti.f64)


def test_conjugate_gradients_with_a_cycle():
    """The prolongation keeps the motions without energy; SciPy solves with the cycle in few iterations."""
    with assembled(held_box()) as made:
        K = (block_csr.to_bsr(made.model, made.A) + 1e-6 * sp.identity(made.free.size)).tobsr((3, 3))
        K.sort_indices()
        modes = rigid_modes(made.x, np.ones_like(made.free))
        P = to_scipy(Multigrid(K, modes, ti.f64).levels[0].prolongation)
        for mode in modes.reshape(-1, MODES).T:
            nearest = P @ spl.lsmr(P, mode, atol=1e-14, btol=1e-14)[0]
            assert np.linalg.norm(nearest - mode) < 1e-7 * np.linalg.norm(mode)
        cycle = Multigrid(made.matrix, rigid_modes(made.x, made.free), ti.f64)
        iterates, rhs = [], (made.free * made.work.rhs.to_numpy()).reshape(-1)
        M = spl.LinearOperator(made.matrix.shape, matvec=cycle.apply)
        y, failed = spl.cg(made.matrix, rhs, rtol=1e-10, maxiter=60, M=M, callback=iterates.append)
        assert not failed and 4 < len(iterates) and np.abs(made.matrix @ y - rhs).max() < 1e-8


def test_steps_solve_the_equations_of_motion_after_a_release_and_resume_bitwise(tmp_path):
    scene, dt, path = strip(), 1 / 30, tmp_path / "checkpoint.npz"
    body = scene.body("strip")
    led = body.rest_positions[:, 0] > 4.99  # in three steps
    held, mass, reports = body.rest_positions[:, 0] < -4.99, lumped_masses(scene)[:, None], []
    with ts.Simulator(scene, dt=dt, integrator="implicit_euler", precision="f64", newton_tolerance=1e-8) as sim:
        for n in range(6):
            v = sim.velocities()
            reports.append(sim.step())
            missing = mass * ((sim.velocities() - v) / dt - [0, -9.81, 0]) - sim.elastic_forces()
            free = ~held & (~led if sim.time < 0.11 else True)
            assert reports[n].converged and np.abs(missing[free]).max() < 1e-5 * (9.81 * body.mass)
            if n == 3:
                sim.save_checkpoint(path)
        assert all(report.multigrid_solves for report in reports[4:]) and sim.field_bytes["multigrid"] > 10_000
        x = sim.positions()
    with ts.Simulator.load_checkpoint(path, scene) as sim:
        assert [sim.step() for _ in range(2)] == reports[4:] and np.array_equal(sim.positions(), x)
