"""3x3 matrices: products, cofactor and its differential, determinant and double contraction, the signed SVD and the clamped
symmetric matrix of all kinds of matrices are NumPy's to a few roundings; the last singular value has the sign of det F.
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


def check_products(runtime, lanes: int) -> None:
    """Products, cofactor and its differential, determinant and double contraction equal NumPy's."""
    F, D = np.random.default_rng(1).standard_normal((2, 102, 3, 3)).astype(runtime.np_real).astype(np.float64)
    h = 1e-30
    dG = oracle.cofactor(F + 1j * h * D).imag / h
    matrices = [F @ D, F @ oracle.transposed(D), oracle.transposed(F) @ D, oracle.cofactor(F), dG]
    scalars = [np.linalg.det(F), np.sum(F * D, axis=(1, 2))]
    expected = np.concatenate([M.reshape(-1, 9) for M in matrices] + [s[:, None] for s in scalars], axis=1)
    A, B = packed(F, lanes, runtime.np_real), packed(D, lanes, runtime.np_real)
    out = np.zeros((len(A), expected.shape[1], lanes), runtime.np_real)
    products(lanes, A, B, out)
    # sums of at most 18 products of numbers of size up to 4
    assert np.abs(unpacked(out, len(F)) - expected).max() < 50 * runtime.eps


def largest(A) -> np.ndarray:
    """Largest entry of each matrix, the scale of its errors; 1 for a zero matrix."""
    size = np.abs(A).max(axis=(1, 2))
    return np.where(size > 0, size, 1.0)


def check_decompositions(runtime, lanes: int) -> None:
    """The signed SVD and the clamped symmetric part of all kinds of matrices are those of NumPy."""
    for kind, F in MATRICES.items():
        F = F.astype(runtime.np_real)
        S = (F + oracle.transposed(F)) / 2
        A = packed(F, lanes, runtime.np_real)
        out = np.zeros((len(A), 30, lanes), runtime.np_real)
        decompositions(lanes, A, packed(S, lanes, runtime.np_real), out)
        flat = unpacked(out, len(F))
        U, V, C = (flat[:, k : k + 9].reshape(-1, 3, 3) for k in (0, 9, 18))
        F, s, S = F.astype(np.float64), flat[:, 27:], S.astype(np.float64)
        size, eps = largest(F), 25 * runtime.eps  # five sweeps of rotations, a few roundings each; 14 eps was observed
        for Q in (U, V):
            assert np.abs(oracle.transposed(Q) @ Q - np.eye(3)).max() < eps, kind
            assert np.abs(np.linalg.det(Q) - 1).max() < eps, kind
        assert (np.abs(U @ (s[..., None] * oracle.transposed(V)) - F).max(axis=(1, 2)) / size).max() < eps, kind
        assert (np.abs(s - oracle.signed_svd(F)[1]).max(axis=1) / size).max() < eps, kind
        assert ((s[:, 1] - s[:, 0]) / size).max() < eps and ((np.abs(s[:, 2]) - s[:, 1]) / size).max() < eps, kind
        clear = np.abs(np.linalg.det(F / size[:, None, None])) > eps
        assert np.array_equal(s[clear, 2] < 0, np.linalg.det(F / size[:, None, None])[clear] < 0), kind
        if kind != "huge":
            w, Q = np.linalg.eigh(S)
            expected = (Q * np.maximum(w, 0)[:, None, :]) @ oracle.transposed(Q)
            assert (np.abs(C - expected).max(axis=(1, 2)) / largest(S)).max() < 40 * runtime.eps, kind


@pytest.mark.parametrize("precision, lanes", [("f64", 4), ("f32", 1)])
def test_products_and_decompositions_equal_those_of_numpy(precision, lanes):
    """Over the lanes of the CPU, and one as on CUDA."""
    with opened(precision) as runtime:
        check_products(runtime, lanes)
        check_decompositions(runtime, lanes)
