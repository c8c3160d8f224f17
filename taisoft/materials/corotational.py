"""Corotational linear solid.

psi = mu |F - R|^2 + lambda/2 (tr(R^T F) - 3)^2,   F = R S the polar decomposition with det R = +1.
Source: Sifakis, Barbic, "FEM Simulation of 3D Deformable Solids", SIGGRAPH 2012 course, section 3.4.
The rotation comes in closed form: f = tr S is the largest root of a quartic in the invariants of F^T F, and R = df/dF
(Lin, Chitalu, Komura, "Isotropic ARAP Energy Using Cauchy-Green Invariants", ACM TOG 41(6), 2022, derive f that way).
Where two stretches nearly cancel (s1 + s2 close to 0: strongly inverted F) the quotient loses its digits, and the
rotation is taken from the signed SVD instead. Weak: R is not unique there, so the stress jumps.
"""

import taichi as ti

from taisoft.math3 import cofactor, ddot, determinant, matmul, matmul_nt, matmul_tn, signed_svd

NAME = "corotational"
NEWTON_STEPS = 7  # from sqrt(3 Ic) down to the largest root: enough for stretch ratios up to about 10; others take the SVD
SVD_BELOW = 0.04  # relative size of the denominator under which the closed form loses more than about a digit


def constants(mu: float, lam: float) -> tuple[float, float, float, float]:
    """(mu, lambda, 0, 0) [Pa]."""
    return mu, lam, 0.0, 0.0


@ti.func
def _svd_rotation(F):
    U, s, V = signed_svd(F, 5)
    return matmul_nt(U, V)


@ti.func
def rotation(F):
    """R of the polar decomposition, det R = +1; any finite F is valid."""
    C = matmul_tn(F, F)
    G = cofactor(F)
    J = F[0] * G[0] + F[1] * G[1] + F[2] * G[2]
    Ic = C[0] + C[4] + C[8]
    IIc = ddot(C, C)
    c0 = 2.0 * IIc - Ic * Ic
    f = ti.sqrt(3.0 * Ic)
    change = 0.0 * f
    for _ in ti.static(range(NEWTON_STEPS)):
        slope = 4.0 * f * (f * f - Ic) - 8.0 * J
        value = f * (f * (f * f - 2.0 * Ic) - 8.0 * J) + c0
        change = value / ti.max(slope, 1e-30)
        f = f - change
    denominator = f * (f * f - Ic) - 2.0 * J
    unsure = (denominator <= SVD_BELOW * f * f * f) | (abs(change) > 1e-5 * f) | ~(f > 0.0)
    FC = matmul(F, C)
    a = f * f + Ic
    N = [a * F[k] + 2.0 * f * G[k] - 2.0 * FC[k] for k in ti.static(range(9))]
    # |R|^2 = 3 takes the rounding of f out of R's length
    scale = ti.sqrt(3.0 / ti.max(ddot(N, N), 1e-30))
    R = [scale * N[k] for k in ti.static(range(9))]
    some = unsure[0] != 0
    for q in ti.static(range(1, F[0].n)):
        some = some or unsure[q] != 0
    if some:
        Q = _svd_rotation(F)
        for k in ti.static(range(9)):
            R[k] = ti.select(unsure, Q[k], R[k])
    return R


@ti.func
def psi(F, p):
    """Energy density [Pa], 0 at rest."""
    R = rotation(F)
    D = [F[k] - R[k] for k in ti.static(range(9))]
    t = ddot(R, D)  # tr(R^T F) - 3, without the cancellation
    return p[0] * ddot(D, D) + 0.5 * p[1] * t * t


@ti.func
def pk1(F, p):
    """First Piola-Kirchhoff stress 2 mu (F - R) + lambda (tr(R^T F) - 3) R [Pa]; any F is valid."""
    R = rotation(F)
    D = [F[k] - R[k] for k in ti.static(range(9))]
    t = p[1] * ddot(R, D)
    return [2.0 * p[0] * D[k] + t * R[k] for k in ti.static(range(9))]


@ti.func
def prepare(F, p):
    """What `dpk1` needs of F: R, the inverse of tr(S) I - S (six entries), and the factors."""
    R = rotation(F)
    S = matmul_tn(R, F)
    t = S[0] + S[4] + S[8]
    K = [
        t - S[0], -0.5 * (S[1] + S[3]), -0.5 * (S[2] + S[6]), -0.5 * (S[1] + S[3]), t - S[4], -0.5 * (S[5] + S[7]),
        -0.5 * (S[2] + S[6]), -0.5 * (S[5] + S[7]), t - S[8],
    ]  # fmt: skip
    det = determinant(K)
    # (s0+s1)(s0+s2)(s1+s2): 0 only where the rotation itself is not unique
    tiny = 1e-12 * abs(t * t * t) + 1e-30
    inverse = 1.0 / ti.select(abs(det) > tiny, det, tiny)
    C = cofactor(K)
    return R + [inverse * C[k] for k in ti.static(range(9))] + [p[0], p[1], p[1] * (t - 3.0) - 2.0 * p[0]]


@ti.func
def dpk1(F, S, D):
    """Differential of the stress along D [Pa], with S = prepare(F, p).

    dR = R [w]x with (tr(S) I - S) w = axial(R^T dF - dF^T R); tr S changes by R : dF.
    """
    R = [S[k] for k in ti.static(range(9))]
    K = [S[9 + k] for k in ti.static(range(9))]
    B = matmul_tn(R, D)
    a = [B[7] - B[5], B[2] - B[6], B[3] - B[1]]
    w = [K[3 * i] * a[0] + K[3 * i + 1] * a[1] + K[3 * i + 2] * a[2] for i in ti.static(range(3))]
    t = S[19] * (B[0] + B[4] + B[8])
    dR = [
        [R[3 * i + 1] * w[2] - R[3 * i + 2] * w[1], R[3 * i + 2] * w[0] - R[3 * i] * w[2], R[3 * i] * w[1] - R[3 * i + 1] * w[0]][j]
        for i in ti.static(range(3))
        for j in ti.static(range(3))
    ]
    return [2.0 * S[18] * D[k] + t * R[k] + S[20] * dR[k] for k in ti.static(range(9))]


@ti.func
def hessian_eigen(s, p):
    """Second derivatives in the SVD frame: the 3x3 block over the stretches s (nine entries), and the eigenvalues of
    the symmetric and of the antisymmetric mode of the pairs (0,1), (0,2), (1,2). All [Pa]."""
    A = [(2.0 * p[0] if ti.static(i == j) else 0.0) + p[1] + 0.0 * s[0] for i in ti.static(range(3)) for j in ti.static(range(3))]
    symmetric = [2.0 * p[0] + 0.0 * s[0], 2.0 * p[0] + 0.0 * s[0], 2.0 * p[0] + 0.0 * s[0]]
    factor = 2.0 * p[1] * (s[0] + s[1] + s[2] - 3.0) - 4.0 * p[0]
    pair = [s[0] + s[1], s[0] + s[2], s[1] + s[2]]
    floor = 1e-12 * (s[0] + 1e-18)
    antisymmetric = [2.0 * p[0] + factor / ti.max(pair[k], floor) for k in ti.static(range(3))]
    return A, symmetric, antisymmetric
