"""Subsets of a model's nodes with the edges and elements that touch them, for stages in which only these nodes move.

A kernel takes a `Subset` as a template: for EVERYTHING it loops over all nodes, node pairs and blocks of elements.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

NODES, EDGES, BLOCKS = range(3)  # indices into `count`; from BLOCKS on: start of each group's blocks, then the total


@dataclass(frozen=True, eq=False)
class Subset:
    """Ascending lists of indices; None: all."""

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
def n_nodes_of(m: ti.template(), subset: ti.template()):
    """Number of nodes in a subset."""
    n = m.n_nodes
    if ti.static(subset.restricted):
        n = subset.count[NODES]
    return n


@ti.func
def node_of(subset: ti.template(), j):
    """The j-th node of a subset."""
    i = j
    if ti.static(subset.restricted):
        i = subset.node[j]
    return i


@ti.func
def n_edges_of(A: ti.template(), subset: ti.template()):
    """Number of node pairs of a matrix with a node in a subset."""
    n = A.n_edges
    if ti.static(subset.restricted):
        n = subset.count[EDGES]
    return n


@ti.func
def edge_of(subset: ti.template(), j):
    """The j-th node pair of a subset."""
    e = j
    if ti.static(subset.restricted):
        e = subset.edge[j]
    return e


@ti.func
def first_block_of(g: ti.template(), n: ti.template(), subset: ti.template()):
    """Start of the blocks of g, the n-th group, in a subset."""
    first = g.first
    if ti.static(subset.restricted):
        first = subset.count[BLOCKS + n]
    return first


@ti.func
def last_block_of(g: ti.template(), n: ti.template(), subset: ti.template()):
    """End (exclusive) of the blocks of g, the n-th group, in a subset."""
    last = g.last
    if ti.static(subset.restricted):
        last = subset.count[BLOCKS + n + 1]
    return last


@ti.func
def block_of(subset: ti.template(), j):
    """The j-th block of a subset."""
    b = j
    if ti.static(subset.restricted):
        b = subset.block[j]
    return b
