"""Sparse matrices of rectangular blocks on the device, and the loops of a multigrid cycle over them.

A block (R, C) is stored column by column, each padded with zeros to 4 or 8 numbers, the lanes of a SIMD instruction; vectors are
padded alike. Rows are gathered in the order of their entries, so that results do not depend on threads.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend import parallel
from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import kernel

NUMBER_SECONDS = 2e-10  # of one thread per number of a matrix
LANES = {3: 4, 6: 8}  # by the rows of a block


@dataclass(frozen=True, eq=False)
class BlockRows:
    """A matrix of blocks, row by row."""

    real: Any  # Taichi type of the numbers
    n_rows: Count
    n_columns: Count
    rows: int  # R
    columns: int  # C
    lanes: int
    serial: bool
    start: Any  # (n_rows + 1) i32
    column: Any  # i32
    value: Any  # (lanes * C)-vectors


@dataclass(frozen=True, eq=False)
class CycleLevel:
    """Arrays of one level; vectors have the lanes of its rows. next_r, next_x: r and x of the next level."""

    matrix: BlockRows
    smoother: Any  # blocks of S
    prolongation: BlockRows
    restriction: BlockRows
    r: Any
    x: Any
    other: Any  # residual on the way down, solution after the cycle
    next_r: Any
    next_x: Any


def padded(blocks: np.ndarray, lanes: int) -> np.ndarray:
    """Convert blocks (k, R, C) to the stored form (k, C * lanes)."""
    k, rows, columns = blocks.shape
    out = np.zeros((k, columns, lanes), dtype=blocks.dtype)
    out[:, :, :rows] = blocks.swapaxes(1, 2)
    return out.reshape(k, -1)


def upload_matrix(matrix: sp.bsr_matrix, arena: FieldArena, name: str, real) -> BlockRows:
    """Copy a matrix to the device."""
    (rows, columns), n_blocks = matrix.blocksize, len(matrix.indices)
    made = BlockRows(
        real=real,
        n_rows=matrix.shape[0] // rows,
        n_columns=matrix.shape[1] // columns,
        rows=rows,
        columns=columns,
        lanes=LANES[rows],
        serial=not parallel.pays(n_blocks * rows * columns * NUMBER_SECONDS),
        start=arena.field(f"{name}_start", ti.i32, len(matrix.indptr), matrix.indptr),
        column=arena.field(f"{name}_column", ti.i32, n_blocks, matrix.indices),
        value=arena.vectors(name, real, n_blocks, n=LANES[rows] * columns),
    )
    made.value.from_numpy(padded(matrix.data, made.lanes))
    return made


@ti.func
def plus_block(y, V, X, lanes: ti.template(), columns: ti.template()):
    """y + V X."""
    z = y
    for c in ti.static(range(columns)):
        z += ti.Vector([V[lanes * c + r] * X[c] for r in ti.static(range(lanes))])
    return z


@ti.func
def block_row_times(B: ti.template(), i, x: ti.template()):
    """(B x)_i."""
    z = ti.Vector.zero(B.real, B.lanes)
    for k in range(B.start[i], B.start[i + 1]):
        z = plus_block(z, B.value[k], x[B.column[k]], B.lanes, B.columns)
    return z


@ti.func
def _smooth(k: ti.template(), A: ti.template(), factor, x: ti.template(), y: ti.template()):
    """y = x + factor S (r - A x), in a loop at the top level of a kernel."""
    ti.loop_config(serialize=A.serial)
    for i in range(A.n_rows):
        d = k.r[i] - block_row_times(A, i, x)
        y[i] = x[i] + ti.cast(factor, A.real) * plus_block(ti.Vector.zero(A.real, A.lanes), k.smoother[i], d, A.lanes, A.rows)


@kernel
def descend(k: ti.template(), first: ti.f64, second: ti.f64):
    """x = both steps of the smoother from 0, and the next level's r = P^T (r - A x)."""
    A, R = ti.static((k.matrix, k.restriction))
    ti.loop_config(serialize=A.serial)
    for i in range(A.n_rows):
        z = plus_block(ti.Vector.zero(A.real, A.lanes), k.smoother[i], k.r[i], A.lanes, A.rows)
        k.other[i] = ti.cast(first, A.real) * z
    _smooth(k, A, second, k.other, k.x)
    ti.loop_config(serialize=A.serial)
    for i in range(A.n_rows):
        k.other[i] = k.r[i] - block_row_times(A, i, k.x)
    ti.loop_config(serialize=R.serial)
    for i in range(R.n_rows):
        k.next_r[i] = block_row_times(R, i, k.other)


@kernel
def ascend(k: ti.template(), first: ti.f64, second: ti.f64):
    """other = x + P (the next level's x), then both steps in reverse order."""
    A, P = ti.static((k.matrix, k.prolongation))
    ti.loop_config(serialize=P.serial)
    for i in range(P.n_rows):
        k.other[i] = k.x[i] + block_row_times(P, i, k.next_x)
    _smooth(k, A, second, k.other, k.x)
    _smooth(k, A, first, k.x, k.other)
