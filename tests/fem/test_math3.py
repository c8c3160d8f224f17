"""3x3 matrices over SIMD lanes, in f32 and f64, with one lane and with four:

* products, cofactor and its differential, determinant and double contraction equal NumPy's;
* the signed SVD reproduces F from two rotations and sorted values to a few roundings, and the last value is negative exactly
  for inverted F; F is random, rank-deficient, zero, tiny, huge, extremely stretched, or has repeated values;
* the clamped symmetric matrix is that of NumPy with negative eigenvalues set to 0.
"""

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem import math3
from tests.backend.lanes import load, opened, packed, store, unpacked
from tests.fem import oracle_laws as oracle
from tests.fem.matrices import MATRICES

SWEEPS = 5  # as in the laws


@kernel
def products(lanes: ti.template(), A: ti.types.ndarray(), B: ti.types.ndarray(), out: ti.types.ndarray()):
    for b in range(A.shape[0]):
        F, D = load(A, b, lanes, 9), load(B, b, lanes, 9)
        AB, ABt, AtB = math3.matmul(F, D), math3.matmul_nt(F, D), math3.matmul_tn(F, D)
        G, dG = math3.cofactor(F), math3.cofactor_differential(F, D)
        store(out, b, 0, AB + ABt + AtB, lanes)
        store(out, b, 27, G + dG + [math3.determinant(F), math3.ddot(F, D)], lanes)


@kernel
def decompositions(lanes: ti.template(), A: ti.types.ndarray(), B: ti.types.ndarray(), out: ti.types.ndarray()):
    for b in range(A.shape[0]):
        F, S = load(A, b, lanes, 9), load(B, b, lanes, 9)
        U, s, V = math3.signed_svd(F, SWEEPS)
        C = math3.clamp_symmetric(S, SWEEPS)
        store(out, b, 0, U + V + C + s, lanes)


@pytest.fixture(scope="module", params=["f64", "f32"])
def machine(request):
    with opened(request.param) as runtime:
        yield runtime


def test_products_equal_those_of_numpy(machine):
    rng = np.random.default_rng(1)
    F, D = rng.standard_normal((2, 102, 3, 3))
    F, D = (A.astype(machine.np_real).astype(np.float64) for A in (F, D))
    G, h = oracle.cofactor(F), 1e-30
    dG = oracle.cofactor(F + 1j * h * D).imag / h
    matrices = [F @ D, F @ oracle.transposed(D), oracle.transposed(F) @ D, G, dG]
    scalars = [np.linalg.det(F), np.sum(F * D, axis=(1, 2))]
    expected = np.concatenate([M.reshape(-1, 9) for M in matrices] + [s[:, None] for s in scalars], axis=1)
    for lanes in (4, 1):
        A, B = packed(F, lanes, machine.np_real), packed(D, lanes, machine.np_real)
        out = np.zeros((len(A), expected.shape[1], lanes), machine.np_real)
        products(lanes, A, B, out)
        # sums of at most 18 products of numbers of size up to 4
        assert np.abs(unpacked(out, len(F)) - expected).max() < 50 * machine.eps


@pytest.fixture(scope="module")
def decomposed(machine):
    """(kind, lanes) -> F, U, s, V, S, clamped S, where S is the symmetric part of F."""
    results = {}
    for lanes in (4, 1):
        for kind, F in MATRICES.items():
            F = F.astype(machine.np_real)
            S = (F + oracle.transposed(F)) / 2
            A = packed(F, lanes, machine.np_real)
            out = np.zeros((len(A), 30, lanes), machine.np_real)
            decompositions(lanes, A, packed(S, lanes, machine.np_real), out)
            flat = unpacked(out, len(F))
            U, V, C = (flat[:, k : k + 9].reshape(-1, 3, 3) for k in (0, 9, 18))
            results[kind, lanes] = F.astype(np.float64), U, flat[:, 27:], V, S.astype(np.float64), C
    return results


def largest(A) -> np.ndarray:
    """Largest entry of each matrix, the scale of its errors; 1 for a zero matrix."""
    size = np.abs(A).max(axis=(1, 2))
    return np.where(size > 0, size, 1.0)


@pytest.mark.parametrize("kind", MATRICES)
def test_signed_svd(machine, decomposed, kind):
    for lanes in (4, 1):
        F, U, s, V, _, _ = decomposed[kind, lanes]
        size, eps = largest(F), 25 * machine.eps  # five sweeps of rotations, a few roundings each; 14 eps was observed
        for Q in (U, V):
            assert np.abs(oracle.transposed(Q) @ Q - np.eye(3)).max() < eps
            assert np.abs(np.linalg.det(Q) - 1).max() < eps
        assert (np.abs(U @ (s[..., None] * oracle.transposed(V)) - F).max(axis=(1, 2)) / size).max() < eps
        assert (np.abs(s - oracle.signed_svd(F)[1]).max(axis=1) / size).max() < eps
        assert ((s[:, 1] - s[:, 0]) / size).max() < eps and ((np.abs(s[:, 2]) - s[:, 1]) / size).max() < eps
        clear = np.abs(np.linalg.det(F / size[:, None, None])) > eps
        assert np.array_equal(s[clear, 2] < 0, np.linalg.det(F / size[:, None, None])[clear] < 0)


def test_the_matrices_include_inverted_flat_isotropic_and_extremely_stretched_ones():
    F = np.concatenate([A / largest(A)[:, None, None] for A in MATRICES.values()])
    s = oracle.signed_svd(F)[1]
    assert (s[:, 2] < -1e-3).sum() > 1000 and (np.abs(s[:, 2]) < 1e-14).sum() > 1000
    assert (s[:, 0] - s[:, 2] < 1e-12).sum() > 400 and (s[:, 0] > 1e5 * s[:, 1]).sum() > 400


@pytest.mark.parametrize("kind", [k for k in MATRICES if k != "huge"])
def test_clamped_symmetric_matrix(machine, decomposed, kind):
    for lanes in (4, 1):
        *_, S, C = decomposed[kind, lanes]
        w, Q = np.linalg.eigh(S)
        expected = (Q * np.maximum(w, 0)[:, None, :]) @ oracle.transposed(Q)
        assert (np.abs(C - expected).max(axis=(1, 2)) / largest(S)).max() < 40 * machine.eps
