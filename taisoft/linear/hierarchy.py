"""Preconditioners that take about as many iterations on any mesh: multigrid, or a factorisation if the band is narrow.

Each has `n_bytes` and `solve`, for all nodes and without coupling terms.
"""

import numpy as np

from taisoft.fem.model import Model
from taisoft.fem.node_graph import whole_rows
from taisoft.linear import block_csr
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.coarse_correction import CoarseCorrection
from taisoft.linear.factor import Factor, factorised
from taisoft.linear.multigrid import block_rows, is_narrow


def rows_with_diagonals(model: Model, A: BlockCsr) -> tuple[np.ndarray, np.ndarray]:
    """Return start (n_nodes + 1) and column of the rows of A, each with its diagonal last."""
    start, order = whole_rows(A.row_start.host)
    own = np.arange(model.n_nodes)
    return start + np.arange(model.n_nodes + 1), np.insert(A.column.host[order], start[1:], own)


def has_narrow_band(model: Model, A: BlockCsr) -> bool:
    """Whether matrices with the pattern of A are factorised."""
    return is_narrow(*rows_with_diagonals(model, A), 3)


def build_hierarchy(
    model: Model, A: BlockCsr, x: np.ndarray, free: np.ndarray, known: Factor | None = None
) -> Factor | CoarseCorrection:
    """Build the preconditioner of A on the free axes (n_nodes, 3) bool. x: (n_nodes, 3) positions [m]; known: an earlier one.

    Raises numpy.linalg.LinAlgError if A is not positive definite, as far as the factorisations show.
    """
    start, column = rows_with_diagonals(model, A)
    if not is_narrow(start, column, 3):
        return CoarseCorrection(model, A, start, column, x, free)
    matrix = block_csr.to_bsr(model, A)
    row = block_rows(matrix)
    matrix.data *= free[row][:, :, None] & free[matrix.indices][:, None, :]
    matrix.data[matrix.indices == row] += np.eye(3) * ~free[:, :, None]
    return factorised(matrix, known)
