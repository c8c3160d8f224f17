"""Direct solve of a linearised stage with contacts: of scenes of rigid bodies alone, whose stiffness slows iterative solves, and
of stages whose iterations stall, as where redundant contacts with friction exchange impulses.

The change s of v satisfies A s = J^T r - r_0, r_0 the residual without contacts. With s eliminated, the impulses r solve
    u = W r + b,   W = J A^-1 J^T,   b = u_0 - J A^-1 r_0
with the laws of contact, u_0 the contacts' velocities at the start: Gauss-Seidel sweeps on W, then, if they do not suffice, an
augmented Lagrangian on the host. A, whose band is that of single bodies unless springs join them, is factorised as multigrid's
coarsest level is. The r-factors come from W: those from the diagonal of A would be too large by as much as the bodies are stiff,
and the laws' residual with them. Where iterations stall, the result counts if it meets the laws at least as well as theirs, with
their r-factors.
A couples no nodes of different parts, bodies in general, so that W is found part by part.
Weakness: W is dense within each part: only stages with few contacts a body are solved so.
"""

import itertools
from typing import Any

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from taisoft.backend.arrays import download, upload
from taisoft.contact import augmented_lagrangian
from taisoft.contact.matrix_contacts import OUTER, MatrixContacts, frames, jacobian
from taisoft.dynamics.contact_terms import StageContacts
from taisoft.fem.model import Model
from taisoft.linear.block_csr import BlockCsr, to_bsr
from taisoft.linear.multigrid import BandedCholesky, factorise, narrow_order
from taisoft.scene.rigid import FRAME


