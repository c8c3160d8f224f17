"""Corotational linear solid.

psi = mu |F - R|^2 + lambda/2 (tr(R^T F) - 3)^2,   F = R S the polar decomposition with det R = +1.
Source: Sifakis, Barbic, "FEM Simulation of 3D Deformable Solids", SIGGRAPH 2012 course, section 3.4.
The rotation has a closed form: f = tr S is the largest root of a quartic in the invariants of F^T F, and R = df/dF
(Lin, Chitalu, Komura, "Isotropic ARAP Energy Using Cauchy-Green Invariants", ACM TOG 41(6), 2022, derive f that way).
If two stretches nearly cancel (s1 + s2 close to 0: strongly inverted F) the quotient loses accuracy, and the rotation is
taken from the signed SVD instead. Weak: R is not unique there, so the stress jumps.
"""

import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.math3 import (
    add_to_diagonal,
    cofactor,
    cross,
    ddot,
    determinant,
    dot,
    matmul,
    matmul_nt,
    matmul_tn,
    plus_pressure,
    signed_svd,
    transform,
)

NAME = "corotational"
N_CONSTANTS = 4
SOFTENS_BELOW = 0.0
POINT_SECONDS = 60e-9  # per quadrature point of an explicit step, on one core
MAX_EXTRA_ITERATIONS = 8  # maximum Halley iterations beyond the two that suffice for moderate strain
CONVERGED_BELOW = 1e-5  # relative change whose cube is below rounding, so that the next iteration would change nothing
SVD_BELOW = 0.04  # relative size of the denominator below which the closed form loses more than about one digit


def constants(mu: float, lam: float) -> tuple[float, float, float, float]:
    """(mu, lambda, 0, 0) [Pa]."""
    return mu, lam, 0.0, 0.0


@arithmetic
def _halley(f, Ic, J, c0):
    """Decrement of f in one Halley iteration: of third order, and from above it never overshoots the largest root."""
    value = f * (f * (f * f - 2.0 * Ic) - 8.0 * J) + c0
    slope = 4.0 * f * (f * f - Ic) - 8.0 * J
    curvature = 6.0 * f * f - 2.0 * Ic  # half the second derivative
    return value * slope / ti.max(slope * slope - value * curvature, 1e-30)


@ti.func
def _any(flags):
    result = flags[0] != 0
    for q in ti.static(range(1, flags.n)):
        result = result or flags[q] != 0
    return result


@ti.func
def rotation(F):
    """R of the polar decomposition, det R = +1; any finite F is valid."""
    C = matmul_tn(F, F)
    G = cofactor(F)
    J = dot(F, G)
    Ic = C[0] + C[4] + C[8]
    c0 = 2.0 * ddot(C, C) - Ic * Ic
    f = ti.sqrt(3.0 * Ic)  # above the root, and close to it if the stretches are nearly equal
    f -= _halley(f, Ic, J, c0)
    change = _halley(f, Ic, J, c0)
    f -= change
    iterations = 0
    while iterations < MAX_EXTRA_ITERATIONS and _any(abs(change) > CONVERGED_BELOW * f):
        change = _halley(f, Ic, J, c0)
        f -= change
        iterations += 1
    denominator = f * (f * f - Ic) - 2.0 * J
    use_svd = (denominator <= SVD_BELOW * f * f * f) | (abs(change) > CONVERGED_BELOW * f) | ~(f > 1e-4)
    FC = matmul(F, C)
    a = f * f + Ic
    N = [a * F[k] + 2.0 * f * G[k] - 2.0 * FC[k] for k in ti.static(range(9))]
    # scaling to |R|^2 = 3 removes the rounding error of f from the norm of R
    scale = ti.sqrt(3.0 / ti.max(ddot(N, N), 1e-30))
    R = [scale * N[k] for k in ti.static(range(9))]
    if _any(use_svd):
        U, _, V = signed_svd(F, 5)
        Q = matmul_nt(U, V)
        for k in ti.static(range(9)):
            R[k] = ti.select(use_svd, Q[k], R[k])
    return R


@arithmetic
def _trace_stress(t, p):
    """lambda t [Pa], t = tr(R^T F) - 3. p[4]: see `laws`."""
    return plus_pressure(p[1] * t, p)


@ti.func
def dilatation(F):
    """tr(R^T F) - 3."""
    R = rotation(F)
    D = [F[k] - R[k] for k in ti.static(range(9))]
    return ddot(R, D)


@ti.func
def dilatation_gradient(F):
    """Derivative of `dilatation` by F."""
    return rotation(F)


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
    t = _trace_stress(ddot(R, D), p)
    return [2.0 * p[0] * D[k] + t * R[k] for k in ti.static(range(9))]


