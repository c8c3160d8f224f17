"""Direct solve of a linearised stage with contacts: of scenes of rigid bodies alone, whose stiffness slows iterative solves, and
of small stages whose iterations take longer, as where bodies are stiff or thin, or redundant contacts exchange impulses.

The change s of v satisfies A s = J^T r - r_0, r_0 the residual without contacts. With s eliminated, the impulses r solve
    u = W r + b,   W = J A^-1 J^T,   b = u_0 - J A^-1 r_0
with the laws of contact, u_0 the contacts' velocities at the start: by Newton's method on a dense W, by Gauss-Seidel sweeps on a
sparse one, and by an augmented Lagrangian where these do not suffice. With A = L L^T (`multifrontal`), W is Y^T Y with
Y = L^-1 J^T (`delassus`). The laws' residual is measured with the stage's r-factors, too, as that of iterations. A problem whose
matrix was not formed anew takes L again, and with the same contacts also Y and W.
Weakness: W is dense within each part of A: only stages with few contacts a body are solved so.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import download, upload
from taisoft.contact.matrix_contacts import OUTER, MatrixContacts, jacobian
from taisoft.dynamics.contact_terms import StageContacts
from taisoft.dynamics.delassus import Delassus, begin_direct, end_direct, move_directly
from taisoft.fem.model import Model
from taisoft.fem.state import LAW
from taisoft.linear.block_csr import BLOCK, BlockCsr
from taisoft.linear.factor import Factor, build_factor
from taisoft.ranges import owners
from taisoft.scene.rigid import FRAME


class DirectSolver:
    """Direct solves of the linearised stages of one system, whose unknowns are the nodes that depend on no others."""

    # most rows of W, and iterations of the augmented Lagrangian: of rigid bodies alone, and of others, whose W takes longer
    RIGID, SOFT = (2000, OUTER), (900, 5)
    DENSE_ROWS, SWEEPS = 900, 1000  # most rows of a dense W; Gauss-Seidel sweeps on a sparse one
    # of the aim: to be reached with the r-factors of W, and with those of the stage, which stiff bodies make far larger
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
        self._max_rows, self._outer = self.RIGID if self.is_rigid else self.SOFT
        self._nodes = np.flatnonzero(m.dependents.number.to_numpy() < 0) if m.has_dependents else np.arange(m.n_nodes)
        self._factor: Factor | None = None
        self._delassus: Delassus | None = None
        self._has_factor = False  # of the present matrix
        self._free = np.zeros((0, 3))  # (nodes, 3), 1 on free axes, of the last factor

    def matrix_changed(self) -> None:
        """Update for a matrix that was formed."""
        self._has_factor = False
        self.rows_changed()

    def rows_changed(self) -> None:
        """Update for contacts that have changed."""
        if self._delassus is not None:
            self._delassus.clear()

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
        self._factor = build_factor(start, column, 3)
        self._delassus = Delassus(m, self._factor, self._nodes, self._max_rows // 3)
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

    def warm_up(self, stage_contacts: StageContacts, beta: float) -> None:
        """Analyse the pattern, and launch all kernels without contacts, on a factor of zeros."""
        if len(self._nodes) > self.MOST_NODES and not self.is_rigid:
            return
        if self._factor is None:
            self._analyse()
        m, k, w = self._model, stage_contacts, self._delassus.unknowns
        begin_direct(m, k, w, beta)
        self._delassus.add(k.problem, np.zeros(0, dtype=np.int64))
        end_direct(m, k, w)
        move_directly(m, w, self._x_hat, beta)

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

    def solve(
        self,
        stage_contacts: StageContacts,
        beta: float,
        tolerance: float,
        acceptable: float,
        with_residual: bool,
        aim: float,
        is_over: Callable[[], bool],
    ) -> tuple[int, bool, float] | None:
        """Move a linearised stage, whose matrix is prepared, to its solution; return (iterations, converged, |r|).

        W is that of contacts that press or close, with those that the solution would close, until there are none. tolerance: of
        the laws' residual. acceptable: that residual above which a result is rejected, the state kept, and None returned.
        with_residual: whether to measure |r|, which is rounding; else it is 0. aim: at what residual of the laws W is solved.
        is_over: whether the augmented Lagrangian, which may take 0.3 s, is to end where it is; not that of rigid bodies.
        """
        m, k, w, delassus = self._model, stage_contacts, self._delassus.unknowns, self._delassus
        p, n = k.problem, int(k.problem.count[0])
        begin_direct(m, k, w, beta)
        friction, factor, r, start = download([p.friction, p.factor, k.work.kept, k.work.velocity], n)
        given, impulses, without = p.r.to_numpy(), np.zeros((n, 3)), w.factor.rhs.to_numpy()
        closes, iterations = (r[:, 0] > 0.0) | (start[:, 0] < 0.0), 0
        for _ in range(self.ROUNDS):
            if len(added := np.setdiff1d(np.flatnonzero(closes), delassus.contacts)):
                delassus.add(p, added)
            w.factor.rhs.from_numpy(without)
            if len(own := delassus.contacts):
                b = start[own].reshape(-1)
                for part in delassus.parts:
                    b[part.rows] += part.Y.T @ without[part.unknowns]
                over = () if self.is_rigid else (is_over,)
                limits = self.FRACTION * aim, self.SWEEPS, self._outer, factor[own], self.MET * aim
                given_W = delassus.matrix(self.DENSE_ROWS), b, friction[own]
                impulses[own], result = self._contacts.solve(*given_W, r[own], "gauss_seidel", *limits, *over)
                iterations += result.iterations
                for part in delassus.parts:
                    w.factor.rhs.host[part.unknowns] += part.Y @ impulses[own].reshape(-1)[part.rows]
            p.r.from_numpy(impulses, 0)
            end_direct(m, k, w)
            closes, r = k.work.rate.to_numpy(n)[:, 0] < 0.0, impulses.copy()
            closes[own] = False
            if not closes.any():
                break
        law_residual = m.state.scalars[LAW]
        if not (self.is_rigid or law_residual <= acceptable):  # also if it is not a number
            upload([(p.r, given)])
            return None
        move_directly(m, w, self._x_hat, beta)
        return iterations, law_residual <= tolerance, self._imbalance(k, impulses) if with_residual else 0.0

    def _imbalance(self, k: StageContacts, impulses: np.ndarray) -> float:
        """|A s - J^T r + r_0| of the change s of v in the factor's right-hand side."""
        fronts, n = self._factor.fronts, len(self._nodes)
        s, free = self._factor.rhs.to_numpy()[fronts.place], self._model.free.to_numpy()[self._nodes].reshape(-1)
        lower = sp.csr_matrix((self._values, (self._row, self._column)), shape=(3 * n, 3 * n))
        applied = (jacobian(k.problem).T @ impulses.reshape(-1)).reshape(-1, 3) - k.residual_linear.to_numpy()
        return float(np.linalg.norm(lower @ s + lower.T @ s - lower.diagonal() * s - free * applied[self._nodes].reshape(-1)))

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name."""
        return self._contacts.field_bytes | (self._delassus.field_bytes if self._delassus else {})

    def release(self) -> None:
        """Free the fields."""
        self._contacts.release()
        if self._delassus:
            self._delassus.release()
