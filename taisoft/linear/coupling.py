"""Terms J^T D J of a matrix, kept in factors: each couples a few nodes by weights times one symmetric 3x3 block.

They come and go with the contacts, so they have no place in the pattern of a `BlockCsr`; a product needs one block for each term
and node, where an assembled matrix would need one for each pair of nodes. Their part of the diagonal is added to the matrix's.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.linear.block_csr import block_times


@dataclass(frozen=True, eq=False)
class Coupling:
    """Terms c with nodes node[c, 0..arity[c]), and the places of each node in them: entry = width * c + place."""

    width: int
    node: Any  # (capacity, width) i32
    arity: Any  # (capacity) i32
    weight: Any  # (capacity, width) f64
    entry_start: Any  # (n_nodes + 1) i32
    entry: Any  # i32, ascending for each node
    block: Any  # (capacity) 12-vectors
    active: Any  # (capacity) i32: 0 where the block is 0


NO_COUPLING = Coupling(0, *[None] * 7)


@ti.func
def coupling_times(m: ti.template(), k: ti.template(), i, x: ti.template(), above: ti.template(), below: ti.template()):
    """(J^T D J x)_i over the nodes after i (above), before it (below), or both; never i itself."""
    y = ti.Vector([0.0, 0.0, 0.0], m.real)
    for e in range(k.entry_start[i], k.entry_start[i + 1]):
        c, own = k.entry[e] // k.width, k.entry[e] % k.width
        if k.active[c] == 1:
            s = ti.Vector([0.0, 0.0, 0.0], m.real)
            for j in range(k.arity[c]):
                other = k.node[c, j]
                wanted = 0
                if ti.static(above):
                    wanted |= int(other > i)
                if ti.static(below):
                    wanted |= int(other < i)
                if wanted == 1:
                    s += ti.cast(k.weight[c, j], m.real) * x[other]
            y += ti.cast(k.weight[c, own], m.real) * block_times(k.block[c], s)
    return y


@ti.func
def coupling_diagonal(m: ti.template(), k: ti.template(), i, d):
    """The diagonal block d of node i with that of J^T D J."""
    total = d
    for e in range(k.entry_start[i], k.entry_start[i + 1]):
        c, own = k.entry[e] // k.width, k.entry[e] % k.width
        weight = ti.cast(k.weight[c, own], m.real)
        total += weight * weight * k.block[c]
    return total
