"""Invariants of F, their derivatives, and sums of matrices in lanes, for laws from an energy density."""

import taichi as ti

from taisoft.backend.tracing import arithmetic, untraced
from taisoft.fem.math3 import cofactor, ddot, dot, matmul, matmul_nt, matmul_tn, signed_svd, transform


@ti.func
def svd_of(F):
    """U, s and V of the signed SVD in one list."""
    U, s, V = signed_svd(F, 5)
    return U + s + V


@arithmetic
def invariants_of(F):
    """I1, I2 and J."""
    C = matmul_tn(F, F)
    I1 = C[0] + C[4] + C[8]
    return [I1, 0.5 * (I1 * I1 - ddot(C, C)), dot(F, cofactor(F))]


@arithmetic
def second_gradient(F):
    """Derivative of I2 by F, 2 (I1 F - F C)."""
    C = matmul_tn(F, F)
    FC = matmul(F, C)
    I1 = C[0] + C[4] + C[8]
    return [2.0 * (I1 * F[k] - FC[k]) for k in ti.static(range(9))]


@arithmetic
def second_gradient_differential(F, C, D):
    """Its change along D."""
    I1 = C[0] + C[4] + C[8]
    change = 2.0 * ddot(F, D)
    DC, B = matmul(D, C), matmul_tn(D, F)
    E = [B[3 * i + j] + B[3 * j + i] for i in ti.static(range(3)) for j in ti.static(range(3))]
    FE = matmul(F, E)
    return [2.0 * (change * F[k] + I1 * D[k] - DC[k] - FE[k]) for k in ti.static(range(9))]


@arithmetic
def scaled(a, A):
    """a A, nine entries."""
    return [a * A[k] for k in ti.static(range(9))]


@arithmetic
def added(A, B):
    """A + B."""
    return [A[k] + B[k] for k in ti.static(range(9))]


@arithmetic
def add_scaled(A, b, B):
    """A + b B."""
    return [A[k] + b * B[k] for k in ti.static(range(9))]


@arithmetic
def outer(x, y):
    """x y^T."""
    return [x[k // 3] * y[k % 3] for k in ti.static(range(9))]


@arithmetic
def add_outer(A, x, y):
    """A + x y^T."""
    return [A[k] + x[k // 3] * y[k % 3] for k in ti.static(range(9))]


@untraced
def combined(terms):
    """Sum of factors times 3-vectors."""
    return [sum((c * x[k] for c, x in terms[1:]), terms[0][0] * terms[0][1][k]) for k in range(3)]


@arithmetic
def add_block_of_I2(K, F, C, B, a, ga, gb):
    """K plus a times the part of `block` that comes from the change of the gradient of I2. B: F F^T."""
    Fa, Fb, c = transform(F, ga), transform(F, gb), dot(ga, gb)
    d = (C[0] + C[4] + C[8]) * c - dot(ga, transform(C, gb))
    return [
        K[k]
        + 2.0 * a * (2.0 * Fb[k // 3] * Fa[k % 3] - Fa[k // 3] * Fb[k % 3] - c * B[k] + (d if ti.static(k % 4 == 0) else 0.0))
        for k in ti.static(range(9))
    ]


@arithmetic
def add_block_of_J(K, d, t, a):
    """K + d I plus a times the part that comes from the change of cof F. t: F (ga x gb)."""
    w = [a * t[k] for k in ti.static(range(3))]
    return [K[0] + d, K[1] - w[2], K[2] + w[1], K[3] + w[2], K[4] + d, K[5] - w[0], K[6] - w[1], K[7] + w[0], K[8] + d]


@arithmetic
def block_of_modes(S, ga, gb):
    """The `block` of the modes in S: U, V, A, and halves of the symmetric and antisymmetric eigenvalues, see `dpk1_isotropic`.

    In the frame of the SVD dF = e_k (x) g_a is the matrix with rows U_ki a, a = V^T g_a.
    """
    U, V, A = S[0:9], S[9:18], S[18:27]
    a, b = [dot(V[j::3], ga) for j in ti.static(range(3))], [dot(V[j::3], gb) for j in ti.static(range(3))]
    p = [S[27 + k] + S[30 + k] for k in ti.static(range(3))]
    m = [S[27 + k] - S[30 + k] for k in ti.static(range(3))]
    M = [
        A[0] * a[0] * b[0] + p[0] * a[1] * b[1] + p[1] * a[2] * b[2],
        A[1] * a[1] * b[0] + m[0] * a[0] * b[1],
        A[2] * a[2] * b[0] + m[1] * a[0] * b[2],
        A[3] * a[0] * b[1] + m[0] * a[1] * b[0],
        A[4] * a[1] * b[1] + p[0] * a[0] * b[0] + p[2] * a[2] * b[2],
        A[5] * a[2] * b[1] + m[2] * a[1] * b[2],
        A[6] * a[0] * b[2] + m[1] * a[2] * b[0],
        A[7] * a[1] * b[2] + m[2] * a[2] * b[1],
        A[8] * a[2] * b[2] + p[1] * a[0] * b[0] + p[2] * a[1] * b[1],
    ]
    UM = matmul(U, M)
    return matmul_nt(UM, U)
