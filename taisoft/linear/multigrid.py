"""Smoothed aggregation multigrid: a symmetric V-cycle, here on the coarse space of `coarse_correction`.

Level: A, S = D^-1 / lambda with the diagonal blocks D of A and the largest eigenvalue lambda of D^-1 A, and the prolongation
P = (I - omega D^-1 A) T of the next level, where T makes each aggregate a rigid body (`aggregation`) and the next level's matrix
is P^T A P. A cycle is, for a residual r and two steps sigma_1 and sigma_2 of a Chebyshev iteration,
    x = sigma_1 S r,   x += sigma_2 S (r - A x),   x += P coarse(P^T (r - A x)),
    x += sigma_2 S (r - A x),   x += sigma_1 S (r - A x).
With |(1 - sigma_1 z) (1 - sigma_2 z)| < 1 for the eigenvalues z of S A, that is symmetric and positive definite if A is. The
number of iterations hardly depends on the size of the mesh. The coarsest level is solved by a Cholesky factorisation.
Levels are built on the host in f64; a cycle runs in kernels in the model's precision, but for the coarsest level.
Source: Vanek, Mandel and Brezina, "Algebraic multigrid by smoothed aggregation for second and fourth order elliptic problems",
Computing 56, 1996.
Weakness: nearly incompressible materials, whose stiff volumes the smoother cannot separate, still take many iterations.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee

from taisoft.backend.arrays import FieldArena
from taisoft.linear.aggregation import MODES, prolongation
from taisoft.linear.block_rows import LANES, CycleLevel, ascend, descend, padded, upload_matrix
from taisoft.linear.factor import factorised
from taisoft.mesh.aggregates import aggregate
from taisoft.ranges import owners

STEPS = 1.05, 3.0  # sigma_1, sigma_2: errors at z from 0.2 to 1 are reduced to 0.32 at most; below 1 up to z = 1.28
PROLONGATOR = 4.0 / 3.0  # omega lambda
POWER_STEPS = 12  # for that eigenvalue, which they give to about a tenth
NARROW, SMALL = 301, 900  # band and unknowns of a level that is factorised
LARGEST_BAND = 10_000_000  # numbers in a band


@dataclass(frozen=True, eq=False)
class Level:
    """One level above the coarsest, on the host."""

    matrix: sp.bsr_matrix
    smoother: np.ndarray  # (n, d, d) blocks of S
    prolongation: sp.bsr_matrix
    restriction: sp.bsr_matrix  # its transpose


class Multigrid:
    """Preconditioner of a symmetric positive definite matrix. Taichi must run on the CPU, in precision `real`."""

    def __init__(self, matrix: sp.bsr_matrix, modes: np.ndarray, real):
        """matrix: with sorted square blocks (d, d) and all diagonal ones; modes: (n, d, 6), 0 on rows that are the identity's.

        Raises numpy.linalg.LinAlgError if the matrix is not positive definite, as far as the factorisations show.
        """
        self._arena = FieldArena()
        self.levels: list[CycleLevel] = []
        host = []
        while not is_narrow(matrix.indptr, matrix.indices, matrix.blocksize[0]):
            unknowns = matrix.shape[0]
            level, matrix, modes = _coarsen(matrix, modes)
            if matrix.shape[0] >= unknowns:
                raise np.linalg.LinAlgError("the aggregates are single nodes")
            host.append(level)
        self.coarsest = factorised(matrix)
        if host:
            self._upload(host, real)
            self.right, self.solution = self.levels[0].r, self.levels[0].other  # of `cycle`, rows padded to lanes
            self._coarsest_right, self._coarsest_solution = self.levels[-1].next_r, self.levels[-1].next_x
        else:
            n, lanes = matrix.shape[0] // matrix.blocksize[0], LANES[matrix.blocksize[0]]
            self.right, self.solution = (self._arena.vectors(f"multigrid_{name}", real, n, n=lanes) for name in ("r", "x"))
            self._coarsest_right, self._coarsest_solution = self.right, self.solution
        self._coarsest_rows = matrix.blocksize[0]
        self._rows = (host[0].matrix if host else matrix).blocksize[0]

    def _upload(self, host: list[Level], real) -> None:
        """Make the levels on the device."""
        arena, levels = self._arena, len(host)
        lanes = [LANES[level.matrix.blocksize[0]] for level in host] + [LANES[MODES]]
        sizes = [level.prolongation.shape[0] // level.prolongation.blocksize[0] for level in host]
        sizes.append(host[-1].prolongation.shape[1] // MODES)
        vectors = [
            [arena.vectors(f"multigrid_{name}_{k}", real, n, n=width) for name in ("r", "x", "other")[: 3 if k < levels else 2]]
            for k, (n, width) in enumerate(zip(sizes, lanes))
        ]
        for k, level in enumerate(host):
            r, x, other = vectors[k]
            below = vectors[k + 1]
            smoother = padded(level.smoother, lanes[k])
            self.levels.append(
                CycleLevel(
                    matrix=upload_matrix(level.matrix, arena, f"multigrid_matrix_{k}", real),
                    smoother=arena.vectors(f"multigrid_smoother_{k}", real, len(smoother), smoother, n=smoother.shape[1]),
                    prolongation=upload_matrix(level.prolongation, arena, f"multigrid_prolongation_{k}", real),
                    restriction=upload_matrix(level.restriction, arena, f"multigrid_restriction_{k}", real),
                    r=r,
                    x=x,
                    other=other,
                    next_r=below[0],
                    next_x=below[-1],  # after its own cycle
                )
            )

    @property
    def n_bytes(self) -> int:
        """Memory of all levels."""
        return self.coarsest.n_bytes + sum(self._arena.bytes.values())

    def cycle(self) -> None:
        """One V-cycle on the residual in `right`."""
        for level in self.levels:
            descend(level, *STEPS)
        rows = self._coarsest_rows
        b = self._coarsest_right.host[:, :rows].astype(np.float64).reshape(-1)
        self._coarsest_solution.host[:, :rows] = self.coarsest.solution(b).reshape(-1, rows)
        for level in reversed(self.levels):
            ascend(level, *STEPS)

    def apply(self, r: np.ndarray) -> np.ndarray:
        """One V-cycle on a residual (n unknowns)."""
        self.right.host[:, : self._rows] = r.reshape(-1, self._rows)
        self.cycle()
        return self.solution.host[:, : self._rows].astype(np.float64).reshape(-1)


def norm(a: np.ndarray) -> float:
    """|a|, without BLAS, which would start threads for these few numbers and sum in an order that depends on their number."""
    return math.sqrt(float(np.einsum("n,n->", a, a)))


def block_rows(A: sp.bsr_matrix) -> np.ndarray:
    """Block row of each block."""
    return owners(np.diff(A.indptr))


def is_narrow(start: np.ndarray, column: np.ndarray, d: int) -> bool:
    """Whether a matrix of (d, d) blocks is factorised: if it is small, or has a narrow band in some order.

    start (n + 1), column: block rows, with all diagonal blocks.
    """
    n = len(start) - 1
    pattern = sp.csr_matrix((np.ones(len(column), dtype=np.int8), column, start), shape=(n, n))
    place = np.argsort(reverse_cuthill_mckee(pattern, symmetric_mode=True))
    band = (int(np.abs(place[owners(np.diff(start))] - place[column]).max()) + 1) * d
    return n * d <= SMALL or band <= NARROW and band * n * d <= LARGEST_BAND


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
    return Level(A, inverse / largest, P, transposed), coarse, coarse_modes


def _largest_eigenvalue(A: sp.bsr_matrix, inverse: sp.bsr_matrix, included: np.ndarray) -> float:
    """Largest eigenvalue of D^-1 A on the included nodes (n) bool, by power iteration from the same vector in every run."""
    v = np.random.default_rng(1).standard_normal(A.shape[0]) * np.repeat(included, A.blocksize[0])
    growth = 1.0
    for _ in range(POWER_STEPS):
        v /= norm(v)
        v = inverse @ (A @ v)
        growth = norm(v)
    return growth
