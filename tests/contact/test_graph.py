"""The contact graph and its colouring:

* contacts over nodes are adjacent if they share a node that is free along some axis, by brute force;
* contacts of a matrix are adjacent if either block between them is not zero;
* colourings give adjacent contacts different colours, number them without gaps and use at most degree + 1;
* random colourings depend on the seed alone; the kernels colour first-fit in the order of priorities, on any number of threads;
* groups hold every contact once, by colour;
* the index of each node's contacts made for many threads, as on CUDA, is the serial one.
"""

from dataclasses import replace

import networkx as nx
import numpy as np
import pytest
import scipy.sparse as sp

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import open_runtime
from taisoft.contact import colouring, problem
from taisoft.contact.colouring import colour_greedy, colour_random, groups, matrix_graph, node_graph
from tests.contact import contact_oracle as oracle

N_NODES, CAPACITY = 120, 700


@pytest.fixture(scope="module")
def problems():
    """Contact problems on one thread and on all."""
    runtime, arenas = open_runtime("cpu", "f32"), [FieldArena(), FieldArena()]
    yield [problem.build_node_problem(arena, CAPACITY, N_NODES, serial) for arena, serial in zip(arenas, (True, False))]
    for arena in arenas:
        arena.release()
    runtime.close()


def fill(p: problem.ContactProblem, made: oracle.NodeContacts) -> None:
    for field, values in ((p.node, made.node), (p.arity, made.arity), (p.inverse_mass, made.inverse_mass)):
        problem.fill_field(field, values)
    p.count[0] = len(made.arity)


def adjacency(made: oracle.NodeContacts) -> np.ndarray:
    """By brute force."""
    sets = [{i for i in made.node[c, :n] if made.inverse_mass[i].any()} for c, n in enumerate(made.arity)]
    return np.array([[bool(a & b) and i != j for j, b in enumerate(sets)] for i, a in enumerate(sets)])


def is_colouring(graph: sp.csr_matrix, colour: np.ndarray) -> bool:
    edges = graph.tocoo()
    return not (colour[edges.row] == colour[edges.col]).any() and set(colour) == set(range(colour.max() + 1))


@pytest.mark.parametrize("prescribed", [False, True])
def test_graph_of_nodes(problems, prescribed):
    made = oracle.random_contacts(0, 60, N_NODES, led=prescribed)
    graph = node_graph(made.node, made.arity, made.inverse_mass)
    assert np.array_equal(graph.toarray(), adjacency(made))
    assert np.array_equal(matrix_graph(sp.csr_matrix(made.W)).toarray(), adjacency(made))
    fill(problems[0], made)
    assert np.array_equal(colouring.graph_of(problems[0]).toarray(), adjacency(made))
    free = oracle.random_contacts(0, 60, N_NODES, led=False)
    assert (adjacency(made).sum() < adjacency(free).sum()) == prescribed


def test_graph_of_a_matrix():
    W = np.kron(np.eye(5), np.ones((3, 3)))
    W[0, 4] = W[10, 14] = 1.0  # above the diagonal only, below only
    W[14, 3] = -1.0
    graph = matrix_graph(sp.csr_matrix(W)).toarray()
    assert {(int(i), int(j)) for i, j in np.argwhere(graph)} == {(0, 1), (1, 0), (3, 4), (4, 3), (4, 1), (1, 4)}
    stored = sp.bsr_matrix((np.zeros((1, 3, 3)), [1], [0, 1, 1]), shape=(6, 6))
    assert matrix_graph(stored).nnz == 0


@pytest.mark.parametrize("k", [1, 2, 30, 200])
@pytest.mark.parametrize("method", ["largest_first", "smallest_last", "random"])
def test_colouring_on_the_host(method, k):
    graph = node_graph(*_arrays(oracle.random_contacts(2, k, N_NODES, led=True)))
    colour = colour_random(graph, seed=3) if method == "random" else colour_greedy(graph, method)
    assert is_colouring(graph, colour) and colour.max() <= np.diff(graph.indptr).max()


def _arrays(made: oracle.NodeContacts):
    return made.node, made.arity, made.inverse_mass


def test_random_colours_depend_on_the_seed():
    graph = node_graph(*_arrays(oracle.random_contacts(3, 150, N_NODES)))
    one, same, other = (colour_random(graph, seed) for seed in (1, 1, 2))
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_random_colours_of_a_clique():
    """Palettes start with a third of the required colours, and must grow."""
    graph = sp.csr_matrix(~np.eye(12, dtype=bool))
    assert sorted(colour_random(graph, 5)) == list(range(12))


def test_a_graph_without_edges():
    graph = sp.csr_matrix((4, 4), dtype=bool)
    assert not colour_random(graph).any() and not colour_greedy(graph).any()
    assert len(colour_greedy(sp.csr_matrix((0, 0), dtype=bool))) == len(colour_random(sp.csr_matrix((0, 0), dtype=bool))) == 0


def priority(c: np.ndarray) -> np.ndarray:
    x = c.astype(np.int64)
    for _ in range(2):
        x = ((x ^ (x >> 16)) * 73244475) % 2**31
    return x ^ (x >> 16)


@pytest.mark.parametrize("k", [1, 60, 700])
def test_kernels_colour_first_fit_by_priority(problems, k):
    made = oracle.random_contacts(4, k, N_NODES, led=True)
    graph = node_graph(*_arrays(made))
    priorities = priority(np.arange(k))
    assert len(set(priorities)) == k
    expected = nx.greedy_color(nx.from_scipy_sparse_array(graph), lambda g, _: sorted(g, key=lambda c: -priorities[c]))
    for p in (*problems, problems[1]):
        fill(p, made)
        colouring.colour_contacts(p)
        colour = p.colour.to_numpy()[:k]
        assert colour.tolist() == [expected[c] for c in range(k)]
        order, start = groups(colour)
        assert p.count[1] == len(start) - 1
        assert np.array_equal(p.order.to_numpy()[:k], order)
        assert np.array_equal(p.colour_start.to_numpy()[: len(start)], start)
    if k == 700:
        assert colour.max() > colouring.BITS  # more colours than one bit mask holds


@pytest.mark.parametrize("method", ["greedy", "random"])
def test_colours_of_the_host_are_stored_in_a_problem(problems, method):
    made = oracle.random_contacts(5, 80, N_NODES)
    fill(problems[0], made)
    graph = colouring.graph_of(problems[0])
    stored = colour_greedy(graph) if method == "greedy" else colour_random(graph, 4)
    colouring.store(problems[0], stored)
    colour = problems[0].colour.to_numpy()[:80]
    assert is_colouring(node_graph(*_arrays(made)), colour) and np.array_equal(colour, stored)
    order, start = groups(colour)
    assert np.array_equal(problems[0].order.to_numpy()[:80], order) and problems[0].count[1] == len(start) - 1


def test_no_contacts(problems):
    problems[0].count[0] = 0
    colouring.colour_contacts(problems[0])
    assert problems[0].count[1] == 0


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
