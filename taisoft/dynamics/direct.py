"""Direct solve of a linearised stage with contacts: of scenes of rigid bodies alone, whose stiffness slows iterative solves, and
of small stages whose iterations take longer, as where bodies are stiff or thin, or redundant contacts exchange impulses.

The change s of v satisfies A s = J^T r - r_0, r_0 the residual without contacts. With s eliminated, the impulses r solve
    u = W r + b,   W = J A^-1 J^T,   b = u_0 - J A^-1 r_0
with the laws of contact, u_0 the contacts' velocities at the start: by Gauss-Seidel sweeps on W, then, if they do not suffice, by
Newton's method or an augmented Lagrangian on the host. With A = L L^T (`multifrontal`), W is Y^T Y with Y = L^-1 J^T. The laws'
residual is measured with the stage's r-factors, too, as that of iterations.
A couples no nodes of different parts, bodies in general, so that W is found part by part.
Weakness: W is dense within each part: only stages with few contacts a body are solved so.
"""

import math
from typing import Any

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp

from taisoft.backend.arrays import download, upload
from taisoft.contact import augmented_lagrangian
from taisoft.contact.matrix_contacts import OUTER, MatrixContacts, frames
from taisoft.contact.problem import read_entries
from taisoft.dynamics.contact_terms import StageContacts
from taisoft.fem.model import Model
from taisoft.linear.block_csr import BLOCK, BlockCsr
from taisoft.linear.factor import Factor, build_factor
from taisoft.ranges import owners
from taisoft.scene.rigid import FRAME


