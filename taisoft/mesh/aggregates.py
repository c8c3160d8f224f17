"""Aggregates of neighbouring nodes of a graph: of a mesh's nodes for multigrid, of its tets for mean dilatation.

Aggregates grow around roots that are more than two edges apart (a maximal independent set of distance 2, found in parallel
rounds): a root takes its neighbours, and the nodes left over join the aggregate of a neighbour.
Source: Bell, Dalton and Olson, "Exposing fine-grained parallelism in algebraic multigrid methods", SIAM J. Sci. Comput. 34(4),
2012.
"""

import numpy as np
import scipy.sparse as sp

from taisoft.mesh.topology import Faces

EQUAL = 1e-6  # of the largest volume: smaller differences do not order tets


def aggregate(start: np.ndarray, column: np.ndarray, included: np.ndarray, priority: np.ndarray | None = None) -> np.ndarray:
    """Aggregate of each node (n), -1 for nodes that are not included (n) bool.

    start (n + 1), column: the graph as CSR rows, each with its diagonal. priority: (n,) a permutation of 1 to n, high for nodes
    that become roots first; by default a random one, the same in every run.
    """

    def highest(value: np.ndarray) -> np.ndarray:
        return np.maximum.reduceat(value[column], start[:-1])

    n = len(included)
    if priority is None:
        priority = np.random.default_rng(0).permutation(n).astype(np.int32) + 1
    root, open_nodes = np.zeros(n, dtype=bool), included.copy()
    while open_nodes.any():
        value = np.where(root, n + priority, np.where(open_nodes, priority, 0))
        best = highest(highest(value))
        root |= open_nodes & (best == priority)
        open_nodes &= (best <= n) & ~root
    label = np.where(root, np.cumsum(root), 0)
    near = highest(label)
    return np.where(included, np.where(near > 0, near, highest(near)), 0) - 1


def tet_patches(tets: np.ndarray, volumes: np.ndarray, regions: np.ndarray) -> np.ndarray:
    """Patch (m,) of each tet, from 0: the large tets first, each with its neighbours across faces of the same region.

    tets: (m,4); volumes: (m,); regions: (m,) int. On the "five" pattern of `box_mesh` the patches are the cells.
    """
    n, faces = len(tets), Faces(tets)
    a, b = (faces.pairs() // 4).T
    same = regions[a] == regions[b]
    a, b, own = a[same], b[same], np.arange(n)
    rows, columns = np.concatenate([a, b, own]), np.concatenate([b, a, own])
    graph = sp.csr_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(n, n))
    priority = np.empty(n, dtype=np.int64)
    priority[np.lexsort((-own, np.round(volumes / (EQUAL * volumes.max()))))] = own + 1
    return aggregate(graph.indptr, graph.indices, np.ones(n, dtype=bool), priority)
