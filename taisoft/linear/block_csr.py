"""Assembled stiffness: 3x3 block CSR over nodes, its pattern built once.

Each tet writes the six blocks K_ab (a < b) between its corners; each mesh edge gathers its blocks in a fixed order and
writes K_ij and its transpose; the diagonal block is minus the row's sum, since a translation stores no energy.
K is the second derivative of the energy (positive at rest), so df/dx = -K. Projected: each element's part is made
positive semi-definite first.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.elements import edge_gradient, law_constants, rest_gradients, volumes
from taisoft.materials.projection import dpk1_projected, prepare_projected
from taisoft.model import Model
from taisoft.runtime import FieldArena, kernel

PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # corner pairs of a tet, in the order of the element buffer


@dataclass(frozen=True, eq=False)
class BlockCsr:
    """A symmetric matrix of 3x3 blocks with the model's node graph as pattern."""

    n_edges: int
    row_start: Any  # (n_nodes + 1) i32
    row_upper: Any  # (n_nodes) i32: where a row's columns pass the diagonal
    column: Any  # (2 n_edges) i32, ascending in each row, no diagonal
    value: Any  # (2 n_edges * 9), blocks row by row
    diagonal: Any  # (n_nodes * 9)
    element: Any  # (n_blocks * 54 * lanes): K_ab of each tet, per block (pair, entry, lane)
    edge_start: Any  # (n_edges + 1) i32: rows of edge_entry
    edge_entry: Any  # (6 n_tets) i32: base index into element
    edge_upper: Any  # (n_edges) i32: where K_ij lies in value / 9
    edge_lower: Any  # (n_edges) i32: where K_ji lies


