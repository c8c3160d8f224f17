"""Rigid-body modes, and the prolongation that makes each aggregate of nodes a rigid body.

Aggregates are those of `mesh.aggregates`. A coarse node has six unknowns: translation and rotation of its aggregate of mesh nodes
about their mean, or the coefficients of an orthonormal basis of the rigid-body modes of its aggregate of coarse nodes.
Source: Vanek, Mandel and Brezina, "Algebraic multigrid by smoothed aggregation for second and fourth order elliptic problems",
Computing 56, 1996.
Weakness: aggregates follow the mesh's edges, not the strength of their coupling, so flat elements are coarsened in every
direction.
"""

import numpy as np
import scipy.sparse as sp

MODES = 6  # three translations, three linearised rotations
DEPENDENT = 1e-8  # of an aggregate's modes: a smaller remainder of a mode depends on the previous ones
NEARLY_DEPENDENT = 1e-4  # smallest eigenvalue of the cosines between independent motions


def rigid_modes(x: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Rigid-body modes (n, 3, 6) of positions x (n, 3) [m], 0 on constrained axes (free: (n, 3) bool), of order 1 at most."""
    return _motions((x - x.mean(axis=0)) / _extent(x)) * free[:, :, None]


def _extent(x: np.ndarray) -> float:
    """Largest distance of a coordinate from the mean."""
    return max(float(np.abs(x - x.mean(axis=0)).max()), 1e-300)


def _motions(arm: np.ndarray) -> np.ndarray:
    """Translations and rotations (n, 3, 6) of points at `arm` (n, 3) from the centre."""
    modes = np.zeros((len(arm), 3, MODES))
    modes[:, range(3), range(3)] = 1.0
    for k in range(3):  # e_k x arm
        i, j = (k + 1) % 3, (k + 2) % 3
        modes[:, j, 3 + k], modes[:, i, 3 + k] = arm[:, i], -arm[:, j]
    return modes


def rigid_aggregates(
    x: np.ndarray, free: np.ndarray, aggregates: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Make each aggregate of nodes rigid. Return the arms, the matrix, the coarse modes and the unused coarse unknowns.

    x, free: as for `rigid_modes`; aggregates: (n), -1 for nodes without rows. Arms (n, 3) are those from the aggregate's centre,
    over their root mean square; rows of the matrix are free (t + w x arm), with coarse unknowns t, w. It is 0 for nodes without
    rows, times the coarse modes (n_coarse, 6, 6) it is `rigid_modes`. Unused (n_coarse, 6) bool, with columns of 0: axes that
    are constrained everywhere, and rotations of aggregates whose motions are not independent, such as of nodes on a line.
    """
    node = np.flatnonzero(aggregates >= 0)
    own, n_coarse = aggregates[node], int(aggregates.max()) + 1
    size = np.bincount(own, minlength=n_coarse)

    def means(of: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(own, of[:, k], n_coarse) for k in range(of.shape[1])], axis=1) / size[:, None]

    centre = means(x[node])
    arm = x[node] - centre[own]
    radius = np.sqrt(means(arm**2).sum(axis=1))
    arm /= np.maximum(radius, 1e-300)[own, None]
    blocks = _motions(arm) * free[node][:, :, None]
    gram = means((blocks.swapaxes(1, 2) @ blocks).reshape(-1, MODES**2)).reshape(-1, MODES, MODES)
    length = np.sqrt(np.diagonal(gram, axis1=1, axis2=2))
    unused = length <= DEPENDENT
    inverse = 1.0 / np.where(unused, 1.0, length)
    cosines = gram * inverse[:, :, None] * inverse[:, None, :] + np.eye(MODES) * unused[:, :, None]
    line = np.linalg.eigvalsh(cosines)[:, 0] <= NEARLY_DEPENDENT
    unused[line, 3:] = True
    arm[line[own]] = 0.0
    blocks[np.broadcast_to(unused[own][:, None, :], blocks.shape)] = 0.0
    coarse = np.zeros((n_coarse, MODES, MODES))
    coarse[:, :3] = _motions((centre - x.mean(axis=0)) / _extent(x))
    coarse[:, range(3, MODES), range(3, MODES)] = radius[:, None] / _extent(x)
    coarse[unused] = 0.0
    arms, matrix = np.zeros((len(x), 3)), np.zeros((len(x), 3, MODES))
    arms[node], matrix[node] = arm, blocks
    return arms, matrix, coarse, unused


def aggregate_modes(modes: np.ndarray, aggregates: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an orthonormal basis (n, d, 6) of each aggregate's modes, the coarse modes and the unused coarse unknowns.

    modes: (n, d, 6); aggregates: (n), -1 for nodes without rows. The basis times the coarse modes (n_coarse, 6, 6) is modes.
    Unused (n_coarse, 6) bool, with columns of 0: rotations that move no node of an aggregate, or move it as others do.
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
    basis, coarse, unused = _orthonormal(stacked.reshape(n_coarse, -1, MODES))
    blocks = np.zeros((n, d, MODES))
    blocks[order] = basis.reshape(n_coarse, -1, d, MODES)[owner, slot]
    return blocks, coarse, unused


def _orthonormal(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orthonormal columns (g, r, 6) by Gram and Schmidt, done twice; the upper triangle that they are multiplied by to give
    `columns`; and which are dependent on the ones before (g, 6), and 0.

    A QR decomposition makes up a vector for a dependent column, which may be part of the next ones.
    """
    length = np.sqrt((columns**2).sum(axis=(1, 2)))
    basis, triangle = np.zeros_like(columns), np.zeros((len(columns), MODES, MODES))
    dependent = np.zeros((len(columns), MODES), dtype=bool)
    for k in range(MODES):
        rest = columns[:, :, k].copy()
        for _ in range(2):
            part = np.einsum("grk,gr->gk", basis[:, :, :k], rest)
            rest -= np.einsum("grk,gk->gr", basis[:, :, :k], part)
            triangle[:, :k, k] += part
        size = np.linalg.norm(rest, axis=1)
        dependent[:, k] = size <= DEPENDENT * length
        triangle[:, k, k] = np.where(dependent[:, k], 0.0, size)
        basis[:, :, k] = np.where(dependent[:, k, None], 0.0, rest / np.where(size > 0.0, size, 1.0)[:, None])
    return basis, triangle, dependent


def prolongation(modes: np.ndarray, aggregates: np.ndarray) -> tuple[sp.bsr_matrix, np.ndarray, np.ndarray]:
    """Return the blocks of `aggregate_modes` as a matrix P, and its other results: P coarse_modes = modes."""
    n, d, _ = modes.shape
    blocks, coarse, unused = aggregate_modes(modes, aggregates)
    row_start = np.concatenate([[0], np.cumsum(aggregates >= 0)])
    included = aggregates >= 0
    P = sp.bsr_matrix((blocks[included], aggregates[included], row_start), shape=(n * d, len(unused) * MODES))
    return P, coarse, unused
