"""Contact problems of explicit steps with rigid bodies: W = J Z Z^T J^T, Z the motions that impulses cause, scaled by M^-1/2.

A node of a soft body moves alone, by M_i^-1 of its impulse. The nodes of a rigid body move together: with B (12, 6) its rigid
motions at x_n, those of its free axes, Z is B (B^T M B)^-1/2. W is assembled on the host, for the solvers of `contact`.
Weakness: the assembly, a product of sparse matrices, takes longer than the solve of a few contacts.
"""

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import download, upload
from taisoft.contact.matrix_contacts import MatrixContacts, jacobian
from taisoft.contact.problem import ContactProblem
from taisoft.contact.solve import SolveResult
from taisoft.fem.model import Model
from taisoft.scene.rigid import FRAME

MOTIONS = 6  # three translations, three rotations


class RigidContacts:
    """Solve contact problems of one model, whose rigid bodies move as such."""

    def __init__(self, model: Model):
        self._model = model
        self._node = model.rigid_tets.node.to_numpy().astype(np.int64).reshape(-1, FRAME)
        self._contacts = MatrixContacts(model.on_cpu)

    def solve(self, p: ContactProblem, method: str, tolerance: float, max_sweeps: int) -> SolveResult:
        """Replace the impulses of a problem over nodes, whose b is set, by the solution."""
        k = int(p.count[0])
        b, r, friction = download([p.b, p.r, p.friction], k)
        impulses = p.r.to_numpy()
        impulses[:k], result = self._contacts.solve(self.delassus(p), b.reshape(-1), friction, r, method, tolerance, max_sweeps)
        upload([(p.r, impulses)])
        return result

    def delassus(self, p: ContactProblem) -> sp.csr_matrix:
        """W (3k, 3k) of the present contacts."""
        J = jacobian(p)
        mass, free, x = download([self._model.mass, self._model.free, self._model.state.x])
        scale = free / np.sqrt(mass.astype(np.float64))[:, None]
        scale[self._node] = 0.0
        B = rigid_motions(mass.astype(np.float64)[self._node], free[self._node].min(axis=1), x[self._node])
        rows, columns = np.broadcast_arrays(
            (3 * self._node[:, :, None] + np.arange(3)).reshape(-1, 3 * FRAME, 1),
            (MOTIONS * np.arange(len(B))[:, None] + np.arange(MOTIONS))[:, None, :],
        )
        B = sp.csr_matrix((B.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(J.shape[1], MOTIONS * len(self._node)))
        Z = sp.hstack([J @ sp.diags(scale.reshape(-1)), J @ B]).tocsr()
        return (Z @ Z.T).tocsr()

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name."""
        return self._contacts.field_bytes

    def release(self) -> None:
        """Free the fields."""
        self._contacts.release()


def rigid_motions(mass: np.ndarray, free: np.ndarray, x: np.ndarray) -> np.ndarray:
    """B (B^T M B)^-1/2 (n, 12, 6) of rigid bodies, 0 for motions along constrained axes.

    mass: (n, 4) [kg]; free: (n, 3), 1 on free axes; x: (n, 4, 3) [m].
    """
    arms = x - (mass[:, :, None] * x).sum(axis=1, keepdims=True) / mass.sum(axis=1)[:, None, None]
    turns = np.roll(free, -1, axis=1) * np.roll(free, -2, axis=1)
    axes = np.eye(3)
    moves = np.broadcast_to(free[:, None, None, :] * axes, (*arms.shape, 3))
    spins = np.cross(axes, arms[:, :, None, :]).swapaxes(2, 3) * turns[:, None, None, :]
    B = np.concatenate([moves, spins], axis=3).reshape(len(x), 3 * FRAME, MOTIONS)
    gram = np.einsum("nia,ni,nib->nab", B, np.repeat(mass, 3, axis=1), B)
    values, vectors = np.linalg.eigh(gram)
    root = np.where(values > 1e-12 * values[:, -1:], 1.0 / np.sqrt(np.maximum(values, 1e-300)), 0.0)
    return B @ vectors * root[:, None, :]
