"""Contact problems of a step as matrices: J, and the solution for a W assembled on the host, in fields that are kept."""

import math
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from taisoft.backend.arrays import FieldArena, download
from taisoft.contact import augmented_lagrangian, semismooth
from taisoft.contact.augmented_lagrangian import residual_at
from taisoft.contact.colouring import colour_greedy, matrix_graph, store
from taisoft.contact.problem import ContactProblem, build_matrix_problem, fill_matrix_problem, read_entries
from taisoft.contact.solve import SolveResult, solve

NEWTON, NEAR = 20, 4.0  # maximum iterations of Newton's method; residual over the tolerance from which it is looked at
TIGHTER = 3  # solves, each to a smaller residual, until that with other r-factors is small enough
OUTER = 30  # maximum iterations of the augmented Lagrangian


class MatrixContacts:
    """Solves matrix problems, one after the other."""

    def __init__(self, serial: bool):
        """serial: whether loops run on one thread."""
        self._serial, self._arena, self._problem = serial, FieldArena(), None

    def solve(
        self,
        W: np.ndarray | sp.spmatrix,
        b: np.ndarray,
        friction: np.ndarray,
        r: np.ndarray,
        method: str,
        tolerance: float,
        sweeps: int,
        outer: int = OUTER,
        factor: np.ndarray | None = None,
        limit: float = math.inf,
        is_over: Callable[[], bool] = lambda: False,
    ) -> tuple[np.ndarray, SolveResult]:
        """Return impulses (k,3), from the start r (k,3), and the result: by Newton's method if W is an array, else by sweeps, and
        by an augmented Lagrangian where these fail.

        W: (3k,3k); b: (3k,); friction: (k,); method, tolerance, sweeps: as in `contact.solve.solve`; outer: maximum iterations of
        the augmented Lagrangian; is_over: whether to end it before the next one. factor, limit: other r-factors (k,2), and a
        bound on the residual with these.
        """
        own = augmented_lagrangian.find_factors(W)

        def residuals(r: np.ndarray) -> tuple[float, float]:
            u = (W @ r.reshape(-1) + b).reshape(-1, 3)
            return residual_at(u, friction, own, r), 0.0 if factor is None else residual_at(u, friction, factor, r)

        def holds(r: np.ndarray) -> bool:
            found = residuals(r)
            return found[0] <= tolerance and found[1] <= limit

        p, goal, iterations = None, tolerance, 0
        if not isinstance(W, np.ndarray):
            p = self._store(sp.bsr_matrix(W, blocksize=(3, 3)), b, friction, method)
        elif found := semismooth.solve(W, b, friction, r, own, holds, NEAR * tolerance, NEWTON):
            return found[0], SolveResult(found[1], residuals(found[0])[0], True)
        for _ in range(TIGHTER):
            result = None
            if p is not None:
                p.r.from_numpy(r, 0)
                result = solve(p, method, goal, sweeps)
                r, iterations = p.r.to_numpy(len(friction)), iterations + result.iterations
            if result is None or not result.converged:
                r, history = augmented_lagrangian.solve(sp.csr_matrix(W), b, friction, r, goal, outer, is_over)
                result = SolveResult(len(history) - 1, history[-1], history[-1] <= goal)
                iterations += result.iterations
            reached, other = residuals(r)
            is_met = reached <= tolerance and other <= limit
            if is_met or not result.converged:
                break
            goal = 0.5 * reached * (limit / other if other > limit else 1.0)
        return r, SolveResult(iterations, reached, is_met)

    def _store(self, W: sp.bsr_matrix, b: np.ndarray, friction: np.ndarray, method: str) -> ContactProblem:
        """Return the problem in fields."""
        p, k = self._problem, len(friction)
        if p is None or p.capacity < k or p.column.shape[0] < len(W.indices):
            arena = FieldArena()
            self._problem = p = build_matrix_problem(arena, 2 * k, 2 * len(W.indices), self._serial)
            self.release()
            self._arena = arena
        fill_matrix_problem(p, W, b, friction)
        if method == "coloured_gauss_seidel":
            store(p, colour_greedy(matrix_graph(W)))
        return p

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
