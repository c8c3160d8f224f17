"""Direct solve of a linearised stage with contacts: of scenes of rigid bodies alone, whose stiffness slows iterative solves, and
of small stages whose iterations take longer, as where bodies are stiff or thin, or redundant contacts exchange impulses.

The change s of v satisfies A s = J^T r - r_0, r_0 the residual without contacts. With s eliminated, the impulses r solve
    u = W r + b,   W = J A^-1 J^T,   b = u_0 - J A^-1 r_0
with the laws of contact, u_0 the contacts' velocities at the start: Gauss-Seidel sweeps on W, then, if they do not suffice, an
augmented Lagrangian on the host. With A = L L^T (`multifrontal`), W is Y^T Y with Y = L^-1 J^T. The r-factors come from W: those
from the diagonal of A would be too large by as much as the bodies are stiff, and the laws' residual with them. A result that
does not meet the laws with these counts if it meets them at least as well as the iterations, with their r-factors.
A couples no nodes of different parts, bodies in general, so that W is found part by part.
Weakness: W is dense within each part: only stages with few contacts a body are solved so.
"""

import math
from typing import Any

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import download, upload
from taisoft.contact import augmented_lagrangian
from taisoft.contact.matrix_contacts import OUTER, MatrixContacts, frames
from taisoft.contact.problem import read_entries
from taisoft.dynamics.contact_terms import StageContacts
from taisoft.fem.model import Model
from taisoft.linear.block_csr import BlockCsr, unpacked
from taisoft.linear.multifrontal import Multifrontal
from taisoft.ranges import owners
from taisoft.scene.rigid import FRAME


