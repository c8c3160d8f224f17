"""Rigid motions of aggregates of nodes as a coarse space for `pcg_multigrid`: its matrices, formed from one on the device.

With A = L + D + L^T, L the half-rows before the diagonal in the order of a Gauss-Seidel sweep, and T the rigid modes of the
aggregates (`aggregation`), these are B = L T and T^T A T = T^T B + (T^T B)^T + T^T D T. They are summed in f64. Blocks E that
sweeps leave out (`pcg_gauss_seidel`) belong to B, those before the diagonal and those after it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import kernel
from taisoft.fem.model import Model
from taisoft.linear.aggregation import MODES, aggregate_modes
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.block_rows import BlockRows, allocate_matrix
from taisoft.mesh.aggregates import aggregate
from taisoft.ranges import expand


@dataclass(frozen=True)
class CoarsePattern:
    """Aggregates of a matrix's nodes, and the blocks of B, row by row."""

    aggregate: np.ndarray  # (n_nodes), -1 for constrained nodes
    n_coarse: int
    row: np.ndarray  # (n_blocks) node of each block
    column: np.ndarray  # (n_blocks) aggregate of each block


def find_pattern(m: Model, A: BlockCsr, start: np.ndarray, column: np.ndarray, free: np.ndarray) -> CoarsePattern:
    """Aggregate the nodes with a free axis, of free (n_nodes, 3) bool. start (n_nodes + 1), column: A's rows with diagonals."""
    own = aggregate(start, column, free.any(axis=1))
    n_coarse, n = int(own.max()) + 1, m.n_nodes
    first, last = A.row_start.host[:-1].copy(), A.row_start.host[1:]
    first[n:] = last[n:] if A.apart_start is None else A.apart_start.host[n:]
    half_row, entry = expand(first, last - first)
    row, near = half_row % n, own[A.column.host[entry]]
    used = (near >= 0) & (own[row] >= 0)
    keys = np.sort(row[used] * np.int64(n_coarse) + near[used])
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return CoarsePattern(own, n_coarse, keys // n_coarse, keys % n_coarse)


@dataclass(frozen=True, eq=False)
class GalerkinWork:
    """Arrays of `form_products`. A slot is a pair of aggregates that blocks of B couple."""

    n_slots: Count
    n_coarse: Count
    aggregate: Any  # (n_nodes) i32
    modes: Any  # (3 n_nodes) 6-vectors: rows of T
    row: Any  # (n_blocks) i32: node of each block of B
    column: Any  # (n_blocks) i32: aggregate
    place: Any  # (n_blocks) i32: index of its transpose
    slot_start: Any  # (n_slots + 1) i32: rows of slot_block
    slot_block: Any  # (n_blocks) i32
    node_start: Any  # (n_coarse + 1) i32: rows of node
    node: Any  # i32: nodes of each aggregate
    lower: Any  # (n_slots) 36-vectors: T^T B
    diagonal: Any  # (n_coarse) 36-vectors: T^T D T


@dataclass(frozen=True, eq=False)
class CoarseSpace:
    """B and B^T of one matrix."""

    product: BlockRows
    transposed: BlockRows


def build_coarse_space(
    m: Model, A: BlockCsr, pattern: CoarsePattern, modes: np.ndarray, arena: FieldArena
) -> tuple[CoarseSpace, sp.bsr_matrix, np.ndarray]:
    """Return B, T^T A T and the coarse modes (n_coarse, 6, 6). modes: (n_nodes, 3, 6) rigid modes, 0 on constrained axes."""
    blocks, coarse_modes, unused = aggregate_modes(modes, pattern.aggregate)
    n, n_coarse, row, column = m.n_nodes, pattern.n_coarse, pattern.row, pattern.column
    by_column = np.argsort(column, kind="stable")
    product = allocate_matrix(arena, "multigrid_product", m.real, (3, MODES), row, column, (n, n_coarse))
    transposed = allocate_matrix(
        arena, "multigrid_transposed", m.real, (MODES, 3), column[by_column], row[by_column], (n_coarse, n)
    )
    slot = pattern.aggregate[row] * np.int64(n_coarse) + column
    by_slot = np.argsort(slot, kind="stable")
    first = np.flatnonzero(np.diff(slot[by_slot], prepend=-1))
    slots = slot[by_slot][first]
    temporary = FieldArena()

    def ints(name: str, data: np.ndarray):
        return temporary.field(f"multigrid_{name}", ti.i32, len(data), data)

    place = np.empty(len(row), dtype=np.int64)
    place[by_column] = np.arange(len(row))
    nodes = np.argsort(pattern.aggregate, kind="stable")
    nodes = nodes[np.count_nonzero(pattern.aggregate < 0) :]
    of_aggregate = np.bincount(pattern.aggregate[nodes], minlength=n_coarse)
    work = GalerkinWork(
        n_slots=len(slots),
        n_coarse=n_coarse,
        aggregate=ints("aggregate", pattern.aggregate),
        modes=temporary.vectors("multigrid_modes", ti.f64, 3 * n, blocks.reshape(-1, MODES), n=MODES),
        row=ints("row", row),
        column=ints("column", column),
        place=ints("place", place),
        slot_start=ints("slot_start", np.append(first, len(slot))),
        slot_block=ints("slot_block", by_slot),
        node_start=ints("node_start", np.concatenate([[0], np.cumsum(of_aggregate)])),
        node=ints("node", nodes),
        lower=temporary.vectors("multigrid_lower", ti.f64, len(slots), n=MODES**2),
        diagonal=temporary.vectors("multigrid_diagonal", ti.f64, n_coarse, n=MODES**2),
    )
    form_products(m, A, work, product, transposed)
    coarse = _coarse_matrix(work.lower.host, work.diagonal.host, slots, unused)
    temporary.release()
    return CoarseSpace(product, transposed), coarse, coarse_modes


def _coarse_matrix(lower: np.ndarray, diagonal: np.ndarray, slots: np.ndarray, unused: np.ndarray) -> sp.bsr_matrix:
    """T^T A T from the arrays of `GalerkinWork`, 1 on the diagonal of unused unknowns. slots: of each block of lower."""
    n, size = len(diagonal), (-1, MODES, MODES)
    i, j = np.divmod(slots, n)
    own, mirrored = np.arange(n) * (n + 1), j * n + i
    keys = np.sort(np.concatenate([slots, own, mirrored]))
    keys = keys[np.diff(keys, prepend=-1) > 0]
    data = np.zeros((len(keys), MODES, MODES))
    data[np.searchsorted(keys, slots)] = lower.reshape(size)
    data[np.searchsorted(keys, mirrored)] += lower.reshape(size).swapaxes(1, 2)
    data[np.searchsorted(keys, own)] += diagonal.reshape(size)
    rows, columns = np.divmod(keys, n)
    node, mode = np.nonzero(unused)
    data[np.flatnonzero(rows == columns)[node], mode, mode] = 1.0
    start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
    return sp.bsr_matrix((data, columns, start), shape=(MODES * n, MODES * n))


@ti.func
def _add_block(b, V, T: ti.template(), j):
    """b + V T_j: (3, 6) numbers row by row, V a stored block."""
    z = b
    for c in ti.static(range(3)):
        t = T[3 * j + c]
        for r in ti.static(range(3)):
            v = ti.cast(V[4 * c + r], ti.f64)
            for a in ti.static(range(MODES)):
                z[MODES * r + a] += v * t[a]
    return z


@ti.func
def _add_product(s, b, T: ti.template(), i):
    """s + T_i^T b: (6, 6) numbers row by row."""
    z = s
    for r in ti.static(range(3)):
        t = T[3 * i + r]
        for a in ti.static(range(MODES)):
            for d in ti.static(range(MODES)):
                z[MODES * a + d] += t[a] * b[MODES * r + d]
    return z


@kernel
def form_products(m: ti.template(), A: ti.template(), g: ti.template(), B: ti.template(), Bt: ti.template()):
    """Set the blocks of B and B^T, T^T B and T^T D T."""
    ti.loop_config(serialize=m.serial)
    for slot in range(g.n_slots):
        s = ti.Vector([0.0 for _ in ti.static(range(MODES * MODES))], ti.f64)
        for at in range(g.slot_start[slot], g.slot_start[slot + 1]):
            k = g.slot_block[at]
            i, b = g.row[k], ti.Vector([0.0 for _ in ti.static(range(3 * MODES))], ti.f64)
            for entry in range(A.row_start[i], A.row_start[i + 1]):
                j = A.column[entry]
                if g.aggregate[j] == g.column[k]:
                    b = _add_block(b, A.value[entry], g.modes, j)
            s = _add_product(s, b, g.modes, i)
            if ti.static(A.crossed):
                for entry in range(A.apart_start[i + m.n_nodes], A.row_start[i + m.n_nodes + 1]):
                    j = A.column[entry]
                    if g.aggregate[j] == g.column[k]:
                        b = _add_block(b, A.value[entry], g.modes, j)
            for r in ti.static(range(3)):
                for a in ti.static(range(MODES)):
                    B.value[k][B.lanes * a + r] = ti.cast(b[MODES * r + a], m.real)
                    Bt.value[g.place[k]][Bt.lanes * r + a] = ti.cast(b[MODES * r + a], m.real)
        g.lower[slot] = s
    ti.loop_config(serialize=m.serial)
    for c in range(g.n_coarse):
        s = ti.Vector([0.0 for _ in ti.static(range(MODES * MODES))], ti.f64)
        for at in range(g.node_start[c], g.node_start[c + 1]):
            i = g.node[at]
            b = _add_block(ti.Vector([0.0 for _ in ti.static(range(3 * MODES))], ti.f64), A.diagonal[i], g.modes, i)
            s = _add_product(s, b, g.modes, i)
        g.diagonal[c] = s
