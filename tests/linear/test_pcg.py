"""Conjugate gradients in both precisions, on stiffness plus inertia of compressed bodies of either order; block-Jacobi, and
Gauss-Seidel over the whole system and over chunks, on one thread and on several:

* the solution is SciPy's on the free axes and exactly 0 on the others, whatever the right-hand side there;
* a looser tolerance stops earlier, the iteration limit holds, and a zero right-hand side takes no iteration;
* negative curvature is reported, and the iterate before it is finite and a descent direction;
* nearly singular diagonal blocks do not spoil the solution;
* with chunks the result is the same on any number of threads, in every run, and takes about as many iterations as without,
  whether blocks couple chunks of one parity or not.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from taisoft.backend.arrays import FieldArena
from taisoft.linear import block_csr, pcg
from taisoft.linear.pcg_work import build_pcg
from tests.dynamics.scenes import built, mixed_scene

METHODS = ("whole", "chunks", "chunks, threads", "crossed", "crossed, threads", "jacobi")


@pytest.fixture(scope="module", params=["f64", "f32"])
def rig(request):
    with built(mixed_scene(order="both"), request.param) as made:
        made.matrix = block_csr.build_block_csr(made.model, made.arena)
        made.work = build_pcg(made.model, made.arena)
        one_thread, ways = replace(made.parallel, serial=True), {}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("taisoft.fem.chunks.MIN_SHIFT", 0)
            for name, chunks in (("chunks", 3), ("crossed", 6)):
                patch.setattr("taisoft.fem.chunks.SWEEP_CHUNKS", chunks)
                matrix, work = block_csr.build_block_csr(one_thread, FieldArena()), build_pcg(one_thread, FieldArena())
                assert work.n_chunks == chunks and matrix.crossed == (name == "crossed")
                ways[name] = one_thread, matrix, work
        ways |= {f"{name}, threads": (made.parallel, *way) for name, (_, *way) in ways.items()}
        jacobi = replace(made.parallel, on_cpu=False)
        made.ways = ways | {name: (m, made.matrix, made.work) for name, m in (("whole", made.model), ("jacobi", jacobi))}
        rng = np.random.default_rng(1)
        x = made.oracle.rest * [0.8, 1.1, 0.9] + 0.05 * rng.standard_normal(made.oracle.rest.shape)
        made.stiffness = made.oracle.stiffness(x, projected=True)
        made.free = rng.random(x.shape) < 0.8
        made.free[3] = False
        made.model.free.from_numpy(made.free.astype(made.machine.np_real))
        made.rhs = rng.standard_normal(x.shape).astype(made.machine.np_real)
        yield made


def fill(rig, dense: np.ndarray) -> sp.csr_matrix:
    """Upload a matrix with the node graph's pattern; returns it as stored, rounded."""
    blocks = dense.reshape(rig.model.n_nodes, 3, rig.model.n_nodes, 3).transpose(0, 2, 1, 3)
    own, stored = np.arange(rig.model.n_nodes), []
    for matrix in (rig.matrix, rig.ways["chunks"][1], rig.ways["crossed"][1]):
        start, column = matrix.row_start.to_numpy(), matrix.column.to_numpy()
        row = np.repeat(np.arange(2 * rig.model.n_nodes), np.diff(start)) % rig.model.n_nodes
        matrix.value.from_numpy(block_csr.packed(blocks[row, column]).astype(rig.machine.np_real))
        matrix.diagonal.from_numpy(block_csr.packed(blocks[own, own]).astype(rig.machine.np_real))
        stored.append(block_csr.to_scipy(rig.model, matrix))
    assert all((one != stored[0]).nnz == 0 for one in stored)
    return stored[0]


def solve(rig, method: str, tolerance: float, limit: int = 1000, rhs: np.ndarray | None = None):
    model, matrix, work = rig.ways[method]
    work.rhs.from_numpy(rig.rhs if rhs is None else rhs)
    work.y.fill(np.nan)
    result = pcg.solve(model, matrix, work, tolerance, limit)
    return result, work.y.to_numpy().astype(np.float64)


@pytest.fixture
def system(rig):
    """Exact solution (n,3) of a system of K plus an inertia of about a hundredth of it."""
    shift = np.repeat(np.random.default_rng(2).uniform(200.0, 2000.0, rig.model.n_nodes), 3)  # [N/m], one per node
    A = fill(rig, rig.stiffness + np.diag(shift))
    free = rig.free.reshape(-1)
    y = np.zeros(free.size)
    y[free] = spl.spsolve(A[free][:, free].tocsc(), rig.rhs.reshape(-1)[free].astype(np.float64))
    return y.reshape(-1, 3)


