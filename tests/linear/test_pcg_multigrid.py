"""Conjugate gradients with multigrid in Gauss-Seidel's sweeps, and its coarse space:

* the stored form of T, and T^T A T, are those of the dense matrices;
* iterates are those of conjugate gradients with the dense V-cycle: forward sweep, coarse correction, backward sweep;
* the solution is SciPy's, 0 on constrained axes; the limit of iterations holds and negative curvature is reported;
* with chunks, also if blocks couple chunks of one parity, the bits are the same on one thread and on several;
* the iterations hardly grow with the mesh, and a factor of the stiffness does not change them.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spl

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.fem.node_graph import EVERYTHING
from taisoft.linear import block_csr, multigrid, pcg
from taisoft.linear.aggregation import MODES, rigid_aggregates, rigid_modes
from taisoft.linear.coarse_space import build_coarse_space
from taisoft.linear.hierarchy import ExactPreconditioner, build_hierarchy, has_narrow_band, rows_with_diagonals
from taisoft.linear.pcg_multigrid import CoarseCorrection
from taisoft.linear.pcg_work import build_pcg
from taisoft.mesh.aggregates import aggregate
from tests.dynamics.scenes import built, rubber
from tests.linear.test_multigrid import assembled, held_box


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """Use multigrid, with several levels, for small matrices too."""
    monkeypatch.setattr(multigrid, "SMALL", 40)
    monkeypatch.setattr(multigrid, "NARROW", 0)


def lower_part(matrix: np.ndarray) -> np.ndarray:
    """The blocks (3, 3) below the diagonal."""
    n = len(matrix) // 3
    return matrix * np.kron(np.tri(n, k=-1), np.ones((3, 3)))


def diagonal_part(matrix: np.ndarray) -> np.ndarray:
    """The diagonal blocks (3, 3)."""
    return matrix * np.kron(np.eye(len(matrix) // 3), np.ones((3, 3)))


def test_the_products_are_those_of_dense_matrices():
    with built(held_box(), "f64") as made:
        A, _, matrix, free = assembled(made, shift=100.0)
        x, m = made.oracle.rest, made.model
        rows = rows_with_diagonals(m, A)
        space, coarse, modes = build_coarse_space(m, A, *rows, x, free, FieldArena())
        own = aggregate(*rows, free.any(axis=1))
        arms, T, _, unused = rigid_aggregates(x, free, own)
        assert np.array_equal(space.arm.host, arms) and np.array_equal(space.aggregate.host, own)
        for c in range(space.n_coarse):
            assert np.array_equal(space.node.host[space.start.host[c] : space.start.host[c + 1]], np.flatnonzero(own == c))
        dense, T = matrix.toarray(), as_dense(T, own)
        expected = T.T @ dense @ T + np.diag(unused.reshape(-1) * 1.0)
        assert np.abs(coarse.toarray() - expected).max() < 1e-12 * np.abs(expected).max() and space.n_coarse > 4
        assert np.abs(T @ modes.reshape(-1, MODES) - rigid_modes(x, free).reshape(-1, MODES)).max() < 1e-14


def as_dense(blocks: np.ndarray, own: np.ndarray) -> np.ndarray:
    """T (3 n, 6 n_coarse) from the blocks (n, 3, 6) and the aggregate of each node."""
    T = np.zeros((len(own), 3, own.max() + 1, MODES))
    T[np.arange(len(own)), :, own] = blocks
    return T.reshape(3 * len(own), -1)


def test_iterates_are_those_of_the_dense_cycle():
    """The shift makes all diagonal blocks positive definite, so that P = D."""
    with built(held_box((10, 4, 4)), "f64") as made:
        A, w, matrix, free = assembled(made, shift=100.0)
        m, f, x = made.model, free.reshape(-1), made.oracle.rest
        hierarchy = build_hierarchy(m, A, x, free)
        assert isinstance(hierarchy, CoarseCorrection) and hierarchy.cycle.levels
        own = aggregate(*rows_with_diagonals(m, A), free.any(axis=1))
        T = as_dense(rigid_aggregates(x, free, own)[1], own)[f]
        C = np.array([hierarchy.cycle.apply(e) for e in np.eye(T.shape[1])])
        dense = matrix.toarray()
        S = np.linalg.inv((diagonal_part(dense) + lower_part(dense))[np.ix_(f, f)])
        K, one = dense[np.ix_(f, f)], np.eye(f.sum())
        M = S + S.T - S.T @ K @ S + (one - S.T @ K) @ T @ C @ T.T @ (one - K @ S)
        r = w.rhs.to_numpy().reshape(-1)[f]
        y, p, last = np.zeros_like(r), np.zeros_like(r), np.inf
        for k in range(1, 5):
            z = M @ r
            p, last = z + (r @ z / last) * p, r @ z
            step = last / (p @ K @ p)
            y, r = y + step * p, r - step * K @ p
            result = hierarchy.solve(m, A, w, 1e-30, k)
            found = w.y.to_numpy().reshape(-1)
            assert result.iterations == k and not result.converged and not found[~f].any()
            assert np.abs(found[f] - y).max() < 1e-9 * np.abs(y).max()


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_the_solution_is_scipys(precision):
    with built(held_box(), precision) as made:
        A, w, matrix, free = assembled(made, shift=100.0)
        m, hierarchy = made.model, build_hierarchy(made.model, A, made.oracle.rest, free)
        tolerance = {"f64": 1e-12, "f32": 1e-6}[precision]
        result = hierarchy.solve(m, A, w, tolerance, 200)
        y = w.y.to_numpy().astype(np.float64).reshape(-1)
        exact = spl.spsolve(matrix.tocsc(), (free * w.rhs.to_numpy()).reshape(-1).astype(np.float64))
        assert result.converged and not result.negative and 4 < result.iterations < 40
        assert np.abs(y - exact).max() < 100 * tolerance * np.abs(exact).max()
        assert not y[~free.reshape(-1)].any()
        w.rhs.fill(0.0)
        result = hierarchy.solve(m, A, w, tolerance, 200)
        assert result.iterations == 0 and result.converged and not w.y.host.any()


def test_negative_curvature_is_reported():
    with built(held_box(), "f64") as made:
        A, w, _, free = assembled(made)
        hierarchy = build_hierarchy(made.model, A, made.oracle.rest, free)
        A.diagonal.host[:, [0, 5, 10]] -= 3e4
        result = hierarchy.solve(made.model, A, w, 1e-8, 200)
        assert result.negative and not result.converged
        assert np.isfinite(w.y.to_numpy()).all() and np.sum(w.y.to_numpy() * w.rhs.to_numpy()) > 0.0


@pytest.mark.parametrize("precision", ["f64", "f32"])
@pytest.mark.parametrize(("shuffled", "limit"), [(False, 15), (True, 25)])
def test_chunks_give_the_same_bits_on_any_number_of_threads(monkeypatch, precision, shuffled, limit):
    """Nodes numbered at random couple all chunks."""
    monkeypatch.setattr("taisoft.fem.chunks.MIN_SHIFT", 0)
    monkeypatch.setattr("taisoft.fem.chunks.SWEEP_CHUNKS", 6)
    scene = held_box()
    if shuffled:
        mesh = scene.body("box").mesh
        order = np.random.default_rng(8).permutation(len(mesh.vertices))
        scene = ts.Scene()
        body = scene.add_body(ts.TetMesh(mesh.vertices[order], np.argsort(order)[mesh.tets]), rubber(young=1e5), name="box")
        body.fix(lambda X: X[:, 0] < -0.99)
    with built(scene, precision) as made:
        found = []
        for m in (replace(made.parallel, serial=True), made.parallel):
            A, w, free = block_csr.build_block_csr(m, FieldArena()), build_pcg(m, FieldArena()), ~made.oracle.fixed
            m.free.from_numpy(free)
            block_csr.assemble(m, A, EVERYTHING, True)
            A.diagonal.host[:, [0, 5, 10]] += 100.0
            w.rhs.from_numpy(np.random.default_rng(7).standard_normal(free.shape))
            result = build_hierarchy(m, A, made.oracle.rest, free).solve(m, A, w, 1e-6, 200)
            assert w.n_chunks == 4 and A.crossed == shuffled and result.converged and result.iterations < limit
            found.append((result, w.y.to_numpy(), w.rhs.to_numpy()))
        (one, y, rhs), (several, again, _) = found
        assert one == several and np.array_equal(y, again)
        f = free.reshape(-1)
        K = sp.diags(1.0 * f) @ block_csr.to_scipy(m, A) @ sp.diags(1.0 * f)
        r = f * (rhs.reshape(-1) - K @ y.reshape(-1))
        assert np.abs(r).max() < 1e-3


def test_iterations_hardly_grow_with_the_mesh():
    counts, plain = [], []
    for cells in ((6, 3, 3), (12, 6, 6), (24, 12, 12)):
        with built(held_box(cells), "f64") as made:
            A, w, _, free = assembled(made)
            hierarchy = build_hierarchy(made.model, A, made.oracle.rest, free)
            counts.append(hierarchy.solve(made.model, A, w, 1e-8, 200).iterations)
            plain.append(pcg.solve(made.model, A, w, 1e-8, 2000).iterations)
    assert plain[-1] > 2.5 * plain[0] and counts[-1] < 50 and counts[-1] < 1.5 * counts[1]


def test_a_factor_of_the_stiffness_does_not_matter():
    with built(held_box(), "f64") as made:
        A, w, _, free = assembled(made)
        hierarchy = build_hierarchy(made.model, A, made.oracle.rest, free)
        first, y = hierarchy.solve(made.model, A, w, 1e-8, 200), w.y.to_numpy()
        A.value.host[...] *= 16.0
        A.diagonal.host[...] *= 16.0
        scaled = hierarchy.solve(made.model, A, w, 1e-8, 200, stiffness=16.0)
        assert scaled == first and np.array_equal(16.0 * w.y.to_numpy(), y)
        assert hierarchy.solve(made.model, A, w, 1e-8, 200).iterations > first.iterations


def test_a_narrow_band_is_factorised(monkeypatch):
    with built(held_box(), "f64") as made:
        A, w, _, free = assembled(made)
        assert not has_narrow_band(made.model, A)
        monkeypatch.setattr(multigrid, "NARROW", 300)
        hierarchy = build_hierarchy(made.model, A, made.oracle.rest, free)
        assert has_narrow_band(made.model, A) and isinstance(hierarchy, ExactPreconditioner)
        result = hierarchy.solve(made.model, A, w, 1e-8, 200)
        assert result.converged and result.iterations <= 2 and hierarchy.n_bytes > 8 * A.n_edges
