"""Direct solve of a linearised stage with contacts: of scenes of rigid bodies alone, whose stiffness slows iterative solves, and
of stages whose iterations stall, as where redundant contacts with friction exchange impulses.

The change s of v satisfies A s = J^T r - r_0, r_0 the residual without contacts. With s eliminated, the impulses r solve
    u = W r + b,   W = J A^-1 J^T,   b = u_0 - J A^-1 r_0
with the laws of contact, u_0 the contacts' velocities at the start: Gauss-Seidel sweeps on W, then, if they do not suffice, an
augmented Lagrangian on the host. A, whose band is that of single bodies unless springs join them, is factorised as multigrid's
coarsest level is. The r-factors come from W: those from the diagonal of A would be too large by as much as the bodies are stiff,
and the laws' residual with them. Whether that is done depends on the numbers of unknowns and contacts alone, which
may be larger in a stage that stalls.
Weakness: W is dense within each group of bodies that touch, so larger stages that stall are left to the iterations.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import download, upload
from taisoft.contact import augmented_lagrangian
from taisoft.contact.matrix_contacts import MatrixContacts, frames, jacobian
from taisoft.fem.model import Model
from taisoft.linear.block_csr import to_bsr
from taisoft.linear.multigrid import BandedCholesky, factorise
from taisoft.scene.rigid import FRAME

if TYPE_CHECKING:
    from taisoft.dynamics.contact_terms import StageContacts
    from taisoft.dynamics.stage_system import StageSystem

LARGEST_W = 4_000_000  # numbers in W
WORK, STALLED_WORK = 2e7, 2e8  # maximum rows of W times numbers in the band of A: about 20 ms, and 0.2 s in stages that stall
FRACTION = 0.01  # of the laws' tolerance, which r-factors of W meet at little cost
SWEEPS = 1000  # of Gauss-Seidel, before the augmented Lagrangian


def is_rigid(m: Model) -> bool:
    """Whether all nodes are those of rigid bodies, or depend on them."""
    return m.has_rigid_tets and FRAME * m.rigid_tets.n + m.dependents.n == m.n_nodes


class DirectSolver:
    """Direct solves of the linearised stages of one system, whose unknowns are the nodes that depend on no others."""

    def __init__(self, system: "StageSystem"):
        m = system.model
        self._system, self._contacts = system, MatrixContacts(m.on_cpu)
        self.always = is_rigid(m)  # solves all stages, not only those that stall
        self._work = WORK if self.always else STALLED_WORK
        self._nodes = np.flatnonzero(m.dependents.number.to_numpy() < 0) if m.has_dependents else np.arange(m.n_nodes)
        self._columns = (3 * self._nodes[:, None] + np.arange(3)).reshape(-1)
        self._factor: BandedCholesky | None = None
        self._formed = -1  # `StageSystem.n_formed` of the factor

    def prepare(self, stage_contacts: "StageContacts") -> bool:
        """Factorise the matrix that was formed, and assemble W; return whether that is possible and not too large.

        Raises numpy.linalg.LinAlgError if A is indefinite.
        """
        rows = 3 * int(stage_contacts.problem.count[0])
        if not 0 < rows**2 <= LARGEST_W:
            return False
        if self._formed != self._system.n_formed:
            self._formed, self._factor = -1, None
            self._free = (self._system.model.free.to_numpy()[self._nodes] > 0.0).reshape(-1).astype(np.float64)
            self._factor = self._factorise(stage_contacts)
            if self._factor is not None and rows * self._factor.factor.size <= self._work:
                self._J = (jacobian(stage_contacts.problem)[:, self._columns] @ sp.diags(self._free)).tocsr()
                self._W = sp.csr_matrix(self._J @ self._factor.solve(self._J.T.toarray()))
            self._formed = self._system.n_formed
        return self._factor is not None and rows * self._factor.factor.size <= self._work

    def set_factors(self, stage_contacts: "StageContacts") -> None:
        """Set the r-factors of the contacts to those of W: the diagonal of A alone would give factors far too large.

        Raises numpy.linalg.LinAlgError if A is indefinite.
        """
        if self.prepare(stage_contacts):
            p = stage_contacts.problem
            factor = p.factor.to_numpy()
            factor[: int(p.count[0])] = augmented_lagrangian.find_factors(self._W)
            upload([(p.factor, factor)])

    def solve(
        self, stage_contacts: "StageContacts", beta: float, tolerance: float, acceptable: float
    ) -> tuple[int, bool, float] | None:
        """Move a linearised stage, whose matrix is prepared, to its solution; return (iterations, converged, |r|).

        tolerance: of the laws' residual. acceptable: its size with the r-factors of the contacts, not of W, above which the stage
        stays and None is returned, as where a stiff body makes these factors far larger.
        """
        m, k = self._system.model, stage_contacts
        p, n = k.problem, int(k.problem.count[0])
        J, residual = self._J, self._free * download([k.residual_linear])[0].astype(np.float64)[self._nodes].reshape(-1)
        b = self._start_velocities(k, beta) - J @ self._factor.solve(residual)
        friction, factor, r = download([p.friction, p.factor, p.r], n)
        r, found = self._contacts.solve(self._W, b, friction, r, "gauss_seidel", FRACTION * tolerance, SWEEPS)
        missed = np.linalg.norm(augmented_lagrangian.natural_map(self._W, b, friction, factor, r))
        if missed > acceptable * np.linalg.norm(r):
            return None
        change = self._factor.solve(J.T @ r.reshape(-1) - residual)
        x, base, impulses = m.state.x.to_numpy(), k.x_linear.to_numpy(), p.r.to_numpy()
        x[self._nodes] = base[self._nodes] + beta * change.reshape(-1, 3)
        impulses[:n] = r
        upload([(m.state.x, x), (p.r, impulses)])
        return found.iterations, found.converged, float(np.linalg.norm(self._matrix @ change + residual - J.T @ r.reshape(-1)))

    def _start_velocities(self, k: "StageContacts", beta: float) -> np.ndarray:
        """u_0 (3k,), see `contact_terms.stage_velocity_of`."""
        n = int(k.problem.count[0])
        gap, offset = download([k.work.gap_minus_target, k.work.tangential_offset], n)
        own = np.einsum("kij,kj->ki", frames(k.problem), offset)
        own[:, 0] = gap
        moved = jacobian(k.problem) @ (k.x_linear.to_numpy() - k.x_start.to_numpy()).reshape(-1)
        return (moved + own.reshape(-1)) / beta

    def _factorise(self, k: "StageContacts") -> BandedCholesky | None:
        """Factorise A, without the contacts' terms, on the free axes of the independent nodes; None if its band is wide."""
        system, keep = self._system, sp.diags(self._free)
        A = to_bsr(system.model, system.matrix, k.coupling.base).tocsr()[self._columns][:, self._columns]
        self._matrix = (keep @ A @ keep + sp.diags(1.0 - self._free)).tocsr()
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
