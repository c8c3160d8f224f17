"""The laws once more, written from the formulas in NumPy and independent of the package.

The corotational rotation comes from NumPy's SVD, derivatives of the other laws from complex steps, the projection from
the eigenvalues of the 9x9 second derivative.
"""

import numpy as np

UNIT = np.eye(9).reshape(9, 3, 3)  # the nine directions in which F can change


def lame(young: float, poisson: float) -> tuple[float, float]:
    """(mu, lambda) [Pa]."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def transposed(A):
    return np.swapaxes(A, -1, -2)


def trace(A):
    return np.trace(A, axis1=-2, axis2=-1)


def cofactor(F):
    """Columns f1 x f2, f2 x f0, f0 x f1."""
    f = [F[..., k] for k in range(3)]
    return np.stack([np.cross(f[1], f[2]), np.cross(f[2], f[0]), np.cross(f[0], f[1])], axis=-1)


def signed_svd(F):
    """F = U diag(s) V^T with rotations U and V; the smallest s is negative where F is inverted."""
    U, s, Vt = np.linalg.svd(F)
    s = s.copy()
    for A, part in ((U, np.s_[..., :, 2]), (Vt, np.s_[..., 2, :])):
        flip = np.linalg.det(A) < 0
        A[part] = np.where(flip[..., None], -A[part], A[part])
        s[..., 2] = np.where(flip, -s[..., 2], s[..., 2])
    return U, s, transposed(Vt)


def rotation(F):
    """The rotation of the polar decomposition, det +1."""
    U, _, V = signed_svd(F)
    return U @ transposed(V)


def floor_energy(F, young: float, poisson: float, floor: float):
    """Energy density (k,) [Pa] that a volume floor adds: the integral of its stress from J = floor down, in two pieces."""
    mu, lam = lame(young, poisson)
    J, M = np.linalg.det(F), lam + 2 * mu
    x = J / floor
    inside, below = floor / 3 * (1 - x) ** 3, floor * (1 / 3 - x + x**2)
    return M * np.where(x >= 1, 0.0, np.where(x > 0, inside, below))


def floor_stress(F, young: float, poisson: float, floor: float):
    """The stress (k,3,3) [Pa] that a volume floor adds; F may be complex."""
    mu, lam = lame(young, poisson)
    G = cofactor(F)
    x = np.sum(F[..., 0] * G[..., 0], axis=-1)[..., None, None] / floor
    slope = np.where(x.real >= 1, 0.0, np.where(x.real > 0, -((1 - x) ** 2), 2 * x - 1))
    return (lam + 2 * mu) * slope * G


def psi(law: str, F, young: float, poisson: float, floor: float = 0.0):
    """Energy density (k,) [Pa], 0 at rest, of F (k,3,3). floor: the volume floor; 0 for none."""
    mu, lam = lame(young, poisson)
    if floor:
        return psi(law, F, young, poisson) + floor_energy(F, young, poisson, floor)
    if law == "st_venant_kirchhoff":
        E = (transposed(F) @ F - np.eye(3)) / 2
        return mu * np.sum(E * E, axis=(-2, -1)) + lam / 2 * trace(E) ** 2
    if law == "corotational":
        R = rotation(F)
        return mu * np.sum((F - R) ** 2, axis=(-2, -1)) + lam / 2 * (trace(transposed(R) @ F) - 3) ** 2
    m, l, alpha = _neo_hookean(mu, lam)

    def value(Ic, J):
        return m / 2 * (Ic - 3) + l / 2 * (J - alpha) ** 2 - m / 2 * np.log(Ic + 1)

    return value(np.sum(F * F, axis=(-2, -1)), np.linalg.det(F)) - value(3.0, 1.0)


def _neo_hookean(mu: float, lam: float) -> tuple[float, float, float]:
    m, l = 4 * mu / 3, lam + 5 * mu / 6
    return m, l, 1 + m / l - m / (4 * l)


def pk1(law: str, F, young: float, poisson: float, floor: float = 0.0):
    """First Piola-Kirchhoff stress (k,3,3) [Pa]; F may be complex but for the corotational law."""
    mu, lam = lame(young, poisson)
    if floor:
        return pk1(law, F, young, poisson) + floor_stress(F, young, poisson, floor)
    if law == "st_venant_kirchhoff":
        E = (transposed(F) @ F - np.eye(3)) / 2
        return F @ (2 * mu * E + lam * trace(E)[..., None, None] * np.eye(3))
    if law == "corotational":
        R = rotation(F)
        return 2 * mu * (F - R) + lam * (trace(transposed(R) @ F) - 3)[..., None, None] * R
    m, l, alpha = _neo_hookean(mu, lam)
    G = cofactor(F)
    Ic = np.sum(F * F, axis=(-2, -1))[..., None, None]
    J = np.sum(F[..., 0] * G[..., 0], axis=-1)[..., None, None]
    return m * (1 - 1 / (Ic + 1)) * F + l * (J - alpha) * G


def dpk1(law: str, F, D, young: float, poisson: float, floor: float = 0.0):
    """Change of the stress along D (k,3,3) [Pa]."""
    h = 1e-30  # a complex step has no cancellation
    if floor:
        return dpk1(law, F, D, young, poisson) + floor_stress(F + 1j * h * D, young, poisson, floor).imag / h
    if law != "corotational":
        return pk1(law, F + 1j * h * D, young, poisson).imag / h
    mu, lam = lame(young, poisson)
    U, s, V = signed_svd(F)
    X = transposed(U) @ D @ V
    R = U @ transposed(V)
    # dR = U W V^T with the antisymmetric W_ij = (X_ij - X_ji) / (s_i + s_j), 0 on the diagonal
    W = (X - transposed(X)) / np.where(np.eye(3, dtype=bool), 1.0, s[..., :, None] + s[..., None, :])
    t = (trace(transposed(R) @ F) - 3)[..., None, None]
    return 2 * mu * D + (lam * t - 2 * mu) * (U @ W @ transposed(V)) + lam * trace(X)[..., None, None] * R


def hessian(law: str, F, young: float, poisson: float, projected: bool = False, floor: float = 0.0):
    """Second derivative (k,9,9) [Pa] of psi over F's entries row by row; projected: negative eigenvalues become 0."""
    columns = [dpk1(law, F, np.broadcast_to(D, F.shape), young, poisson, floor).reshape(-1, 9) for D in UNIT]
    H = np.stack(columns, axis=-1)
    if not projected:
        return H
    w, Q = np.linalg.eigh((H + transposed(H)) / 2)
    return (Q * np.maximum(w, 0.0)[:, None, :]) @ transposed(Q)
