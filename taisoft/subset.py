"""Some nodes of a model and what touches them: what the kernels of a stage go through where only these nodes move.

A kernel takes a `Subset` as a template: for EVERYTHING its loops are those over all nodes, node pairs and blocks of elements.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

NODES, EDGES, BLOCKS = range(3)  # places in `count`; from BLOCKS on, where each group's blocks begin, and their number


@dataclass(frozen=True, eq=False)
class Subset:
    """Ascending lists; None: everything."""

    count: Any = None  # (3 + n_groups) i32
    node: Any = None  # i32
    edge: Any = None  # i32: pairs of nodes that share an element, one of them in the list
    block: Any = None  # i32: of elements with a node in the list, group after group

    @property
    def some(self) -> bool:
        """Whether there are lists."""
        return self.node is not None


EVERYTHING = Subset()


@ti.func
def n_nodes_of(m: ti.template(), subset: ti.template()):
    """Nodes of a subset."""
    n = m.n_nodes
    if ti.static(subset.some):
        n = subset.count[NODES]
    return n


@ti.func
def node_of(subset: ti.template(), j):
    """The j-th node of a subset."""
    i = j
    if ti.static(subset.some):
        i = subset.node[j]
    return i


@ti.func
def n_edges_of(A: ti.template(), subset: ti.template()):
    """Pairs of nodes of a matrix of which one is in a subset."""
    n = A.n_edges
    if ti.static(subset.some):
        n = subset.count[EDGES]
    return n


@ti.func
def edge_of(subset: ti.template(), j):
    """The j-th of these."""
    e = j
    if ti.static(subset.some):
        e = subset.edge[j]
    return e


@ti.func
def first_block_of(g: ti.template(), n: ti.template(), subset: ti.template()):
    """Where the blocks of g, the n-th group, begin in a subset."""
    first = g.first
    if ti.static(subset.some):
        first = subset.count[BLOCKS + n]
    return first


@ti.func
def last_block_of(g: ti.template(), n: ti.template(), subset: ti.template()):
    """One past the last of these."""
    last = g.last
    if ti.static(subset.some):
        last = subset.count[BLOCKS + n + 1]
    return last


@ti.func
def block_of(subset: ti.template(), j):
    """The j-th block of a subset."""
    b = j
    if ti.static(subset.some):
        b = subset.block[j]
    return b
