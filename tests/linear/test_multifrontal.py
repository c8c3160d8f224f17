"""The multifrontal factor, compared with dense NumPy on random positive definite matrices of 3x3 blocks whose graphs have one
node, no edges, all edges, a chain, a grid, or several parts:

* solutions and substitutions are those of the matrix; each part of uncoupled nodes has its own fronts;
* one factor serves many sets of values, to the same bits as a new one; an indefinite matrix is refused, and the next is not;
* entries are stored where the fronts say; how fronts are merged does not change solutions.
"""

import itertools

import numpy as np
import pytest
import scipy.linalg as sl
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from taisoft.linear.factor import Factor, build_factor
from taisoft.linear.multifrontal import Multifrontal
from tests.backend.lanes import opened


def chain(n: int) -> list[tuple[int, int]]:
    return [(k, k + 1) for k in range(n - 1)]


def grid(n: int) -> list[tuple[int, int]]:
    """Neighbours in a cube of n^3 nodes, along edges and one diagonal."""
    number = np.arange(n**3).reshape(n, n, n)
    pairs = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:]), (number[:, :, :-1], number[:, :, 1:])]
    pairs.append((number[:-1, :-1, :-1], number[1:, 1:, 1:]))
    return [pair for a, b in pairs for pair in zip(a.ravel(), b.ravel())]


def several(seed: int) -> tuple[int, list[tuple[int, int]]]:
    """Random parts whose nodes are mixed, and single nodes."""
    rng, n = np.random.default_rng(seed), 40
    part = rng.integers(0, 5, n)
    a, b = rng.integers(0, n, (2, 3 * n))
    return n, [(i, j) for i, j in zip(a, b) if i != j and part[i] == part[j] > 0]


GRAPHS = {
    "one node": (1, []),
    "no edges": (4, []),
    "dense": (9, list(itertools.combinations(range(9), 2))),
    "chain": (30, chain(30)),
    "grid": (64, grid(4)),
    "parts 0": several(0),
    "parts 1": several(1),
    "parts 2": several(2),
}


