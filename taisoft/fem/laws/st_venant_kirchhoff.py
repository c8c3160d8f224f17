"""St. Venant-Kirchhoff solid.

psi = mu E : E + lambda/2 tr(E)^2,   E = (F^T F - I)/2,   P = F (2 mu E + lambda tr(E) I).
Source: Sifakis, Barbic, "FEM Simulation of 3D Deformable Solids", SIGGRAPH 2012 course, section 3.3.
Weak: softens in compression below a stretch of 1/sqrt(3) = 0.577 and does not resist inversion (psi is invariant under
reflection), so compressed bodies collapse.
"""

import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.math3 import add_to_diagonal, ddot, dot, matmul, matmul_nt, matmul_tn, plus_pressure, transform

NAME = "st_venant_kirchhoff"
N_CONSTANTS = 4
SOFTENS_BELOW = 0.6  # stretch that triggers a warning, slightly above 1/sqrt(3)
POINT_SECONDS = 30e-9  # per quadrature point of an explicit step, on one core


def constants(mu: float, lam: float) -> tuple[float, float, float, float]:
    """(mu, lambda, 0, 0) [Pa]."""
    return mu, lam, 0.0, 0.0


@arithmetic
def green_strain(F):
    """E = (F^T F - I)/2, computed from H = F - I to avoid cancellation at small strains."""
    H = [F[k] - (1.0 if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]
    C = matmul_tn(H, H)
    return [0.5 * (H[3 * i + j] + H[3 * j + i] + C[3 * i + j]) for i in ti.static(range(3)) for j in ti.static(range(3))]


@arithmetic
def _trace_stress(t, p):
    """lambda t [Pa], t = tr(E). p[4]: see `laws`."""
    return plus_pressure(p[1] * t, p)


@arithmetic
def dilatation(F):
    """tr(E)."""
    E = green_strain(F)
    return E[0] + E[4] + E[8]


@arithmetic
def dilatation_gradient(F):
    """Derivative of `dilatation` by F."""
    return F


@arithmetic
def _second_pk(E, p):
    """S = 2 mu E + lambda tr(E) I [Pa]."""
    t = _trace_stress(E[0] + E[4] + E[8], p)
    return add_to_diagonal([2.0 * p[0] * E[k] for k in ti.static(range(9))], t)


@arithmetic
def psi(F, p):
    """Energy density [Pa], 0 at rest."""
    E = green_strain(F)
    t = E[0] + E[4] + E[8]
    return p[0] * ddot(E, E) + 0.5 * p[1] * t * t


@arithmetic
def pk1(F, p):
    """First Piola-Kirchhoff stress [Pa]; any F is valid. Evaluated as mu F C + (lambda/2 (tr C - 3) - mu) F, C = F^T F."""
    C = matmul_tn(F, F)
    FC = matmul(F, C)
    t = _trace_stress(0.5 * (C[0] + C[4] + C[8] - 3.0), p) - p[0]
    return [p[0] * FC[k] + t * F[k] for k in ti.static(range(9))]


@arithmetic
def prepare(F, p):
    """Precompute for `dpk1` and `block`: the second Piola-Kirchhoff stress, the Lamé parameters, mu F F^T."""
    B = matmul_nt(F, F)
    return _second_pk(green_strain(F), p) + [p[0], p[1]] + [p[0] * B[k] for k in ti.static(range(9))]


@arithmetic
def dpk1(F, S, D):
    """Differential of the stress along D [Pa], with S = prepare(F, p): D S + F dS."""
    B = matmul_tn(F, D)
    t = S[10] * (B[0] + B[4] + B[8])
    T = add_to_diagonal([S[9] * (B[3 * i + j] + B[3 * j + i]) for i in ti.static(range(3)) for j in ti.static(range(3))], t)
    first, second = matmul(D, S), matmul(F, T)
    return [first[k] + second[k] for k in ti.static(range(9))]


@arithmetic
def block(F, S, ga, gb):
    """Differential of (P g_b)_i along the displacement gradient e_k (x) g_a: nine entries (i, k) [Pa/m^2]."""
    Fa, Fb = transform(F, ga), transform(F, gb)
    c, d = dot(ga, gb), dot(ga, transform(S, gb))
    m = [S[9] * Fa[k] for k in ti.static(range(3))]
    l = [S[10] * Fb[k] for k in ti.static(range(3))]
    return add_to_diagonal([c * S[11 + k] + m[k // 3] * Fb[k % 3] + l[k // 3] * Fa[k % 3] for k in ti.static(range(9))], d)


@arithmetic
def hessian_eigen(s, p):
    """Second derivatives in the SVD frame [Pa], over the stretches s: see `laws`."""
    h = _trace_stress(0.5 * (s[0] * s[0] + s[1] * s[1] + s[2] * s[2] - 3.0), p)
    A = [
        p[1] * s[i] * s[j] + ((p[0] * (3.0 * s[i] * s[i] - 1.0) + h) if ti.static(i == j) else 0.0)
        for i in ti.static(range(3))
        for j in ti.static(range(3))
    ]
    square = [s[0] * s[0] + s[1] * s[1] - 1.0, s[0] * s[0] + s[2] * s[2] - 1.0, s[1] * s[1] + s[2] * s[2] - 1.0]
    mixed = [s[0] * s[1], s[0] * s[2], s[1] * s[2]]
    symmetric = [p[0] * (square[k] + mixed[k]) + h for k in ti.static(range(3))]
    antisymmetric = [p[0] * (square[k] - mixed[k]) + h for k in ti.static(range(3))]
    return A, symmetric, antisymmetric
