"""Smoothed aggregation multigrid: a symmetric V-cycle as preconditioner of conjugate gradients, on the host in f64.

Level: A, its smoother S = omega D^-1 with the diagonal blocks D of A, and the prolongation P = (I - omega_P D^-1 A) T of the
next level, where T makes each aggregate a rigid body (`aggregation`) and the next level's matrix is P^T A P. A cycle adds, for a
residual r,
    x = S r,   x += P coarse(P^T (r - A x)),   x += S (r - A x).
With omega below 2 over the largest eigenvalue of D^-1 A, that is symmetric and positive definite if A is. The number of
iterations hardly depends on the size of the mesh. The coarsest level is solved by a banded Cholesky factorisation; a slender
bar's matrix has a narrow band, so it may be the first level.
Source: Vanek, Mandel and Brezina, "Algebraic multigrid by smoothed aggregation for second and fourth order elliptic problems",
Computing 56, 1996.
Weakness: nearly incompressible materials, whose stiff volumes the smoother cannot separate, still take many iterations.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee

from taisoft.linear.aggregation import MODES, prolongation
from taisoft.mesh.aggregates import aggregate
from taisoft.ranges import owners

SMOOTHER, PROLONGATOR = 1.5, 4.0 / 3.0  # over the largest eigenvalue of D^-1 A: omega and omega_P
POWER_STEPS = 12  # for that eigenvalue, which they give to about a tenth
NARROW, SMALL = 300, 900  # band and unknowns of a level that is factorised
LARGEST_BAND = 10_000_000  # numbers in a band
SHIFT = 1e-12  # of its diagonal, added to the coarsest matrix: rounding must not make it indefinite


@dataclass(frozen=True, eq=False)
class Level:
    """One level above the coarsest: block matrices."""

    matrix: sp.bsr_matrix
    smoother: sp.bsr_matrix  # S, block diagonal
    prolongation: sp.bsr_matrix
    restriction: sp.bsr_matrix  # its transpose


@dataclass(frozen=True, eq=False)
class BandedCholesky:
    """Factor of a symmetric positive definite matrix, its unknowns in the order of reverse Cuthill-McKee."""

    factor: np.ndarray  # (band + 1, n), lower
    order: np.ndarray  # (n) old index of each unknown

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Return the solution (n) for a right-hand side (n)."""
        x = np.empty_like(b)
        x[self.order] = sl.cho_solve_banded((self.factor, True), b[self.order], check_finite=False)
        return x


class Multigrid:
    """Preconditioner of a symmetric positive definite matrix."""

    def __init__(self, matrix: sp.bsr_matrix, modes: np.ndarray):
        """matrix: with sorted square blocks (d, d) and all diagonal ones; modes: (n, d, 6), 0 on rows that are the identity's.

        Raises numpy.linalg.LinAlgError if the matrix is not positive definite, as far as the factorisations show.
        """
        self.levels: list[Level] = []
        while (found := factorise(matrix)) is None:
            level, matrix, modes = _coarsen(matrix, modes)
            self.levels.append(level)
        self.coarsest = found

    @property
    def n_bytes(self) -> int:
        """Memory of all levels."""
        matrices = [m for k in self.levels for m in (k.matrix, k.smoother, k.prolongation, k.restriction)]
        return self.coarsest.factor.nbytes + sum(m.data.nbytes + m.indices.nbytes + m.indptr.nbytes for m in matrices)

    def apply(self, r: np.ndarray, level: int = 0) -> np.ndarray:
        """One V-cycle on a residual (n unknowns)."""
        if level == len(self.levels):
            return self.coarsest.solve(r)
        here = self.levels[level]
        x = here.smoother @ r
        x += here.prolongation @ self.apply(here.restriction @ (r - here.matrix @ x), level + 1)
        x += here.smoother @ (r - here.matrix @ x)
        return x


def block_rows(A: sp.bsr_matrix) -> np.ndarray:
    """Block row of each block."""
    return owners(np.diff(A.indptr))


def factorise(A: sp.bsr_matrix) -> BandedCholesky | None:
    """Factorise A if its band is narrow or A is small; otherwise return None."""
    n, d = len(A.indptr) - 1, A.blocksize[0]
    pattern = sp.csr_matrix((np.ones(len(A.indices), dtype=np.int8), A.indices, A.indptr), shape=(n, n))
    order = reverse_cuthill_mckee(pattern, symmetric_mode=True)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    i, j = place[block_rows(A)], place[A.indices]
    band = (int(np.abs(i - j).max()) + 1) * d - 1
    if n * d > SMALL and (band > NARROW or (band + 1) * n * d > LARGEST_BAND):
        return None
    axis = np.arange(d)
    row, column = np.broadcast_arrays((i[:, None] * d + axis)[:, :, None], (j[:, None] * d + axis)[:, None, :])
    lower = row >= column
    banded = np.zeros((band + 1, n * d))
    banded[(row - column)[lower], column[lower]] = A.data[lower]
    banded[0] *= 1.0 + SHIFT
    factor = sl.cholesky_banded(banded, overwrite_ab=True, lower=True, check_finite=False)
    return BandedCholesky(factor, (order[:, None].astype(np.int64) * d + axis).reshape(-1))


def _coarsen(A: sp.bsr_matrix, modes: np.ndarray) -> tuple[Level, sp.bsr_matrix, np.ndarray]:
    """Return the level of A, and matrix and modes of the next."""
    n, d = len(A.indptr) - 1, A.blocksize[0]
    own = np.arange(n + 1)
    inverse = np.linalg.inv(A.data[A.indices == block_rows(A)])
    included = modes.any(axis=(1, 2))
    largest = _largest_eigenvalue(A, sp.bsr_matrix((inverse, own[:-1], own), shape=A.shape), included)
    tentative, coarse_modes, unused = prolongation(modes, aggregate(A.indptr, A.indices, included))
    change = A @ tentative
    change = sp.bsr_matrix((inverse[block_rows(change)] @ change.data, change.indices, change.indptr), shape=change.shape)
    P = (tentative - (PROLONGATOR / largest) * change).tobsr((d, MODES))
    P.sort_indices()
    transposed = P.T.tobsr((MODES, d))
    transposed.sort_indices()
    coarse = (transposed @ (A @ P)).tobsr((MODES, MODES))
    coarse.sort_indices()
    diagonal = np.flatnonzero(coarse.indices == block_rows(coarse))
    node, mode = np.nonzero(unused)
    coarse.data[diagonal[node], mode, mode] = 1.0
    smoother = sp.bsr_matrix(((SMOOTHER / largest) * inverse, own[:-1], own), shape=A.shape)
    return Level(A, smoother, P, transposed), coarse, coarse_modes


def _largest_eigenvalue(A: sp.bsr_matrix, inverse: sp.bsr_matrix, included: np.ndarray) -> float:
    """Largest eigenvalue of D^-1 A on the included nodes (n) bool, by power iteration from the same vector in every run."""
    v = np.random.default_rng(1).standard_normal(A.shape[0]) * np.repeat(included, A.blocksize[0])
    growth = 1.0
    for _ in range(POWER_STEPS):
        v /= np.linalg.norm(v)
        v = inverse @ (A @ v)
        growth = float(np.linalg.norm(v))
    return growth