class Pattern:
    """The blocks of a graph's matrix, row by row, and random matrices with them."""

    def __init__(self, n: int, pairs: list[tuple[int, int]]):
        i, j = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        own = np.arange(n)
        ones = (np.ones(n + 2 * len(i)), (np.concatenate([own, i, j]), np.concatenate([own, j, i])))
        self.blocks = sp.csr_matrix(ones, shape=(n, n))
        self.start, self.column = self.blocks.indptr, self.blocks.indices
        self.size = 3 * n

    def matrix(self, seed: int) -> np.ndarray:
        """A positive definite matrix, whose entries are of very different sizes."""
        rng, mask = np.random.default_rng(seed), np.kron(self.blocks.toarray() > 0, np.ones((3, 3)))
        A = mask * rng.standard_normal(mask.shape)
        A += A.T
        A += np.diag(np.abs(A).sum(axis=1) * rng.uniform(1.01, 2.0, len(A)))
        scale = 10.0 ** rng.uniform(-1, 1, len(A))
        return scale[:, None] * A * scale

    def entries(self, factor: Multifrontal) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the lower triangle in the order of elimination, shuffled."""
        mask = np.kron(self.blocks.toarray() > 0, np.ones((3, 3)))[np.ix_(factor.order, factor.order)]
        i, j = np.nonzero(np.tril(mask))
        mixed = np.random.default_rng(len(i)).permutation(len(i))
        return i[mixed], j[mixed]

    def factorise(self, factor: Factor, A: np.ndarray) -> None:
        row = np.repeat(np.arange(self.size // 3), np.diff(self.start))
        blocks = A.reshape(-1, 3, self.size // 3, 3).swapaxes(1, 2)[row, self.column]
        factor.fronts.factorise(blocks.reshape(-1)[factor.fronts.lower])


def factorised(pattern: Pattern, A: np.ndarray, calls: float = Multifrontal.CALLS) -> Factor:
    factor = build_factor(pattern.start, pattern.column, 3, calls)
    pattern.factorise(factor, A)
    return factor


@pytest.fixture(scope="module", autouse=True)
def kernels():
    with opened("f64"):
        yield


@pytest.fixture(params=GRAPHS)
def pattern(request) -> Pattern:
    return Pattern(*GRAPHS[request.param])


def rights(pattern: Pattern, n: int) -> np.ndarray:
    return np.random.default_rng(n).standard_normal((pattern.size, n))


def assert_close(found: np.ndarray, expected: np.ndarray) -> None:
    assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()


def test_it_solves(pattern):
    A = pattern.matrix(0)
    factor = factorised(pattern, A)
    assert np.array_equal(factor.fronts.order[factor.fronts.place], np.arange(pattern.size))
    for b in rights(pattern, 3).T:
        given = b.copy()
        assert_close(factor.solution(b), np.linalg.solve(A, b))
        assert np.array_equal(b, given)


def test_substitutions_are_those_of_the_cholesky_factor(pattern):
    """Of each part; right sides with one entry fill few fronts."""
    A = pattern.matrix(1)
    factor = factorised(pattern, A).fronts
    permuted = A[np.ix_(factor.order, factor.order)]
    for part in factor.parts:
        own = factor.unknowns_of(part)
        L = np.linalg.cholesky(permuted[own, own])
        for right in (rights(pattern, 5)[own], np.eye(L.shape[0]), np.zeros((L.shape[0], 2))):
            found = right.copy()
            factor.forward(part, found)
            assert_close(found, sl.solve_triangular(L, right, lower=True))
    assert factor.n_entries >= np.count_nonzero(np.linalg.cholesky(permuted))


def test_parts_are_those_of_the_graph(pattern):
    """Each lies in a row of unknowns, and they are in the same order as the unknowns."""
    factor = Multifrontal(pattern.start, pattern.column)
    n_parts, label = connected_components(pattern.blocks, directed=False)
    found = [np.unique(factor.order[factor.unknowns_of(part)] // 3) for part in factor.parts]
    assert sorted(tuple(nodes) for nodes in found) == sorted(tuple(np.flatnonzero(label == k)) for k in range(n_parts))
    bounds = [(factor.unknowns_of(part).start, factor.unknowns_of(part).stop) for part in factor.parts]
    assert bounds[0][0] == 0 and bounds[-1][1] == pattern.size
    assert all(before[1] == after[0] for before, after in itertools.pairwise(bounds))


def test_one_factor_serves_many_matrices(pattern):
    """In any order, and after one that is refused."""
    factor, b = factorised(pattern, pattern.matrix(1)), rights(pattern, 1)[:, 0]
    for seed in (2, 3, 2):
        A = pattern.matrix(seed)
        pattern.factorise(factor, A)
        other = factorised(pattern, A)
        assert np.array_equal(factor.solution(b), other.solution(b))
        A[-1, -1] *= -1.0
        with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
            pattern.factorise(factor, A)


def test_a_matrix_that_only_elimination_shows_to_be_indefinite_is_refused():
    pattern = Pattern(*GRAPHS["chain"])
    A = pattern.matrix(4)
    diagonal = np.diag(np.diag(A))
    lowest = sl.eigh(A, diagonal, eigvals_only=True)[0]
    factorised(pattern, A - 0.99 * lowest * diagonal)
    shifted = A - 1.01 * lowest * diagonal
    assert np.diag(shifted).min() > 0.0
    with pytest.raises(np.linalg.LinAlgError):
        factorised(pattern, shifted)


def test_places_are_those_of_the_fronts(pattern):
    """Each entry lies in the front of its column, in the row of its own among the front's."""
    factor = Multifrontal(pattern.start, pattern.column)
    i, j = pattern.entries(factor)
    places = factor.places(i, j)
    assert len(np.unique(places)) == len(places)
    expected = np.full(len(i), -1)
    for k, (w, b) in enumerate(zip(factor.width, factor.n_below)):
        rows = [*range(factor.first[k], factor.first[k + 1]), *factor.row[factor.start[k] : factor.start[k + 1]]]
        for e in np.flatnonzero((j >= factor.first[k]) & (j < factor.first[k + 1])):
            row, column = rows.index(i[e]), j[e] - factor.first[k]
            expected[e] = factor.at[k] + (column * w + row if row < w else w * w + column * b + row - w)
    assert np.array_equal(places, expected)


def test_merging_fronts_does_not_change_solutions(pattern):
    """Neither none, as where calls cost nothing, nor all of a part."""
    A, b = pattern.matrix(5), rights(pattern, 2)[:, 0]
    factors = [factorised(pattern, A, calls) for calls in (Multifrontal.CALLS, 0.0, 1e3)]
    merged, apart, whole = (len(factor.fronts.width) for factor in factors)
    assert apart >= merged >= whole == len(factors[0].fronts.parts)
    if pattern.size == 3 * 64:
        assert apart > 10
    expected = np.linalg.solve(A, b)
    for factor in factors:
        assert_close(factor.solution(b), expected)
