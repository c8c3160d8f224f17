"""Maxwell branches over a step: an addition to a law (see `additions`), with constants from their history (`fem.viscosity`).

    psi = mu' |dev E - Z|^2 + c,   P = F S,   S = 2 mu' (dev E - Z),   E = (F^T F - I)/2,
which is St. Venant-Kirchhoff's law with lambda = -2/3 mu' about the strain Z. The projected differential of P is
    F dS + D S+,   dS = 2 mu' dev sym(F^T D),
with the positive part S+ of S: neither term has negative eigenvalues.
"""

import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.laws import st_venant_kirchhoff as svk
from taisoft.fem.math3 import clamp_symmetric, ddot, matmul

SWITCH = "viscosity"
N_CONSTANTS, N_PREPARED, N_PROJECTED = 8, 20, 29
PLACES = (0, 5, 4, 5, 1, 3, 4, 3, 2)  # of the entries of a symmetric matrix among (xx, yy, zz, yz, xz, xy)


def applies(body) -> bool:
    """Whether a body has branches."""
    return body.composition.branches.shape[1] > 0


@ti.func
def constants(m: ti.template(), g: ti.template(), b, q, real: ti.template()):
    """mu' [Pa], c [Pa] and Z of quadrature point q of block b."""
    at = m.viscosity.first_point[b] + q
    return [
        ti.Vector([ti.cast(m.viscosity.constants[at, k, l], real) for l in ti.static(range(m.lanes))])
        for k in ti.static(range(8))
    ]


@arithmetic
def _strain(F, p):
    """dev E - Z."""
    E = svk.green_strain(F)
    t = (E[0] + E[4] + E[8]) / 3.0
    return [E[k] - p[2 + PLACES[k]] - (t if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]


@arithmetic
def _stress(F, p):
    """S [Pa]."""
    A = _strain(F, p)
    return [2.0 * p[0] * A[k] for k in ti.static(range(9))]


@arithmetic
def psi(F, p):
    """Energy density [Pa]."""
    A = _strain(F, p)
    return p[0] * ddot(A, A) + p[1]


@arithmetic
def add_stress(P, F, p):
    """P + F S [Pa]."""
    S = _stress(F, p)
    T = matmul(F, S)
    return [P[k] + T[k] for k in ti.static(range(9))]


@arithmetic
def prepared(F, p):
    """What St. Venant-Kirchhoff's law prepares, with S as its stress."""
    S = _stress(F, p)
    return S + svk.prepare(F, [p[0], -2.0 / 3.0 * p[0]])[9:]


@arithmetic
def add_differential(T, F, S, D):
    """T + D S + F dS [Pa]."""
    U = svk.dpk1(F, S, D)
    return [T[k] + U[k] for k in ti.static(range(9))]


@arithmetic
def add_block(K, F, S, ga, gb):
    """K plus the same differential along e_k (x) g_a, times g_b [Pa/m^2]."""
    L = svk.block(F, S, ga, gb)
    return [K[k] + L[k] for k in ti.static(range(9))]


@ti.func
def prepared_projected(F, p):
    """S+, then what `prepared` has after S, and F."""
    S = prepared(F, p)
    positive = clamp_symmetric(S[:9], 5)
    return positive + S[9:] + F


@arithmetic
def add_projected(T, S, D):
    """T + D S+ + F dS [Pa]."""
    return add_differential(T, S[20:], S[:20], D)
