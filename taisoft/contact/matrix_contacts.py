"""Contact problems of a step as matrices: J, and the solution for a W assembled on the host, in fields that are kept."""

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import FieldArena, download
from taisoft.contact import augmented_lagrangian
from taisoft.contact.colouring import colour_greedy, matrix_graph, store
from taisoft.contact.problem import ContactProblem, build_matrix_problem, fill_field, fill_matrix_problem, read_entries
from taisoft.contact.solve import SolveResult, solve

OUTER = 30  # maximum iterations of the augmented Lagrangian


class MatrixContacts:
    """Solves matrix problems, one after the other."""

    def __init__(self, serial: bool):
        """serial: whether loops run on one thread."""
        self._serial, self._arena, self._problem = serial, FieldArena(), None

    def solve(
        self,
        W: sp.spmatrix,
        b: np.ndarray,
        friction: np.ndarray,
        r: np.ndarray,
        method: str,
        tolerance: float,
        sweeps: int,
        outer: int = OUTER,
    ) -> tuple[np.ndarray, SolveResult]:
        """Return impulses (k,3), from the start r (k,3), and the result; use an augmented Lagrangian if sweeps do not suffice.

        W: (3k,3k); b: (3k,); friction: (k,); method, tolerance, sweeps: as in `contact.solve.solve`; outer: maximum iterations of
        the augmented Lagrangian.
        """
        W, k = sp.bsr_matrix(W, blocksize=(3, 3)), len(friction)
        p = self._problem
        if p is None or p.capacity < k or p.column.shape[0] < len(W.indices):
            arena = FieldArena()
            self._problem = p = build_matrix_problem(arena, 2 * k, 2 * len(W.indices), self._serial)
            self.release()
            self._arena = arena
        fill_matrix_problem(p, W, b, friction)
        fill_field(p.r, r)
        if method == "coloured_gauss_seidel":
            store(p, colour_greedy(matrix_graph(W)))
        result = solve(p, method, tolerance, sweeps)
        r = p.r.to_numpy(k)
        if not result.converged:
            r, history = augmented_lagrangian.solve(W.tocsr(), b, friction, r, tolerance, outer)
            result = SolveResult(result.iterations + len(history) - 1, history[-1], history[-1] <= tolerance)
        return r, result

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name."""
        return self._arena.bytes

    def release(self) -> None:
        """Free the fields."""
        self._arena.release()


def frames(p: ContactProblem) -> np.ndarray:
    """Rows normal, t1, t2 of each contact (k,3,3)."""
    normal, tangent = download([p.normal, p.tangent], int(p.count[0]))
    return np.stack([normal, tangent, np.cross(normal, tangent)], axis=1)


def jacobian(p: ContactProblem) -> sp.csr_matrix:
    """J (3k, 3 n_nodes): velocities in the frames of the contacts from those of nodes."""
    k = int(p.count[0])
    contact, node, weight = read_entries(p)
    values = weight[:, None, None] * frames(p)[contact]
    rows = np.broadcast_to((3 * contact[:, None] + np.arange(3))[:, :, None], values.shape)
    columns = np.broadcast_to((3 * node.astype(np.int64)[:, None] + np.arange(3))[:, None, :], values.shape)
    return sp.csr_matrix((values.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(3 * k, 3 * p.n_nodes))
