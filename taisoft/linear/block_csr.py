"""Assemble the stiffness matrix as 3x3 block CSR over nodes, with a pattern built once.

Each tet writes the blocks K_ab (a < b) between its nodes (`element_blocks`). Each node pair gathers its blocks in a fixed
order and writes K_ij and its transpose. The diagonal block is minus the sum of the row, since a translation stores no energy.
K is the second derivative of the energy (positive at rest), so df/dx = -K. Projected: each element's contribution is made
positive semi-definite first.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, download
from taisoft.backend.runtime import kernel
from taisoft.errors import SimulationError
from taisoft.fem import rigid_tets, springs
from taisoft.fem.chunks import chunk_entry, chunk_size
from taisoft.fem.model import Model
from taisoft.fem.pattern import MATRIX_BLOCKS, model_graph
from taisoft.fem.terms import rayleigh_damping
from taisoft.fem.terms.elasticity import prepare_terms
from taisoft.linear.block_rows import padded
from taisoft.linear.element_blocks import element_blocks, pair_terms
from taisoft.linear.patch_terms import PatchTerms, add_patches, build_patch_terms, find_gradients
from taisoft.ranges import owners

# A block is a 12-vector, column by column, each padded with a zero: entry (r, c) is at 4 c + r. All entries share one address,
# and a column times a number is one SIMD instruction.
BLOCK = 12
ROW_SUM_STEP = 4  # entries of `row_sum` per chunk, so that threads write to different cache lines
SINGULAR = 1e-12  # of the product of its diagonal: a block with a smaller determinant counts as singular


@dataclass(frozen=True, eq=False)
class BlockCsr:
    """A symmetric matrix of 3x3 blocks with the model's node graph as pattern."""

    n_edges: Count
    row_start: Any  # (2 n_nodes + 1) i32: of half-rows before the diagonal, then after it, see `node_graph.NodeGraph`
    column: Any  # (2 n_edges) i32
    value: Any  # (2 n_edges) 12-vectors: blocks off the diagonal
    diagonal: Any  # (n_nodes) 12-vectors
    row_sum: Any  # 4-vectors: written but not read, see `keep_padding_lane`
    row_sum_mask: int  # of the chunks that write to it
    element: Any  # K_ab of each tet, per block of tets (pair, entry, lane)
    edge_start: Any  # (n_edges + 1) i32: rows of edge_entry
    edge_entry: Any  # i32: index into element, lanes times the first entry plus the lane
    edge_upper: Any  # (n_edges) i32: index of K_ij in value
    edge_lower: Any  # (n_edges) i32: index of K_ji
    term_start: Any = None  # this and the next two only for quadratic tets, see `element_blocks.pair_terms`
    term_pair: Any = None
    term_factor: Any = None
    apart_start: Any = None  # (2 n_nodes) i32, see `node_graph.NodeGraph`
    edge_factor: Any = None  # (entries, 2), see `fem.dependent_table.expanded_pairs`; only with dependent nodes
    patches: PatchTerms | None = None  # of mean dilatation

    @property
    def crossed(self) -> bool:
        """Whether blocks couple different chunks of one parity of a sweep."""
        return self.apart_start is not None

    @property
    def is_expanded(self) -> bool:
        """Whether blocks of tets act on other nodes than the tets'."""
        return self.edge_factor is not None


