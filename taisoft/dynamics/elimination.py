"""Nonlinear elimination: solve separately on the few nodes that keep Newton's method from converging.

Tets that invert, fold or snap are few and strongly nonlinear: each Newton step of the whole stage changes them so much that the
next one makes no progress. If a step reduces |r| little, and nearly all of it is on few nodes, the stage is solved on these and
their neighbours while all others are fixed. The remaining residual is smooth and suits the next full step.
Source: Lanzkron, Rose and Wilkes, "An analysis of approximate nonlinear elimination", SIAM J. Sci. Comput. 17(2), 1996.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import taichi as ti

from taisoft.backend.fields import FieldArena
from taisoft.backend.transfer import download, upload
from taisoft.dynamics.newton import Newton
from taisoft.dynamics.stage import STAY
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.fem.model import Model
from taisoft.fem.subset import BLOCKS, EDGES, NODES, Subset
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


CONCENTRATED, FEW = 0.99, 0.35  # minimum fraction of |r|^2 on the chosen nodes, and maximum fraction of nodes
RINGS = 2  # of neighbours added to them
STEPS, REDUCTION = 32, 0.1  # maximum Newton steps of an elimination, and target fraction of |r|


@dataclass(frozen=True)
class Eliminated:
    """Newton and CG iterations of an elimination, each times the fraction of nodes."""

    newton: float
    linear: float


def choose_nodes(residual: np.ndarray, start: np.ndarray, column: np.ndarray) -> np.ndarray | None:
    """Return the fewest nodes with nearly all of |r|^2, and their neighbours, ascending; None if they are many.

    residual: (n, 3) on the free axes, 0 on others. start (n + 1), column: each node's neighbours.
    """
    squares = (residual.astype(np.float64) ** 2).sum(axis=1)
    largest = np.argsort(-squares, kind="stable")
    cumulative = np.cumsum(squares[largest])
    if not 0.0 < cumulative[-1] < math.inf:
        return None
    n = int(np.searchsorted(cumulative, CONCENTRATED * cumulative[-1])) + 1
    if n > FEW * len(squares):
        return None
    nodes = largest[:n]
    for _ in range(RINGS):
        nodes = np.unique(np.concatenate([nodes, column[entries_of(start, nodes)]]))
    return nodes


def eliminate(system: StageSystem, stage: Stage, r: float) -> Eliminated | None:
    """Solve a stage on the few nodes with nearly all of |r|, see `solve_on`; return None if they are many."""
    residual, free = download([system.work.residual, system.model.free])
    lists = system.lists
    nodes = choose_nodes(free * residual, lists.start, lists.column)
    return None if nodes is None else solve_on(system, stage, nodes, REDUCTION * r)


def solve_on(system: StageSystem, stage: Stage, nodes: np.ndarray, target: float) -> Eliminated:
    """Solve a stage on some nodes, ascending, under the current multipliers, until their |r| is at most `target` [N s].

    This updates the state and the elastic forces; the residual must be evaluated again, and the matrix is invalid.
    """
    system.restrict(nodes)
    try:
        substage = replace(stage, absolute_tolerance=target, contact_tolerance=math.inf, keeps_multipliers=True, max_newton=STEPS)
        newton = Newton(system, substage)
        newton.run(*system.evaluate(STAY), fresh=False)
    finally:
        system.restrict(None)
    fraction = len(nodes) / system.model.n_nodes
    return Eliminated(fraction * newton.newton, fraction * newton.linear)
