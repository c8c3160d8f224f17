"""The registry of material laws by name, and the projection of their second derivatives.

To add a law, add a file like the others here and list it below. A law has NAME, SOFTENS_BELOW (the compressive stretch below
which it softens, 0 for none), POINT_SECONDS (approximate time of a quadrature point in an explicit step, which sizes launches),
`constants(mu, lam)` (on the host, four numbers per body) and the lane functions `psi`, `pk1`, `prepare`, `dpk1`, `block` (the
same differential along e_k (x) g_a, times g_b, for assembly) and `hessian_eigen(s, p)`. Tests over the registry check them
against each other by finite differences.

For mean dilatation a law is psi(F; mu, lambda) = psi(F; mu, 0) + lambda/2 theta(F)^2, with the lane functions `dilatation`,
theta, and `dilatation_gradient`. p then has a fifth entry, a pressure q [Pa], for which `pk1`, `prepare`, `dpk1`, `block` and
`hessian_eigen` are those of psi(F; p) + q theta(F).

`hessian_eigen` splits the second derivative in the frame of F's signed SVD: with F = U diag(s) V^T and dF = U X V^T it is a 3x3
block over X's diagonal (nine entries) and, for each pair (0,1), (0,2), (1,2), a symmetric and an antisymmetric mode of
(X_ij, X_ji) with one eigenvalue each [Pa]; it returns these three. The positive semi-definite part is exact: the eigenvalues of
each part are clamped at 0.
Source: Smith, de Goes, Kim, "Analytic Eigensystems for Isotropic Distortion Energies", ACM TOG 38(1), 2019, gives the
modes; the 3x3 block is clamped numerically.
"""

from typing import Any

import taichi as ti

from taisoft.backend.tracing import arithmetic
from taisoft.fem.laws import corotational, st_venant_kirchhoff, stable_neo_hookean
from taisoft.fem.laws.volume_floor import VolumeFloor
from taisoft.fem.math3 import clamp_symmetric, matmul, matmul_nt, matmul_tn, signed_svd

LAWS = {law.NAME: law for law in (st_venant_kirchhoff, corotational, stable_neo_hookean)}


def law_of(name: str, volume_floor: bool) -> Any:
    """The law of a name, with a volume floor or without one."""
    return VolumeFloor(LAWS[name]) if volume_floor else LAWS[name]


def n_constants(law: Any) -> int:
    """Number of the constants p of a law, without the pressure of mean dilatation."""
    return 6 if isinstance(law, VolumeFloor) else 4


@ti.func
def prepare_projected(law: ti.template(), F, p):
    """Precompute for `dpk1_projected`: U (9), V (9), the clamped block (9), half the clamped symmetric (3) and antisymmetric (3)
    eigenvalues [Pa]."""
    U, s, V = signed_svd(F, 5)
    A, symmetric, antisymmetric = law.hessian_eigen(s, p)
    B = clamp_symmetric(A, 5)
    half_symmetric = [0.5 * ti.max(symmetric[k], 0.0) for k in ti.static(range(3))]
    half_antisymmetric = [0.5 * ti.max(antisymmetric[k], 0.0) for k in ti.static(range(3))]
    return U + V + B + half_symmetric + half_antisymmetric


@arithmetic
def dpk1_projected(S, D):
    """Stress differential along D [Pa] by the projected second derivative, with S = prepare_projected(law, F, p)."""
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
