"""Parallel colouring of the contacts, and their groups for coloured Gauss-Seidel.

Jones and Plassmann 1993: a contact takes the first free colour once all its neighbours of higher priority are coloured. The
result is first-fit in the order of the priorities, independent of threads. Priorities are hashes, which keeps the longest chain
of waiting contacts short. A step colours its contacts once, before the first sweep.
"""

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.graph import UNCOLOURED, colour_greedy, colour_random, groups, matrix_graph, node_graph
from taisoft.contact.problem import NODES, ContactProblem, fill_field, index_nodes
from taisoft.errors import SimulationError

BITS = 30  # colours tested at a time, as bits of an integer


@ti.func
def _priority(c):
    """Hash of contact c; different for different contacts."""
    x = ti.cast(c, ti.i64)
    for _ in ti.static(range(2)):
        x = ((x ^ (x >> 16)) * 73244475) & 0x7FFFFFFF
    return x ^ (x >> 16)


@ti.func
def _is_movable(p: ti.template(), i):
    return (p.inverse_mass[i] != 0.0).any()


@ti.func
def _is_waiting(p: ti.template(), c):
    """Whether a neighbour of higher priority is uncoloured."""
    waiting, mine = False, _priority(c)
    for k in range(p.arity[c]):
        i = p.node[c, k]
        if _is_movable(p, i):
            for e in range(p.entry_start[i], p.entry_start[i + 1]):
                d = p.entry[e] // NODES
                if _priority(d) > mine:
                    if p.colour[d] == UNCOLOURED:
                        waiting = True
    return waiting


@ti.func
def _first_free(p: ti.template(), c):
    """The lowest colour that no neighbour of higher priority has."""
    result, low, mine = UNCOLOURED, 0, _priority(c)
    while result == UNCOLOURED:
        taken = 0
        for k in range(p.arity[c]):
            i = p.node[c, k]
            if _is_movable(p, i):
                for e in range(p.entry_start[i], p.entry_start[i + 1]):
                    d = p.entry[e] // NODES
                    offset = p.colour[d] - low
                    if _priority(d) > mine:
                        if offset >= 0 and offset < BITS:
                            taken |= 1 << offset
        for bit in range(BITS):
            if result == UNCOLOURED:
                if (taken >> bit) & 1 == 0:
                    result = low + bit
        low += BITS
    return result


@kernel
def _clear_colours(p: ti.template()):
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.colour[c] = UNCOLOURED


@kernel
def _colour_round(p: ti.template()) -> ti.i32:
    """Colour contacts whose higher-priority neighbours are coloured (same round included, if visible). Return their number."""
    coloured = 0
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        if p.colour[c] == UNCOLOURED:
            if not _is_waiting(p, c):
                p.colour[c] = _first_free(p, c)
                coloured += 1
    return coloured


@kernel
def _group(p: ti.template()):
    """Set `order` and `colour_start` from the colours by a counting sort."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        n, colours = p.count[0], 0
        for k in range(n + 1):
            p.colour_start[k] = 0
        for c in range(n):
            p.colour_start[p.colour[c]] += 1
            colours = ti.max(colours, p.colour[c] + 1)
        total = 0
        for k in range(colours + 1):
            total += p.colour_start[k]
            p.colour_start[k] = total
        for back in range(n):
            c = n - 1 - back
            p.colour_start[p.colour[c]] -= 1
            p.order[p.colour_start[p.colour[c]]] = c
        p.count[1] = colours


def colour_parallel(p: ContactProblem) -> None:
    """Colour and group the contacts of a problem over nodes, on the device. Requires `index_nodes`."""
    remaining = int(p.count[0])
    _clear_colours(p)
    while remaining:
        coloured = int(_colour_round(p))
        if not coloured:
            raise SimulationError(f"{remaining} contacts could not be coloured")
        remaining -= coloured
    _group(p)


def colour_contacts(p: ContactProblem, colouring: str = "parallel", seed: int = 0) -> None:
    """Group the contacts for coloured Gauss-Seidel, once before the sweeps.

    colouring: "parallel" (only over nodes), "greedy" or "random" (with `seed`).
    """
    if colouring == "parallel":
        index_nodes(p)
        colour_parallel(p)
        return
    graph = graph_of(p)
    store(p, colour_greedy(graph) if colouring == "greedy" else colour_random(graph, seed))


def graph_of(p: ContactProblem) -> sp.csr_matrix:
    """Adjacency matrix of the problem's contacts, on the host."""
    k = int(p.count[0])
    if not p.matrix:
        return node_graph(p.node.to_numpy(k), p.arity.to_numpy(k), p.inverse_mass.to_numpy())
    start = p.row_start.to_numpy(k + 1)
    n = int(start[-1])
    blocks = p.block.to_numpy(n).reshape(-1, 3, 3)
    return matrix_graph(sp.bsr_matrix((blocks, p.column.to_numpy(n), start), shape=(3 * k, 3 * k)))


def store(p: ContactProblem, colour: np.ndarray) -> None:
    """Set the colours (k,) of the problem's contacts and group them."""
    k = len(colour)
    order, start = groups(colour)
    for field, values in ((p.colour, colour), (p.order, order), (p.colour_start, start)):
        fill_field(field, values)
    p.count[1] = len(start) - 1 if k else 0
