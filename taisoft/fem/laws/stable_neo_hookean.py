"""Stable neo-Hookean solid.

psi = m/2 (Ic - 3) + l/2 (J - alpha)^2 - m/2 ln(Ic + 1) - psi_rest,   Ic = F : F, J = det F,
m = 4/3 mu, l = lambda + 5/6 mu, alpha = 1 + m/l - m/(4 l), which match the Lamé parameters of Hooke's law at F = I.
Source: Smith, de Goes, Kim, "Stable Neo-Hookean Flesh Simulation", ACM TOG 37(2), 2018, eqs 14 and 18.
Strong: finite for every F, recovers from inversion. Weak: slightly too soft in compression for
rubber. Stress-free states exist only with the log term, which is kept here.
"""

import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.math3 import cofactor, cofactor_differential, cross, ddot, dot, plus_pressure, transform

NAME = "stable_neo_hookean"
N_CONSTANTS = 4
SOFTENS_BELOW = 0.0
POINT_SECONDS = 30e-9  # per quadrature point of an explicit step, on one core


def constants(mu: float, lam: float) -> tuple[float, float, float, float]:
    """(m, l, alpha, l (1 - alpha)) from the Lamé parameters [Pa]."""
    m, l = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
    alpha = 1.0 + m / l - m / (4.0 * l)
    return m, l, alpha, l * (1.0 - alpha)


@arithmetic
def _volume_change(H):
    """J - 1 of F = I + H, without cancellation at small strains."""
    G = cofactor(H)
    return H[0] + H[4] + H[8] + (G[0] + G[4] + G[8]) + H[0] * G[0] + H[1] * G[1] + H[2] * G[2]


@arithmetic
def _volume_stress(J, p):
    """Derivative by J of the terms in J [Pa]. p[4]: see `laws`."""
    return plus_pressure(p[1] * (J - p[2]), p)


@arithmetic
def dilatation(F):
    """J - 1."""
    return _volume_change([F[k] - (1.0 if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))])


@arithmetic
def dilatation_gradient(F):
    """Derivative of `dilatation` by F."""
    return cofactor(F)


@arithmetic
def psi(F, p):
    """Energy density [Pa], 0 at rest.

    Evaluated in d = Ic - 3 and e = J - 1 to avoid cancellation at small strains: with l (1 - alpha) = -3/4 m,
    psi = m/2 (d - log1p(d/4)) + l/2 e^2 + l (1 - alpha) e.
    """
    H = [F[k] - (1.0 if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]
    trace = H[0] + H[4] + H[8]
    norm2 = ddot(H, H)
    d = 2.0 * trace + norm2
    e = _volume_change(H)
    z = 0.25 * d
    u = 1.0 + z  # log1p as a quotient that cancels the rounding of 1 + z
    log1p = ti.select(u == 1.0, z, ti.log(u) * z / ti.select(u == 1.0, 1.0 + 0.0 * u, u - 1.0))
    return 0.5 * p[0] * (d - log1p) + 0.5 * p[1] * e * e + p[3] * e


@arithmetic
def pk1(F, p):
    """First Piola-Kirchhoff stress [Pa]; any F is valid. Source: the paper's eq. 18."""
    G = cofactor(F)
    J = dot(F, G)
    a = p[0] - p[0] / (ddot(F, F) + 1.0)
    b = _volume_stress(J, p)
    return [a * F[k] + b * G[k] for k in ti.static(range(9))]


@arithmetic
def prepare(F, p):
    """Precompute for `dpk1` and `block`: the cofactor of F and the factors of the four terms."""
    G = cofactor(F)
    J = dot(F, G)
    q = 1.0 / (ddot(F, F) + 1.0)
    return G + [p[0] - p[0] * q, 2.0 * p[0] * q * q, p[1], _volume_stress(J, p)]


@arithmetic
def dpk1(F, S, D):
    """Differential of the stress along D [Pa], with S = prepare(F, p)."""
    FD = S[10] * ddot(F, D)
    GD = S[11] * ddot(S, D)
    C = cofactor_differential(F, D)
    return [S[9] * D[k] + FD * F[k] + GD * S[k] + S[12] * C[k] for k in ti.static(range(9))]


@arithmetic
def block(F, S, ga, gb):
    """Differential of (P g_b)_i along the displacement gradient e_k (x) g_a: nine entries (i, k) [Pa/m^2]."""
    Fa, Fb, Ga, Gb = transform(F, ga), transform(F, gb), transform(S, ga), transform(S, gb)
    d = S[9] * dot(ga, gb)
    t = transform(F, cross(ga, gb))
    w = [S[12] * t[k] for k in ti.static(range(3))]
    f = [S[10] * Fb[k] for k in ti.static(range(3))]
    g = [S[11] * Gb[k] for k in ti.static(range(3))]
    return [
        d + f[0] * Fa[0] + g[0] * Ga[0],
        f[0] * Fa[1] + g[0] * Ga[1] - w[2],
        f[0] * Fa[2] + g[0] * Ga[2] + w[1],
        f[1] * Fa[0] + g[1] * Ga[0] + w[2],
        d + f[1] * Fa[1] + g[1] * Ga[1],
        f[1] * Fa[2] + g[1] * Ga[2] - w[0],
        f[2] * Fa[0] + g[2] * Ga[0] - w[1],
        f[2] * Fa[1] + g[2] * Ga[1] + w[0],
        d + f[2] * Fa[2] + g[2] * Ga[2],
    ]


@arithmetic
def hessian_eigen(s, p):
    """Second derivatives in the SVD frame [Pa], over the stretches s: see `laws`."""
    Ic = s[0] * s[0] + s[1] * s[1] + s[2] * s[2]
    q = 1.0 / (Ic + 1.0)
    a, f = p[0] - p[0] * q, 2.0 * p[0] * q * q
    g = [s[1] * s[2], s[0] * s[2], s[0] * s[1]]
    b = _volume_stress(s[0] * g[0], p)
    A = [
        (a if ti.static(i == j) else b * s[(3 - i - j) % 3]) + f * s[i] * s[j] + p[1] * g[i] * g[j]
        for i in ti.static(range(3))
        for j in ti.static(range(3))
    ]
    remaining = [s[2], s[1], s[0]]  # for each pair, the stretch that is not in it
    return A, [a - b * remaining[k] for k in ti.static(range(3))], [a + b * remaining[k] for k in ti.static(range(3))]