def build_block_csr(model: Model, arena: FieldArena, prefix: str = "stiffness") -> BlockCsr:
    """Build the pattern and gather table from the model's tets. `assemble` fills the values."""
    graph, base, shares = model_graph(model)
    if base.max(initial=0) > np.iinfo(np.int32).max - 9 * model.lanes:
        raise SimulationError(f"{int(model.volume.shape[0]) * model.lanes} tets are too many to assemble a stiffness matrix")
    n_edges, rules = len(graph.ends), {}
    if model.springs is not None:
        springs.set_pair_entries(model.springs, graph)
    if model.rigid_tets is not None:
        rigid_tets.set_pair_entries(model.rigid_tets, graph)

    def copied(name: str, data: np.ndarray, dtype=ti.i32):
        return arena.field(f"{prefix}_{name}", dtype, data.shape, data)

    if model.points is not None:
        start, pairs, factors = pair_terms(model.rules)
        rules["term_start"], rules["term_pair"] = copied("term_start", start), copied("term_pair", pairs)
        rules["term_factor"] = copied("term_factor", factors, model.real)
    if graph.apart_start is not None:
        rules["apart_start"] = copied("apart_start", graph.apart_start)
    of_tets, of_patches = graph.pair[: len(base)], graph.pair[len(base) :]
    by_edge = np.argsort(of_tets, kind="stable")
    if shares is not None:
        rules["edge_factor"] = copied("edge_factor", shares[by_edge], model.real)
    if model.mean_dilatation:
        rules["patches"] = build_patch_terms(model, arena, prefix, of_patches, n_edges)
    size = sum((g.last - g.first) * MATRIX_BLOCKS[g.order] * 9 for g in model.groups)
    chunks = model.chunks if model.on_cpu else 1  # a power of two
    return BlockCsr(
        n_edges=n_edges,
        row_start=copied("row_start", graph.row_start),
        column=copied("column", graph.column),
        **_values(model, arena, prefix, n_edges),
        row_sum=arena.vectors(f"{prefix}_row_sum", model.real, ROW_SUM_STEP * (chunks - 1) + 1, n=4),
        row_sum_mask=chunks - 1,
        element=arena.field(f"{prefix}_element", model.real, size * model.lanes),
        edge_start=copied("edge_start", np.concatenate([[0], np.cumsum(np.bincount(of_tets, minlength=n_edges))])),
        edge_entry=copied("edge_entry", base[by_edge]),
        edge_upper=copied("edge_upper", graph.upper),
        edge_lower=copied("edge_lower", graph.lower),
        **rules,
    )


def sibling(matrix: BlockCsr, model: Model, arena: FieldArena, prefix: str) -> BlockCsr:
    """A second matrix that shares pattern and element buffer but has its own values."""
    return replace(matrix, **_values(model, arena, prefix, matrix.n_edges))


def _values(model: Model, arena: FieldArena, prefix: str, n_edges: int) -> dict[str, Any]:
    return {
        "value": arena.vectors(f"{prefix}_value", model.real, 2 * n_edges, n=BLOCK),
        "diagonal": arena.vectors(f"{prefix}_diagonal", model.real, model.n_nodes, n=BLOCK),
    }


@kernel
def assemble(m: ti.template(), A: ti.template(), projected: ti.template()):
    """Assemble A = K(x) [N/m]. projected: with positive semi-definite element contributions."""
    if ti.static(m.mean_dilatation):
        find_gradients(m, A)
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            element_blocks(m, g, A, b, projected)
    ti.loop_config(serialize=m.serial)
    for e in range(A.n_edges):
        gather_edge(m, A, e, projected)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        s = ti.Vector([0.0 for _ in ti.static(range(BLOCK))], m.real)
        for half in range(2):
            row = i + half * m.n_nodes
            for k in range(A.row_start[row], A.row_start[row + 1]):
                s -= A.value[k]
        A.diagonal[i] = s


@ti.func
def gather_edge(m: ti.template(), A: ti.template(), e, projected: ti.template()):
    """Sum the element blocks, and terms of patches, of one edge and write K_ij and K_ji."""
    s = ti.Vector([0.0 for _ in ti.static(range(BLOCK))], m.real)
    for k in range(A.edge_start[e], A.edge_start[e + 1]):
        at = A.edge_entry[k]
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                if ti.static(A.is_expanded):
                    transposed = A.element[at + (3 * c + r) * m.lanes]
                    s[4 * c + r] += A.edge_factor[k, 0] * A.element[at + (3 * r + c) * m.lanes] + A.edge_factor[k, 1] * transposed
                else:
                    s[4 * c + r] += A.element[at + (3 * r + c) * m.lanes]
    if ti.static(m.mean_dilatation):
        add_patches(m, A, e, s, projected)
    A.value[A.edge_upper[e]] = s
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            A.value[A.edge_lower[e]][4 * r + c] = s[4 * c + r]


