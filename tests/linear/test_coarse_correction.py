"""Conjugate gradients with multigrid in Gauss-Seidel's sweeps, and its coarse space: iterates are those of the V-cycle, solutions
exact, the bits the same on any number of threads; the iterations hardly grow with the mesh; a narrow band is factorised.
"""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from taisoft.backend.arrays import FieldArena
from taisoft.linear.aggregation import MODES, rigid_aggregates, rigid_modes
from taisoft.linear.coarse_correction import CoarseCorrection
from taisoft.linear.coarse_space import build_coarse_space
from taisoft.linear.factor import Factor
from taisoft.linear.hierarchy import build_hierarchy, rows_with_diagonals
from taisoft.mesh.aggregates import aggregate
from tests.linear.boxes import assembled, error, held_box


def hierarchy_of(made):
    return build_hierarchy(made.model, made.A, made.x, made.free)


def motions(made, own: np.ndarray) -> sp.csr_matrix:
    """T (3 n, 6 n_coarse)."""
    T, node = rigid_aggregates(made.x, made.free, own)[1], np.flatnonzero(own >= 0)
    start = np.concatenate([[0], np.cumsum(own >= 0)])
    return sp.bsr_matrix((T[node], own[node], start), shape=(3 * len(own), MODES * (own.max() + 1))).tocsr()


def test_the_coarse_space_has_the_products_of_matrices():
    with assembled(held_box((6, 3, 3)), shift=100.0) as made:
        rows = rows_with_diagonals(made.model, made.A)
        space, coarse, modes = build_coarse_space(made.model, made.A, *rows, made.x, made.free, FieldArena())
        own = aggregate(*rows, made.free.any(axis=1))
        unused, T = rigid_aggregates(made.x, made.free, own)[3], motions(made, own)
        assert np.array_equal(space.aggregate.host, own) and space.n_coarse > 4
        expected = (T.T @ made.matrix @ T).toarray() + np.diag(unused.reshape(-1) * 1.0)
        assert np.abs(coarse.toarray() - expected).max() < 1e-12 * np.abs(expected).max()
        assert np.abs(T @ modes.reshape(-1, MODES) - rigid_modes(made.x, made.free).reshape(-1, MODES)).max() < 1e-14


def test_iterates_are_those_of_the_cycle():
    """The shift makes all diagonal blocks positive definite, so that the sweeps use them."""
    with assembled(held_box(), shift=100.0) as made:
        hierarchy, f = hierarchy_of(made), made.free.reshape(-1)
        assert isinstance(hierarchy, CoarseCorrection)
        T = motions(made, aggregate(*rows_with_diagonals(made.model, made.A), made.free.any(axis=1)))
        K, rows = made.matrix.tocsr(), np.arange(len(f)) // 3
        lower = K.tocoo()
        kept = rows[lower.row] >= rows[lower.col]
        lower = sp.csc_matrix((lower.data[kept], (lower.row[kept], lower.col[kept])), shape=K.shape)
        forward, backward = (spl.splu(part.tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0) for part in (lower, lower.T))

        def precondition(r: np.ndarray) -> np.ndarray:
            x = forward.solve(r)
            x = x + T @ hierarchy.cycle.apply(T.T @ (r - K @ x))
            return f * (x + backward.solve(r - K @ x))

        r = (made.free * made.work.rhs.to_numpy()).reshape(-1)
        y, p, last = np.zeros_like(r), np.zeros_like(r), np.inf
        for k in range(1, 5):
            z = precondition(r)
            p, last = z + (r @ z / last) * p, r @ z
            step = last / (p @ (K @ p))
            y, r = y + step * p, r - step * (K @ p)
            result, found = hierarchy.solve(made.model, made.A, made.work, 1e-30, k), made.work.y.to_numpy().reshape(-1)
            assert result.iterations == k and not result.converged and not found[~f].any()
            assert np.abs(found - y).max() < 1e-9 * np.abs(y).max()


def test_the_solution_factors_limits_and_negative_curvature():
    with assembled(held_box()) as made:
        m, A, w, hierarchy = made.model, made.A, made.work, hierarchy_of(made)
        first = hierarchy.solve(m, A, w, 1e-10, 200)
        assert first.converged and not first.negative and 4 < first.iterations < 60 and error(made) < 1e-7
        y, rhs = w.y.to_numpy(), w.rhs.to_numpy()
        w.rhs.fill(0.0)
        none = hierarchy.solve(m, A, w, 1e-10, 200)
        assert none.iterations == 0 and none.converged and not w.y.host.any()
        w.rhs.from_numpy(rhs)
        for array in (A.value, A.diagonal):
            array.host[...] *= 16.0
        assert hierarchy.solve(m, A, w, 1e-10, 200, stiffness=16.0) == first and np.array_equal(16.0 * w.y.to_numpy(), y)
        assert hierarchy.solve(m, A, w, 1e-10, 200).iterations > first.iterations
        A.diagonal.host[:, [0, 5, 10]] -= 16.0 * 3e4
        result = hierarchy.solve(m, A, w, 1e-8, 200)
        assert result.negative and not result.converged
        assert np.isfinite(w.y.to_numpy()).all() and np.sum(w.y.to_numpy() * rhs) > 0.0


def test_chunks_give_the_same_bits_on_any_number_of_threads():
    """Nodes numbered at random couple all chunks."""
    found = []
    for serial in (True, False):
        with assembled(held_box(shuffled=True), 100.0, chunk_shift=8, serial=serial) as made:
            result = hierarchy_of(made).solve(made.model, made.A, made.work, 1e-6, 200)
            assert made.work.n_chunks == 6 and made.A.crossed
            assert result.converged and result.iterations < 30 and error(made) < 1e-3
            found.append((result, made.work.y.to_numpy()))
    assert found[0][0] == found[1][0] and np.array_equal(found[0][1], found[1][1])


def test_iterations_hardly_grow_with_the_mesh():
    counts = []
    for cells in ((14, 10, 10), (24, 17, 17)):
        with assembled(held_box(cells)) as made:
            counts.append(hierarchy_of(made).solve(made.model, made.A, made.work, 1e-8, 200).iterations)
    assert counts[1] < 50 and counts[1] < 1.3 * counts[0]


def test_a_narrow_band_is_factorised():
    with assembled(held_box((20, 3, 3))) as made:
        hierarchy = hierarchy_of(made)
        assert isinstance(hierarchy, Factor)
        result = hierarchy.solve(made.model, made.A, made.work, 1e-8, 200)
        assert result.converged and result.iterations <= 2 and hierarchy.n_bytes > 8 * made.A.n_edges and error(made) < 1e-7
        m, A, w, f = made.model, made.A, made.work, made.free
        A.diagonal.host[:, [0, 5, 10]] += 1e4  # the factor is now another matrix's
        made.matrix = made.matrix + sp.diags(1e4 * f.reshape(-1))
        result = hierarchy.solve(m, A, w, 1e-8, 200)
        assert result.converged and 4 < result.iterations < 100 and error(made) < 1e-5
        stopped = hierarchy.solve(m, A, w, 1e-8, 3)
        assert stopped.iterations == 3 and not stopped.converged and not stopped.negative
        A.diagonal.host[:, [0, 5, 10]] -= 1e5
        result = hierarchy.solve(m, A, w, 1e-8, 200)
        assert result.negative and not result.converged
        assert np.isfinite(w.y.to_numpy()).all() and np.sum(w.y.to_numpy() * w.rhs.to_numpy()) > 0.0
