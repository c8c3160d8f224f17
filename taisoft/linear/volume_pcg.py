"""Conjugate gradients for nearly incompressible bodies with mean dilatation: a preconditioner that holds volumes exactly.

The system is A = B + G^T C G, with a row of G for each patch's gradient and C = diag(beta^2 k) (`patch_terms`). With D, the 3x3
diagonal blocks of B, the preconditioner is the inverse of D + G^T C G, by Woodbury's formula
    D^-1 - D^-1 G^T S^-1 G D^-1,   S = C^-1 + G D^-1 G^T.
The eigenvalues of A relative to it lie between 1 and those of B relative to D: however large lambda is, the iterations are at
most those of block Jacobi without the volume terms. S has a row for each patch and couples patches that share a node, like a
matrix of pressures; it has a banded Cholesky factor.
Weakness: the band, so bodies thick in all directions fall back on `pcg`, as do contacts and CUDA.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti
from scipy.sparse.csgraph import reverse_cuthill_mckee

from taisoft.backend.arrays import Count, FieldArena, download
from taisoft.backend.runtime import kernel
from taisoft.fem.mean_dilatation import find_dilatations
from taisoft.fem.model import Model
from taisoft.linear.block_csr import BlockCsr, block_times, definite_inverse, row_times
from taisoft.linear.patch_terms import patch_stiffness
from taisoft.linear.pcg import batch_of
from taisoft.linear.pcg_work import (
    CONVERGED,
    COUNT,
    MAX_NEGATIVE_STEP,
    NEGATIVE,
    RUNNING,
    RZ,
    RZ_START,
    STATUS,
    STEP,
    LinearResult,
    PcgWork,
    dot64,
)

WIDE = 8  # numbers of a loop that LLVM merges into SIMD instructions, since the index mask proves that they are adjacent
MASK = 2**30 - 1
PAUSED = -1  # status in the kernel after its last iteration
STIFF = 10.0  # lambda over mu above which the preconditioner is worth its cost
LARGEST_WORK = 100_000_000  # operations of a factorisation


@dataclass(frozen=True, eq=False)
class VolumeSystem:
    """S and its right-hand side, patches in their own order or that of reverse Cuthill-McKee, whichever has the narrower band."""

    n_patches: Count
    width: Count  # of the lower band, diagonal included
    place: Any  # (n_patches) i32: row of each patch
    node_start: Any  # (n_nodes + 1) i32: rows of row and column
    row: Any  # i32: row of S of each patch of each node
    column: Any  # 3-vectors: D^-1 G^T for that node and patch
    factor: Any  # (n_patches * width) f64: the band by columns, of S and then of its Cholesky factor
    target: Any  # (n_patches) f64: dilatation of each patch that a correction leads to
    rhs: Any  # (n_patches) f64: right-hand side, then the solution


def is_nearly_incompressible(m: Model) -> bool:
    """Whether some patch has lambda above STIFF mu, and none a lambda of 0 or below."""
    modulus, constants, body, start, tet = download([m.mean.modulus, m.law_constants, m.block_body, m.mean.tet_start, m.mean.tet])
    first = tet[start[:-1]]
    mu = constants[first // m.lanes, 0, first % m.lanes] if m.elasticity_by_tet else constants[body[first // m.lanes], 0]
    return bool((modulus > STIFF * mu).any() and (modulus > 0.0).all())


def build_volume_system(m: Model, A: BlockCsr, arena: FieldArena) -> VolumeSystem | None:
    """Allocate S; None if its band is too wide."""
    n, (patch, start, entry) = m.mean.n_patches, download([A.patches.patch, A.patches.node_start, A.patches.entry])
    of_node = sp.csr_matrix((np.ones(len(entry), dtype=np.int32), patch[entry], start), shape=(m.n_nodes, n))
    graph = (of_node.T @ of_node).tocoo()
    place, other = np.arange(n, dtype=np.int32), np.empty(n, dtype=np.int32)  # as numbered, which suits meshes made by rows
    other[reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)] = np.arange(n)
    width, other_width = (int(np.abs(p[graph.row] - p[graph.col]).max()) + 1 for p in (place, other))
    if other_width < width:
        place, width = other, other_width
    if n * width * width > LARGEST_WORK:
        return None
    return VolumeSystem(
        n_patches=n,
        width=width,
        place=arena.field("volume_place", ti.i32, n, place),
        node_start=A.patches.node_start,
        row=arena.field("volume_row", ti.i32, len(entry), place[patch[entry]]),
        column=arena.vectors("volume_column", m.real, len(entry)),
        factor=arena.field("volume_factor", ti.f64, n * width),
        target=arena.field("volume_target", ti.f64, n),
        rhs=arena.field("volume_rhs", ti.f64, n),
    )


def solve(m: Model, A: BlockCsr, w: PcgWork, s: VolumeSystem, tolerance: float, max_iterations: int) -> LinearResult:
    """Solve for w.y given w.rhs, as `pcg.solve` without coupling and for all nodes, after `prepare_volumes`."""
    done, batch = 0, batch_of(m, A)
    while True:
        iterate_with_volumes(m, A, w, s, min(batch, max_iterations - done), tolerance, int(done == 0))
        done, status = int(w.state[COUNT]), int(w.state[STATUS])
        if status != RUNNING or done >= max_iterations:
            return LinearResult(done, status == CONVERGED, status == NEGATIVE)


@kernel
def prepare_volumes(m: ti.template(), A: ti.template(), w: ti.template(), s: ti.template(), beta2: ti.f64):
    """Compute D^-1, as w.inverse, and the factor of S, serially. beta2: the square of the beta with which A was formed."""
    t, mean = ti.static((A.patches, m.mean))
    ti.loop_config(serialize=True)
    for _ in range(1):
        for k in range(s.n_patches * s.width):
            s.factor[k] = 0.0
        for p in range(mean.n_patches):
            s.factor[s.place[p] * s.width] = 1.0 / (beta2 * patch_stiffness(m, p))
        for i in range(m.n_nodes):
            first, last = t.node_start[i], t.node_start[i + 1]
            D = A.diagonal[i]
            for n in range(first, last):
                g, k = t.gradient[t.entry[n]], ti.cast(beta2 * patch_stiffness(m, t.patch[t.entry[n]]), m.real)
                for r in ti.static(range(3)):
                    for c in ti.static(range(3)):
                        D[4 * c + r] -= k * g[r] * g[c]
            inverse, _P = definite_inverse(m, D, m.free[i])
            w.inverse[i] = inverse
            for n in range(first, last):
                h = block_times(inverse, t.gradient[t.entry[n]])
                s.column[n] = h
                for other in range(first, last):
                    below = s.row[other] - s.row[n]
                    if below >= 0:
                        at = s.row[n] * s.width + below
                        s.factor[at] = s.factor[at] + dot64(t.gradient[t.entry[other]], h)
        factorise(s)


@ti.func
def load(values: ti.template(), at):
    """Load WIDE adjacent numbers."""
    return ti.Vector([values[at + q] for q in ti.static(range(WIDE))])


@ti.func
def subtract(values: ti.template(), at, factor, other: ti.template(), start, first, last):
    """values[at + d] -= factor * other[start + d] for first <= d < last."""
    n_wide = (last - first) // WIDE
    for k in range(n_wide):
        d = first + WIDE * k
        to = (at + d) & MASK
        change = load(values, to) - factor * load(other, (start + d) & MASK)
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
        sums += load(a, (at + d) & MASK) * load(b, (start + d) & MASK)
    total = ti.cast(0.0, ti.f64)
    for q in ti.static(range(WIDE)):
        total += sums[q]
    for d in range(first + WIDE * n_wide, last):
        total += a[at + d] * b[start + d]
    return total


@ti.func
def factorise(s: ti.template()):
    """Replace the lower band of S by its Cholesky factor."""
    for j in range(s.n_patches):
        start, last = j * s.width, ti.min(s.width, s.n_patches - j)
        pivot = ti.sqrt(ti.max(s.factor[start], 1e-300))
        for d in range(last):
            s.factor[start + d] = s.factor[start + d] / pivot
        for k in range(1, last):
            l = s.factor[start + k]
            if l != 0.0:
                subtract(s.factor, (j + k) * s.width - k, l, s.factor, start, k, last)


@ti.func
def solve_volumes(s: ti.template()):
    """Replace the right-hand side by S^-1 times it."""
    n = s.n_patches
    for j in range(n):
        y = s.rhs[j] / s.factor[j * s.width]
        s.rhs[j] = y
        subtract(s.rhs, j, y, s.factor, j * s.width, 1, ti.min(s.width, n - j))
    for reverse in range(n):
        j = n - 1 - reverse
        below = product(s.factor, j * s.width, s.rhs, j, 1, ti.min(s.width, n - j))
        s.rhs[j] = (s.rhs[j] - below) / s.factor[j * s.width]


@ti.func
def precondition(m: ti.template(), w: ti.template(), s: ti.template()):
    """Set z to the preconditioned residual; return r.z."""
    for p in range(s.n_patches):
        s.rhs[p] = 0.0
    for i in range(m.n_nodes):
        r = w.r[i]
        for n in range(s.node_start[i], s.node_start[i + 1]):
            s.rhs[s.row[n]] = s.rhs[s.row[n]] + ti.cast(s.column[n].dot(r), ti.f64)
    solve_volumes(s)
    rz = ti.cast(0.0, ti.f64)
    for i in range(m.n_nodes):
        z = block_times(w.inverse[i], w.r[i])
        for n in range(s.node_start[i], s.node_start[i + 1]):
            z -= ti.cast(s.rhs[s.row[n]], m.real) * s.column[n]
        w.z[i] = z
        rz += dot64(w.r[i], z)
    return rz


@kernel
def save_volumes(m: ti.template(), s: ti.template()):
    """Save the dilatations at x for `restore_volumes`."""
    find_dilatations(m)
    ti.loop_config(serialize=m.serial)
    for p in range(s.n_patches):
        s.target[p] = m.mean.dilatation[p]


@ti.func
def correct_volumes(m: ti.template(), s: ti.template(), x_hat: ti.template(), beta):
    """Correct x, and v = (x - x_hat) / beta, to first order towards the target dilatations, by the smallest change in D, as
    top-level loops of a kernel."""
    find_dilatations(m)
    ti.loop_config(serialize=True)
    for _ in range(1):
        for p in range(s.n_patches):
            s.rhs[s.place[p]] = m.mean.volume[p] * (m.mean.dilatation[p] - s.target[p])
        solve_volumes(s)
        for i in range(m.n_nodes):
            change = ti.Vector([0.0, 0.0, 0.0], ti.f64)
            for n in range(s.node_start[i], s.node_start[i + 1]):
                change += s.rhs[s.row[n]] * ti.cast(s.column[n], ti.f64)
            x = m.state.x[i] - change
            m.state.x[i] = x
            m.state.v[i] = (x - x_hat[i]) / beta


@kernel
def restore_volumes(m: ti.template(), s: ti.template(), x_hat: ti.template(), beta: ti.f64):
    """Correct x and v towards the saved dilatations, see `correct_volumes`."""
    correct_volumes(m, s, x_hat, beta)


@kernel
def step_with_volumes(
    m: ti.template(),
    A: ti.template(),
    s: ti.template(),
    base: ti.template(),
    y: ti.template(),
    x_hat: ti.template(),
    beta: ti.f64,
):
    """Set base = x, take the step beta y, and correct it towards the dilatations that it leads to in first order.

    m.mean.dilatation: those at x.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        for p in range(s.n_patches):
            s.rhs[p] = 0.0
        for i in range(m.n_nodes):
            step, x = y[i], m.state.x[i]
            for n in range(s.node_start[i], s.node_start[i + 1]):
                s.rhs[s.row[n]] = s.rhs[s.row[n]] + dot64(A.patches.gradient[A.patches.entry[n]], step)
            base[i] = x
            m.state.x[i] = x + beta * ti.cast(step, ti.f64)
        for p in range(s.n_patches):
            s.target[p] = m.mean.dilatation[p] + beta * s.rhs[s.place[p]] / m.mean.volume[p]
    correct_volumes(m, s, x_hat, beta)


