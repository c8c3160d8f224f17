"""The contact graph and its colours: contacts that push the same node must not be relaxed at once.

An edge joins two contacts that share a node which can move (report, algorithm 6); obstacles and fully led nodes join nothing. For
a W that is given as a matrix, an edge is a block off the diagonal that is not zero, either way round. Colours on the host:
    colour_greedy    networkx, largest degree first or another of its strategies;
    colour_random    Vivace, Fratarcangeli, Tibaldo and Pellacini 2016: tentative colours at random, kept where no neighbour
                     before it has the same; the palette of a contact that runs dry grows by one.
`colouring` colours in kernels.
"""

import numpy as np
import scipy.sparse as sp

UNCOLOURED = -1


# --- the graph --------------------------------------------------------------------------------------------------------


def node_graph(node: np.ndarray, arity: np.ndarray, inverse_mass: np.ndarray) -> sp.csr_matrix:
    """Adjacency (k,k), bool, of contacts over nodes.

    node: (k, NODES) of which the first arity[c] hold; inverse_mass: (n_nodes, 3) [1/kg].
    """
    k = len(arity)
    held = np.arange(node.shape[1]) < arity[:, None]
    contact, nodes = np.broadcast_to(np.arange(k)[:, None], node.shape)[held], node[held]
    free = np.any(inverse_mass[nodes] != 0.0, axis=1)
    touches = sp.csr_matrix(
        (np.ones(free.sum(), dtype=np.int32), (contact[free], nodes[free])), shape=(k, len(inverse_mass))
    )
    return _without_loops(touches @ touches.T)


def matrix_graph(W: sp.spmatrix) -> sp.csr_matrix:
    """Adjacency (k,k), bool, of the contacts of W (3k,3k)."""
    W = W.tocoo()
    k, used = W.shape[0] // 3, W.data != 0.0
    blocks = sp.csr_matrix((np.ones(used.sum(), dtype=np.int32), (W.row[used] // 3, W.col[used] // 3)), shape=(k, k))
    return _without_loops(blocks + blocks.T)


def _without_loops(joined: sp.spmatrix) -> sp.csr_matrix:
    joined = joined.tocoo()
    off = joined.row != joined.col
    return sp.csr_matrix((np.ones(off.sum(), dtype=bool), (joined.row[off], joined.col[off])), shape=joined.shape)


# --- colours on the host ----------------------------------------------------------------------------------------------


def colour_greedy(graph: sp.csr_matrix, strategy: str = "largest_first") -> np.ndarray:
    """Colours (k,) from 0 by networkx.greedy_color."""
    import networkx as nx  # a tenth of a second, which few scenes need

    colours = nx.greedy_color(nx.from_scipy_sparse_array(graph), strategy=strategy)
    return np.array([colours[c] for c in range(graph.shape[0])], dtype=np.int32)


def colour_random(graph: sp.csr_matrix, seed: int = 0, shrink: float = 3.0) -> np.ndarray:
    """Colours (k,) from 0 by Vivace; palettes start with degree / shrink colours."""
    k = graph.shape[0]
    generator = np.random.default_rng(seed)
    edges = sp.triu(graph).tocoo()
    a, b = edges.row, edges.col
    degree = np.diff(graph.indptr)
    size = np.maximum(1, np.ceil(degree / shrink)).astype(int)  # of the palettes; none needs more than degree + 1
    number = np.arange(int(degree.max(initial=0)) + 2)
    taken = np.zeros((k, len(number)), dtype=bool)
    colour = np.full(k, UNCOLOURED, dtype=np.int32)
    while True:
        left = np.flatnonzero(colour == UNCOLOURED)
        if not len(left):
            return _in_use(colour)
        free = (number < size[left, None]) & ~taken[left]
        dry = ~free.any(axis=1)
        size[left[dry]] += 1
        left, free = left[~dry], free[~dry]
        tentative = np.full(k, UNCOLOURED)
        tentative[left] = np.argmax(np.where(free, generator.random(free.shape), -1.0), axis=1)
        keep = tentative != UNCOLOURED
        # of two with the same the lower keeps it: if neither did, two that have one colour each would never end
        keep[b[keep[a] & (tentative[a] == tentative[b])]] = False
        colour[keep] = tentative[keep]
        for one, other in ((a, b), (b, a)):
            told = keep[one]
            taken[other[told], colour[one[told]]] = True


def _in_use(colour: np.ndarray) -> np.ndarray:
    """The same colours, numbered without gaps."""
    return np.unique(colour, return_inverse=True)[1].astype(np.int32)


def groups(colour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Contacts by colour: (order (k,), start (colours + 1,)); those of one colour in ascending order."""
    order = np.argsort(colour, kind="stable").astype(np.int32)
    start = np.concatenate([[0], np.cumsum(np.bincount(colour))]).astype(np.int32)
    return order, start
