"""Direct solve of a linearised stage with contacts, of scenes with rigid bodies: their stiffness slows iterative solves.

The change s of v satisfies A s = J^T r - r_0, r_0 the residual without contacts. With s eliminated, the impulses r solve
    u = W r + b,   W = J A^-1 J^T,   b = u_0 - J A^-1 r_0
with the laws of contact, u_0 the contacts' velocities at the start: Gauss-Seidel sweeps on W, then, if they do not suffice, an
augmented Lagrangian on the host. A is factorised once, as multigrid's coarsest level is: rigid bodies alone have a band of 12.
Whether a stage is solved so depends on the number of its unknowns and contacts, and on the band of A alone.
Weakness: W is dense within each group of bodies that touch.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import download, upload
from taisoft.contact import augmented_lagrangian
from taisoft.contact.matrix_contacts import MatrixContacts, frames, jacobian
from taisoft.linear.block_csr import to_bsr, unpacked
from taisoft.linear.multigrid import BandedCholesky, block_rows, factorise

if TYPE_CHECKING:
    from taisoft.dynamics.contact_terms import StageContacts
    from taisoft.dynamics.stage_system import StageSystem

LARGEST = 4_000_000  # unknowns times rows of W
SWEEPS, OUTER = 1000, 30  # of Gauss-Seidel, then outer iterations of the augmented Lagrangian


class DirectSolver:
    """Direct solves of the linearised stages of one system. rows: (k,) nodes that depend on no others, ascending."""

    def __init__(self, system: "StageSystem"):
        m = system.model
        self._system, self._contacts = system, MatrixContacts(m.serial)
        self._rows = np.flatnonzero(m.dependents.number.to_numpy() < 0)
        self._factor: BandedCholesky | None = None
        self._formed = -1  # `StageSystem.n_formed` of the factor

    def prepare(self, stage_contacts: "StageContacts") -> bool:
        """Factorise the matrix that was formed, and assemble W; return whether that is possible and not too large.

        Raises numpy.linalg.LinAlgError if A is indefinite.
        """
        system, k = self._system, stage_contacts
        p = k.problem
        if not 0 < 9 * int(p.count[0]) * len(self._rows) <= LARGEST:
            return False
        if self._formed != system.n_formed:
            self._formed, self._factor = -1, None
            self._free = (system.model.free.to_numpy()[self._rows] > 0.0).reshape(-1)
            self._factor = self._factorise(k, self._free)
            if self._factor is not None:
                columns = (3 * self._rows[:, None] + np.arange(3)).reshape(-1)
                self._J = (jacobian(p)[:, columns] @ sp.diags(self._free.astype(np.float64))).tocsr()
                self._lifted = self._factor.solve(self._J.T.toarray())
                self._W = sp.csr_matrix(self._J @ self._lifted)
            self._formed = system.n_formed
        return self._factor is not None

    def set_factors(self, stage_contacts: "StageContacts") -> None:
        """Set the r-factors of the contacts to those of W: the diagonal of A alone would give factors far too large.

        Raises numpy.linalg.LinAlgError if A is indefinite.
        """
        if self.prepare(stage_contacts):
            p = stage_contacts.problem
            factor = p.factor.to_numpy()
            factor[: int(p.count[0])] = augmented_lagrangian.find_factors(self._W)
            upload([(p.factor, factor)])

    def solve(self, stage_contacts: "StageContacts", beta: float, tolerance: float) -> tuple[int, bool, float]:
        """Move a linearised stage, whose matrix is prepared, to its solution; return (iterations, converged, |r|).

        tolerance: of the laws' residual.
        """
        m, k = self._system.model, stage_contacts
        p, n = k.problem, int(k.problem.count[0])
        J, residual = self._J, self._free * download([k.residual_linear])[0].astype(np.float64)[self._rows].reshape(-1)
        b = self._start_velocities(k, beta) - self._lifted.T @ residual
        friction, r = download([p.friction, p.r], n)
        r, found = self._contacts.solve(self._W, b, friction, r, "gauss_seidel", tolerance, SWEEPS)
        iterations, converged = found.iterations, found.converged
        if not converged:
            r, history = augmented_lagrangian.solve(self._W, b, friction, r, tolerance, OUTER)
            iterations, converged = iterations + len(history) - 1, history[-1] <= tolerance
        change = self._factor.solve(J.T @ r.reshape(-1) - residual)
        x, base, impulses = m.state.x.to_numpy(), k.x_linear.to_numpy(), p.r.to_numpy()
        x[self._rows] = base[self._rows] + beta * change.reshape(-1, 3)
        impulses[:n] = r
        upload([(m.state.x, x), (p.r, impulses)])
        return iterations, converged, float(np.linalg.norm(self._matrix @ change + residual - J.T @ r.reshape(-1)))

    def _start_velocities(self, k: "StageContacts", beta: float) -> np.ndarray:
        """u_0 (3k,), see `contact_terms.stage_velocity_of`."""
        n = int(k.problem.count[0])
        gap, offset = download([k.work.gap_minus_target, k.work.tangential_offset], n)
        own = np.einsum("kij,kj->ki", frames(k.problem), offset)
        own[:, 0] = gap
        moved = jacobian(k.problem) @ k.displacement.to_numpy().reshape(-1)
        return (moved + own.reshape(-1)) / beta

    def _factorise(self, k: "StageContacts", free: np.ndarray) -> BandedCholesky | None:
        """Factorise A on the free axes of the independent nodes."""
        system, rows = self._system, self._rows
        A = to_bsr(system.model, system.matrix)
        A.data[A.indices == block_rows(A)] = unpacked(k.coupling.base.to_numpy())  # without the contacts' terms
        A = A.tocsr()
        columns = (3 * rows[:, None] + np.arange(3)).reshape(-1)
        A = A[columns][:, columns]
        keep = sp.diags(free.astype(np.float64))
        self._matrix = (keep @ A @ keep + sp.diags(1.0 - free.astype(np.float64))).tocsr()
        blocks = self._matrix.tobsr((3, 3))
        blocks.sort_indices()
        return factorise(blocks)

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name."""
        return self._contacts.field_bytes

    def release(self) -> None:
        """Free the fields."""
        self._contacts.release()
