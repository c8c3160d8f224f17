"""Colours of the contacts in kernels, and the groups that coloured Gauss-Seidel sweeps over.

Jones and Plassmann 1993: a contact takes the first colour that is free as soon as all its neighbours of higher priority have
theirs. That is first-fit in the order of the priorities, whatever the threads do. Priorities are hashes, so that the longest
chain of waiting contacts is short. A step colours its contacts once, before the first sweep.
"""

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.contact.graph import UNCOLOURED, colour_greedy, colour_random, groups, matrix_graph, node_graph
from taisoft.contact.problem import NODES, ContactProblem, fill_field, index_nodes
from taisoft.errors import SimulationError
from taisoft.runtime import kernel

BITS = 30  # colours that are looked at in one go


@ti.func
def _priority(c):
    """A number that scatters contacts; two contacts never have the same one."""
    x = ti.cast(c, ti.i64)
    for _ in ti.static(range(2)):
        x = ((x ^ (x >> 16)) * 73244475) & 0x7FFFFFFF
    return x ^ (x >> 16)


@ti.func
def _moves(p: ti.template(), i):
    return (p.inverse_mass[i] != 0.0).any()


@ti.func
def _waits(p: ti.template(), c):
    """Whether a neighbour of higher priority has no colour yet."""
    waits, mine = False, _priority(c)
    for k in range(p.arity[c]):
        i = p.node[c, k]
        if _moves(p, i):
            for e in range(p.entry_start[i], p.entry_start[i + 1]):
                d = p.entry[e] // NODES
                if _priority(d) > mine:
                    if p.colour[d] == UNCOLOURED:
                        waits = True
    return waits


@ti.func
def _first_free(p: ti.template(), c):
    """The least colour that no neighbour of higher priority has."""
    result, low, mine = UNCOLOURED, 0, _priority(c)
    while result == UNCOLOURED:
        taken = 0
        for k in range(p.arity[c]):
            i = p.node[c, k]
            if _moves(p, i):
                for e in range(p.entry_start[i], p.entry_start[i + 1]):
                    d = p.entry[e] // NODES
                    above = p.colour[d] - low
                    if _priority(d) > mine:
                        if above >= 0 and above < BITS:
                            taken |= 1 << above
        for bit in range(BITS):
            if result == UNCOLOURED:
                if (taken >> bit) & 1 == 0:
                    result = low + bit
        low += BITS
    return result


@kernel
def _uncolour(p: ti.template()):
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.colour[c] = UNCOLOURED


@kernel
def _colour_round(p: ti.template()) -> ti.i32:
    """Colour whom nobody keeps waiting; returns how many that were. Who is seen coloured in the same round may be so at once."""
    coloured = 0
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        if p.colour[c] == UNCOLOURED:
            if not _waits(p, c):
                p.colour[c] = _first_free(p, c)
                coloured += 1
    return coloured


@kernel
def _group(p: ti.template()):
    """order and colour_start from the colours: a counting sort."""
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
    """Colour and group the contacts of a problem over nodes, on the device; the nodes are indexed."""
    left = int(p.count[0])
    _uncolour(p)
    while left:
        coloured = int(_colour_round(p))
        if not coloured:
            raise SimulationError(f"{left} contacts could not be coloured")
        left -= coloured
    _group(p)


def colour_contacts(p: ContactProblem, colouring: str = "parallel", seed: int = 0) -> None:
    """Group the contacts for coloured Gauss-Seidel, once before the sweeps.

    colouring: "parallel", over nodes only; "greedy"; "random", with this seed.
    """
    if colouring == "parallel":
        index_nodes(p)
        colour_parallel(p)
        return
    graph = graph_of(p)
    store(p, colour_greedy(graph) if colouring == "greedy" else colour_random(graph, seed))


def graph_of(p: ContactProblem) -> sp.csr_matrix:
    """Adjacency of the contacts that a problem holds, brought to the host."""
    k = int(p.count[0])
    if not p.matrix:
        return node_graph(p.node.to_numpy(k), p.arity.to_numpy(k), p.inverse_mass.to_numpy())
    start = p.row_start.to_numpy(k + 1)
    n = int(start[-1])
    blocks = p.block.to_numpy(n).reshape(-1, 3, 3)
    return matrix_graph(sp.bsr_matrix((blocks, p.column.to_numpy(n), start), shape=(3 * k, 3 * k)))


def store(p: ContactProblem, colour: np.ndarray) -> None:
    """Give the problem's contacts these colours (k,) and group them."""
    k = len(colour)
    order, start = groups(colour)
    for field, values in ((p.colour, colour), (p.order, order), (p.colour_start, start)):
        fill_field(field, values)
    p.count[1] = len(start) - 1 if k else 0