@pytest.mark.parametrize("method", METHODS)
def test_the_solution_is_scipys(rig, system, method):
    tolerance = {"f64": 1e-12, "f32": 1e-6}[rig.machine.precision]
    result, y = solve(rig, method, tolerance)
    assert result.converged and not result.negative and 5 < result.iterations < rig.free.sum()
    # the error is at most the tolerance times the root of the condition of the preconditioned matrix, about 30
    assert np.abs(y - system).max() < 100 * tolerance * np.abs(system).max()
    assert np.abs(system).max() > 0.0 and np.all(y[~rig.free] == 0.0) and np.abs(rig.rhs[~rig.free]).max() > 1.0


@pytest.mark.parametrize("method", METHODS)
def test_the_tolerance_and_the_iteration_limit_stop_the_solver(rig, system, method):
    counts = [solve(rig, method, tolerance)[0].iterations for tolerance in (0.3, 1e-2, 1e-5)]
    assert counts == sorted(set(counts))
    loose = solve(rig, method, 0.3)[1]
    assert 1e-3 < np.abs(loose - system).max() / np.abs(system).max() < 1.0
    result, y = solve(rig, method, 1e-5, limit=3)
    assert result.iterations == 3 and not result.converged and not result.negative and np.isfinite(y).all()


def test_gauss_seidel_takes_fewer_iterations(rig, system):
    whole, chunks, crossed, jacobi = (solve(rig, m, 1e-5)[0].iterations for m in ("whole", "chunks", "crossed", "jacobi"))
    assert whole < 0.8 * jacobi and chunks < 1.15 * whole and crossed < 0.9 * jacobi


@pytest.mark.parametrize("method", ["chunks", "crossed"])
def test_any_number_of_threads_gives_the_same_bits(rig, system, method):
    first = solve(rig, method, 1e-5)
    for _ in range(5):
        again = solve(rig, f"{method}, threads", 1e-5)
        assert again[0] == first[0] and np.array_equal(again[1], first[1])


@pytest.mark.parametrize("method", METHODS)
def test_a_zero_right_hand_side_takes_no_iteration(rig, system, method):
    result, y = solve(rig, method, 1e-6, rhs=np.where(rig.free, 0.0, 1.0).astype(rig.machine.np_real))
    assert result.converged and result.iterations == 0 and not y.any()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shift", [-1e3, -1e5])
def test_negative_curvature_is_reported(rig, method, shift):
    """Slightly indefinite, and negative definite, which already shows in the diagonal blocks."""
    A = fill(rig, rig.stiffness + shift * np.eye(len(rig.stiffness)))
    free = rig.free.reshape(-1)
    assert np.linalg.eigvalsh(A[free][:, free].toarray()).min() < -500
    result, y = solve(rig, method, 1e-6)
    assert result.negative and not result.converged
    assert np.isfinite(y).all() and np.sum(y * rig.rhs) >= 0.0
    for after in (1, 2, 8):  # the limit falls into the iteration that finds it, or a later one of its batch
        again, same = solve(rig, method, 1e-6, limit=result.iterations + after)
        assert again == result and np.array_equal(same, y)


@pytest.mark.parametrize("method", METHODS)
def test_nearly_singular_blocks_do_not_spoil_the_solution(rig, method):
    """Nodes ten thousand times as stiff along one oblique axis: the determinants of their blocks are nearly 0."""
    u = np.array([1.0, 2.0, -2.0]) / 3.0
    blocks = {i: 3e6 * np.outer(u, u) for i in range(4, 20, 3)}
    A = rig.stiffness + 300.0 * np.eye(len(rig.stiffness))
    for i, block in blocks.items():
        A[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block + 300.0 * np.eye(3)
        others = np.r_[0 : 3 * i, 3 * i + 3 : len(A)]
        A[3 * i : 3 * i + 3, others] = 0.01 * A[3 * i : 3 * i + 3, others]
        A[others, 3 * i : 3 * i + 3] = A[3 * i : 3 * i + 3, others].T
    A = fill(rig, A)
    free = rig.free.reshape(-1)
    assert np.linalg.eigvalsh(A[free][:, free].toarray()).min() > 10.0
    exact = np.zeros(free.size)
    exact[free] = spl.spsolve(A[free][:, free].tocsc(), rig.rhs.reshape(-1)[free].astype(np.float64))
    result, y = solve(rig, method, 1e-6)
    assert result.converged and not result.negative
    assert np.abs(y.reshape(-1) - exact).max() < 1e-2 * np.abs(exact).max()
