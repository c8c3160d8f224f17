"""Preconditioners that take about as many iterations on any mesh: multigrid, or a factorisation if the band is narrow.

Each has `n_bytes` and `solve`, which is that of `pcg` without coupling and for all nodes.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.fem.model import Model
from taisoft.fem.node_graph import whole_rows
from taisoft.linear import block_csr, host_pcg
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.multigrid import BandedCholesky, block_rows, factorise, narrow_order
from taisoft.linear.pcg_multigrid import CoarseCorrection
from taisoft.linear.pcg_work import LinearResult, PcgWork


@dataclass(frozen=True, eq=False)
class ExactPreconditioner:
    """The factorisation of an earlier matrix."""

    factor: BandedCholesky

    @property
    def n_bytes(self) -> int:
        """Memory of the factor."""
        return self.factor.factor.nbytes

    def solve(
        self, m: Model, A: BlockCsr, w: PcgWork, tolerance: float, max_iterations: int, stiffness: float = 1.0
    ) -> LinearResult:
        """Solve for w.y given w.rhs. stiffness has no effect: conjugate gradients do not depend on a factor."""
        return host_pcg.solve(m, A, w, tolerance, max_iterations, self.factor.solve)


def rows_with_diagonals(m: Model, A: BlockCsr) -> tuple[np.ndarray, np.ndarray]:
    """Return start (n_nodes + 1) and column of the rows of A, each with its diagonal last."""
    start, order = whole_rows(A.row_start.host)
    own = np.arange(m.n_nodes)
    return start + np.arange(m.n_nodes + 1), np.insert(A.column.host[order], start[1:], own)


def has_narrow_band(m: Model, A: BlockCsr) -> bool:
    """Whether matrices with the pattern of A are factorised."""
    return narrow_order(*rows_with_diagonals(m, A), 3) is not None


def build_hierarchy(m: Model, A: BlockCsr, x: np.ndarray, free: np.ndarray) -> ExactPreconditioner | CoarseCorrection:
    """Build the preconditioner of A on the free axes (n_nodes, 3) bool. x: (n_nodes, 3) positions [m].

    Raises numpy.linalg.LinAlgError if A is not positive definite, as far as the factorisations show.
    """
    start, column = rows_with_diagonals(m, A)
    if narrow_order(start, column, 3) is None:
        return CoarseCorrection(m, A, start, column, x, free)
    matrix = block_csr.to_bsr(m, A)
    row = block_rows(matrix)
    matrix.data *= free[row][:, :, None] & free[matrix.indices][:, None, :]
    matrix.data[matrix.indices == row] += np.eye(3) * ~free[:, :, None]
    return ExactPreconditioner(factorise(matrix))
