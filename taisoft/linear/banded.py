"""Banded Cholesky factors inside kernels, and the factor of an earlier matrix as preconditioner of `pcg`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.fem.model import Model
from taisoft.linear import pcg
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.multigrid import BandedCholesky
from taisoft.linear.pcg_work import LinearResult, PcgWork, sum_products

WIDE = 8  # numbers of a loop that LLVM merges into SIMD instructions, since the index mask proves that they are adjacent
MASK = 2**30 - 1


@dataclass(frozen=True, eq=False)
class Band:
    """The lower band of a symmetric matrix, or its Cholesky factor L: row j + d of column j at j * width + d."""

    n: Count  # rows
    width: Count  # of the lower band, diagonal included
    factor: Any  # (n * width) f64


@ti.func
def factorise(band: ti.template()):
    """Replace the matrix by its factor, inside a serial loop."""
    for j in range(band.n):
        start, last = j * band.width, ti.min(band.width, band.n - j)
        pivot = ti.sqrt(ti.max(band.factor[start], 1e-300))
        for d in range(last):
            band.factor[start + d] = band.factor[start + d] / pivot
        for k in range(1, last):
            l = band.factor[start + k]
            if l != 0.0:
                _subtract(band.factor, (j + k) * band.width - k, l, band.factor, start, k, last)


@ti.func
def solve_banded(band: ti.template(), rhs: ti.template()):
    """Replace a right-hand side (n) f64 by (L L^T)^-1 times it, inside a serial loop."""
    for j in range(band.n):
        y = rhs[j] / band.factor[j * band.width]
        rhs[j] = y
        _subtract(rhs, j, y, band.factor, j * band.width, 1, ti.min(band.width, band.n - j))
    for reverse in range(band.n):
        j = band.n - 1 - reverse
        below = _product(band.factor, j * band.width, rhs, j, 1, ti.min(band.width, band.n - j))
        rhs[j] = (rhs[j] - below) / band.factor[j * band.width]


@ti.func
def _load(values: ti.template(), at):
    """Load WIDE adjacent numbers."""
    return ti.Vector([values[at + q] for q in ti.static(range(WIDE))])


@ti.func
def _subtract(values: ti.template(), at, factor, other: ti.template(), start, first, last):
    """values[at + d] -= factor * other[start + d] for first <= d < last."""
    n_wide = (last - first) // WIDE
    for k in range(n_wide):
        d = first + WIDE * k
        to = (at + d) & MASK
        change = _load(values, to) - factor * _load(other, (start + d) & MASK)
        for q in ti.static(range(WIDE)):
            values[to + q] = change[q]
    for d in range(first + WIDE * n_wide, last):
        values[at + d] = values[at + d] - factor * other[start + d]


@ti.func
def _product(a: ti.template(), at, b: ti.template(), start, first, last):
    """Sum of a[at + d] b[start + d] over first <= d < last."""
    n_wide = (last - first) // WIDE
    sums = ti.Vector([0.0 for _ in ti.static(range(WIDE))], ti.f64)
    for k in range(n_wide):
        d = first + WIDE * k
        sums += _load(a, (at + d) & MASK) * _load(b, (start + d) & MASK)
    total = ti.cast(0.0, ti.f64)
    for q in ti.static(range(WIDE)):
        total += sums[q]
    for d in range(first + WIDE * n_wide, last):
        total += a[at + d] * b[start + d]
    return total


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """The inverse of a factorised matrix, see `pcg.Preconditioner`."""

    band: Band
    order: Any  # (3 n_nodes) i32: 3 node + axis of each unknown
    rhs: Any  # (3 n_nodes) f64: right-hand side, then the solution

    @ti.func
    def prepare(self, model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), i, same_matrix):
        """Nothing."""

    @ti.func
    def apply(self, model: ti.template(), work: ti.template()):
        """z = A^-1 r of the factorised matrix."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            for k in range(self.band.n):
                self.rhs[k] = work.r[self.order[k] // 3][self.order[k] % 3]
            solve_banded(self.band, self.rhs)
            for k in range(self.band.n):
                i, axis = self.order[k] // 3, self.order[k] % 3
                work.z[i][axis] = model.free[i][axis] * ti.cast(self.rhs[k], model.real)
        sum_products(model, work)


class BandedPreconditioner:
    """The factor on the device."""

    def __init__(self, found: BandedCholesky):
        self._arena, (width, n) = FieldArena(), found.factor.shape
        self._factor = BandedFactor(
            band=Band(n, width, self._arena.field("band", ti.f64, n * width, found.factor.T.reshape(-1))),
            order=self._arena.field("band_order", ti.i32, n, found.order.astype(np.int32)),
            rhs=self._arena.field("band_rhs", ti.f64, n),
        )

    @property
    def n_bytes(self) -> int:
        """Memory of the factor."""
        return sum(self._arena.bytes.values())

    def solve(
        self, model: Model, A: BlockCsr, work: PcgWork, tolerance: float, max_iterations: int, stiffness: float = 1.0
    ) -> LinearResult:
        """Solve for work.y given work.rhs. stiffness has no effect: conjugate gradients do not depend on a factor."""
        return pcg.solve(model, A, self._factor, work, tolerance, max_iterations)
