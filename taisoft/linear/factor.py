"""A Cholesky factor in kernels: its fronts, which `multifrontal` factorises on the host, and substitutions on one thread.

The factor of an earlier matrix is a preconditioner of `pcg`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.blas import one_thread
from taisoft.backend.runtime import kernel
from taisoft.fem.model import Model
from taisoft.linear import pcg
from taisoft.linear.banded import product, subtract
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.multifrontal import Multifrontal
from taisoft.linear.pcg_work import LinearResult, PcgWork, sum_products
from taisoft.ranges import owners

FEW_CALLS = 5e-6  # [s] of a front, as in `Multifrontal`, where each factorisation is followed by many solves
SHIFT = 1e-12  # of its diagonal, added to a matrix: rounding must not make it indefinite


@dataclass(frozen=True, eq=False)
class Factor:
    """L, and a right-hand side (n) f64, then the solution, in the order of elimination. Also a `pcg.Preconditioner`."""

    fronts: Multifrontal  # on the host, whose numbers are `value`
    n: Count
    n_fronts: Count
    first: Any  # (n_fronts + 1) i32: first column of each front
    start: Any  # (n_fronts + 1) i32: where its rows begin in `row`
    row: Any  # i32: rows below the columns of each front
    at: Any  # (n_fronts) i32: where its numbers begin in `value`
    value: Any  # f64
    order: Any  # (n) i32: old index of each unknown
    rhs: Any
    below: Any  # (most rows below) f64: numbers of these rows

    @ti.func
    def prepare(self, model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), i, same_matrix):
        """Nothing."""

    @ti.func
    def apply(self, model: ti.template(), work: ti.template()):
        """z = A^-1 r of the factorised matrix."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            for k in range(self.n):
                self.rhs[k] = work.r[self.order[k] // 3][self.order[k] % 3]
            substitute(self)
            for k in range(self.n):
                i, axis = self.order[k] // 3, self.order[k] % 3
                work.z[i][axis] = model.free[i][axis] * ti.cast(self.rhs[k], model.real)
        sum_products(model, work)

    def solution(self, b: np.ndarray) -> np.ndarray:
        """Return the solution (n) for a right-hand side (n)."""
        self.rhs.host[:] = b[self.fronts.order]
        substitute_once(self)
        return self.rhs.host[self.fronts.place]

    @property
    def n_bytes(self) -> int:
        """Memory of the factor."""
        return self.value.host.nbytes

    def solve(
        self, model: Model, A: BlockCsr, work: PcgWork, tolerance: float, max_iterations: int, stiffness: float = 1.0
    ) -> LinearResult:
        """Solve for work.y given work.rhs. stiffness has no effect: conjugate gradients do not depend on a factor."""
        return pcg.solve(model, A, self, work, tolerance, max_iterations)


def build_factor(start: np.ndarray, column: np.ndarray, d: int, calls: float = Multifrontal.CALLS) -> Factor:
    """Allocate the factor of matrices with these blocks (d, d), see `Multifrontal`."""
    fronts, arena = Multifrontal(start, column, d, calls), FieldArena()
    n, names = len(fronts.order), ("first", "start", "row", "at", "order")
    indices = {name: arena.filled(name, ti.i32, getattr(fronts, name)) for name in names}
    sizes = {"value": len(fronts.values), "rhs": n, "below": fronts.n_below.max()}
    numbers = {name: arena.field(name, ti.f64, int(size)) for name, size in sizes.items()}
    fronts.keep_in(numbers["value"].host)
    return Factor(fronts, n, len(fronts.width), **indices, **numbers)


def factorised(A: sp.bsr_matrix, known: Factor | None = None) -> Factor:
    """Factorise A for many solves; raise numpy.linalg.LinAlgError if it is not positive definite.

    known: of the same pattern, to be overwritten.
    """
    d, blocks = A.blocksize[0], A.data.copy()
    blocks[A.indices == owners(np.diff(A.indptr))] *= 1.0 + SHIFT * np.eye(d)
    found = known or build_factor(A.indptr, A.indices, d, FEW_CALLS)
    with one_thread():
        found.fronts.factorise(blocks.reshape(-1)[found.fronts.lower])
    return found


@ti.func
def substitute(L: ti.template()):
    """Replace the right-hand side by (L L^T)^-1 times it, inside a serial loop."""
    substitute_forward(L)
    substitute_backward(L)


@ti.func
def substitute_forward(L: ti.template()):
    """Replace the right-hand side by L^-1 times it."""
    for f in range(L.n_fronts):
        first, width, start = L.first[f], L.first[f + 1] - L.first[f], L.start[f]
        below = L.start[f + 1] - start
        for k in range(below):
            L.below[k] = 0.0
        for j in range(width):
            top, low = L.at[f] + j * (width + 1), L.at[f] + width * width + j * below
            y = L.rhs[first + j] / L.value[top]
            L.rhs[first + j] = y
            subtract(L.rhs, first + j, y, L.value, top, 1, width - j)
            subtract(L.below, 0, y, L.value, low, 0, below)
        for k in range(below):
            L.rhs[L.row[start + k]] = L.rhs[L.row[start + k]] + L.below[k]


@ti.func
def substitute_backward(L: ti.template()):
    """Replace the right-hand side by L^-T times it."""
    for reverse_front in range(L.n_fronts):
        f = L.n_fronts - 1 - reverse_front
        first, width, start = L.first[f], L.first[f + 1] - L.first[f], L.start[f]
        below = L.start[f + 1] - start
        for k in range(below):
            L.below[k] = L.rhs[L.row[start + k]]
        for reverse in range(width):
            j = width - 1 - reverse
            top, low = L.at[f] + j * (width + 1), L.at[f] + width * width + j * below
            known = product(L.value, top, L.rhs, first + j, 1, width - j) + product(L.value, low, L.below, 0, 0, below)
            L.rhs[first + j] = (L.rhs[first + j] - known) / L.value[top]


@kernel
def substitute_once(L: ti.template()):
    """See `substitute`."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        substitute(L)
