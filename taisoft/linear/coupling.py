"""Matrix terms J^T D J in factored form: each couples a few nodes by weights times one symmetric 3x3 block D.

They change with the contacts, so the fixed pattern of a `BlockCsr` cannot hold them. A product computes D J x for each term, and
each node gathers the products of its terms. A Gauss-Seidel sweep, which needs the contributions of the nodes passed so far, adds
each node to the products as it goes. Either way costs one block per term and node.
Their diagonal blocks are added to those of the matrix.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.linear.block_csr import padded_times


@dataclass(frozen=True, eq=False)
class Coupling:
    """Terms c, each with arity[c] entries from first[c] on, and the entries of each node."""

    count: Any = None  # i32: count[0] terms
    first: Any = None  # (capacity) i32
    arity: Any = None  # (capacity) i32
    node: Any = None  # (n_entries) i32
    weight: Any = None  # (n_entries) f64
    contact: Any = None  # (n_entries) i32: the term
    entry_start: Any = None  # (n_nodes + 1) i32
    entry: Any = None  # i32, ascending for each node
    block: Any = None  # (capacity) 12-vectors
    active: Any = None  # (capacity) i32: 0 if the block is 0
    base: Any = None  # (n_nodes) 12-vectors: the matrix's diagonal without the terms
    n_active: Any = None  # (n_nodes) i32: active terms of each node, listed from entry_start on in term and term_weight
    term: Any = None  # (n_entries) i32
    term_weight: Any = None  # (n_entries): the node's weight in the term
    product: Any = None  # (capacity) 4-vectors: D J x of each term, the last entry 0
    place: Any = None  # (n_nodes) i32: PLAIN, BESIDE or IS_LAST of `sweep_order`; this and the next two None if not shared
    last: Any = None  # (n_nodes) i32: the last nodes, ascending
    n_last: Any = None  # (1) i32: their number

    @property
    def any(self) -> bool:
        """Whether there can be terms."""
        return self.node is not None


NO_COUPLING = Coupling()


def build_coupling(arena, real, n_nodes: int, shared: bool = False, **fields) -> Coupling:
    """Build terms over existing fields of nodes, weights and blocks (all up to `base`), which the caller fills.

    shared: whether threads share chunks of a sweep; `sweep_order.find_last` must then follow every change of the terms' nodes.
    """
    entries = fields["node"].shape[0]
    if shared:
        fields |= {name: arena.field(f"coupling_{name}", ti.i32, n_nodes) for name in ("place", "last")}
        fields["n_last"] = arena.field("coupling_n_last", ti.i32, 1)
    return Coupling(
        **fields,
        n_active=arena.field("coupling_n_active", ti.i32, n_nodes),
        term=arena.field("coupling_term", ti.i32, entries),
        term_weight=arena.field("coupling_term_weight", real, entries),
        product=arena.vectors("coupling_product", real, fields["block"].shape[0], n=4),
    )


@ti.func
def has_terms(k: ti.template(), i):
    """Whether any term contains node i."""
    return k.entry_start[i] < k.entry_start[i + 1]


@ti.func
def prepare_terms(m: ti.template(), k: ti.template(), i):
    """List the active terms of node i. Return the diagonal block of the matrix plus terms."""
    total, n = k.base[i], 0
    first = k.entry_start[i]
    for at in range(first, k.entry_start[i + 1]):
        c = k.contact[k.entry[at]]
        if k.active[c] == 1:
            weight = ti.cast(k.weight[k.entry[at]], m.real)
            total += weight * weight * k.block[c]
            k.term[first + n], k.term_weight[first + n] = c, weight
            n += 1
    k.n_active[i] = n
    return total


@ti.func
def clear_products(m: ti.template(), k: ti.template()):
    """Set the products of all terms, if there can be any, to 0."""
    if ti.static(k.any):
        for c in range(k.count[0]):
            k.product[c] = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)


@ti.func
def add_products(m: ti.template(), k: ti.template(), i, x):
    """Add the contribution of x at node i to the products of its terms, if there can be any."""
    if ti.static(k.any):
        first = k.entry_start[i]
        for e in range(first, first + k.n_active[i]):
            c = k.term[e]
            k.product[c] += padded_times(k.block[c], k.term_weight[e] * x)


@ti.func
def gather_products(m: ti.template(), k: ti.template(), i):
    """Row i of J^T D J x, from the products."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)
    first = k.entry_start[i]
    for e in range(first, first + k.n_active[i]):
        y += k.term_weight[e] * k.product[k.term[e]]
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def form_product(m: ti.template(), k: ti.template(), c, x: ti.template()):
    """Set the product D J x of term c."""
    if k.active[c] == 1:
        s = ti.Vector([0.0, 0.0, 0.0], m.real)
        for e in range(k.first[c], k.first[c] + k.arity[c]):
            s += ti.cast(k.weight[e], m.real) * x[k.node[e]]
        k.product[c] = padded_times(k.block[c], s)
