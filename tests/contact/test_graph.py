"""The contact graph and its colouring:

* contacts over nodes are adjacent if they share a node that is free along some axis, those of a matrix if a block between them
  is not zero;
* colourings give adjacent contacts different colours, number them without gaps and use at most degree + 1; groups hold every
  contact once, by colour; the kernels colour first-fit, alike on any number of threads;
* the entries of each node are listed in ascending order, on any number of threads.
"""

import numpy as np
import pytest
import scipy.sparse as sp

from benchmarks import contact_colouring
from benchmarks.contact_colouring import colour_random, node_graph
from taisoft.contact import colouring, problem
from taisoft.contact.colouring import colour_greedy, groups, matrix_graph
from tests.contact import contact_oracle as oracle
from tests.contact.contact_rig import N_NODES


def adjacency(made: oracle.NodeContacts) -> np.ndarray:
    """By brute force."""
    sets = [{i for i in made.node[c, :n] if made.inverse_mass[i].any()} for c, n in enumerate(made.arity)]
    return np.array([[bool(a & b) and i != j for j, b in enumerate(sets)] for i, a in enumerate(sets)])


def graph_of(made: oracle.NodeContacts) -> sp.csr_matrix:
    contact, node, _ = made.entries
    return node_graph(contact, node, len(made.arity), made.inverse_mass)


def is_colouring(graph: sp.csr_matrix, colour: np.ndarray) -> bool:
    edges = graph.tocoo()
    return not (colour[edges.row] == colour[edges.col]).any() and set(colour) == set(range(colour.max() + 1))


def test_graph_of_nodes(rig):
    made = oracle.random_contacts(0, 60, N_NODES, prescribed=True)
    expected = adjacency(made)
    for graph in (graph_of(made), matrix_graph(sp.csr_matrix(made.W)), contact_colouring.graph_of(rig.nodes(made))):
        assert np.array_equal(graph.toarray(), expected)
    assert expected.sum() < adjacency(oracle.random_contacts(0, 60, N_NODES)).sum()


def test_graph_of_a_matrix():
    W = np.kron(np.eye(5), np.ones((3, 3)))
    W[0, 4] = W[10, 14] = 1.0  # above the diagonal only, below only
    W[14, 3] = -1.0
    graph = matrix_graph(sp.csr_matrix(W)).toarray()
    assert {(int(i), int(j)) for i, j in np.argwhere(graph)} == {(0, 1), (1, 0), (3, 4), (4, 3), (4, 1), (1, 4)}


@pytest.mark.parametrize("method", ["largest_first", "smallest_last", "random"])
def test_colouring_on_the_host(rig, method):
    def colours(graph, seed: int = 3) -> np.ndarray:
        return colour_random(graph, seed) if method == "random" else colour_greedy(graph, method)

    for k in (1, 2, 30, 200):
        made = oracle.random_contacts(2, k, N_NODES, prescribed=True)
        graph = graph_of(made)
        colour = colours(graph)
        assert is_colouring(graph, colour) and colour.max() <= np.diff(graph.indptr).max()
        p, (order, start) = rig.nodes(made), groups(colour)
        colouring.store(p, colour)
        assert np.array_equal(order, np.argsort(colour, kind="stable")) and start.tolist() == [0, *np.cumsum(np.bincount(colour))]
        assert np.array_equal(p.sweep.order.to_numpy()[:k], order) and p.count[1] == len(start) - 1
        assert np.array_equal(p.sweep.colour.to_numpy()[:k], colour)
    assert np.array_equal(colour, colours(graph)) and np.array_equal(colour, colours(graph, 4)) == (method != "random")
    assert sorted(colours(sp.csr_matrix(~np.eye(12, dtype=bool)))) == list(range(12))  # a clique
    assert not colours(sp.csr_matrix((4, 4), dtype=bool)).any() and len(colours(sp.csr_matrix((0, 0), dtype=bool))) == 0


@pytest.mark.parametrize("k", [1, 700])  # 700: more colours than one bit mask holds
def test_kernels_colour_first_fit(rig, k):
    made, found = oracle.random_contacts(4, k, N_NODES, prescribed=True), []
    graph = graph_of(made)
    for serial in (True, False, False):
        p = rig.nodes(made, serial)
        colouring.colour_contacts(p)
        found.append(p.sweep.colour.to_numpy()[:k])
        order, start = np.argsort(found[0], kind="stable"), np.cumsum([0, *np.bincount(found[0])])
        assert p.count[1] == len(start) - 1 and np.array_equal(p.sweep.order.to_numpy()[:k], order)
        assert np.array_equal(p.sweep.by_colour.start.to_numpy()[: len(start)], start)
        p.count[0] = 0
        colouring.colour_contacts(p)
        assert p.count[1] == 0
    assert all(np.array_equal(colour, found[0]) for colour in found) and is_colouring(graph, found[0])
    for own, row in zip(found[0], graph.toarray()):  # colours below a contact's own are those of neighbours
        assert set(range(own)) <= set(found[0][row])


@pytest.mark.parametrize("n", [0, 1, 300])
def test_index_of_nodes(rig, n):
    made = oracle.random_contacts(9, max(n, 1), N_NODES)
    of_rows = made.entries[1][: made.arity[:n].sum()]
    expected = [np.flatnonzero(of_rows == i).tolist() for i in range(N_NODES)]
    for serial in (True, False):
        p = rig.nodes(made, serial)
        p.count[0] = n
        problem.index_nodes(p)
        start, entry = p.by_node.start.to_numpy(), p.entry.to_numpy()
        assert [entry[a:b].tolist() for a, b in zip(start[:N_NODES], start[1:])] == expected
