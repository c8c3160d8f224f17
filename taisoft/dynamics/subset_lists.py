"""Lists of a subset of a stage's nodes and of the edges and blocks at them, for a `Subset`."""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download, upload
from taisoft.fem.model import Model
from taisoft.fem.node_graph import BLOCKS, EDGES, NODES, Subset
from taisoft.linear.block_csr import BlockCsr


def entries_of(start: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the indices of all entries of some rows, row by row. start: (n + 1) first index of each row."""
    counts = start[rows + 1] - start[rows]
    ends = np.cumsum(counts)
    return np.arange(counts.sum()) + np.repeat(start[rows] - ends + counts, counts)


class SubsetLists:
    """Edges and blocks at each node of a model, on the host, and storage for a subset."""

    def __init__(self, m: Model, A: BlockCsr):
        self._groups = m.groups
        self.start, self.column, upper, lower = download([A.row_start, A.column, A.edge_upper, A.edge_lower])
        self._edge = np.zeros(2 * A.n_edges, dtype=np.int32)  # of each entry of the matrix
        self._edge[upper] = self._edge[lower] = np.arange(A.n_edges)
        self._tet_start, entry = download([m.gather_start, m.gather_entry])
        self._block = np.zeros(len(entry), dtype=np.int32)  # of each tet at each node
        for g in m.groups:
            size = 3 * g.n_nodes * m.lanes
            own = (entry >= g.force_at) & (entry < g.force_at + (g.last - g.first) * size)
            self._block[own] = g.first + (entry[own] - g.force_at) // size
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
