"""Banded Cholesky factors inside kernels, for matrices with one unknown a node: fronts (`factor`) of these would be so small that
calls of LAPACK took longer."""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Count

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
                subtract(band.factor, (j + k) * band.width - k, l, band.factor, start, k, last)


@ti.func
def solve_banded(band: ti.template(), rhs: ti.template()):
    """Replace a right-hand side (n) f64 by (L L^T)^-1 times it, inside a serial loop."""
    for j in range(band.n):
        y = rhs[j] / band.factor[j * band.width]
        rhs[j] = y
        subtract(rhs, j, y, band.factor, j * band.width, 1, ti.min(band.width, band.n - j))
    for reverse in range(band.n):
        j = band.n - 1 - reverse
        below = product(band.factor, j * band.width, rhs, j, 1, ti.min(band.width, band.n - j))
        rhs[j] = (rhs[j] - below) / band.factor[j * band.width]


@ti.func
def _load(values: ti.template(), at):
    """Load WIDE adjacent numbers."""
    return ti.Vector([values[at + q] for q in ti.static(range(WIDE))])


@ti.func
def subtract(values: ti.template(), at, factor, other: ti.template(), start, first, last):
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
def product(a: ti.template(), at, b: ti.template(), start, first, last):
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
