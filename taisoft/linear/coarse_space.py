"""Rigid motions of aggregates of nodes as a coarse space for `coarse_correction`: T, and T^T A T of a matrix on the device.

A row of T has the six motions of its node's aggregate (`aggregation`), of which only the arm is stored. With A = L + D + L^T, L
the half-rows before the diagonal, T^T A T = T^T B + (T^T B)^T + T^T D T, B = L T. It is summed in f64, block by block of B, which
is not stored either.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import kernel
from taisoft.fem.model import Model
from taisoft.linear.aggregation import MODES, rigid_aggregates
from taisoft.linear.block_csr import BlockCsr
from taisoft.mesh.aggregates import aggregate
from taisoft.ranges import expand


@dataclass(frozen=True, eq=False)
class CoarseSpace:
    """T: each aggregate of nodes moves as a rigid body."""

    n_coarse: Count
    aggregate: Any  # (n_nodes) i32, -1 for constrained nodes
    arm: Any  # (n_nodes) 3-vectors, see `aggregation.rigid_aggregates`
    start: Any  # (n_coarse + 1) i32: rows of node
    node: Any  # i32: nodes of each aggregate


@dataclass(frozen=True, eq=False)
class GalerkinWork:
    """Arrays of `form_products`. A slot is a pair of aggregates that blocks of B couple."""

    n_slots: Count
    modes: Any  # (3 n_nodes) 6-vectors: rows of T
    slot_start: Any  # (n_slots + 1) i32: rows of row
    slot_column: Any  # (n_slots) i32: aggregate of the column
    row: Any  # i32: node of each block of B, by slot
    lower: Any  # (n_slots) 36-vectors: T^T B
    diagonal: Any  # (n_coarse) 36-vectors: T^T D T


def build_coarse_space(
    m: Model, A: BlockCsr, start: np.ndarray, column: np.ndarray, x: np.ndarray, free: np.ndarray, arena: FieldArena
) -> tuple[CoarseSpace, sp.bsr_matrix, np.ndarray]:
    """Return T, T^T A T and the coarse modes (n_coarse, 6, 6).

    start (n_nodes + 1), column: A's rows with diagonals; x: (n_nodes, 3) positions [m]; free: (n_nodes, 3) bool.
    """
    own = aggregate(start, column, free.any(axis=1))
    arms, matrix, modes, unused = rigid_aggregates(x, free, own)
    n, n_coarse = m.n_nodes, len(modes)
    nodes = np.argsort(own, kind="stable")[np.count_nonzero(own < 0) :]
    node_start = np.concatenate([[0], np.cumsum(np.bincount(own[nodes], minlength=n_coarse))])
    space = CoarseSpace(
        n_coarse=n_coarse,
        aggregate=arena.field("multigrid_aggregate", ti.i32, n, own),
        arm=arena.vectors("multigrid_arm", m.real, n, arms),
        start=arena.field("multigrid_start", ti.i32, n_coarse + 1, node_start),
        node=arena.field("multigrid_node", ti.i32, len(nodes), nodes),
    )
    slots, row = _slots(A, own, n_coarse)
    first = np.flatnonzero(np.diff(slots, prepend=-1))
    temporary, slots = FieldArena(), slots[first]
    work = GalerkinWork(
        n_slots=len(slots),
        modes=temporary.vectors("multigrid_modes", ti.f64, 3 * n, matrix.reshape(-1, MODES), n=MODES),
        slot_start=temporary.field("multigrid_slot_start", ti.i32, len(slots) + 1, np.append(first, len(row))),
        slot_column=temporary.field("multigrid_slot_column", ti.i32, len(slots), slots % n_coarse),
        row=temporary.field("multigrid_row", ti.i32, len(row), row),
        lower=temporary.vectors("multigrid_lower", ti.f64, len(slots), n=MODES**2),
        diagonal=temporary.vectors("multigrid_diagonal", ti.f64, n_coarse, n=MODES**2),
    )
    form_products(m, A, space, work)
    coarse = _coarse_matrix(work.lower.host, work.diagonal.host, slots, unused)
    temporary.release()
    return space, coarse, modes


def _slots(A: BlockCsr, own: np.ndarray, n_coarse: int) -> tuple[np.ndarray, np.ndarray]:
    """Return slot (ascending) and row of each block of B. own: (n_nodes) aggregates."""
    n, start = len(own), A.row_start.host[: len(own) + 1]
    row, entry = expand(start[:-1], np.diff(start))
    near = own[A.column.host[entry]]
    used = (near >= 0) & (own[row] >= 0)
    row, near = row[used], near[used]
    keys = np.sort((own[row] * np.int64(n_coarse) + near) * n + row)
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return keys // n, keys % n


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
def form_products(m: ti.template(), A: ti.template(), t: ti.template(), g: ti.template()):
    """Set T^T B and T^T D T."""
    ti.loop_config(serialize=m.serial)
    for slot in range(g.n_slots):
        s = ti.Vector([0.0 for _ in ti.static(range(MODES * MODES))], ti.f64)
        for at in range(g.slot_start[slot], g.slot_start[slot + 1]):
            i, b = g.row[at], ti.Vector([0.0 for _ in ti.static(range(3 * MODES))], ti.f64)
            for entry in range(A.row_start[i], A.row_start[i + 1]):
                j = A.column[entry]
                if t.aggregate[j] == g.slot_column[slot]:
                    b = _add_block(b, A.value[entry], g.modes, j)
            s = _add_product(s, b, g.modes, i)
        g.lower[slot] = s
    ti.loop_config(serialize=m.serial)
    for c in range(t.n_coarse):
        s = ti.Vector([0.0 for _ in ti.static(range(MODES * MODES))], ti.f64)
        for at in range(t.start[c], t.start[c + 1]):
            i = t.node[at]
            b = _add_block(ti.Vector([0.0 for _ in ti.static(range(3 * MODES))], ti.f64), A.diagonal[i], g.modes, i)
            s = _add_product(s, b, g.modes, i)
        g.diagonal[c] = s
