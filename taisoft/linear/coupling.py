"""Terms J^T D J of a matrix, kept in factors: each couples a few nodes by weights times one symmetric 3x3 block.

They come and go with the contacts, so they have no place in the pattern of a `BlockCsr`. A product goes through the terms: each
pulls with D J x, and a node gathers the pulls of its terms. A sweep over the nodes, which needs what the nodes passed so far
contribute, adds each node to the pulls as it goes; so either costs one block for each term and node.
Their part of the diagonal is added to the matrix's.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.linear.block_csr import padded_times


@dataclass(frozen=True, eq=False)
class Coupling:
    """Terms c with nodes node[c, 0..arity[c]), and the places of each node in them: entry = width * c + place."""

    width: int
    count: Any  # i32, count[0] terms
    node: Any  # (capacity, width) i32
    arity: Any  # (capacity) i32
    weight: Any  # (capacity, width) f64
    entry_start: Any  # (n_nodes + 1) i32
    entry: Any  # i32, ascending for each node
    block: Any  # (capacity) 12-vectors
    active: Any  # (capacity) i32: 0 where the block is 0
    base: Any  # (n_nodes) 12-vectors: the matrix's diagonal without the terms
    n_active: Any  # (n_nodes) i32: active terms of each node, listed from entry_start in the next two
    term: Any  # (capacity * width) i32
    term_weight: Any  # (capacity * width): the node's weight in it
    product: Any  # (capacity) 4-vectors, the last entry 0


NO_COUPLING = Coupling(0, *[None] * 13)


def build_coupling(
    arena, real, n_nodes: int, count, node, arity, weight, entry_start, entry, block, active, base
) -> Coupling:
    """Terms whose nodes, weights and blocks lie in fields that others fill."""
    capacity, width = node.shape
    return Coupling(
        width, count, node, arity, weight, entry_start, entry, block, active, base,
        arena.field("coupling_active", ti.i32, n_nodes), arena.field("coupling_term", ti.i32, capacity * width),
        arena.field("coupling_share", real, capacity * width), arena.vectors("coupling_pull", real, capacity, n=4),
    )  # fmt: skip


@ti.func
def has_terms(k: ti.template(), i):
    """Whether any term holds node i."""
    return k.entry_start[i] < k.entry_start[i + 1]


@ti.func
def prepare_terms(m: ti.template(), k: ti.template(), i):
    """List the active terms of node i. Returns the diagonal block of the whole matrix."""
    total, n = k.base[i], 0
    first = k.entry_start[i]
    for e in range(first, k.entry_start[i + 1]):
        c, own = k.entry[e] // k.width, k.entry[e] % k.width
        if k.active[c] == 1:
            weight = ti.cast(k.weight[c, own], m.real)
            total += weight * weight * k.block[c]
            k.term[first + n], k.term_weight[first + n] = c, weight
            n += 1
    k.n_active[i] = n
    return total


@ti.func
def clear_products(m: ti.template(), k: ti.template()):
    """No node pulls."""
    for c in range(k.count[0]):
        k.product[c] = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)


@ti.func
def add_products(m: ti.template(), k: ti.template(), i, x):
    """Node i pulls with x."""
    first = k.entry_start[i]
    for e in range(first, first + k.n_active[i]):
        c = k.term[e]
        k.product[c] += padded_times(k.block[c], k.term_weight[e] * x)


@ti.func
def gather_products(m: ti.template(), k: ti.template(), i):
    """What the pulls make of row i of J^T D J x."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)
    first = k.entry_start[i]
    for e in range(first, first + k.n_active[i]):
        y += k.term_weight[e] * k.product[k.term[e]]
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def form_product(m: ti.template(), k: ti.template(), c, x: ti.template()):
    """Every node of term c pulls with its x."""
    if k.active[c] == 1:
        s = ti.Vector([0.0, 0.0, 0.0], m.real)
        for j in range(k.arity[c]):
            s += ti.cast(k.weight[c, j], m.real) * x[k.node[c, j]]
        k.product[c] = padded_times(k.block[c], s)
