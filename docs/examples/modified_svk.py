"""St. Venant-Kirchhoff solid with a volume term that sees inversion.

psi = mu E : E + lambda/2 (J - 1)^2,   E = (F^T F - I)/2, J = det F,   P = 2 mu F E + lambda (J - 1) cof F.
Weak: the deviatoric part still softens in compression.
"""

import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.laws.st_venant_kirchhoff import green_strain
from taisoft.fem.math3 import cofactor, cofactor_differential, cross, ddot, dot, matmul, matmul_nt, matmul_tn, transform

NAME = "modified_svk"
N_CONSTANTS = 4
SOFTENS_BELOW = 0.6
POINT_SECONDS = 30e-9


def constants(mu: float, lam: float) -> tuple[float, float, float, float]:
    """(mu, lambda, 0, 0) [Pa]."""
    return mu, lam, 0.0, 0.0


@arithmetic
def _volume_change(F):
    """J - 1, formed from H = F - I so that small strains keep their digits."""
    H = [F[k] - (1.0 if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]
    G = cofactor(H)
    return (H[0] + H[4] + H[8]) + (G[0] + G[4] + G[8]) + (H[0] * G[0] + H[1] * G[1] + H[2] * G[2])


@arithmetic
def psi(F, p):
    """Energy density [Pa], 0 at rest."""
    E = green_strain(F)
    e = _volume_change(F)
    return p[0] * ddot(E, E) + 0.5 * p[1] * e * e


@arithmetic
def pk1(F, p):
    """First Piola-Kirchhoff stress [Pa]."""
    FE = matmul(F, green_strain(F))
    G = cofactor(F)
    b = p[1] * _volume_change(F)
    return [2.0 * p[0] * FE[k] + b * G[k] for k in ti.static(range(9))]


@arithmetic
def prepare(F, p):
    """What `dpk1` and `block` need of F: S = 2 mu E, cof F, mu F F^T, and the factors mu, lambda, lambda (J - 1)."""
    E = green_strain(F)
    B = matmul_nt(F, F)
    S = [2.0 * p[0] * E[k] for k in ti.static(range(9))]
    return S + cofactor(F) + [p[0] * B[k] for k in ti.static(range(9))] + [p[0], p[1], p[1] * _volume_change(F)]


@arithmetic
def dpk1(F, S, D):
    """Differential of the stress along D [Pa], with S = prepare(F, p)."""
    E2 = [S[k] for k in ti.static(range(9))]
    G = [S[9 + k] for k in ti.static(range(9))]
    A = matmul_tn(F, D)
    T = [S[27] * (A[3 * i + j] + A[3 * j + i]) for i in ti.static(range(3)) for j in ti.static(range(3))]
    first, second, C = matmul(D, E2), matmul(F, T), cofactor_differential(F, D)
    g = S[28] * ddot(G, D)
    return [first[k] + second[k] + g * G[k] + S[29] * C[k] for k in ti.static(range(9))]


@arithmetic
def block(F, S, ga, gb):
    """(d/dx_k of) (P g_b)_i for a displacement field with gradient e_k (x) g_a: the nine entries (i, k) [Pa/m^2]."""
    E2 = [S[k] for k in ti.static(range(9))]
    G = [S[9 + k] for k in ti.static(range(9))]
    Fa, Fb, Ga, Gb = transform(F, ga), transform(F, gb), transform(G, ga), transform(G, gb)
    d, c = dot(ga, transform(E2, gb)), dot(ga, gb)
    t = transform(F, cross(ga, gb))
    w = [S[29] * t[k] for k in ti.static(range(3))]
    turn = [0.0 * d, -w[2], w[1], w[2], 0.0 * d, -w[0], -w[1], w[0], 0.0 * d]
    return [
        S[27] * Fa[i] * Fb[k]
        + c * S[18 + 3 * i + k]
        + S[28] * Gb[i] * Ga[k]
        + turn[3 * i + k]
        + (d if ti.static(i == k) else 0.0)
        for i in ti.static(range(3))
        for k in ti.static(range(3))
    ]


@arithmetic
def hessian_eigen(s, p):
    """Second derivatives over the stretches s (nine entries), and the eigenvalues of the symmetric and antisymmetric modes."""
    J = s[0] * s[1] * s[2]
    b = p[1] * (J - 1.0)
    g = [s[1] * s[2], s[0] * s[2], s[0] * s[1]]
    A = [
        (p[0] * (3.0 * s[i] * s[i] - 1.0) if ti.static(i == j) else b * s[(3 - i - j) % 3]) + p[1] * g[i] * g[j]
        for i in ti.static(range(3))
        for j in ti.static(range(3))
    ]
    across = [s[2], s[1], s[0]]  # the stretch that is in neither pair
    square = [s[0] * s[0] + s[1] * s[1] - 1.0, s[0] * s[0] + s[2] * s[2] - 1.0, s[1] * s[1] + s[2] * s[2] - 1.0]
    product = [s[0] * s[1], s[0] * s[2], s[1] * s[2]]
    symmetric = [p[0] * (square[k] + product[k]) - b * across[k] for k in ti.static(range(3))]
    antisymmetric = [p[0] * (square[k] - product[k]) + b * across[k] for k in ti.static(range(3))]
    return A, symmetric, antisymmetric