class DirectSolver:
    """Direct solves of the linearised stages of one system, whose unknowns are the nodes that depend on no others."""

    # most rows of W, Gauss-Seidel sweeps, and iterations of the augmented Lagrangian after these: of rigid bodies alone, and
    # where soft ones stall, whose W takes longer
    RIGID, STALLED = (2000, 1000, OUTER), (900, 200, 5)
    WORK = 2e8  # maximum sum over parts of rows of W times numbers in the band of A: about 0.1 s
    FRACTION = 0.1  # of the laws' tolerance, to which they are met with the r-factors of W

    def __init__(self, model: Model, matrix: BlockCsr, x_hat: Any):
        """x_hat: of the stage, see `StageWork`."""
        m = model
        self._model, self._A, self._x_hat, self._contacts = model, matrix, x_hat, MatrixContacts(model.on_cpu)
        self.is_rigid = m.has_rigid_tets and FRAME * m.rigid_tets.n + m.dependents.n == m.n_nodes  # then it solves all stages
        self._max_rows, *self._limits = self.RIGID if self.is_rigid else self.STALLED
        self._nodes = np.flatnonzero(m.dependents.number.to_numpy() < 0) if m.has_dependents else np.arange(m.n_nodes)
        self._columns = (3 * self._nodes[:, None] + np.arange(3)).reshape(-1)
        self._factor: BandedCholesky | None = None
        self._band: int | None = None  # numbers of a row in its band; 0: not narrow
        self._part = np.zeros(0, dtype=np.int64)  # of each unknown
        self._is_prepared = False  # for the present matrix

    def matrix_changed(self) -> None:
        """Update for a matrix that was formed."""
        self._is_prepared = False

    def prepare(self, stage_contacts: StageContacts) -> bool:
        """Factorise the matrix that was formed, and assemble W; return whether that is possible and not too large.

        Raises numpy.linalg.LinAlgError if A is indefinite, of rigid bodies alone: contacts may hold soft ones whose A is.
        """
        rows = 3 * int(stage_contacts.problem.count[0])
        if not 0 < rows <= self._max_rows:
            return False
        if self._band is None:
            self._find_parts(self._independent(stage_contacts).tobsr((3, 3)))
        if self._band == 0:
            return False
        if not self._is_prepared:
            self._free = (self._model.free.to_numpy()[self._nodes] > 0.0).reshape(-1).astype(np.float64)
            self._J = (jacobian(stage_contacts.problem)[:, self._columns] @ sp.diags(self._free)).tocsr()
            if self._work() > self.WORK:
                return False
            try:
                self._factor = self._factorise(stage_contacts)
            except np.linalg.LinAlgError:
                if self.is_rigid:
                    raise
                return False
            if self._factor is None:
                self._band = 0
                return False
            self._W = self._delassus()
            self._is_prepared = True
        return True

    def _find_parts(self, blocks: sp.bsr_matrix) -> None:
        """Find the parts of A and the width of its band; its pattern stays."""
        found = narrow_order(blocks.indptr, blocks.indices, 3)
        self._band = 0 if found is None else found[2] + 1
        pattern = sp.csr_matrix((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr))
        self._part = np.repeat(connected_components(pattern, directed=False)[1], 3)

    def _work(self) -> int:
        """Sum over the parts of the rows of J that are not 0 there times numbers in the band."""
        is_in = sp.csr_matrix((np.ones(len(self._part)), (np.arange(len(self._part)), self._part)))
        rows = np.diff((abs(self._J) @ is_in).tocsc().indptr)
        return self._band * int(rows @ np.bincount(self._part))

    def _delassus(self) -> sp.csr_matrix:
        """W, from the rows of J that are not 0 in each part. The order of the band leads from part to part."""
        order, n, entries = self._factor.order, self._J.shape[0], []
        J, changes = self._J.tocsc()[:, order], np.flatnonzero(np.diff(self._part[order])) + 1
        for first, last in itertools.pairwise([0, *changes.tolist(), len(order)]):
            part = J[:, first:last].tocsr()
            rows = np.flatnonzero(np.diff(part.indptr))
            if len(rows):
                part, band = part[rows].toarray(), self._factor.factor[: last - first, first:last]
                Y, _ = sl.lapack.dtbtrs(band, part.T, uplo="L")  # L^-1 J^T, half of what A^-1 J^T takes
                entries.append((np.repeat(rows, len(rows)), np.tile(rows, len(rows)), (Y.T @ Y).reshape(-1)))
        if not entries:  # no contact can move
            return sp.csr_matrix((n, n))
        i, j, values = (np.concatenate(one) for one in zip(*entries))
        return sp.csr_matrix((values, (i, j)), shape=(n, n))

    def set_factors(self, stage_contacts: StageContacts) -> None:
        """Set the r-factors of the contacts to those of W: the diagonal of A alone would give factors far too large.

        Raises numpy.linalg.LinAlgError if A is indefinite.
        """
        if self.prepare(stage_contacts):
            p = stage_contacts.problem
            factor = p.factor.to_numpy()
            factor[: int(p.count[0])] = augmented_lagrangian.find_factors(self._W)
            upload([(p.factor, factor)])

    def solve(
        self, stage_contacts: StageContacts, beta: float, tolerance: float, acceptable: float
    ) -> tuple[int, bool, float] | None:
        """Move a linearised stage, whose matrix is prepared, to its solution; return (iterations, converged, |r|).

        tolerance: of the laws' residual. acceptable: that residual with the r-factors of the contacts, not of W, above which the
        result is rejected, the state kept, and None returned, as where a stiff body makes these factors far larger.
        """
        m, k = self._model, stage_contacts
        p, n = k.problem, int(k.problem.count[0])
        # at the present x: iterations may have moved it, and the residual with it
        x, v, residual = download([m.state.x, m.state.v, k.residual_linear])
        J, residual = self._J, self._free * residual.astype(np.float64)[self._nodes].reshape(-1)
        b = self._velocities(k, x, beta) - J @ self._factor.solve(residual)
        friction, factor, r = download([p.friction, p.factor, k.work.kept], n)
        r, found = self._contacts.solve(self._W, b, friction, r, "gauss_seidel", self.FRACTION * tolerance, *self._limits)
        law_residual = found.residual
        if not self.is_rigid:
            law_residual = augmented_lagrangian.find_residual(self._W, b, friction, r, factor)
            if not law_residual <= acceptable:  # also if it is not a number
                return None
        change = self._factor.solve(J.T @ r.reshape(-1) - residual)
        impulses = p.r.to_numpy()
        x[self._nodes] += beta * change.reshape(-1, 3)
        v[self._nodes] = (x[self._nodes] - self._x_hat.to_numpy()[self._nodes]) / beta
        impulses[:n] = r
        upload([(m.state.x, x), (m.state.v, v), (p.r, impulses)])
        unbalanced = float(np.linalg.norm(self._matrix @ change + residual - J.T @ r.reshape(-1)))
        return found.iterations, law_residual <= tolerance, unbalanced

    def _velocities(self, k: StageContacts, x: np.ndarray, beta: float) -> np.ndarray:
        """u (3k,) at positions x (n_nodes,3), see `contact_terms.stage_velocity_of`."""
        n = int(k.problem.count[0])
        gap, offset = download([k.work.gap_minus_target, k.work.tangential_offset], n)
        own = np.einsum("kij,kj->ki", frames(k.problem), offset)
        own[:, 0] = gap
        moved = jacobian(k.problem) @ (x - k.x_start.to_numpy()).reshape(-1)
        return (moved + own.reshape(-1)) / beta

    def _independent(self, k: StageContacts) -> sp.csr_matrix:
        """A, without the contacts' terms, of the independent nodes."""
        A = to_bsr(self._model, self._A, k.coupling.base).tocsr()
        return A[self._columns][:, self._columns]

    def _factorise(self, k: StageContacts) -> BandedCholesky | None:
        """Factorise it on the free axes; None if its band is wide."""
        keep = sp.diags(self._free)
        self._matrix = (keep @ self._independent(k) @ keep + sp.diags(1.0 - self._free)).tocsr()
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
