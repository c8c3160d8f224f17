"""Graph of the nodes that share an element, which is the sparsity pattern of every matrix over nodes, and subsets of it.

A subset restricts a stage to the nodes that move in it, and to the edges and elements that touch them. A kernel takes a `Subset`
as a template: for EVERYTHING it loops over all nodes, edges and blocks of elements.
"""

from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
import taichi as ti

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


NODES, EDGES, BLOCKS = range(3)  # indices into `count`; from BLOCKS on: start of each group's blocks, then the total


@dataclass(frozen=True, eq=False)
class Subset:
    """Lists of indices, nodes in the order of a Gauss-Seidel sweep, others ascending; None: all."""

    count: Any = None  # (3 + n_groups) i32
    node: Any = None  # i32
    edge: Any = None  # i32: pairs of nodes that share an element, at least one of them in the list
    block: Any = None  # i32: blocks of elements with a node in the list, by group

    @property
    def restricted(self) -> bool:
        """Whether the subset is given by lists."""
        return self.node is not None


EVERYTHING = Subset()


@ti.func
def count_of(subset: ti.template(), k: ti.template(), everything):
    """Entry k of a subset's count: NODES, EDGES or an end of a group's blocks; `everything` if it is not restricted."""
    n = everything
    if ti.static(subset.restricted):
        n = subset.count[k]
    return n


@ti.func
def n_nodes_of(m: ti.template(), subset: ti.template()):
    """Number of nodes in a subset."""
    return count_of(subset, NODES, m.n_nodes)


@ti.func
def node_of(subset: ti.template(), j):
    """The j-th node of a subset."""
    i = j
    if ti.static(subset.restricted):
        i = subset.node[j]
    return i


@ti.func
def edge_of(subset: ti.template(), j):
    """The j-th node pair of a subset."""
    e = j
    if ti.static(subset.restricted):
        e = subset.edge[j]
    return e


@ti.func
def block_of(subset: ti.template(), j):
    """The j-th block of a subset."""
    b = j
    if ti.static(subset.restricted):
        b = subset.block[j]
    return b