class DirectSolver:
    """Direct solves of the linearised stages of one system, whose unknowns are the nodes that depend on no others."""

    # most rows of W, Gauss-Seidel sweeps, and iterations of the augmented Lagrangian after these: of rigid bodies alone, and of
    # others, whose W takes longer
    RIGID, SOFT = (2000, 1000, OUTER), (900, 200, 5)
    # the laws' residual with the r-factors of W is reduced to FRACTION of their tolerance, and further, in up to TIGHTER solves,
    # until that with those of the stage is MET times the tolerance: stiff bodies have larger ones
    FRACTION, MET, TIGHTER = 0.1, 0.5, 3
    # [s]: what a solve takes beside factorisation and W, and a number of L times a row of W, measured on one core
    CALLS, PRODUCT = 2e-3, 1.5e-10
    LARGEST = 0.1  # [s] most that a direct solve may be expected to take

    def __init__(self, model: Model, matrix: BlockCsr, x_hat: Any):
        """x_hat: of the stage, see `StageWork`."""
        m = model
        self._model, self._A, self._x_hat, self._contacts = model, matrix, x_hat, MatrixContacts(model.on_cpu)
        self.is_rigid = m.has_rigid_tets and FRAME * m.rigid_tets.n + m.dependents.n == m.n_nodes  # then it solves all stages
        self._max_rows, *self._limits = self.RIGID if self.is_rigid else self.SOFT
        self._nodes = np.flatnonzero(m.dependents.number.to_numpy() < 0) if m.has_dependents else np.arange(m.n_nodes)
        self._factor: Multifrontal | None = None
        self._has_factor = self._has_delassus = False  # of the present matrix and contacts

    def matrix_changed(self) -> None:
        """Update for a matrix that was formed."""
        self._has_factor = self._has_delassus = False

    def contacts_changed(self) -> None:
        """Update for other contacts on the same matrix."""
        self._has_delassus = False

    def seconds(self, n_contacts: int) -> float:
        """Expected duration of a solve, infinite if there are too many contacts or nodes."""
        if not 0 < 3 * n_contacts <= self._max_rows:
            return math.inf
        if self._factor is None:
            self._analyse()
        size = self._factor.n_entries
        return self._factor.seconds + self.CALLS + 3 * n_contacts * size * self.PRODUCT

    def _analyse(self) -> None:
        """Find what depends on the pattern of A alone."""
        m = self._model
        start, column = download([self._A.row_start, self._A.column])
        number = np.full(m.n_nodes, -1)
        number[self._nodes] = own = np.arange(len(self._nodes))
        row, column = number[owners(np.diff(start)) % m.n_nodes], number[column]
        among = np.flatnonzero((row >= 0) & (column >= 0))
        row, column = np.concatenate([row[among], own]), np.concatenate([column[among], own])
        order = np.lexsort((column, row))
        self._blocks = np.concatenate([among, self._A.column.shape[0] + self._nodes])[
            order
        ]  # among those of A, then its diagonal
        self._row, self._column = row[order], column[order]
        self._start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(own)))])
        self._number, self._factor = number, Multifrontal(self._start, self._column)
        axis, place = np.arange(3), self._factor.place
        i, j = place[3 * self._row[:, None, None] + axis[:, None]], place[3 * self._column[:, None, None] + axis]
        i, j = (one.reshape(-1) for one in np.broadcast_arrays(i, j))
        self._lower = np.flatnonzero(i >= j)
        self._places = self._factor.places(i[self._lower], j[self._lower])

    def prepare(self, stage_contacts: StageContacts) -> bool:
        """Factorise the matrix that was formed, and assemble W; return whether that is possible and not too large.

        Raises numpy.linalg.LinAlgError if A is indefinite, of rigid bodies alone: contacts may hold soft ones whose A is.
        """
        if self.seconds(int(stage_contacts.problem.count[0])) > self.LARGEST:
            return False
        try:
            if not self._has_factor:
                self._factorise(stage_contacts)
        except np.linalg.LinAlgError:
            if self.is_rigid:
                raise
            return False
        if not self._has_delassus:
            self._find_delassus(stage_contacts)
        self._has_factor = self._has_delassus = True
        return True

    def _factorise(self, k: StageContacts) -> None:
        """Factorise A on the free axes, without the contacts' terms."""
        self._free = (self._model.free.to_numpy()[self._nodes] > 0.0).astype(np.float64)
        blocks = unpacked(np.concatenate(download([self._A.value, k.coupling.base]))[self._blocks])
        if not self._free.all():
            blocks *= self._free[self._row][:, :, None] * self._free[self._column][:, None, :]
            blocks[self._row == self._column] += np.eye(3) * (1.0 - self._free)[:, None, :]
        self._matrix = sp.bsr_matrix((blocks, self._column, self._start))
        self._factor.factorise(blocks.reshape(-1)[self._lower], self._places)

    def _find_delassus(self, k: StageContacts) -> None:
        """Find W, and Y of each part, from the rows of J that are not 0 there: not those of tangents without friction."""
        p, n, factor = k.problem, int(k.problem.count[0]), self._factor
        contact, node, weight = read_entries(p)
        J = frames(p)
        J[download([p.friction], n)[0] == 0.0, 1:] = 0.0
        node = self._number[node]
        J = weight[:, None, None] * J[contact] * self._free[node][:, None, :]
        self._J = contact, node, J
        entry, axis, of = np.nonzero(J)
        row, column, J = 3 * contact[entry] + axis, factor.place[3 * node[entry] + of], J[entry, axis, of]
        keys, blocks, self._halves = [], [], []  # of W; (unknowns, rows, Y) of each part
        for part in factor.parts:
            unknowns = factor.unknowns_of(part)
            inside = (column >= unknowns.start) & (column < unknowns.stop)
            if inside.any():
                own = np.zeros(3 * n, dtype=bool)
                own[row[inside]] = True
                rows, at = np.flatnonzero(own), np.cumsum(own) - 1
                Y = np.zeros((unknowns.stop - unknowns.start, len(rows)))
                np.add.at(Y.reshape(-1), (column[inside] - unknowns.start) * len(rows) + at[row[inside]], J[inside])
                factor.forward(part, Y)
                self._halves.append((unknowns, rows, Y))
                touched = np.flatnonzero(own.reshape(-1, 3).any(axis=1))
                W, place = np.zeros((3 * len(touched),) * 2), np.searchsorted(touched, rows // 3) * 3 + rows % 3
                W[place[:, None], place] = Y.T @ Y
                keys.append((touched[:, None] * n + touched).reshape(-1))
                blocks.append(W.reshape(len(touched), 3, -1, 3).swapaxes(1, 2).reshape(-1, 3, 3))
        self._W = sp.bsr_matrix((3 * n, 3 * n), blocksize=(3, 3))  # if no contact can move
        if keys:
            key, at = np.unique(np.concatenate(keys), return_inverse=True)
            whole = np.zeros((len(key), 3, 3))
            np.add.at(whole, at, np.concatenate(blocks))
            start = np.concatenate([[0], np.cumsum(np.bincount(key // n, minlength=n))])
            self._W = sp.bsr_matrix((whole, key % n, start), shape=(3 * n, 3 * n))

    def solve(
        self, stage_contacts: StageContacts, beta: float, tolerance: float, acceptable: float
    ) -> tuple[int, bool, float] | None:
        """Move a linearised stage, whose matrix is prepared, to its solution; return (iterations, converged, |r|).

        tolerance: of the laws' residual. acceptable: that residual with the r-factors of the contacts, not of W, above which a
        result that does not meet the laws is rejected, the state kept, and None returned.
        """
        m, k = self._model, stage_contacts
        p, n = k.problem, int(k.problem.count[0])
        # at the present x: iterations may have moved it, and the residual with it
        x, v, residual = download([m.state.x, m.state.v, k.residual_linear])
        residual = (self._free * residual.astype(np.float64)[self._nodes]).reshape(-1)
        y = residual[self._factor.order]
        for part in self._factor.parts:
            self._factor.forward(part, y[self._factor.unknowns_of(part), None])
        b = self._velocities(k, x, beta)
        for unknowns, rows, Y in self._halves:
            b[rows] -= y[unknowns] @ Y
        friction, factor, r = download([p.friction, p.factor, k.work.kept], n)
        goal, iterations = self.FRACTION * tolerance, 0
        for _ in range(self.TIGHTER):
            r, found = self._contacts.solve(self._W, b, friction, r, "gauss_seidel", goal, *self._limits)
            iterations += found.iterations
            law_residual = augmented_lagrangian.find_residual(self._W, b, friction, r, factor)
            if not (found.converged and law_residual > self.MET * tolerance):
                break
            goal *= 0.5 * self.MET * tolerance / law_residual
        if not (self.is_rigid or law_residual <= acceptable):  # also if it is not a number
            return None
        pushed = np.zeros_like(y)
        for unknowns, rows, Y in self._halves:
            pushed[unknowns] = Y @ r.reshape(-1)[rows]
        change = self._factor.backward(pushed - y)
        impulses = p.r.to_numpy()
        x[self._nodes] += beta * change.reshape(-1, 3)
        v[self._nodes] = (x[self._nodes] - self._x_hat.to_numpy()[self._nodes]) / beta
        impulses[:n] = r
        upload([(m.state.x, x), (m.state.v, v), (p.r, impulses)])
        left, (contact, node, J) = (self._matrix @ change + residual).reshape(-1, 3), self._J
        np.subtract.at(left, node, np.einsum("eij,ei->ej", J, r[contact]))
        return iterations, law_residual <= tolerance, float(np.linalg.norm(left))

    def _velocities(self, k: StageContacts, x: np.ndarray, beta: float) -> np.ndarray:
        """u (3k,) at positions x (n_nodes,3), see `contact_terms.stage_velocity_of`."""
        n = int(k.problem.count[0])
        gap, offset = download([k.work.gap_minus_target, k.work.tangential_offset], n)
        contact, node, weight = read_entries(k.problem)
        moved = np.zeros((n, 3))
        np.add.at(moved, contact, weight[:, None] * (x - k.x_start.to_numpy())[node])
        u = np.einsum("kij,kj->ki", frames(k.problem), moved + offset)
        u[:, 0] = gap + np.einsum("kj,kj->k", k.problem.normal.to_numpy(n), moved)
        return u.reshape(-1) / beta

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name."""
        return self._contacts.field_bytes

    def release(self) -> None:
        """Free the fields."""
        self._contacts.release()
