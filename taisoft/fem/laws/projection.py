"""The positive semi-definite part of an isotropic law's second derivative, in the frame of F's signed SVD.

With F = U diag(s) V^T and dF = U X V^T the second derivative is a 3x3 block over X's diagonal and, for each pair (0,1), (0,2),
(1,2), a symmetric and an antisymmetric mode of (X_ij, X_ji) with one eigenvalue each: a law's `hessian_eigen(s, p)` returns them
[Pa]. The eigenvalues of each part are clamped at 0, which is exact.
Source: Smith, de Goes, Kim, "Analytic Eigensystems for Isotropic Distortion Energies", ACM TOG 38(1), 2019, gives the
modes; the 3x3 block is clamped numerically.
"""

import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.math3 import clamp_symmetric, matmul, matmul_nt, matmul_tn, signed_svd


@ti.func
def prepare_isotropic(law: ti.template(), F, p):
    """Precompute for `dpk1_isotropic`: U (9), V (9), the clamped block (9), half the clamped symmetric (3) and antisymmetric (3)
    eigenvalues [Pa]."""
    U, s, V = signed_svd(F, 5)
    A, symmetric, antisymmetric = law.hessian_eigen(s, p)
    B = clamp_symmetric(A, 5)
    half_symmetric = [0.5 * ti.max(symmetric[k], 0.0) for k in ti.static(range(3))]
    half_antisymmetric = [0.5 * ti.max(antisymmetric[k], 0.0) for k in ti.static(range(3))]
    return U + V + B + half_symmetric + half_antisymmetric


@arithmetic
def dpk1_isotropic(S, D):
    """Stress differential along D [Pa] by the projected second derivative, with S = prepare_isotropic(law, F, p)."""
    U = [S[k] for k in ti.static(range(9))]
    V = [S[9 + k] for k in ti.static(range(9))]
    UD = matmul_tn(U, D)
    X = matmul(UD, V)
    Y = [0.0 * X[k] for k in ti.static(range(9))]
    for i in ti.static(range(3)):
        Y[4 * i] = S[18 + 3 * i] * X[0] + S[19 + 3 * i] * X[4] + S[20 + 3 * i] * X[8]
    for k, i, j in ti.static(((0, 0, 1), (1, 0, 2), (2, 1, 2))):
        a, b = S[27 + k] * (X[3 * i + j] + X[3 * j + i]), S[30 + k] * (X[3 * i + j] - X[3 * j + i])
        Y[3 * i + j] = a + b
        Y[3 * j + i] = a - b
    UY = matmul(U, Y)
    return matmul_nt(UY, V)
