"""A volume floor: an addition to a law (see `additions`) that stiffens a tet squeezed below a fraction delta of its rest volume.

psi = kappa/3 (d^3 - e^3),   d = max(0, delta - J),   e = max(0, -J),   kappa = (lambda + 2 mu) / delta^2,
twice continuously differentiable in J: nothing from J = delta on, a volumetric stress of lambda + 2 mu at J = 0, and the constant
stiffness 2 (lambda + 2 mu) / delta below, which e bounds. All laws are finite at J = 0, so large enough pressures turn their tets
inside out. lambda + 2 mu is the stiffness of a bar that cannot widen, about as much as the laws resist a flat tet.
The form is taisoft's own: a penalty, not a barrier. Inverted tets are valid and recover, and larger pressures invert tets still.
Weak: a flat tet whose sides have their lengths at rest vibrates sqrt(1 + 2/delta) times as fast as at rest, see `stability`.
"""

import numpy as np
import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.laws.table import table_constants
from taisoft.fem.math3 import cofactor, cofactor_differential, cross, ddot, determinant, transform

N_CONSTANTS, N_PREPARED = 2, 11


def table(floor: float | np.ndarray, mu: float | np.ndarray, lam: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(delta, kappa [Pa]), which follow a law's own constants in the model's table; kappa is 0 where the floor is."""
    has = np.asarray(floor) > 0.0
    return np.where(has, floor, 0.0), np.where(has, (lam + 2.0 * mu) / np.where(has, floor, 1.0) ** 2, 0.0)


@ti.func
def constants(m: ti.template(), g: ti.template(), b, q, real: ti.template()):
    """delta and kappa of the tets of block b."""
    return table_constants(m, b, g.law.N_CONSTANTS, 2, real)


@arithmetic
def psi(F, p):
    """kappa/3 (d^3 - e^3) [Pa]. p: (delta, kappa)."""
    J = determinant(F)
    d, e = ti.max(p[0] - J, 0.0), ti.max(-J, 0.0)
    return p[1] * (d * d * d - e * e * e) / 3.0


@arithmetic
def derivatives(J, p):
    """First and second derivative of `psi` by J [Pa]."""
    d, e = ti.max(p[0] - J, 0.0), ti.max(-J, 0.0)
    return -p[1] * (d * d - e * e), 2.0 * p[1] * (d - e)


@arithmetic
def add_stress(P, F, p):
    """P + dpsi/dJ cof F [Pa]."""
    w, _ = derivatives(determinant(F), p)
    G = cofactor(F)
    return [P[k] + w * G[k] for k in ti.static(range(9))]


@arithmetic
def prepared(F, p):
    """What `prepare` adds at the end."""
    w, k = derivatives(determinant(F), p)
    G = cofactor(F)
    return G + [w, k]


@arithmetic
def add_differential(T, F, S, D):
    """T plus the differential of the term's stress along D [Pa]. S: from `prepare`."""
    G = S[-11:-2]
    GD = S[-1] * ddot(G, D)
    C = cofactor_differential(F, D)
    return [T[k] + GD * G[k] + S[-2] * C[k] for k in ti.static(range(9))]


@arithmetic
def add_block(K, F, S, ga, gb):
    """K plus the same differential along e_k (x) g_a, times g_b [Pa/m^2]."""
    G = S[-11:-2]
    Ga, Gb, t = transform(G, ga), transform(G, gb), transform(F, cross(ga, gb))
    w = [S[-2] * t[k] for k in ti.static(range(3))]
    g = [S[-1] * Gb[k] for k in ti.static(range(3))]
    turned = [0.0 * w[0], -w[2], w[1], w[2], 0.0 * w[0], -w[0], -w[1], w[0], 0.0 * w[0]]
    return [K[k] + g[k // 3] * Ga[k % 3] + turned[k] for k in ti.static(range(9))]


@arithmetic
def add_eigen(A, symmetric, antisymmetric, s, p):
    """The three parts of the law's second derivative in the SVD frame plus those of the term [Pa], see `laws`."""
    g = [s[1] * s[2], s[0] * s[2], s[0] * s[1]]
    w, k = derivatives(s[0] * g[0], p)
    B = [
        A[3 * i + j] + k * g[i] * g[j] + (0.0 if ti.static(i == j) else w * s[(3 - i - j) % 3])
        for i in ti.static(range(3))
        for j in ti.static(range(3))
    ]
    remaining = [s[2], s[1], s[0]]  # for each pair, the stretch that is not in it
    return (
        B,
        [symmetric[n] - w * remaining[n] for n in ti.static(range(3))],
        [antisymmetric[n] + w * remaining[n] for n in ti.static(range(3))],
    )
