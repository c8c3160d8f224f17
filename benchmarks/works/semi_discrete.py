"""Soft bodies discrete in space and continuous in time, in NumPy and double precision: the reference for solvers.

Linear tets, lumped masses, one law, undamped; independent of taisoft's elasticity. Laws, with F the deformation gradient,
J = det F, I = tr(F^T F), mu and lam Lame's parameters:

* "SVK", St. Venant and Kirchhoff: S = lam tr(E) 1 + 2 mu E, E = (F^T F - 1) / 2, P = F S;
* "SNH", Smith, de Goes and Kim 2018, eq. 14: P = mu' (1 - 1/(I + 1)) F + (lam' (J - 1) - 3/4 mu') cof F with
  mu' = 4/3 mu, lam' = lam + 5/6 mu; the law of taisoft's stable_neo_hookean and of PyBullet;
* "SNH13", the same paper's eq. 13, without the logarithm: P = mu F + (lam' (J - 1) - mu) cof F, lam' = lam + mu; Newton's.
"""

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_matrix

from taisoft.mesh.tet_mesh import TetMesh

Components = np.ndarray  # (3, 3, m): one matrix a tet, its components first


def _product(a: Components, b: Components) -> Components:
    return np.stack([[sum(a[i, k] * b[k, j] for k in range(3)) for j in range(3)] for i in range(3)])


def cofactor(F: Components) -> Components:
    """dJ/dF of each tet's F."""
    return np.stack([np.cross(F[1], F[2], axis=0), np.cross(F[2], F[0], axis=0), np.cross(F[0], F[1], axis=0)])


def _svk(F: Components, mu: float, lam: float) -> Components:
    identity = np.eye(3)[:, :, None]
    E = 0.5 * (_product(F.transpose(1, 0, 2), F) - identity)
    return _product(F, 2 * mu * E + lam * np.trace(E) * identity)


def _snh(F: Components, mu: float, lam: float) -> Components:
    mu, lam = 4 / 3 * mu, lam + 5 / 6 * mu
    cof = cofactor(F)
    J, squares = np.sum(F[0] * cof[0], axis=0), np.sum(F * F, axis=(0, 1))
    return mu * (1 - 1 / (squares + 1)) * F + (lam * (J - 1) - 0.75 * mu) * cof


def _snh13(F: Components, mu: float, lam: float) -> Components:
    cof = cofactor(F)
    return mu * F + ((lam + mu) * (np.sum(F[0] * cof[0], axis=0) - 1) - mu) * cof


LAWS: dict[str, Callable[[Components, float, float], Components]] = {"SVK": _svk, "SNH": _snh, "SNH13": _snh13}


class SemiDiscrete:
    """Bodies of one material as one mesh.

    mesh: n vertices [m], m tets. law: one of LAWS. young [Pa], poisson, density [kg/m^3]; gravity [m/s^2] along -y. free: (n,)
    bool. equal_masses: the total mass divided equally among all vertices, as in PyBullet, instead of a quarter of each tet's mass
    per corner. Attributes: vertices (n,3), tets (m,4), volumes (m,), mass (n,) [kg], free, mu, lam [Pa].
    """

    def __init__(
        self,
        mesh: TetMesh,
        law: str,
        young: float,
        poisson: float,
        density: float,
        gravity: float,
        free: np.ndarray,
        *,
        equal_masses: bool = False,
    ) -> None:
        self.vertices, self.tets, self.volumes, self.free = mesh.vertices, mesh.tets, mesh.volumes, free
        n, m = len(self.vertices), len(self.tets)
        self.mass = np.bincount(self.tets.ravel(), np.repeat(density * self.volumes / 4, 4), n)
        if equal_masses:
            self.mass = np.full(n, self.mass.mean())
        self.lam = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
        self.mu = young / (2 * (1 + poisson))
        self.gravity, self._pk1 = gravity, LAWS[law]
        # Row j m + e of the operator: the derivative along X_j in tet e of a nodal quantity.
        edges = self.vertices[self.tets[:, 1:]] - self.vertices[self.tets[:, :1]]
        gradients = np.linalg.inv(edges).transpose(0, 2, 1)
        gradients = np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)  # (m, 4 corners, 3)
        rows = np.broadcast_to(np.arange(3) * m + np.arange(m)[:, None, None], gradients.shape)
        columns = np.broadcast_to(self.tets[:, :, None], gradients.shape)
        self._gradient = csr_matrix((gradients.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * m, n))
        self._divergence = self._gradient.T.tocsr()

    def deformation_gradient(self, u: np.ndarray) -> Components:
        """F (3,3,m) at the displacement u (3,n) [m]."""
        m = len(self.tets)
        return np.stack([(self._gradient @ u[i]).reshape(3, m) for i in range(3)]) + np.eye(3)[:, :, None]

    def elastic_force(self, u: np.ndarray) -> np.ndarray:
        """Force of the material on each node (3,n) [N] at the displacement u (3,n) [m]."""
        pk1 = self.volumes * self._pk1(self.deformation_gradient(u), self.mu, self.lam)
        return -np.stack([self._divergence @ pk1[i].ravel() for i in range(3)])

    def acceleration(self, u: np.ndarray) -> np.ndarray:
        """Acceleration (3,n) [m/s^2] at the displacement u (3,n) [m]; zero for the fixed nodes."""
        a = self.elastic_force(u) / self.mass
        a[1] -= self.gravity
        a[:, ~self.free] = 0.0
        return a


def inverted(mesh: TetMesh, x: np.ndarray) -> int:
    """Number of inverted or non-finite tets at the positions x (n,3) [m]."""
    edges = x[mesh.tets[:, 1:]] - x[mesh.tets[:, :1]]
    return int(np.sum(~(np.linalg.det(edges) > 0.0)))
