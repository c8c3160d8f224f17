"""Dependent nodes, x_d = sum_i w_i x_i of independent nodes i: those of exact attachments, and of embedded surfaces. NumPy.

With x = T q of the independent positions q, forces act as T^T f, and matrices as T^T A T. The lumped mass of a dependent node
goes to its independent ones in proportion to |w_i|: any share conserves momentum and angular momentum, and masses stay positive
where quadratic tets have negative weights. Weight acts by w_i. A node may depend on nodes that are dependent themselves; T then
maps through them.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from taisoft.errors import SceneError
from taisoft.scene.connections import locate_nodes
from taisoft.scene.scene import Scene

# Of its own mass, what a dependent node keeps: kernels divide by masses, whose quotients they then discard
KEPT_MASS = 1e-12


@dataclass(frozen=True, eq=False)
class DependentTable:
    """d dependent nodes of n; s weights in all."""

    n_nodes: int
    node: np.ndarray  # (d,) ascending
    start: np.ndarray  # (d + 1) first weight of each
    master: np.ndarray  # (s,) independent nodes
    weight: np.ndarray  # (s,)
    chained: sp.csr_matrix | None = None  # (d, d) weights of those that depend on dependent nodes; None: unknown

    @cached_property
    def rows(self) -> sp.csr_matrix:
        """The rows of T of the dependent nodes (d, n_nodes)."""
        return sp.csr_matrix((self.weight, self.master, self.start), shape=(len(self.node), self.n_nodes))

    @cached_property
    def matrix(self) -> sp.csr_matrix:
        """T (n_nodes, n_nodes); columns of dependent nodes are 0."""
        independent = np.ones(self.n_nodes)
        independent[self.node] = 0.0
        placed = sp.csr_matrix((np.ones(len(self.node)), (self.node, np.arange(len(self.node)))), (self.n_nodes, len(self.node)))
        return (sp.diags(independent) + placed @ self.rows).tocsr()

    def place(self, x: np.ndarray) -> None:
        """Set the rows of the dependent nodes in x (n_nodes, 3)."""
        x[self.node] = self.rows @ x.astype(np.float64)

    def lump(self, mass: np.ndarray) -> np.ndarray:
        """Lumped masses (n_nodes,) [kg] after the dependent nodes' have moved."""
        share = abs(self.rows)
        share = sp.diags(1.0 / np.asarray(share.sum(axis=1)).ravel()) @ share
        moved = mass + share.T @ mass[self.node]
        own = mass[self.node]
        moved[self.node] = KEPT_MASS * np.where(own > 0.0, own, share @ mass)  # embedded nodes have none
        return moved

    @property
    def most_masters(self) -> int:
        """Largest number of nodes that a node depends on."""
        return int(np.diff(self.start).max())

    def growth(self, elastic: np.ndarray) -> float:
        """Largest sum |w_i|, at least 1: by its square the highest frequency of the dependent nodes' tets may grow.

        elastic: (n_nodes,) bool, which nodes belong to tets.
        """
        sums = np.asarray(abs(self.rows).sum(axis=1)).ravel()
        return float(sums[elastic[self.node]].max(initial=1.0))


