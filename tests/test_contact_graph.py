"""The contact graph and its colours:

* contacts over nodes are joined where they share a node that can move along some axis, by brute force; fully led nodes join none;
* contacts of a matrix are joined by a block off the diagonal, either way round; blocks of zeros join none;
* every colouring gives no two joined contacts the same colour, numbers its colours without gaps and needs at most degree + 1;
* random colours depend on the seed alone; the kernels' colours are first-fit in the order of their priorities, whatever the
  threads do;
* groups hold every contact once, by colour.
"""

import contact_oracle as oracle
import networkx as nx
import numpy as np
import pytest
import scipy.sparse as sp

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import open_runtime
from taisoft.contact import colouring, problem
from taisoft.contact.colouring import colour_greedy, colour_random, groups, matrix_graph, node_graph

N_NODES, CAPACITY = 120, 700


@pytest.fixture(scope="module")
def problems():
    """Room on one thread and on all."""
    runtime, arenas = open_runtime("cpu", "f32"), [FieldArena(), FieldArena()]
    yield [problem.build_node_problem(arena, CAPACITY, N_NODES, serial) for arena, serial in zip(arenas, (True, False))]
    for arena in arenas:
        arena.release()
    runtime.close()


def put(p: problem.ContactProblem, made: oracle.NodeContacts) -> None:
    for field, values in ((p.node, made.node), (p.arity, made.arity), (p.inverse_mass, made.inverse_mass)):
        problem.fill_field(field, values)
    p.count[0] = len(made.arity)


def joined(made: oracle.NodeContacts) -> np.ndarray:
    """Adjacency by brute force."""
    sets = [{i for i in made.node[c, :n] if made.inverse_mass[i].any()} for c, n in enumerate(made.arity)]
    return np.array([[bool(a & b) and i != j for j, b in enumerate(sets)] for i, a in enumerate(sets)])


def is_colouring(graph: sp.csr_matrix, colour: np.ndarray) -> bool:
    edges = graph.tocoo()
    return not (colour[edges.row] == colour[edges.col]).any() and set(colour) == set(range(colour.max() + 1))


@pytest.mark.parametrize("led", [False, True])
def test_graph_of_nodes(problems, led):
    made = oracle.random_contacts(0, 60, N_NODES, led=led)
    graph = node_graph(made.node, made.arity, made.inverse_mass)
    assert np.array_equal(graph.toarray(), joined(made))
    put(problems[0], made)
    assert np.array_equal(colouring.graph_of(problems[0]).toarray(), joined(made))
    free = oracle.random_contacts(0, 60, N_NODES, led=False)
    assert (joined(made).sum() < joined(free).sum()) == led


def test_graph_of_a_matrix():
    W = np.kron(np.eye(5), np.ones((3, 3)))
    W[0, 4] = W[10, 14] = 1.0  # above the diagonal only, below only
    W[14, 3] = -1.0
    graph = matrix_graph(sp.csr_matrix(W)).toarray()
    assert {(int(i), int(j)) for i, j in np.argwhere(graph)} == {(0, 1), (1, 0), (3, 4), (4, 3), (4, 1), (1, 4)}
    stored = sp.bsr_matrix((np.zeros((1, 3, 3)), [1], [0, 1, 1]), shape=(6, 6))
    assert matrix_graph(stored).nnz == 0


def test_both_forms_have_one_graph():
    made = oracle.random_contacts(1, 50, N_NODES, led=True)
    assert np.array_equal(matrix_graph(sp.csr_matrix(made.W)).toarray(), joined(made))


@pytest.mark.parametrize("k", [1, 2, 30, 200])
@pytest.mark.parametrize("way", ["largest_first", "smallest_last", "random"])
def test_colours_on_the_host(way, k):
    graph = node_graph(*_of(oracle.random_contacts(2, k, N_NODES, led=True)))
    colour = colour_random(graph, seed=3) if way == "random" else colour_greedy(graph, way)
    assert is_colouring(graph, colour) and colour.max() <= np.diff(graph.indptr).max()


def _of(made: oracle.NodeContacts):
    return made.node, made.arity, made.inverse_mass


def test_random_colours_follow_the_seed():
    graph = node_graph(*_of(oracle.random_contacts(3, 150, N_NODES)))
    one, same, other = (colour_random(graph, seed) for seed in (1, 1, 2))
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_random_colours_of_a_clique():
    """Palettes start with a third of the colours that are needed: they must grow."""
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
def test_colours_of_the_kernels(problems, k):
    made = oracle.random_contacts(4, k, N_NODES, led=True)
    graph = node_graph(*_of(made))
    names = priority(np.arange(k))
    assert len(set(names)) == k
    expected = nx.greedy_color(nx.from_scipy_sparse_array(graph), lambda g, _: sorted(g, key=lambda c: -names[c]))
    for p in (*problems, problems[1]):
        put(p, made)
        colouring.colour_contacts(p)
        colour = p.colour.to_numpy()[:k]
        assert colour.tolist() == [expected[c] for c in range(k)]
        order, start = groups(colour)
        assert p.count[1] == len(start) - 1
        assert np.array_equal(p.order.to_numpy()[:k], order)
        assert np.array_equal(p.colour_start.to_numpy()[: len(start)], start)
    if k == 700:
        assert colour.max() > colouring.BITS  # more colours than one look holds


@pytest.mark.parametrize("way", ["greedy", "random"])
def test_colours_of_the_host_in_a_problem(problems, way):
    made = oracle.random_contacts(5, 80, N_NODES)
    put(problems[0], made)
    graph = colouring.graph_of(problems[0])
    stored = colour_greedy(graph) if way == "greedy" else colour_random(graph, 4)
    colouring.store(problems[0], stored)
    colour = problems[0].colour.to_numpy()[:80]
    assert is_colouring(node_graph(*_of(made)), colour) and np.array_equal(colour, stored)
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
