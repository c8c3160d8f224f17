"""Colours of the contacts, and their groups for coloured Gauss-Seidel: contacts that act on the same node must not be relaxed in
parallel.

An edge of the contact graph joins two contacts that share a movable node (report, algorithm 6); obstacles and fully prescribed
nodes add no edges. For a W given as a matrix, an edge is a nonzero block off the diagonal, in either triangle.
    colour_contacts  in kernels, once a step: Jones and Plassmann 1993. A contact takes the first free colour once all its
                     neighbours of higher priority are coloured. The result is first-fit in the order of the priorities,
                     independent of threads. Priorities are hashes, which keeps the longest chain of waiting contacts short;
    colour_greedy    on the host: networkx, largest degree first or another of its strategies.
"""

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.lists import count_entry, place_of_entry
from taisoft.backend.runtime import kernel
from taisoft.contact.problem import ContactProblem, fill_field

UNCOLOURED = -1
BITS = 30  # colours tested at a time, as bits of an integer


# --- on the host ------------------------------------------------------------------------------------------------------


def matrix_graph(W: sp.spmatrix) -> sp.csr_matrix:
    """Adjacency (k,k), bool, of the contacts of W (3k,3k)."""
    W = W.tocoo()
    k, used = W.shape[0] // 3, W.data != 0.0
    blocks = sp.csr_matrix((np.ones(used.sum(), dtype=np.int32), (W.row[used] // 3, W.col[used] // 3)), shape=(k, k))
    joined = (blocks + blocks.T).tocoo()
    off = joined.row != joined.col
    return sp.csr_matrix((np.ones(off.sum(), dtype=bool), (joined.row[off], joined.col[off])), shape=joined.shape)


def colour_greedy(graph: sp.csr_matrix, strategy: str = "largest_first") -> np.ndarray:
    """Colours (k,) from 0 by networkx.greedy_color."""
    import networkx as nx  # imported here: it takes 0.1 s, and few scenes need it

    colours = nx.greedy_color(nx.from_scipy_sparse_array(graph), strategy=strategy)
    return np.array([colours[c] for c in range(graph.shape[0])], dtype=np.int32)


def groups(colour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group contacts by colour: (order (k,), start (colours + 1,)), ascending within a colour."""
    order = np.argsort(colour, kind="stable").astype(np.int32)
    start = np.concatenate([[0], np.cumsum(np.bincount(colour))]).astype(np.int32)
    return order, start


def store(problem: ContactProblem, colour: np.ndarray) -> None:
    """Set the colours (k,) of the problem's contacts and group them."""
    order, start = groups(colour)
    for field, values in ((problem.sweep.colour, colour), (problem.sweep.order, order), (problem.sweep.by_colour.start, start)):
        fill_field(field, values)
    problem.count[1] = len(start) - 1


# --- in kernels -------------------------------------------------------------------------------------------------------


@ti.func
def _priority(c):
    """Hash of contact c; different for different contacts."""
    x = ti.cast(c, ti.i64)
    for _ in ti.static(range(2)):
        x = ((x ^ (x >> 16)) * 73244475) & 0x7FFFFFFF
    return x ^ (x >> 16)


@ti.func
def _first_free(problem: ti.template(), c):
    """The lowest colour that no neighbour of higher priority has; UNCOLOURED if one of these is uncoloured."""
    result, low, waiting = UNCOLOURED, 0, False
    while result == UNCOLOURED and not waiting:
        taken = 0
        for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
            i = problem.node[e]
            if (problem.inverse_mass[i] != 0.0).any():
                for at in range(problem.by_node.start[i], problem.by_node.start[i + 1]):
                    d = problem.contact[problem.entry[at]]
                    if _priority(d) > _priority(c):
                        colour = problem.sweep.colour[d]
                        if colour == UNCOLOURED:
                            waiting = True
                        elif colour >= low and colour < low + BITS:
                            taken |= 1 << (colour - low)
        for bit in range(BITS):
            if result == UNCOLOURED and not waiting and (taken >> bit) & 1 == 0:
                result = low + bit
        low += BITS
    return result


@ti.func
def colour(problem: ti.template(), team: ti.template(), t):
    """Colour and group the contacts, by all threads t of a team. A round colours those whose neighbours of higher priority are
    coloured, in the same round if that is visible."""
    n = problem.count[0]
    for j in range(team.share(t, n)):
        problem.sweep.colour[team.entry(t, j, n)] = UNCOLOURED
    team.sync()
    remaining, coloured = ti.cast(n, ti.f64), ti.cast(1.0, ti.f64)
    while remaining > 0.0 and coloured > 0.0:
        found = ti.cast(0.0, ti.f64)
        for j in range(team.share(t, n)):
            c = team.entry(t, j, n)
            if problem.sweep.colour[c] == UNCOLOURED:
                problem.sweep.colour[c] = _first_free(problem, c)
                found += ti.cast(problem.sweep.colour[c] != UNCOLOURED, ti.f64)
        coloured = team.total(t, found)
        remaining -= coloured
    _group(problem, team, t, n)


@ti.func
def _group(problem: ti.template(), team: ti.template(), t, n):
    """Group the contacts by colour. Their order within a colour may vary, and does not matter: they share no movable node."""
    (start,) = ti.static((problem.sweep.by_colour.start,))
    highest = ti.cast(-1.0, ti.f64)
    for j in range(team.share(t, n)):
        highest = ti.max(highest, ti.cast(problem.sweep.colour[team.term(t, j)], ti.f64))
    n_colours = ti.cast(team.largest(t, highest), ti.i32) + 1
    for j in range(team.share(t, n_colours + 2)):
        start[team.entry(t, j, n_colours + 2)] = 0
    team.sync()
    for j in range(team.share(t, n)):
        count_entry(problem.sweep.by_colour, problem.sweep.colour[team.entry(t, j, n)])
    team.sync()
    if t == 0:
        problem.count[1] = n_colours
        for k in range(1, n_colours + 2):
            start[k] += start[k - 1]
    team.sync()
    for j in range(team.share(t, n)):
        c = team.entry(t, j, n)
        problem.sweep.order[place_of_entry(problem.sweep.by_colour, problem.sweep.colour[c])] = c
    team.sync()


@kernel
def colour_contacts(problem: ti.template()):
    """Colour and group the contacts of a problem over nodes, once before the sweeps, after `index_nodes`."""
    ti.loop_config(serialize=problem.team.alone, block_dim=problem.team.threads)
    for t in range(problem.team.threads):
        colour(problem, problem.team, t)
