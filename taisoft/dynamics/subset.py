"""Lists by which a stage is restricted to few nodes, see `elimination`: the edges and blocks of elements at each node."""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download, upload
from taisoft.fem.model import Model
from taisoft.fem.node_graph import BLOCKS, EDGES, NODES, Subset, whole_rows
from taisoft.fem.pattern import patch_nodes
from taisoft.linear.block_csr import BlockCsr
from taisoft.ranges import entries_of, owners


def _with_patches(m: Model, start: np.ndarray, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add to the blocks at each node those of its patches. start (n + 1), block: rows of a table, in and out."""
    patch, node = patch_nodes(m)
    tet_start, tet = download([m.mean.tet_start, m.mean.tet])
    counts = np.diff(tet_start)[patch]
    key = np.concatenate([owners(np.diff(start)), np.repeat(node, counts)]) * m.n_blocks
    key = np.unique(key + np.concatenate([block, tet[entries_of(tet_start, patch)] // m.lanes]))
    return np.searchsorted(key, np.arange(len(start)) * m.n_blocks), key % m.n_blocks


class SubsetLists:
    """Edges and blocks at each node of a model, on the host, and storage for a subset."""

    def __init__(self, m: Model, A: BlockCsr):
        self._groups, self._sweep = m.groups, m.sweep
        half_start, column, upper, lower = download([A.row_start, A.column, A.edge_upper, A.edge_lower])
        self.start, order = whole_rows(half_start)
        edge = np.zeros(2 * A.n_edges, dtype=np.int32)  # of each entry of the matrix
        edge[upper] = edge[lower] = np.arange(A.n_edges)
        self.column, self._edge = column[order], edge[order]
        self._tet_start, entry = download([m.gather_start, m.gather_entry])
        self._block = np.zeros(len(entry), dtype=np.int32)  # of each tet at each node
        for g in m.groups:
            block = (entry - g.force_at * m.lanes) // (3 * g.n_nodes * m.lanes)
            own = (block >= 0) & (block < g.last - g.first)
            self._block[own] = g.first + block[own]
        if m.mean_dilatation:  # a node changes the pressure on all tets of its patches
            self._tet_start, self._block = _with_patches(m, self._tet_start, self._block)
        self._arena = FieldArena()
        count = self._arena.field("subset_count", ti.i32, BLOCKS + len(m.groups) + 1)
        sizes = {"node": m.n_nodes, "edge": A.n_edges, "block": m.groups[-1].last}
        self._subset = Subset(count, *(self._arena.field(f"subset_{name}", ti.i32, n) for name, n in sizes.items()))

    def subset(self, nodes: np.ndarray) -> Subset:
        """Return a subset of nodes, ascending, with the edges and blocks at them; the same record each time."""
        s, groups = self._subset, self._groups
        edges = np.unique(self._edge[entries_of(self.start, nodes)])
        blocks = np.unique(self._block[entries_of(self._tet_start, nodes)])
        count = np.zeros(s.count.shape, dtype=np.int32)
        count[[NODES, EDGES]] = len(nodes), len(edges)
        nodes = nodes[np.argsort(self._sweep.rank(nodes))]
        count[BLOCKS:] = np.searchsorted(blocks, [g.first for g in groups] + [groups[-1].last])
        rows = [(field, np.resize(data, field.shape)) for field, data in ((s.node, nodes), (s.edge, edges), (s.block, blocks))]
        upload([(s.count, count), *rows])
        return s

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of the lists by name."""
        return self._arena.bytes

    def release(self) -> None:
        """Free their memory."""
        self._arena.release()
