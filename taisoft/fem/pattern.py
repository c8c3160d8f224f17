"""Pairs of nodes that share a tet, a patch or a spring: the pattern of matrices, and where the blocks of tets add to it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from taisoft.backend.arrays import download
from taisoft.fem import springs
from taisoft.fem.dependent_table import DependentTable, expanded_pairs, master_pairs
from taisoft.fem.model import Group, Model
from taisoft.fem.node_graph import PAIRS, NodeGraph, node_graph

MATRIX_BLOCKS = {1: 6, 2: 45 + 6}  # 3x3 blocks per tet in the assembly buffer: node pairs, and six scratch blocks of order 2


def group_nodes(model: Model) -> Iterator[tuple[Group, np.ndarray, np.ndarray]]:
    """For each group its lanes (k,) that are not padding, counted from its first, and the nodes (k, n_nodes) of their tets."""
    (nodes, volume), lanes = download([model.nodes, model.volume]), model.lanes
    flat, real = nodes.astype(np.int64), volume.reshape(-1) > 0
    for g in model.groups:
        lane = np.flatnonzero(real[g.first * lanes : g.last * lanes])
        block = flat[g.nodes_at :][: (g.last - g.first) * g.n_nodes * lanes].reshape(-1, g.n_nodes, lanes)
        yield g, lane, block.transpose(0, 2, 1).reshape(-1, g.n_nodes)[lane]


def patch_nodes(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Patches (k,), ascending, and their nodes (k,), ascending in each patch."""
    patch, lanes, pairs = model.mean.patch.to_numpy().reshape(-1).astype(np.int64), model.lanes, []
    for g, lane, own in group_nodes(model):
        if g.mean_dilatation:
            pairs.append(np.unique(patch[g.first * lanes + lane][:, None] * model.n_nodes + own))
    return np.divmod(np.unique(np.concatenate(pairs)), model.n_nodes)


def patch_pairs(patch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (k,), (k,) of all pairs of entries with the same patch, the lower first. patch: ascending."""
    firsts, seconds = [], []
    for distance in range(1, int(np.bincount(patch).max())):
        first = np.flatnonzero(patch[distance:] == patch[:-distance])
        firsts.append(first)
        seconds.append(first + distance)
    return np.concatenate(firsts), np.concatenate(seconds)


def model_graph(model: Model) -> tuple[NodeGraph, np.ndarray, np.ndarray | None]:
    """Pairs of nodes that share a tet, a patch or a spring, and where the assembly buffer has the blocks (e,) that they sum up.

    The latter are indices times lanes, plus the lane, in the order of the graph's `pair`, which goes on with those of
    `patch_pairs`. With dependent nodes also the factors (e,2) of `expanded_pairs`, else None.
    """
    ends, entries, lanes = [], [], model.lanes
    for g, lane, own in group_nodes(model):
        pairs = np.array(PAIRS[g.order])
        ends.append(own[:, pairs].reshape(-1, 2))
        base = g.matrix_at + (lane // lanes)[:, None] * (MATRIX_BLOCKS[g.order] * 9) + 9 * np.arange(len(pairs))
        entries.append((base * lanes + (lane % lanes)[:, None]).reshape(-1))
    ends, entries, factors, others = np.concatenate(ends), np.concatenate(entries), None, []
    if model.dependents is not None:
        own = model.dependents
        node, start, master, weight = download([own.node, own.start, own.master, own.weight])
        table = DependentTable(model.n_nodes, *(ids.astype(np.int64) for ids in (node, start, master)), weight)
        others += [ends, master_pairs(table, ends)]
        ends, rows, factors = expanded_pairs(table, ends)
        entries = entries[rows]
    patches = np.zeros((0, 2), dtype=np.int64)
    if model.mean_dilatation:
        patch, node = patch_nodes(model)
        patches = node[np.stack(patch_pairs(patch), axis=1)]
    if model.springs is not None:
        others.append(springs.node_pairs(model.springs))
    graph = node_graph(np.concatenate([ends, patches, *others]), model.n_nodes, model.sweep)
    return replace(graph, pair=graph.pair[: len(entries) + len(patches)]), entries, factors
