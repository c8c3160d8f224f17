"""The positive semi-definite part of a law's second derivative: in the frame of F's signed SVD, or of a symmetric 9x9 matrix.

With F = U diag(s) V^T and dF = U X V^T the second derivative is a 3x3 block over X's diagonal and, for each pair (0,1), (0,2),
(1,2), a symmetric and an antisymmetric mode of (X_ij, X_ji) with one eigenvalue each: a law's `hessian_eigen(s, p)` returns them
[Pa]. The eigenvalues of each part are clamped at 0, which is exact.
Source: Smith, de Goes, Kim, "Analytic Eigensystems for Isotropic Distortion Energies", ACM TOG 38(1), 2019, gives the
modes; the 3x3 block is clamped numerically.
"""

import taichi as ti

from taisoft.backend.private import impl, make_matrix
from taisoft.backend.tracing import arithmetic, untraced
from taisoft.fem.math3 import clamp_symmetric, jacobi_angle, matmul, matmul_nt, matmul_tn, signed_svd


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


SWEEPS = 10  # at most, of a Jacobi iteration that converges quadratically in the last three


@untraced
def local_array(like, values):
    """A local array of the kernel, whose index may be a run-time number, with these values in the precision of `like`."""
    return impl.expr_init(make_matrix([like * 0.0 + value for value in values]))


@ti.func
def clamp_9x9(H):
    """The positive semi-definite part of symmetric 9x9 matrices, their upper triangles row by row (45 entries in lanes).

    Matrices with positive pivots are left as they are; the others are rotated to diagonal form by cyclic Jacobi sweeps.
    """
    P = [H[k] + 0.0 for k in ti.static(range(45))]
    for q in range(H[0].n):
        A, R = local_array(H[0][0], [0.0] * 81), local_array(H[0][0], [0.0] * 81)
        for i in ti.static(range(9)):
            for j in ti.static(range(9)):
                A[9 * i + j] = H[ti.static(upper(i, j))][q]
                R[9 * i + j] = H[ti.static(upper(i, j))][q]
        if not _has_positive_pivots(R):
            Q = local_array(H[0][0], [float(k % 10 == 0) for k in range(81)])
            _diagonalise(A, Q)
            for i in range(9):
                for j in range(9):
                    R[9 * i + j] = _clamped_entry(A, Q, i, j)
            for i in ti.static(range(9)):
                for j in ti.static(range(i, 9)):
                    P[upper(i, j)][q] = R[9 * i + j]
    return P


@untraced
def upper(i, j):
    """Place of an entry of a symmetric 9x9 matrix in its upper triangle."""
    i, j = min(i, j), max(i, j)
    return 9 * i - i * (i - 1) // 2 + j - i


@ti.func
def _has_positive_pivots(A: ti.template()):
    """Whether a matrix is positive definite, by Gaussian elimination in place; a pivot that is only rounding is not positive."""
    largest = A[0]
    for i in range(9):
        largest = ti.max(largest, A[10 * i])
    is_positive = 1
    for k in range(9):
        if A[10 * k] <= 1e-6 * largest:
            is_positive = 0
        if is_positive == 1:
            for i in range(k + 1, 9):
                factor = A[9 * i + k] / A[10 * k]
                for j in range(k + 1, 9):
                    A[9 * i + j] -= factor * A[9 * k + j]
    return is_positive == 1


@ti.func
def _diagonalise(A: ti.template(), Q: ti.template()):
    """Rotate A to diagonal form; the columns of Q become its eigenvectors."""
    for _ in range(SWEEPS):
        off, total = 0.0 * A[0], 0.0 * A[0]
        for i in range(9):
            for j in range(9):
                total += A[9 * i + j] * A[9 * i + j]
                if i != j:
                    off += A[9 * i + j] * A[9 * i + j]
        if off > 1e-32 * total:
            for i in range(8):
                for j in range(i + 1, 9):
                    c, s = jacobi_angle(A[10 * i], A[10 * j], A[9 * i + j])
                    for k in range(9):
                        x, y = A[9 * k + i], A[9 * k + j]
                        A[9 * k + i], A[9 * k + j] = c * x - s * y, s * x + c * y
                        u, w = Q[9 * k + i], Q[9 * k + j]
                        Q[9 * k + i], Q[9 * k + j] = c * u - s * w, s * u + c * w
                    for k in range(9):
                        x, y = A[9 * i + k], A[9 * j + k]
                        A[9 * i + k], A[9 * j + k] = c * x - s * y, s * x + c * y


@ti.func
def _clamped_entry(A: ti.template(), Q: ti.template(), i, j):
    """Entry (i, j) of Q max(D, 0) Q^T, D the diagonal of A."""
    total = 0.0 * A[0]
    for k in range(9):
        total += ti.max(A[10 * k], 0.0) * Q[9 * i + k] * Q[9 * j + k]
    return total