@ti.func
def prepare(F, p):
    """Precompute for `dpk1` and `block`: R, the inverse of tr(S) I - S in the rotated frame (R K R^T), and the factors."""
    R = rotation(F)
    T = matmul_nt(F, R)  # R S R^T, symmetric
    t = T[0] + T[4] + T[8]
    a, b, c = -0.5 * (T[1] + T[3]), -0.5 * (T[2] + T[6]), -0.5 * (T[5] + T[7])
    K = [t - T[0], a, b, a, t - T[4], c, b, c, t - T[8]]
    det = determinant(K)  # (s0+s1)(s0+s2)(s1+s2): 0 only if the rotation is not unique
    tiny = 1e-12 * abs(t * t * t) + 1e-30
    inverse = 1.0 / ti.select(abs(det) > tiny, det, tiny)
    C = cofactor(K)
    return R + [inverse * C[k] for k in ti.static(range(9))] + [p[0], p[1], _trace_stress(t - 3.0, p) - 2.0 * p[0]]


@arithmetic
def rotation_differential(R, K, B, factor):
    """factor dR along D, with B = D R^T and R and K from `prepare`."""
    w = transform(K, [B[7] - B[5], B[2] - B[6], B[3] - B[1]])
    c = [factor * w[k] for k in ti.static(range(3))]
    return [
        c[(i + 1) % 3] * R[3 * ((i + 2) % 3) + j] - c[(i + 2) % 3] * R[3 * ((i + 1) % 3) + j]
        for i in ti.static(range(3))
        for j in ti.static(range(3))
    ]


@arithmetic
def rotation_block(K, Ra, Rb, factor):
    """factor dR g_b along e_k (x) g_a: nine entries (i, k), with Ra = R g_a and Rb = R g_b."""
    # dR g_b = w x R g_b with w = K (R g_a x e_k), so the matrix over k is -[R g_b]x K [R g_a]x
    N = [cross(K[3 * i : 3 * i + 3], Ra) for i in ti.static(range(3))]
    c = [factor * Rb[k] for k in ti.static(range(3))]
    return [
        c[(i + 2) % 3] * N[(i + 1) % 3][k] - c[(i + 1) % 3] * N[(i + 2) % 3][k]
        for i in ti.static(range(3))
        for k in ti.static(range(3))
    ]


@arithmetic
def dpk1(F, S, D):
    """Differential of the stress along D [Pa], with S = prepare(F, p).

    dR = [w]x R with R (tr(S) I - S) R^T w = axial(dF R^T - R dF^T); tr S changes by R : dF.
    """
    R = [S[k] for k in ti.static(range(9))]
    K = [S[9 + k] for k in ti.static(range(9))]
    B = matmul_nt(D, R)
    t = S[19] * (B[0] + B[4] + B[8])
    dR = rotation_differential(R, K, B, S[20])
    return [2.0 * S[18] * D[k] + t * R[k] + dR[k] for k in ti.static(range(9))]


@arithmetic
def block(F, S, ga, gb):
    """Differential of (P g_b)_i along the displacement gradient e_k (x) g_a: nine entries (i, k) [Pa/m^2]."""
    R = [S[k] for k in ti.static(range(9))]
    Ra, Rb = transform(R, ga), transform(R, gb)
    d = 2.0 * S[18] * dot(ga, gb)
    l = [S[19] * Rb[k] for k in ti.static(range(3))]
    rotated = rotation_block(S[9:18], Ra, Rb, S[20])
    return add_to_diagonal([rotated[k] + l[k // 3] * Ra[k % 3] for k in ti.static(range(9))], d)


@arithmetic
def hessian_eigen(s, p):
    """Second derivatives in the SVD frame [Pa], over the stretches s: see `laws`."""
    A = [(2.0 * p[0] if ti.static(i == j) else 0.0) + p[1] + 0.0 * s[0] for i in ti.static(range(3)) for j in ti.static(range(3))]
    symmetric = [2.0 * p[0] + 0.0 * s[0], 2.0 * p[0] + 0.0 * s[0], 2.0 * p[0] + 0.0 * s[0]]
    factor = 2.0 * _trace_stress(s[0] + s[1] + s[2] - 3.0, p) - 4.0 * p[0]
    pair = [s[0] + s[1], s[0] + s[2], s[1] + s[2]]
    floor = 1e-12 * (s[0] + 1e-18)
    antisymmetric = [2.0 * p[0] + factor / ti.max(pair[k], floor) for k in ti.static(range(3))]
    return A, symmetric, antisymmetric
