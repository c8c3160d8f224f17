"""Graph of the nodes that share an element: the sparsity pattern of every matrix over nodes."""

from dataclasses import dataclass

import numpy as np

from taisoft.mesh.topology import EDGES

# Pairs of an element's nodes, the lower first. Order 2: corner-corner (as order 1), corner-midpoint, midpoint-midpoint.
PAIRS = {
    1: EDGES,
    2: (*EDGES, *((a, b) for a in range(4) for b in range(4, 10)), *((a, b) for a in range(4, 10) for b in range(a + 1, 10))),
}


@dataclass(frozen=True)
class NodeGraph:
    """Node pairs i < j, and the same as CSR rows: columns ascend within a row, without the diagonal."""

    ends: np.ndarray  # (n_pairs, 2)
    row_start: np.ndarray  # (n_nodes + 1)
    row_upper: np.ndarray  # (n_nodes) first entry of a row right of the diagonal
    column: np.ndarray  # (2 n_pairs)
    upper: np.ndarray  # (n_pairs) index of (i, j) in column
    lower: np.ndarray  # (n_pairs) index of (j, i) in column
    pair: np.ndarray  # (k,) index in ends of each given pair


def node_graph(pairs: np.ndarray, n_nodes: int) -> NodeGraph:
    """Build the graph of node pairs (k, 2), i < j; pairs may repeat."""
    key, pair = np.unique(pairs[:, 0] * np.int64(n_nodes) + pairs[:, 1], return_inverse=True)
    i, j = key // n_nodes, key % n_nodes
    rows, columns = np.concatenate([i, j]), np.concatenate([j, i])
    order = np.lexsort((columns, rows))
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n_nodes))])
    return NodeGraph(
        ends=np.stack([i, j], axis=1),
        row_start=start,
        row_upper=start[:-1] + np.bincount(j, minlength=n_nodes),
        column=columns[order],
        upper=position[: len(key)],
        lower=position[len(key) :],
        pair=pair.reshape(-1),
    )
