"""Fibres: an addition to a law (see `additions`) that bears tension along a direction a of each tet at rest, and is active.

With w = F a, I4 = |w|^2, activation A from 0 to 1, s = 1 / (1 - A active_strain)^2 and T = A active_stress,
    psi = k1/(2 k2) (exp(k2 d^2) - 1) + T (|w| - 1),   d = max(s I4 - 1, 0);   k1/2 d^2 + T (|w| - 1) for k2 = 0.
Active strain shortens the length at which fibres are slack; active stress is a nominal tension. At rest k1 adds 4 k1 to the
stiffness along a. The second derivative has the eigenvalues 2 psi', twice, and 2 psi' + 4 psi'' I4 in the direction of w, where
psi' = dpsi/dI4. None is negative, so it is its own projection.
Any F is valid: below |w| = SHORTEST the tension falls to 0 in proportion to |w|, and where k2 d^2 exceeds MOST the exponential
stays as it is there, so that the energy grows with d^2 and numbers in f32 are finite.
Sources: Holzapfel, Gasser, Ogden, "A new constitutive framework for arterial wall mechanics", J. Elasticity 61, 2000, eq. 71;
Kim, De Goes, Iben, "Anisotropic elasticity for inversion-safety and element rehabilitation", ACM TOG 38(4), 2019 (eigenvalues).
Weak: no fibre dispersion, and no force-length or force-velocity relation of muscles. The stiffness jumps at d = 0 and SHORTEST.
"""

import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.math3 import dot, transform

N_CONSTANTS = 7  # a, k1, k2, T, s
N_PREPARED = N_PROJECTED = 8  # w, a, 2 psi', 4 psi''
SHORTEST = 1e-3  # of |F a|
MOST = 30.0  # of k2 d^2


def applies(body) -> bool:
    """Whether a body has fibres."""
    return body.fibres is not None


@ti.func
def constants(m: ti.template(), g: ti.template(), b, q, real: ti.template()):
    """a, k1 [Pa], k2, T [Pa] and s of the tets of block b."""
    n = [ti.Vector([m.fibres.numbers[b, k, l] for l in ti.static(range(m.lanes))]) for k in ti.static(range(7))]
    A = ti.Vector([m.amplitudes[m.fibres.slot[b, l]] for l in ti.static(range(m.lanes))])
    slack = 1.0 - A * n[6]
    return [ti.cast(n[k], real) for k in ti.static(range(5))] + [ti.cast(A * n[5], real), ti.cast(1.0 / (slack * slack), real)]


@arithmetic
def _stretched(F, p):
    """w, I4, d, and d^2 as far as the exponential follows it, with exp(k2 d^2) there."""
    H = [F[k] - (1.0 if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]
    w, h = transform(F, p), transform(H, p)
    d = ti.max(p[6] * (2.0 * dot(p, h) + dot(h, h)) + (p[6] - 1.0), 0.0)  # without the rounding of I4
    is_most = p[4] * d * d > MOST
    square = ti.select(is_most, MOST / ti.select(is_most, p[4], 1.0 + 0.0 * d), d * d)
    return w, dot(w, w), d, square, ti.exp(p[4] * square)


@arithmetic
def psi(F, p):
    """Energy density [Pa]."""
    _, I4, d, square, u = _stretched(F, p)
    # (u - 1) / k2, as a quotient by log u that cancels the rounding of u; beyond MOST u (d^2 - square) follows
    is_small = u == 1.0
    grown = square * ti.select(is_small, u, (u - 1.0) / ti.select(is_small, u, ti.log(u)))
    r = ti.max(ti.sqrt(I4), SHORTEST)
    return 0.5 * p[3] * (grown + u * (d * d - square)) + p[5] * (0.5 * (I4 / r + r) - 1.0)


@arithmetic
def add_stress(P, F, p):
    """P + 2 psi' w a^T [Pa]."""
    w, I4, d, _, u = _stretched(F, p)
    c = 2.0 * p[6] * p[3] * d * u + p[5] / ti.max(ti.sqrt(I4), SHORTEST)
    return [P[k] + c * w[k // 3] * p[k % 3] for k in ti.static(range(9))]


@arithmetic
def prepared(F, p):
    """w, a, 2 psi' and 4 psi''."""
    w, I4, d, square, u = _stretched(F, p)
    r = ti.max(ti.sqrt(I4), SHORTEST)
    T, z, none = p[5] / r, p[4] * square, 0.0 * d
    passive = 4.0 * p[6] * p[6] * p[3] * u * (1.0 + ti.select(z < MOST, 2.0 * z, none))
    h = ti.select(d > 0.0, passive, none) - ti.select(r > SHORTEST, T / (r * r), none)
    return w + p[0:3] + [2.0 * p[6] * p[3] * d * u + T, h]


@arithmetic
def add_differential(T, F, S, D):
    """T + (2 psi' D a + 4 psi'' (w . D a) w) a^T [Pa]."""
    return add_projected(T, S, D)


@arithmetic
def add_block(K, F, S, ga, gb):
    """K + (a . g_a) (a . g_b) (2 psi' I + 4 psi'' w w^T) [Pa/m^2]."""
    both = dot(S[3:6], ga) * dot(S[3:6], gb)
    c, h = S[6] * both, S[7] * both
    return [K[k] + h * S[k // 3] * S[k % 3] + (c if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]


prepared_projected = prepared


@arithmetic
def add_projected(T, S, D):
    """As `add_differential`, which has no negative eigenvalue."""
    v = transform(D, S[3:6])
    along = S[7] * dot(S, v)
    return [T[k] + (S[6] * v[k // 3] + along * S[k // 3]) * S[3 + k % 3] for k in ti.static(range(9))]