@kernel
def to_system(m: ti.template(), A: ti.template(), damper: ti.template(), projected: ti.i32, c: ti.f64, beta: ti.f64):
    """Set A = (c + beta a) M + beta^2 (A + K_t) + beta b K_d in place.

    a, b: mass and stiffness damping of the row's body; K_d: values of the matrix `damper`; K_t: stiffness of the terms that have
    STIFFNESS, without their negative part if projected.
    """
    prepare_terms(m)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        k, inertia, damping = ti.cast(beta * beta, m.real), ti.cast(c, m.real), ti.cast(0.0, m.real)
        if ti.static(m.damped):
            inertia += ti.cast(beta, m.real) * rayleigh_damping.mass_rate(m, i)
            damping = ti.cast(beta, m.real) * rayleigh_damping.stiffness_rate(m, i)
        mass = m.mass[i]
        if ti.static(m.consistent):
            mass = m.mass_matrix.diagonal[i]
        for half in range(2):
            row = i + half * m.n_nodes
            for at in range(A.row_start[row], A.row_start[row + 1]):
                A.value[at] = k * A.value[at]
                if ti.static(m.stiffness_damping):
                    A.value[at] += damping * damper.value[at]
                if ti.static(m.consistent):
                    for r in ti.static(range(3)):
                        A.value[at][5 * r] += inertia * m.mass_matrix.value[at]
        d = k * A.diagonal[i]
        if ti.static(m.stiffness_damping):
            d += damping * damper.diagonal[i]
        for r in ti.static(range(3)):
            d[5 * r] += inertia * mass
        A.diagonal[i] = d
        for term in ti.static(m.terms):
            if ti.static(term.STIFFNESS):
                term.add_stiffness(m, A, i, beta, projected)


@ti.func
def padded_times(B, x):
    """A block times a 3-vector, as a 4-vector whose last entry is 0."""
    return ti.Vector([B[r] * x[0] + B[4 + r] * x[1] + B[8 + r] * x[2] for r in ti.static(range(4))])


@ti.func
def block_times(B, x):
    """A block times a 3-vector."""
    y = padded_times(B, x)
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def definite_inverse(m: ti.template(), D, free):
    """Inverse of P on the free axes, and P: D, or a diagonal of absolute row sums if D is not positive definite."""
    P, inverse = D, ti.Vector([0.0 for _ in ti.static(range(BLOCK))], m.real)
    B = ti.Matrix.zero(ti.f64, 3, 3)  # f64, to invert blocks whose stiffness differs much between directions
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            free_rc = free[r] * free[c]
            B[r, c] = free_rc * D[4 * c + r] + (1.0 - free_rc if ti.static(r == c) else 0.0)
    minor = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
    det, size = B.determinant(), B[0, 0] * B[1, 1] * B[2, 2]
    if not (B[0, 0] > 0.0 and minor > 0.0 and det > SINGULAR * size):
        P = inverse
        for r in ti.static(range(3)):
            d = ti.max(abs(B[r, 0]) + abs(B[r, 1]) + abs(B[r, 2]), 1e-30)
            for c in ti.static(range(3)):
                B[r, c] = d if ti.static(r == c) else 0.0
            P[5 * r] = ti.cast(d, m.real)
    C = B.inverse()
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            inverse[4 * c + r] = free[r] * free[c] * ti.cast(C[r, c], m.real)
    return inverse, P


@ti.func
def keep_padding_lane(m: ti.template(), A: ti.template(), c, y):
    """Store a row's sum so that the compiler keeps its unused fourth entry and adds four numbers in one SIMD operation, not two.

    Conjugate gradient iterations then take 0.75 of the time if the matrix fits into the cache, 0.9 if it does not.
    """
    if ti.static(m.on_cpu):
        A.row_sum[ROW_SUM_STEP * (c & A.row_sum_mask)] = y