@kernel
def iterate_with_volumes(
    m: ti.template(), A: ti.template(), w: ti.template(), s: ti.template(), n: ti.i32, tolerance: ti.f64, begin: ti.i32
):
    """Run up to n iterations. begin: 1 to start from y = 0, 0 to go on."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        if begin == 1:
            for i in range(m.n_nodes):
                w.y[i] = ti.Vector([0.0, 0.0, 0.0], m.real)
                w.r[i] = m.free[i] * w.rhs[i]
                w.p[i] = ti.Vector([0.0, 0.0, 0.0], m.real)
            w.state[RZ_START], w.state[COUNT], w.state[STATUS], w.state[STEP] = -1.0, 0.0, RUNNING, 0.0
        count, status = 0, ti.cast(RUNNING, ti.i32)
        while status == RUNNING:
            rz = precondition(m, w, s)
            ratio = ti.cast(0.0, m.real)
            if w.state[RZ_START] < 0.0:
                w.state[RZ_START] = rz
            else:
                ratio = ti.cast(rz / w.state[RZ], m.real)
            if rz <= tolerance * tolerance * w.state[RZ_START]:
                status = CONVERGED
            elif count >= n:
                status = PAUSED
            else:
                w.state[RZ] = rz
                curvature = ti.cast(0.0, ti.f64)
                for i in range(m.n_nodes):
                    w.p[i] = w.z[i] + ratio * w.p[i]
                for i in range(m.n_nodes):
                    q = m.free[i] * row_times(m, A, 0, i, w.p)
                    w.q[i] = q
                    curvature += dot64(w.p[i], q)
                if not curvature > 0.0:
                    status = NEGATIVE
                    length = ti.cast(MAX_NEGATIVE_STEP, m.real)
                    if curvature < 0.0:
                        length = ti.cast(ti.min(rz / -curvature, MAX_NEGATIVE_STEP), m.real)
                    for i in range(m.n_nodes):
                        w.y[i] = w.y[i] + length * w.p[i]
                else:
                    a = ti.cast(rz / curvature, m.real)
                    for i in range(m.n_nodes):
                        w.y[i] = w.y[i] + a * w.p[i]
                        w.r[i] = w.r[i] - a * w.q[i]
                    count += 1
        w.state[STATUS] = RUNNING if status == PAUSED else status
        w.state[COUNT] = w.state[COUNT] + count