def build_block_csr(model: Model, arena: FieldArena, real, prefix: str = "stiffness") -> BlockCsr:
    """Pattern and gather table from the model's tets; values are filled by `assemble`."""
    lanes, n = model.lanes, model.n_nodes
    verts = model.verts.to_numpy().transpose(0, 2, 1).reshape(-1, 4).astype(np.int64)
    lane = np.flatnonzero(model.volume.to_numpy().reshape(-1) > 0)
    ends = np.stack([verts[lane][:, PAIRS[k]] for k in range(6)], axis=1).reshape(-1, 2)
    base = (((lane // lanes)[:, None] * 6 + np.arange(6)) * 9 * lanes + (lane % lanes)[:, None]).reshape(-1)
    key, edge = np.unique(ends[:, 0] * n + ends[:, 1], return_inverse=True)  # a tet's vertices ascend
    order = np.argsort(edge, kind="stable")
    edge_start = np.concatenate([[0], np.cumsum(np.bincount(edge, minlength=len(key)))])
    i, j = key // n, key % n
    rows, columns = np.concatenate([i, j]), np.concatenate([j, i])
    sort = np.lexsort((columns, rows))
    place = np.empty_like(sort)
    place[sort] = np.arange(len(sort))
    row_start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])

    def ints(name: str, data: np.ndarray):
        return arena.field(f"{prefix}_{name}", ti.i32, len(data), data.astype(np.int32))

    return BlockCsr(
        n_edges=len(key), row_start=ints("row_start", row_start),
        row_upper=ints("row_upper", row_start[:-1] + np.bincount(j, minlength=n)), column=ints("column", columns[sort]),
        value=arena.field(f"{prefix}_value", real, 18 * len(key)), diagonal=arena.field(f"{prefix}_diagonal", real, 9 * n),
        element=arena.field(f"{prefix}_element", real, model.n_blocks * 54 * lanes),
        edge_start=ints("edge_start", edge_start), edge_entry=ints("edge_entry", base[order]),
        edge_upper=ints("edge_upper", place[: len(key)]), edge_lower=ints("edge_lower", place[len(key) :]),
    )  # fmt: skip


def sibling(matrix: BlockCsr, model: Model, arena: FieldArena, real, prefix: str) -> BlockCsr:
    """A second matrix with the same pattern and element buffer, its own values."""
    return replace(
        matrix,
        value=arena.field(f"{prefix}_value", real, 18 * matrix.n_edges),
        diagonal=arena.field(f"{prefix}_diagonal", real, 9 * model.n_nodes),
    )


@kernel
def assemble(m: ti.template(), A: ti.template(), projected: ti.template()):
    """A = K(x) over all nodes [N/m], unprojected or with every element's part made positive semi-definite."""
    for law, first, last in ti.static(m.laws):
        ti.loop_config(serialize=m.serial)
        for b in range(first, last):
            F = edge_gradient(m, m.x, b, m.real)
            p = law_constants(m, b, m.real)
            M = rest_gradients(m, b, m.real)
            V = volumes(m, b, m.real)
            if ti.static(projected):
                S = prepare_projected(law, F, p)
                projected_blocks(m, A, b, S, M, V)
            else:
                S = law.prepare(F, p)
                exact_blocks(m, A, law, b, F, S, M, V)
    ti.loop_config(serialize=m.serial)
    for e in range(A.n_edges):
        gather_edge(m, A, e)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        for c in ti.static(range(9)):
            s = ti.cast(0.0, m.real)
            for k in range(A.row_start[i], A.row_start[i + 1]):
                s -= A.value[9 * k + c]
            A.diagonal[9 * i + c] = s


@ti.func
def exact_blocks(m: ti.template(), A: ti.template(), law: ti.template(), b, F, S, M, V):
    """K_ab of the corner pairs of block b by the law's closed form.

    Corners 1, 2, 3 have the gradients g of M's rows; K_0b is minus the sum over a of K_ab.
    """
    g = [[M[3 * a], M[3 * a + 1], M[3 * a + 2]] for a in ti.static(range(3))]
    K11, K22, K33 = law.block(F, S, g[0], g[0]), law.block(F, S, g[1], g[1]), law.block(F, S, g[2], g[2])
    # law.block(ga, gb) has the force at b as rows: its transpose is K_ab
    K21, K31, K32 = law.block(F, S, g[0], g[1]), law.block(F, S, g[0], g[2]), law.block(F, S, g[1], g[2])
    base = b * (54 * m.lanes)
    for i in ti.static(range(3)):
        for k in ti.static(range(3)):
            store(m, A, base, 0, 3 * i + k, -V * (K11[3 * i + k] + K21[3 * i + k] + K31[3 * i + k]))
            store(m, A, base, 1, 3 * i + k, -V * (K21[3 * k + i] + K22[3 * i + k] + K32[3 * i + k]))
            store(m, A, base, 2, 3 * i + k, -V * (K31[3 * k + i] + K32[3 * k + i] + K33[3 * i + k]))
            store(m, A, base, 3, 3 * i + k, V * K21[3 * k + i])
            store(m, A, base, 4, 3 * i + k, V * K31[3 * k + i])
            store(m, A, base, 5, 3 * i + k, V * K32[3 * k + i])


@ti.func
def store(m: ti.template(), A: ti.template(), base, pair: ti.template(), entry: ti.template(), value):
    for q in ti.static(range(m.lanes)):
        A.element[base + ((pair * 9 + entry) * m.lanes + q)] = value[q]


@ti.func
def projected_blocks(m: ti.template(), A: ti.template(), b, S, M, V):
    """The same of the projected second derivative, a column at a time: unrolled it takes seconds to compile."""
    base = b * (54 * m.lanes)
    for a in ti.static(range(3)):
        for k in range(3):
            # unit displacement of corner a + 1 along axis k
            on = [ti.select(k == r, ti.cast(1.0, m.real), ti.cast(0.0, m.real)) for r in ti.static(range(3))]
            D = [on[r] * M[3 * a + c] for r in ti.static(range(3)) for c in ti.static(range(3))]
            T = dpk1_projected(S, D)
            store_column(m, A, base, a, k, T, M, V)


@ti.func
def store_column(m: ti.template(), A: ti.template(), base, a: ti.template(), k, T, M, V):
    """Column k of the blocks between corner a + 1 and the others: rows r of K_(c+1)(a+1) as row k of K_(a+1)(c+1)."""
    for r in ti.static(range(3)):
        g = [
            V * (T[3 * r] * M[3 * c] + T[3 * r + 1] * M[3 * c + 1] + T[3 * r + 2] * M[3 * c + 2])
            for c in ti.static(range(3))
        ]
        g0 = -(g[0] + g[1] + g[2])
        # pair (0, a + 1) is number a: entry (r, k) of K_0a
        at0 = base + (a * 9 + 3 * r + k) * m.lanes
        for q in ti.static(range(m.lanes)):
            A.element[at0 + q] = g0[q]
        for c in ti.static(range(3)):
            if ti.static(c > a):
                # pair (a + 1, c + 1) is number a + c + 2: K_(c+1)(a+1)[r, k] is K_(a+1)(c+1)[k, r]
                at = base + ((a + c + 2) * 9 + 3 * k + r) * m.lanes
                for q in ti.static(range(m.lanes)):
                    A.element[at + q] = g[c][q]


@ti.func
def gather_edge(m: ti.template(), A: ti.template(), e):
    """Sum the element blocks of one edge and write K_ij and K_ji."""
    s = ti.Matrix.zero(m.real, 3, 3)
    for k in range(A.edge_start[e], A.edge_start[e + 1]):
        at = A.edge_entry[k]
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                s[r, c] += A.element[at + (3 * r + c) * m.lanes]
    upper, lower = 9 * A.edge_upper[e], 9 * A.edge_lower[e]
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            A.value[upper + 3 * r + c] = s[r, c]
            A.value[lower + 3 * c + r] = s[r, c]


@kernel
def to_system(m: ti.template(), A: ti.template(), damper: ti.template(), shift: ti.template(), k: ti.f64, c: ti.f64):
    """A = diag(shift) + k A + c b K_d in place; b is the stiffness damping of the row's body, K_d the damper's values."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        kr, drag = ti.cast(k, m.real), ti.cast(0.0, m.real)
        if ti.static(m.stiffness_damping):
            drag = ti.cast(c, m.real) * m.damping[m.node_body[i], 1]
        for at in range(9 * A.row_start[i], 9 * A.row_start[i + 1]):
            A.value[at] = kr * A.value[at]
            if ti.static(m.stiffness_damping):
                A.value[at] = A.value[at] + drag * damper.value[at]
        for e in ti.static(range(9)):
            d = kr * A.diagonal[9 * i + e]
            if ti.static(m.stiffness_damping):
                d += drag * damper.diagonal[9 * i + e]
            if ti.static(e % 4 == 0):
                d += shift[i]
            A.diagonal[9 * i + e] = d


@ti.func
def diagonal_times(m: ti.template(), A: ti.template(), i, x):
    """The diagonal block of row i times a 3-vector."""
    y = ti.Vector([0.0, 0.0, 0.0], m.real)
    for r in ti.static(range(3)):
        y[r] = (
            A.diagonal[9 * i + 3 * r] * x[0]
            + A.diagonal[9 * i + 3 * r + 1] * x[1]
            + A.diagonal[9 * i + 3 * r + 2] * x[2]
        )
    return y


@ti.func
def part_times(m: ti.template(), A: ti.template(), first, last, x: ti.template()):
    """Sum of the blocks first..last (of one row) times x at their columns."""
    y = ti.Vector([0.0, 0.0, 0.0], m.real)
    for k in range(first, last):
        xj, at = x[A.column[k]], 9 * k
        for r in ti.static(range(3)):
            y[r] += A.value[at + 3 * r] * xj[0] + A.value[at + 3 * r + 1] * xj[1] + A.value[at + 3 * r + 2] * xj[2]
    return y


@ti.func
def row_times(m: ti.template(), A: ti.template(), i, x: ti.template()):
    """(A x)_i."""
    return diagonal_times(m, A, i, x[i]) + part_times(m, A, A.row_start[i], A.row_start[i + 1], x)


@kernel
def multiply(m: ti.template(), A: ti.template(), x: ti.template(), y: ti.template()):
    """y = A x, (n_nodes) 3-vectors."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        y[i] = row_times(m, A, i, x)


def to_scipy(m: Model, A: BlockCsr) -> sp.csr_matrix:
    """A copy on the host, (3 n_nodes, 3 n_nodes) float64."""
    start, column = A.row_start.to_numpy().astype(np.int64), A.column.to_numpy()
    off = A.value.to_numpy().astype(np.float64).reshape(-1, 3, 3)
    diagonal = A.diagonal.to_numpy().astype(np.float64).reshape(-1, 3, 3)
    shape = (3 * m.n_nodes, 3 * m.n_nodes)
    own = np.arange(m.n_nodes)
    return (
        sp.bsr_matrix((off, column, start), shape=shape)
        + sp.bsr_matrix((diagonal, own, np.arange(m.n_nodes + 1)), shape=shape)
    ).tocsr()
