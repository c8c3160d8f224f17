"""Graph of the nodes that share an element, which is the sparsity pattern of every matrix over nodes."""

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from taisoft.fem.chunks import SweepOrder
from taisoft.mesh import topology
from taisoft.ranges import owners

# Pairs of an element's nodes, the lower first. Order 2: corner-corner (as order 1), corner-midpoint, midpoint-midpoint.
PAIRS = {1: topology.EDGES, 2: (*topology.EDGES, *product(range(4), range(4, 10)), *combinations(range(4, 10), 2))}


@dataclass(frozen=True)
class NodeGraph:
    """Node pairs i < j, and the same as CSR half-rows: half-row i has the neighbours of node i that a Gauss-Seidel sweep passes
    before it, those left of the diagonal if the sweep is not divided, and half-row n_nodes + i those that it passes after it.

    Columns ascend within a half-row, but those apart (`SweepOrder.apart`) follow the others. A sweep reads one kind of half-rows
    alone: twice as fast as from whole rows, if they do not fit into the caches.
    """

    ends: np.ndarray  # (n_pairs, 2)
    row_start: np.ndarray  # (2 n_nodes + 1) of half-rows
    apart_start: np.ndarray | None  # (2 n_nodes) where those apart begin; None if there are none
    column: np.ndarray  # (2 n_pairs)
    upper: np.ndarray  # (n_pairs) index of (i, j) in column
    lower: np.ndarray  # (n_pairs) index of (j, i) in column
    pair: np.ndarray  # (k,) index in ends of each given pair
    order: SweepOrder

    def entries(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the index in `column` of each (row, column), of pairs in the graph."""
        n = len(self.row_start) // 2
        stored = _keys(owners(np.diff(self.row_start)) % n, self.column, n, self.order)
        return np.searchsorted(stored, _keys(rows, columns, n, self.order))


def _keys(rows: np.ndarray, columns: np.ndarray, n_nodes: int, order: SweepOrder) -> np.ndarray:
    """Numbers that ascend in the order of the entries (rows, columns) of a graph."""
    half_rows = rows + np.int64(n_nodes) * (order.rank(columns) > order.rank(rows))
    return (2 * half_rows + order.apart(rows, columns)) * n_nodes + columns


def node_graph(pairs: np.ndarray, n_nodes: int, order: SweepOrder) -> NodeGraph:
    """Build the graph of node pairs (k, 2), i < j; pairs may repeat."""
    key, pair = np.unique(pairs[:, 0] * np.int64(n_nodes) + pairs[:, 1], return_inverse=True)
    i, j = key // n_nodes, key % n_nodes
    columns = np.concatenate([j, i])
    keys = _keys(np.concatenate([i, j]), columns, n_nodes, order)
    stored = np.argsort(keys)
    position = np.empty_like(stored)
    position[stored] = np.arange(len(stored))
    half_row, apart = np.divmod(keys // n_nodes, 2)
    start = np.concatenate([[0], np.cumsum(np.bincount(half_row, minlength=2 * n_nodes))])
    n_apart = np.bincount(half_row[apart == 1], minlength=2 * n_nodes)
    return NodeGraph(
        ends=np.stack([i, j], axis=1),
        row_start=start,
        apart_start=start[1:] - n_apart if n_apart.any() else None,
        column=columns[stored],
        upper=position[: len(key)],
        lower=position[len(key) :],
        pair=pair.reshape(-1),
        order=order,
    )


def whole_rows(row_start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the starts (n + 1) of whole rows and the order of their entries, from those of half-rows."""
    n = len(row_start) // 2
    row = owners(np.diff(row_start)) % n
    start = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=n))])
    return start, np.argsort(row, kind="stable")
