"""The contact graph and its colouring:

* contacts over nodes are adjacent if they share a node that is free along some axis, by brute force; contacts of a matrix if
  either block between them is not zero;
* colourings give adjacent contacts different colours, number them without gaps and use at most degree + 1; groups hold every
  contact once, by colour; random colourings depend on the seed alone;
* the kernels colour first-fit, alike on any number of threads;
* the index of each node's contacts made for many threads, as on CUDA, is the serial one.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from taisoft.backend.arrays import FieldArena
from taisoft.contact import colouring, problem
from taisoft.contact.colouring import colour_greedy, colour_random, groups, matrix_graph, node_graph
from tests.contact import contact_oracle as oracle

N_NODES, CAPACITY = 120, 700


@pytest.fixture(scope="module")
def problems():
    """Contact problems on one thread and on all."""
    arenas = [FieldArena(), FieldArena()]
    yield [problem.build_node_problem(arena, CAPACITY, N_NODES, serial) for arena, serial in zip(arenas, (True, False))]
    for arena in arenas:
        arena.release()


def fill(p: problem.ContactProblem, made: oracle.NodeContacts) -> None:
    for field, values in ((p.node, made.node), (p.arity, made.arity), (p.inverse_mass, made.inverse_mass)):
        problem.fill_field(field, values)
    p.count[0] = len(made.arity)


def adjacency(made: oracle.NodeContacts) -> np.ndarray:
    """By brute force."""
    sets = [{i for i in made.node[c, :n] if made.inverse_mass[i].any()} for c, n in enumerate(made.arity)]
    return np.array([[bool(a & b) and i != j for j, b in enumerate(sets)] for i, a in enumerate(sets)])


def graph_of(made: oracle.NodeContacts) -> sp.csr_matrix:
    return node_graph(made.node, made.arity, made.inverse_mass)


def is_colouring(graph: sp.csr_matrix, colour: np.ndarray) -> bool:
    edges = graph.tocoo()
    return not (colour[edges.row] == colour[edges.col]).any() and set(colour) == set(range(colour.max() + 1))


@pytest.mark.parametrize("prescribed", [False, True])
def test_graph_of_nodes(problems, prescribed):
    made = oracle.random_contacts(0, 60, N_NODES, prescribed=prescribed)
    assert np.array_equal(graph_of(made).toarray(), adjacency(made))
    assert np.array_equal(matrix_graph(sp.csr_matrix(made.W)).toarray(), adjacency(made))
    fill(problems[0], made)
    assert np.array_equal(colouring.graph_of(problems[0]).toarray(), adjacency(made))
    free = oracle.random_contacts(0, 60, N_NODES, prescribed=False)
    assert (adjacency(made).sum() < adjacency(free).sum()) == prescribed


def test_graph_of_a_matrix():
    W = np.kron(np.eye(5), np.ones((3, 3)))
    W[0, 4] = W[10, 14] = 1.0  # above the diagonal only, below only
    W[14, 3] = -1.0
    graph = matrix_graph(sp.csr_matrix(W)).toarray()
    assert {(int(i), int(j)) for i, j in np.argwhere(graph)} == {(0, 1), (1, 0), (3, 4), (4, 3), (4, 1), (1, 4)}
    stored = sp.bsr_matrix((np.zeros((1, 3, 3)), [1], [0, 1, 1]), shape=(6, 6))
    assert matrix_graph(stored).nnz == 0


@pytest.mark.parametrize("method", ["largest_first", "smallest_last", "random"])
def test_colouring_on_the_host(problems, method):
    def colours(graph, seed: int = 3) -> np.ndarray:
        return colour_random(graph, seed) if method == "random" else colour_greedy(graph, method)

    for k in (1, 2, 30, 200):
        made = oracle.random_contacts(2, k, N_NODES, prescribed=True)
        graph = graph_of(made)
        colour = colours(graph)
        assert is_colouring(graph, colour) and colour.max() <= np.diff(graph.indptr).max()
        fill(problems[0], made)
        colouring.store(problems[0], colour)
        order, start = groups(colour)
        assert np.array_equal(problems[0].order.to_numpy()[:k], order) and problems[0].count[1] == len(start) - 1
        assert np.array_equal(problems[0].colour.to_numpy()[:k], colour)
    assert np.array_equal(colour, colours(graph)) and np.array_equal(colour, colours(graph, 4)) == (method != "random")
    assert sorted(colours(sp.csr_matrix(~np.eye(12, dtype=bool)))) == list(range(12))  # a clique
    assert not colours(sp.csr_matrix((4, 4), dtype=bool)).any() and len(colours(sp.csr_matrix((0, 0), dtype=bool))) == 0


@pytest.mark.parametrize("k", [1, 60, 700])  # 700: more colours than one bit mask holds
def test_kernels_colour_first_fit(problems, k):
    made, found = oracle.random_contacts(4, k, N_NODES, prescribed=True), []
    neighbours = graph_of(made).toarray()
    for p in (*problems, problems[1]):
        fill(p, made)
        colouring.colour_contacts(p)
        found.append(p.colour.to_numpy()[:k])
        order, start = groups(found[0])
        assert p.count[1] == len(start) - 1
        assert np.array_equal(p.order.to_numpy()[:k], order)
        assert np.array_equal(p.colour_start.to_numpy()[: len(start)], start)
        p.count[0] = 0
        colouring.colour_contacts(p)
        assert p.count[1] == 0
    assert all(np.array_equal(colour, found[0]) for colour in found) and is_colouring(graph_of(made), found[0])
    for own, row in zip(found[0], neighbours):  # colours below a contact's own are those of neighbours
        assert set(range(own)) <= set(found[0][row])


def test_groups():
    colour = np.array([1, 0, 2, 1, 0, 1])
    order, start = groups(colour)
    assert order.tolist() == [1, 4, 0, 3, 5, 2] and start.tolist() == [0, 2, 5, 6]


@pytest.mark.parametrize("n", [0, 1, 300])
def test_index_for_many_threads(problems, n):
    for p in problems:
        if n:
            fill(p, oracle.random_contacts(9, n, N_NODES))
        p.count[0] = n
        problem.index_nodes(p)
        start, entry = p.entry_start.to_numpy(), p.entry.to_numpy()
        arena = FieldArena()
        scan = arena.field("scan", p.count.dtype, problem.SCAN)
        p.entry_start.fill(-1)
        p.entry.fill(-1)
        problem.index_nodes(replace(p, on_cpu=False, scan=scan))
        assert np.array_equal(p.entry_start.to_numpy(), start)
        assert np.array_equal(p.entry.to_numpy()[: start[-1]], entry[: start[-1]])
        assert start[-1] == p.arity.to_numpy()[:n].sum()
        arena.release()