@ti.func
def partial_row_times(m: ti.template(), A: ti.template(), c, first, last, x: ti.template()):
    """Sum of blocks first <= k < last (of one row) times x at their columns, within chunk c of a loop."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)
    for k in range(first, last):
        y += padded_times(A.value[k], x[A.column[k]])
    keep_padding_lane(m, A, c, y)
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def partial_row_times_backward(m: ti.template(), A: ti.template(), c, first, last, x: ti.template()):
    """The same sum in reverse order: a backward sweep then uses the most recently computed entries of x last."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)
    for n in range(last - first):
        k = last - 1 - n
        y += padded_times(A.value[k], x[A.column[k]])
    keep_padding_lane(m, A, c, y)
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def _times_neighbours(m: ti.template(), A: ti.template(), c, i, x: ti.template(), relative: ti.template()):
    """Off-diagonal blocks of row i times x of their nodes, with `relative` minus that of node i, within chunk c of a loop."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)
    for half in range(2):
        row = i + half * m.n_nodes
        for k in range(A.row_start[row], A.row_start[row + 1]):
            if ti.static(relative):
                y += padded_times(A.value[k], ti.cast(x[A.column[k]] - x[i], m.real))
            else:
                y += padded_times(A.value[k], x[A.column[k]])
    keep_padding_lane(m, A, c, y)
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def off_diagonal_times(m: ti.template(), A: ti.template(), c, i, x: ti.template()):
    """((A - D) x)_i, D the diagonal blocks, within chunk c of a loop."""
    return _times_neighbours(m, A, c, i, x, False)


@ti.func
def row_times(m: ti.template(), A: ti.template(), c, i, x: ti.template()):
    """(A x)_i, within chunk c of a loop."""
    return block_times(A.diagonal[i], x[i]) + off_diagonal_times(m, A, c, i, x)


@ti.func
def stiffness_times(m: ti.template(), A: ti.template(), c, i, x: ti.template()):
    """(A x)_i of a stiffness, within chunk c of a loop. Its rows sum to zero: differences leave no rounding of a common x."""
    return _times_neighbours(m, A, c, i, x, True)


@kernel
def multiply(m: ti.template(), A: ti.template(), x: ti.template(), y: ti.template()):
    """y = A x, (n_nodes) 3-vectors."""
    ti.loop_config(serialize=m.serial)
    for task in range(m.chunks * m.spread):
        if task % m.spread == 0:
            c = task // m.spread
            for k in range(chunk_size(m, c, m.n_nodes)):
                i = chunk_entry(m, c, k, m.n_nodes)
                y[i] = row_times(m, A, c, i, x)


def packed(blocks: np.ndarray) -> np.ndarray:
    """Convert blocks (k, 3, 3) to the stored form (k, 12)."""
    return padded(blocks, BLOCK // 3)


def unpacked(blocks: np.ndarray) -> np.ndarray:
    """Convert stored blocks (k, 12) to (k, 3, 3) float64."""
    return blocks.reshape(-1, 3, 4)[:, :, :3].swapaxes(1, 2).astype(np.float64)


def to_bsr(m: Model, A: BlockCsr, diagonal: Any = None) -> sp.bsr_matrix:
    """Copy the matrix to the host, blocks (3, 3) float64 in ascending columns, with all diagonal ones.

    diagonal: field of diagonal blocks; None: A's.
    """
    start, column, value, diagonal = download([A.row_start, A.column, A.value, A.diagonal if diagonal is None else diagonal])
    own = np.arange(m.n_nodes)
    row, column = np.concatenate([owners(np.diff(start)) % m.n_nodes, own]), np.concatenate([column, own])
    order = np.lexsort((column, row))  # SciPy's sum would leave out blocks that are 0
    blocks, whole = np.concatenate([unpacked(value), unpacked(diagonal)]), np.concatenate([[0], np.cumsum(np.bincount(row))])
    return sp.bsr_matrix((blocks[order], column[order], whole), shape=(3 * m.n_nodes, 3 * m.n_nodes))