class DirectSolver:
    """Direct solves of the linearised stages of one system, whose unknowns are the nodes that depend on no others."""

    # most rows of W, Gauss-Seidel sweeps, and iterations of the augmented Lagrangian after these: of rigid bodies alone, and of
    # others, whose W takes longer
    RIGID, SOFT = (2000, 1000, OUTER), (900, 200, 5)
    # of the laws' tolerance: sweeps end at FRACTION, with the r-factors of W; where those of the stage, which stiff bodies make
    # far larger, leave more than MET, Newton's method goes on
    FRACTION, MET = 0.1, 0.5
    ROUNDS = 4  # solves of a problem, each with the contacts that the last one would close
    # [s], measured on one core: what a solve takes beside factorisation and W, a number of L times a row of W, and a row of W
    # cubed, for iterations on it
    CALLS, PRODUCT, DENSE = 4e-3, 2.2e-10, 4e-10
    MOST_NODES = 4000  # of soft bodies: their factors take longer than LARGEST, and analysing the pattern seconds
    WORTH, LARGEST = 0.03, 0.1  # [s] most that one may be expected to take, to be tried before iterations end, and at all

    def __init__(self, model: Model, matrix: BlockCsr, x_hat: Any):
        """x_hat: of the stage, see `StageWork`."""
        m = model
        self._model, self._A, self._x_hat, self._contacts = model, matrix, x_hat, MatrixContacts(model.on_cpu)
        # then all stages are solved so at once, unless it is expected to take too long
        self.is_rigid = m.has_rigid_tets and FRAME * m.rigid_tets.n + m.dependents.n == m.n_nodes
        self._max_rows, *self._limits = self.RIGID if self.is_rigid else self.SOFT
        self._nodes = np.flatnonzero(m.dependents.number.to_numpy() < 0) if m.has_dependents else np.arange(m.n_nodes)
        self._factor: Factor | None = None
        self._has_factor = False  # of the present matrix
        self._free = np.zeros((0, 3))  # (nodes, 3), 1 on free axes, of the last factor

    def matrix_changed(self) -> None:
        """Update for a matrix that was formed."""
        self._has_factor = False

    def seconds(self, stage_contacts: StageContacts) -> float:
        """Expected duration of a solve with the contacts that have an impulse, infinite if there are too many contacts."""
        n = int(stage_contacts.problem.count[0])
        if not 0 < 3 * n <= self._max_rows or (len(self._nodes) > self.MOST_NODES and not self.is_rigid):
            return math.inf
        if self._factor is None:
            self._analyse()
        factor = self._factor.fronts
        rows = 3 * np.count_nonzero(stage_contacts.problem.r.to_numpy(n)[:, 0])
        entries = factor.n_entries * min(1.0, 2.0 / len(factor.parts))  # a row touches two parts at most
        dense = 0.0 if self.is_rigid else rows**3 * self.DENSE
        return factor.seconds + self.CALLS + rows * entries * self.PRODUCT + dense

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
        blocks = np.concatenate([among, self._A.column.shape[0] + self._nodes])[order]  # among those of A, then its diagonal
        row, column = row[order], column[order]
        start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(own)))])
        self._number, self._factor = number, build_factor(start, column, 3)
        # entries of the lower triangle: row and column, and place among the stored numbers
        block, i, j = np.unravel_index(self._factor.fronts.lower, (len(row), 3, 3))
        self._row, self._column, self._stored = 3 * row[block] + i, 3 * column[block] + j, BLOCK * blocks[block] + 4 * j + i

    def prepare(self, stage_contacts: StageContacts) -> bool:
        """Factorise the matrix that was formed; return whether that is possible and a solve is not expected to take too long.

        Raises numpy.linalg.LinAlgError if A is indefinite, of rigid bodies alone: contacts may hold soft ones whose A is.
        """
        if self.seconds(stage_contacts) > self.LARGEST:
            return False
        try:
            if not self._has_factor:
                self._factorise(stage_contacts)
        except np.linalg.LinAlgError:
            if self.is_rigid:
                raise
            return False
        self._has_factor = True
        return True

    def _factorise(self, k: StageContacts) -> None:
        """Factorise A on the free axes, without the contacts' terms."""
        free = (self._model.free.host[self._nodes] > 0.0).astype(np.float64)
        if not np.array_equal(free, self._free):
            self._free, free = free, free.reshape(-1)
            self._held = np.flatnonzero(free[self._row] * free[self._column] == 0.0)
        values = np.concatenate([self._A.value.host.reshape(-1), k.coupling.base.host.reshape(-1)])[self._stored].astype(
            np.float64
        )
        values[self._held] = self._row[self._held] == self._column[self._held]
        self._values = values
        self._factor.fronts.factorise(values)

    def _find_rows(self, entries: tuple, axes: np.ndarray, friction: np.ndarray) -> None:
        """Find the rows of J (entries, axes of the contact, of the node), 0 for tangents without friction.

        entries: of the contacts, see `read_entries`; axes: their `frames`; friction: (k,).
        """
        contact, node, weight = entries
        J = axes.copy()
        J[friction == 0.0, 1:] = 0.0
        node = self._number[node]
        self._J = contact, node, weight[:, None, None] * J[contact] * self._free[node][:, None, :]

    def _find_delassus(self, active: np.ndarray) -> sp.bsr_matrix:
        """Return W of the active contacts (k,), numbered anew."""
        (contact, node, J), factor, n = self._J, self._factor.fronts, int(active.sum())
        contact = np.where(active, np.cumsum(active) - 1, -1)[contact]
        entry, axis, of = np.nonzero(J * (contact >= 0)[:, None, None])
        row, column, J = 3 * contact[entry] + axis, factor.place[3 * node[entry] + of], J[entry, axis, of]
        keys, blocks = [], []
        for part in factor.parts:
            unknowns = factor.unknowns_of(part)
            inside = (column >= unknowns.start) & (column < unknowns.stop)
            if inside.any():
                rows, at = np.unique(row[inside], return_inverse=True)
                Y = np.zeros((unknowns.stop - unknowns.start, len(rows)))
                np.add.at(Y.reshape(-1), (column[inside] - unknowns.start) * len(rows) + at, J[inside])
                factor.forward(part, Y)
                touched = np.unique(rows // 3)
                W, place = np.zeros((3 * len(touched),) * 2), np.searchsorted(touched, rows // 3) * 3 + rows % 3
                half = sl.blas.dsyrk(1.0, Y.T, lower=1)
                W[place[:, None], place] = half + np.tril(half, -1).T
                keys.append((touched[:, None] * n + touched).reshape(-1))
                blocks.append(W.reshape(len(touched), 3, -1, 3).swapaxes(1, 2).reshape(-1, 3, 3))
        if not keys:  # no contact can move
            return sp.bsr_matrix((3 * n, 3 * n), blocksize=(3, 3))
        key, at = np.unique(np.concatenate(keys), return_inverse=True)
        whole = np.zeros((len(key), 3, 3))
        np.add.at(whole, at, np.concatenate(blocks))
        start = np.concatenate([[0], np.cumsum(np.bincount(key // n, minlength=n))])
        return sp.bsr_matrix((whole, key % n, start), shape=(3 * n, 3 * n))

    def solve(
        self, stage_contacts: StageContacts, beta: float, tolerance: float, acceptable: float, with_residual: bool
    ) -> tuple[int, bool, float] | None:
        """Move a linearised stage, whose matrix is prepared, to its solution; return (iterations, converged, |r|).

        W is that of contacts that press or close, with those that the solution would close, until there are none. tolerance: of
        the laws' residual. acceptable: that residual above which a result is rejected, the state kept, and None returned.
        with_residual: whether to measure |r|, which is rounding; else it is 0.
        """
        m, k = self._model, stage_contacts
        p, n = k.problem, int(k.problem.count[0])
        # at the present x: iterations may have moved it, and the residual with it
        x, v, residual = download([m.state.x, m.state.v, k.residual_linear])
        residual = (self._free * residual.astype(np.float64)[self._nodes]).reshape(-1)
        change = -self._factor.solution(residual)  # without impulses
        friction, factor, r = download([p.friction, p.factor, k.work.kept], n)
        entries, axes = read_entries(p), frames(p)
        self._find_rows(entries, axes, friction)
        start = self._velocities(k, entries, axes, x, beta)
        active, iterations = (r[:, 0] > 0.0) | (start[:, 0] < 0.0), 0
        b = start + self._contact_velocities(change, n)
        for _ in range(self.ROUNDS):
            r, n_iterations = self._solve_active(active, b, r, friction, factor, tolerance)
            change = self._factor.solution(self._forces(r) - residual)
            iterations += n_iterations
            u = start + self._contact_velocities(change, n)
            if not (closes := ~active & (u[:, 0] < 0.0)).any():
                break
            active |= closes
        law_residual = augmented_lagrangian.residual_at(u, friction, factor, r)
        if not (self.is_rigid or law_residual <= acceptable):  # also if it is not a number
            return None
        impulses = p.r.to_numpy()
        x[self._nodes] += beta * change.reshape(-1, 3)
        v[self._nodes] = (x[self._nodes] - self._x_hat.to_numpy()[self._nodes]) / beta
        impulses[:n] = r
        upload([(m.state.x, x), (m.state.v, v), (p.r, impulses)])
        return iterations, law_residual <= tolerance, self._imbalance(change, residual, r) if with_residual else 0.0

    def _solve_active(
        self, active: np.ndarray, b: np.ndarray, r: np.ndarray, friction: np.ndarray, factor: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, int]:
        """Return impulses (k,3), which only active contacts have, and the number of iterations from the start r. b: (k,3)."""
        found = np.zeros_like(r)
        if not active.any():
            return found, 0
        given = friction[active], r[active], "gauss_seidel", self.FRACTION * tolerance, *self._limits
        W = self._find_delassus(active)
        found[active], result = self._contacts.solve(W, b[active].reshape(-1), *given, factor[active], self.MET * tolerance)
        return found, result.iterations

    def _forces(self, r: np.ndarray) -> np.ndarray:
        """J^T r (n,) of impulses r (k,3)."""
        contact, node, J = self._J
        found = np.zeros((len(self._nodes), 3))
        np.add.at(found, node, np.einsum("eij,ei->ej", J, r[contact]))
        return found.reshape(-1)

    def _contact_velocities(self, change: np.ndarray, n: int) -> np.ndarray:
        """J s (k,3) of a change s (n,) of v."""
        contact, node, J = self._J
        found = np.zeros((n, 3))
        np.add.at(found, contact, np.einsum("eij,ej->ei", J, change.reshape(-1, 3)[node]))
        return found

    def _imbalance(self, change: np.ndarray, residual: np.ndarray, r: np.ndarray) -> float:
        """|A s - J^T r + r_0| of a change s (n,)."""
        n = len(change)
        lower = sp.csr_matrix((self._values, (self._row, self._column)), shape=(n, n))
        left = lower @ change + lower.T @ change - lower.diagonal() * change
        return float(np.linalg.norm(left + residual - self._forces(r)))

    def _velocities(self, k: StageContacts, entries: tuple, axes: np.ndarray, x: np.ndarray, beta: float) -> np.ndarray:
        """u (k,3) at positions x (n_nodes,3), see `contact_terms.stage_velocity_of`. entries, axes: as for `_find_rows`."""
        gap, offset = download([k.work.gap_minus_target, k.work.tangential_offset], len(axes))
        contact, node, weight = entries
        moved = np.zeros((len(axes), 3))
        np.add.at(moved, contact, weight[:, None] * (x - k.x_start.to_numpy())[node])
        u = np.einsum("kij,kj->ki", axes, moved + offset)
        u[:, 0] = gap + np.einsum("kj,kj->k", axes[:, 0], moved)
        return u / beta

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name."""
        return self._contacts.field_bytes

    def release(self) -> None:
        """Free the fields."""
        self._contacts.release()
