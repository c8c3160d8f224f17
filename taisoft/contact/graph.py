"""The contact graph and its colouring: contacts that act on the same node must not be relaxed in parallel.

An edge joins two contacts that share a movable node (report, algorithm 6); obstacles and fully prescribed nodes add no edges. For
a W given as a matrix, an edge is a nonzero block off the diagonal, in either triangle. Colourings on the host:
    colour_greedy    networkx, largest degree first or another of its strategies;
    colour_random    Vivace, Fratarcangeli, Tibaldo and Pellacini 2016: random tentative colours, kept if no neighbour of lower
                     index has the same; an exhausted palette grows by one colour.
`colouring` does this in kernels.
"""

import numpy as np
import scipy.sparse as sp

UNCOLOURED = -1


# --- the graph --------------------------------------------------------------------------------------------------------


def node_graph(node: np.ndarray, arity: np.ndarray, inverse_mass: np.ndarray) -> sp.csr_matrix:
    """Adjacency (k,k), bool, of contacts over nodes.

    node: (k, NODES), the first arity[c] are used; inverse_mass: (n_nodes, 3) [1/kg].
    """
    k = len(arity)
    used = np.arange(node.shape[1]) < arity[:, None]
    contact, nodes = np.broadcast_to(np.arange(k)[:, None], node.shape)[used], node[used]
    free = np.any(inverse_mass[nodes] != 0.0, axis=1)
    touches = sp.csr_matrix((np.ones(free.sum(), dtype=np.int32), (contact[free], nodes[free])), shape=(k, len(inverse_mass)))
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
    import networkx as nx  # imported here: it takes 0.1 s, and few scenes need it

    colours = nx.greedy_color(nx.from_scipy_sparse_array(graph), strategy=strategy)
    return np.array([colours[c] for c in range(graph.shape[0])], dtype=np.int32)


def colour_random(graph: sp.csr_matrix, seed: int = 0, shrink: float = 3.0) -> np.ndarray:
    """Colours (k,) from 0 by Vivace; palettes start with degree / shrink colours."""
    k = graph.shape[0]
    generator = np.random.default_rng(seed)
    edges = sp.triu(graph).tocoo()
    a, b = edges.row, edges.col
    degree = np.diff(graph.indptr)
    size = np.maximum(1, np.ceil(degree / shrink)).astype(int)  # of the palettes; degree + 1 suffices
    number = np.arange(int(degree.max(initial=0)) + 2)
    taken = np.zeros((k, len(number)), dtype=bool)
    colour = np.full(k, UNCOLOURED, dtype=np.int32)
    while True:
        uncoloured = np.flatnonzero(colour == UNCOLOURED)
        if not len(uncoloured):
            return _in_use(colour)
        free = (number < size[uncoloured, None]) & ~taken[uncoloured]
        exhausted = ~free.any(axis=1)
        size[uncoloured[exhausted]] += 1
        uncoloured, free = uncoloured[~exhausted], free[~exhausted]
        tentative = np.full(k, UNCOLOURED)
        tentative[uncoloured] = np.argmax(np.where(free, generator.random(free.shape), -1.0), axis=1)
        keep = tentative != UNCOLOURED
        # of two equal colours the lower index keeps its own: if neither did, two equal palettes of one colour would loop forever
        keep[b[keep[a] & (tentative[a] == tentative[b])]] = False
        colour[keep] = tentative[keep]
        for one, other in ((a, b), (b, a)):
            kept = keep[one]
            taken[other[kept], colour[one[kept]]] = True


def _in_use(colour: np.ndarray) -> np.ndarray:
    """Renumber the colours without gaps."""
    return np.unique(colour, return_inverse=True)[1].astype(np.int32)


def groups(colour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group contacts by colour: (order (k,), start (colours + 1,)), ascending within a colour."""
    order = np.argsort(colour, kind="stable").astype(np.int32)
    start = np.concatenate([[0], np.cumsum(np.bincount(colour))]).astype(np.int32)
    return order, start
