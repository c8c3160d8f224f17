"""Aggregates of nodes are connected and cover the included ones; rigid motions lie in the range of the prolongation, also of
aggregates of few nodes, of nodes on a line and of constrained ones; its columns are orthonormal.
"""

import numpy as np
import pytest
import scipy.sparse as sp

from taisoft.linear.aggregation import MODES, prolongation, rigid_aggregates, rigid_modes
from taisoft.mesh.aggregates import aggregate
from tests.dynamics.scenes import cube


def test_aggregates_cover_the_included_nodes_and_are_connected():
    mesh = cube(cells=(7, 5, 4))
    pairs = np.concatenate([mesh.tets[:, [a, b]] for a in range(4) for b in range(4)])
    graph = sp.csr_matrix((np.ones(len(pairs)), pairs.T), shape=(len(mesh.vertices),) * 2)
    included = np.arange(len(mesh.vertices)) >= 6
    found = aggregate(graph.indptr, graph.indices, included)
    assert np.array_equal(found >= 0, included) and np.array_equal(np.unique(found[included]), np.arange(found.max() + 1))
    assert 4 < included.sum() / (found.max() + 1) < 60
    for k in range(found.max() + 1):
        own = np.flatnonzero(found == k)
        assert sp.csgraph.connected_components(graph[own][:, own])[0] == 1


def points() -> tuple[np.ndarray, np.ndarray]:
    x, free = np.random.default_rng(6).standard_normal((40, 3)), np.ones((40, 3), dtype=bool)
    free[3], free[7, 1] = False, False
    return x, free


@pytest.mark.parametrize("axis", range(3))
def test_rigid_motions_are_prolonged_exactly(axis):
    """Also in aggregates of one or two nodes, which have fewer than six motions: none about the line of two nodes."""
    x, free = points()
    x[9] = x[2] + 0.3 * np.eye(3)[axis]
    modes = rigid_modes(x, free)
    owner = np.array([-1 if k == 3 else 0 if k == 1 else 1 if k in (2, 9) else 2 + k % 3 for k in range(40)])
    P, coarse, unused = prolongation(modes, owner)
    assert np.abs(P @ coarse.reshape(-1, MODES) - modes.reshape(-1, MODES)).max() < 1e-12
    assert unused[0].sum() == 3 and np.array_equal(unused[1], np.arange(6) == 3 + axis) and not unused[2:].any()
    used = P.toarray()[:, ~unused.reshape(-1)]
    assert np.abs(used.T @ used - np.eye(used.shape[1])).max() < 1e-12
    turned = np.cross([0.0, 0.0, 1.0], x - x.mean(axis=0)) * free  # e_z x r turns x to y
    assert np.allclose(turned, turned[0, 0] / modes[0, 0, 5] * modes[:, :, 5])


def test_aggregates_that_are_rigid_about_their_centres_have_the_same_motions():
    """A single node and a line have no rotations, neither have rows of constrained axes."""
    x, free = points()
    free[2, 2] = False
    x[11:14] = x[10] + np.outer([1.0, 2.0, 3.0], [0.3, -0.2, 0.1])
    modes = rigid_modes(x, free)
    owner = np.array([-1 if k == 3 else 0 if k == 1 else 1 if k == 2 else 2 if 10 <= k < 14 else 3 + k % 3 for k in range(40)])
    arms, T, coarse, unused = rigid_aggregates(x, free, owner)
    found = np.einsum("nij,njk->nik", T, coarse[owner])
    assert np.abs(found - modes)[(owner >= 3) | (owner == 0) | (owner == 1)].max() < 1e-12
    assert np.abs(found[10:14] - modes[10:14].mean(axis=0)).max() < 1e-12
    assert not arms[[1, 2, 3, *range(10, 14)]].any() and not T[3].any() and not coarse[unused].any() and not unused[3:].any()
    assert all(np.array_equal(unused[k], np.arange(6) > last) for k, last in ((0, 2), (1, 1), (2, 2)))
    for c in range(3, 6):
        own = arms[owner == c]
        assert np.abs(own.mean(axis=0)).max() < 1e-12 and abs((own**2).sum(axis=1).mean() - 1.0) < 1e-12
