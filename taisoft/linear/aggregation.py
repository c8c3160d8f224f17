"""Aggregates of neighbouring nodes, and the prolongation that makes each of them a rigid body.

Aggregates grow around roots that are more than two edges apart (a maximal independent set of distance 2, found in parallel
rounds): a root takes its neighbours, and the nodes left over join the aggregate of a neighbour. A coarse node has six unknowns,
the coefficients of an orthonormal basis of its aggregate's rigid-body modes.
Sources: Bell, Dalton and Olson, "Exposing fine-grained parallelism in algebraic multigrid methods", SIAM J. Sci. Comput. 34(4),
2012 (aggregates); Vanek, Mandel and Brezina, "Algebraic multigrid by smoothed aggregation for second and fourth order elliptic
problems", Computing 56, 1996 (modes).
Weakness: aggregates follow the mesh's edges, not the strength of their coupling, so flat elements are coarsened in every
direction.
"""

import numpy as np
import scipy.sparse as sp

MODES = 6  # three translations, three linearised rotations
DEPENDENT = 1e-8  # of an aggregate's modes: a smaller remainder of a mode depends on the previous ones


def rigid_modes(x: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Rigid-body modes (n, 3, 6) of positions x (n, 3) [m], 0 on constrained axes (free: (n, 3) bool), of order 1 at most."""
    arm = x - x.mean(axis=0)
    arm = arm / max(float(np.abs(arm).max()), 1e-300)
    modes = np.zeros((len(x), 3, MODES))
    modes[:, range(3), range(3)] = 1.0
    for k in range(3):  # e_k x arm
        i, j = (k + 1) % 3, (k + 2) % 3
        modes[:, j, 3 + k], modes[:, i, 3 + k] = arm[:, i], -arm[:, j]
    return modes * free[:, :, None]


def aggregate(start: np.ndarray, column: np.ndarray, included: np.ndarray) -> np.ndarray:
    """Aggregate of each node (n), -1 for nodes that are not included (n) bool.

    start (n + 1), column: the nodes' graph as CSR rows, each with its diagonal. The priorities are the same in every run.
    """

    def highest(value: np.ndarray) -> np.ndarray:
        return np.maximum.reduceat(value[column], start[:-1])

    n = len(included)
    priority = np.random.default_rng(0).permutation(n) + 1
    root, open_nodes = np.zeros(n, dtype=bool), included.copy()
    while open_nodes.any():
        value = np.where(root, n + priority, np.where(open_nodes, priority, 0))
        best = highest(highest(value))
        root |= open_nodes & (best == priority)
        open_nodes &= (best <= n) & ~root
    label = np.where(root, np.cumsum(root), 0)
    near = highest(label)
    return np.where(included, np.where(near > 0, near, highest(near)), 0) - 1


def prolongation(modes: np.ndarray, aggregates: np.ndarray) -> tuple[sp.bsr_matrix, np.ndarray, np.ndarray]:
    """Return P, the coarse modes and the unused coarse unknowns (n_coarse, 6) bool, with P coarse_modes = modes.

    modes: (n, d, 6); aggregates: (n), -1 for nodes without rows. P: blocks (d, 6) with orthonormal columns, but 0 for unused
    unknowns: rotations that move no node of an aggregate, or move it as others do.
    """
    n, d, _ = modes.shape
    node = np.flatnonzero(aggregates >= 0)
    order = node[np.argsort(aggregates[node], kind="stable")]
    owner = aggregates[order]
    n_coarse = int(owner[-1]) + 1
    size = np.bincount(owner, minlength=n_coarse)
    slot = np.arange(len(order)) - (np.cumsum(size) - size)[owner]
    stacked = np.zeros((n_coarse, max(int(size.max()), -(-MODES // d)), d, MODES))
    stacked[owner, slot] = modes[order]
    basis, coarse = np.linalg.qr(stacked.reshape(n_coarse, -1, MODES))
    length = np.sqrt((stacked**2).sum(axis=(1, 2, 3)))
    unused = np.abs(np.diagonal(coarse, axis1=1, axis2=2)) <= DEPENDENT * length[:, None]
    moved = stacked.reshape(n_coarse, -1, MODES).any(axis=2)  # rounding must not move the others
    basis, coarse = np.where(unused[:, None, :] | ~moved[:, :, None], 0.0, basis), np.where(unused[:, :, None], 0.0, coarse)
    blocks = np.zeros((n, d, MODES))
    blocks[order] = basis.reshape(n_coarse, -1, d, MODES)[owner, slot]
    row_start = np.concatenate([[0], np.cumsum(aggregates >= 0)])
    P = sp.bsr_matrix((blocks[node], aggregates[node], row_start), shape=(n * d, n_coarse * MODES))
    return P, coarse, unused