def dependent_table(scene: Scene) -> DependentTable | None:
    """The dependent nodes of a scene; None if it has none. Raises SceneError for nodes that depend on themselves."""
    exact, embedding = scene.dependent_attachments, [body for body in scene.bodies if body.nodes.embedded is not None]
    if not exact and not embedding:
        return None
    starts = scene.first_nodes
    n = sum(body.n_nodes for body in scene.bodies)
    rows, columns, weights = [], [], []
    for one in exact:
        nodes, own = locate_nodes(scene, one)
        rows.append(np.repeat(starts[one.a] + one.nodes, nodes.shape[1]))
        columns.append((starts[one.b] + nodes).reshape(-1))
        weights.append(own.reshape(-1))
    for body in embedding:
        embedded, first = body.nodes.embedded.tocoo(), starts[body.name]
        rows.append(first + body.nodes.n_elastic + embedded.row)
        columns.append(first + embedded.col)
        weights.append(embedded.data)
    direct = sp.csr_matrix((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(n, n))
    direct.eliminate_zeros()
    node = np.unique(np.concatenate(rows))
    on_dependent, total = sp.diags(np.isin(np.arange(n), node).astype(float)), direct
    for _ in (*exact, *embedding[:1]):  # embedded nodes depend on others of their body alone
        chained = total @ on_dependent
        chained.eliminate_zeros()
        if chained.nnz == 0:
            break
        total = (total - chained + chained @ direct).tocsr()
        total.eliminate_zeros()
    else:
        _refuse_cycle(scene, (total @ on_dependent).tocsr(), starts)
    total.sort_indices()
    own = total[node]
    chained = direct[node][:, node].tocsr()
    return DependentTable(n, node, own.indptr.astype(np.int64), own.indices.astype(np.int64), own.data, chained)


def _refuse_cycle(scene: Scene, chained: sp.csr_matrix, starts: dict[str, int]) -> None:
    chained.eliminate_zeros()
    if chained.nnz == 0:
        return
    first = int(np.flatnonzero(np.diff(chained.indptr))[0])
    body = [b for b in scene.bodies if starts[b.name] <= first][-1]
    raise SceneError(
        f"attachments: node {first - starts[body.name]} of body {body.name!r} is attached, through others, to itself"
    )


def master_pairs(table: DependentTable, ends: np.ndarray) -> np.ndarray:
    """Pairs (e,2), i < j, of independent nodes that pairs (k,2) of nodes couple if some of them are dependent."""
    rows = ends[np.isin(ends, table.node).any(axis=1)]
    own, weights = zip(*(_padded(table, rows[:, side]) for side in (0, 1)))
    nodes, used = np.concatenate(own, axis=1), np.concatenate(weights, axis=1) != 0.0
    i, j = np.triu_indices(nodes.shape[1], 1)
    pairs = np.sort(np.stack([nodes[:, i], nodes[:, j]], axis=2)[used[:, i] & used[:, j]], axis=1)
    return np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0)


def expanded_pairs(table: DependentTable, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the block K_ab of each pair (k,2) of nodes of a tet acts, if some of them are dependent.

    Returns pairs (e,2), i < j, the row of `ends` of each, and factors (e,2): K_ij gets factor 0 times K_ab plus factor 1 times
    its transpose. The tet's diagonal blocks are minus the sums of its rows, so in x^T K x the pair stands for
    2 x_a.K_ab x_b - x_a.K_ab x_a - x_b.K_ab^T x_b, in which x_a and x_b are replaced by their sums.
    """
    involved = np.isin(ends, table.node).any(axis=1)
    plain = np.flatnonzero(~involved)
    rows = np.flatnonzero(involved)
    (nodes_a, weights_a), (nodes_b, weights_b) = (_padded(table, ends[rows, side]) for side in (0, 1))
    nodes, zero = np.concatenate([nodes_a, nodes_b], axis=1), np.zeros_like(weights_a)
    A, B = np.concatenate([weights_a, zero], axis=1), np.concatenate([zero, weights_b], axis=1)
    first = A[:, :, None] * (B - A)[:, None, :]
    second = B[:, :, None] * (A - B)[:, None, :]
    kept = (nodes[:, :, None] < nodes[:, None, :]) & ((first != 0.0) | (second != 0.0))
    at, r, s = np.nonzero(kept)
    pairs = np.concatenate([ends[plain], np.stack([nodes[at, r], nodes[at, s]], axis=1)])
    factors = np.concatenate([np.tile([1.0, 0.0], (len(plain), 1)), np.stack([first[at, r, s], second[at, r, s]], axis=1)])
    return pairs, np.concatenate([plain, rows[at]]), factors


def _padded(table: DependentTable, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Independent nodes and weights (k, most_masters) of nodes (k,), padded with weights of 0."""
    width = table.most_masters
    own, weights = np.repeat(nodes[:, None], width, axis=1), np.zeros((len(nodes), width))
    weights[:, 0] = 1.0
    at = np.flatnonzero(np.isin(nodes, table.node))
    row = np.searchsorted(table.node, nodes[at])
    entry = np.minimum(table.start[row][:, None] + np.arange(width), table.start[row + 1][:, None] - 1)
    used = np.arange(width) < np.diff(table.start)[row][:, None]
    own[at], weights[at] = table.master[entry], np.where(used, table.weight[entry], 0.0)
    return own, weights
