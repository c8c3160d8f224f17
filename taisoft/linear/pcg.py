"""Preconditioned conjugate gradients on the free axes, for (shift + k K [+ damping K_d]) y = rhs.

shift is a number per node (inertia). The preconditioner is block-Jacobi: the inverse of each node's 3x3 block. Vectors
are in the model's precision, sums in f64 and in a fixed order. Stops on sqrt(r.z), relative to the start, and on negative
curvature (p.Ap <= 0), which is reported: the caller then asks for a projected matrix.
Small systems run in one serial kernel (a launch an iteration would cost more than the iteration); large ones in parallel
loops whose residual is read every few iterations.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.linear.block_csr import BlockCsr, row_times
from taisoft.model import Model
from taisoft.runtime import FieldArena, kernel

SERIAL_WORK = 40_000_000  # block products per launch: about 0.2 s, so that Ctrl-C is heard
PARALLEL_BATCH = 8  # iterations between two looks at the residual
RZ, RZ_START, CURVATURE, STEP, COUNT, STOP = range(6)  # places in `state`
RUNNING, CONVERGED, NEGATIVE = range(3)


@dataclass(frozen=True, eq=False)
class PcgWork:
    """The system beside its matrix, and the vectors of the iteration; (n_nodes) 3-vectors unless said otherwise."""

    rhs: Any
    y: Any  # the solution
    r: Any
    z: Any
    p: Any
    q: Any  # A p
    shift: Any  # (n_nodes): inertia of each node
    inverse: Any  # (n_nodes * 9): preconditioner blocks
    damper: Any  # BlockCsr of the damping matrix, or None
    factor: Any  # (2) f64: factor of K, factor of the damping matrix's rows
    state: Any  # (6) f64


def build_pcg(model: Model, arena: FieldArena, damper: BlockCsr | None) -> PcgWork:
    """Allocate the vectors of a solve."""
    names = ("rhs", "y", "r", "z", "p", "q")
    vectors = {name: arena.vectors(f"pcg_{name}", model.real, model.n_nodes) for name in names}
    return PcgWork(
        **vectors, shift=arena.field("pcg_shift", model.real, model.n_nodes),
        inverse=arena.field("pcg_inverse", model.real, 9 * model.n_nodes), damper=damper,
        factor=arena.field("pcg_factor", ti.f64, 2), state=arena.field("pcg_state", ti.f64, 6),
    )  # fmt: skip


@ti.func
def apply_row(m: ti.template(), A: ti.template(), w: ti.template(), i, x: ti.template()):
    """Row i of the system times x, on free axes."""
    y = w.shift[i] * x[i] + ti.cast(w.factor[0], m.real) * row_times(m, A, i, x)
    if ti.static(m.stiffness_damping):
        c = ti.cast(w.factor[1], m.real) * m.damping[m.node_body[i], 1]
        y += c * row_times(m, w.damper, i, x)
    return m.free[i] * y


@ti.func
def invert_block(m: ti.template(), A: ti.template(), w: ti.template(), i):
    """The preconditioner block of node i: constrained axes drop out."""
    B = ti.Matrix.zero(m.real, 3, 3)
    k = ti.cast(w.factor[0], m.real)
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            B[r, c] = k * A.diagonal[9 * i + 3 * r + c]
            if ti.static(m.stiffness_damping):
                B[r, c] += ti.cast(w.factor[1], m.real) * m.damping[m.node_body[i], 1] * w.damper.diagonal[9 * i + 3 * r + c]
    free = m.free[i]
    for r in ti.static(range(3)):
        B[r, r] += w.shift[i]
        for c in ti.static(range(3)):
            if free[r] == 0.0 or free[c] == 0.0:
                B[r, c] = 1.0 if ti.static(r == c) else 0.0
    det = B.determinant()
    safe = B[0, 0] > 0.0 and B[1, 1] > 0.0 and B[2, 2] > 0.0 and det > 1e-6 * B[0, 0] * B[1, 1] * B[2, 2]
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            w.inverse[9 * i + 3 * r + c] = 0.0
    if safe:
        C = B.inverse()
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                w.inverse[9 * i + 3 * r + c] = C[r, c]
    else:
        # an indefinite block (unprojected, compressed): its diagonal still makes a positive preconditioner
        for r in ti.static(range(3)):
            d = abs(B[r, r])
            w.inverse[9 * i + 4 * r] = ti.select(d > 0.0, 1.0 / ti.max(d, 1e-30), 1.0)


@ti.func
def start_row(m: ti.template(), A: ti.template(), w: ti.template(), i):
    """Zero solution, residual and first direction of node i; returns r.z."""
    invert_block(m, A, w, i)
    r = m.free[i] * w.rhs[i]
    w.y[i] = ti.Vector([0.0, 0.0, 0.0], m.real)
    w.r[i] = r
    z = precondition(m, w, i, r)
    w.z[i], w.p[i] = z, z
    return dot64(r, z)


@ti.func
def precondition(m: ti.template(), w: ti.template(), i, r):
    z = ti.Vector([0.0, 0.0, 0.0], m.real)
    for k in ti.static(range(3)):
        z[k] = w.inverse[9 * i + 3 * k] * r[0] + w.inverse[9 * i + 3 * k + 1] * r[1] + w.inverse[9 * i + 3 * k + 2] * r[2]
    return m.free[i] * z


@ti.func
def dot64(a, b):
    """a . b in f64."""
    return ti.cast(a, ti.f64).dot(ti.cast(b, ti.f64))


@ti.func
def product_row(m: ti.template(), A: ti.template(), w: ti.template(), i):
    """q_i = (A p)_i; returns p.Ap's share."""
    q = apply_row(m, A, w, i, w.p)
    w.q[i] = q
    return dot64(w.p[i], q)


@ti.func
def update_row(m: ti.template(), w: ti.template(), i, step):
    """y += a p, r -= a q, z = B r; returns r.z's share."""
    a = ti.cast(step, m.real)
    w.y[i] = w.y[i] + a * w.p[i]
    r = w.r[i] - a * w.q[i]
    w.r[i] = r
    z = precondition(m, w, i, r)
    w.z[i] = z
    return dot64(r, z)


@kernel
def start_serial(m: ti.template(), A: ti.template(), w: ti.template()):
    """First residual and direction."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        rz = ti.cast(0.0, ti.f64)
        for i in range(m.n_nodes):
            rz += start_row(m, A, w, i)
        w.state[RZ], w.state[RZ_START], w.state[COUNT], w.state[STOP] = rz, rz, 0.0, RUNNING


@kernel
def iterate_serial(m: ti.template(), A: ti.template(), w: ti.template(), n: ti.i32, tolerance: ti.f64):
    """Up to n iterations."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        rz, stop, k = w.state[RZ], ti.cast(RUNNING, ti.i32), 0
        limit = tolerance * tolerance * w.state[RZ_START]
        if rz <= limit:
            stop = CONVERGED
        while k < n and stop == RUNNING:
            curvature = ti.cast(0.0, ti.f64)
            for i in range(m.n_nodes):
                curvature += product_row(m, A, w, i)
            if curvature <= 0.0:
                stop = NEGATIVE
            else:
                step, next_rz = rz / curvature, ti.cast(0.0, ti.f64)
                for i in range(m.n_nodes):
                    next_rz += update_row(m, w, i, step)
                along = ti.cast(next_rz / rz, m.real)
                for i in range(m.n_nodes):
                    w.p[i] = w.z[i] + along * w.p[i]
                rz = next_rz
                k += 1
                if rz <= limit:
                    stop = CONVERGED
        w.state[RZ], w.state[STOP] = rz, stop
        w.state[COUNT] = w.state[COUNT] + k


@ti.func
def total(m: ti.template(), column: ti.template()):
    """Sum of a column of the partial sums, in order."""
    s = ti.cast(0.0, ti.f64)
    for c in range(m.chunks):
        s += m.partial[c, column]
    return s


@kernel
def start_parallel(m: ti.template(), A: ti.template(), w: ti.template()):
    """First residual and direction."""
    for c in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        for i in range(c * size, ti.min(m.n_nodes, (c + 1) * size)):
            s += start_row(m, A, w, i)
        m.partial[c, 6] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        rz = total(m, 6)
        w.state[RZ], w.state[RZ_START], w.state[COUNT], w.state[STOP] = rz, rz, 0.0, RUNNING


@kernel
def iterate_parallel(m: ti.template(), A: ti.template(), w: ti.template(), tolerance: ti.f64):
    """One iteration; does nothing once stopped."""
    for c in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        if w.state[STOP] == RUNNING:
            for i in range(c * size, ti.min(m.n_nodes, (c + 1) * size)):
                s += product_row(m, A, w, i)
        m.partial[c, 6] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        if w.state[STOP] == RUNNING:
            curvature = total(m, 6)
            w.state[CURVATURE] = curvature
            w.state[STEP] = w.state[RZ] / curvature
            if w.state[RZ] <= tolerance * tolerance * w.state[RZ_START]:
                w.state[STOP] = CONVERGED
            elif curvature <= 0.0:
                w.state[STOP] = NEGATIVE
    for c in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        if w.state[STOP] == RUNNING:
            for i in range(c * size, ti.min(m.n_nodes, (c + 1) * size)):
                s += update_row(m, w, i, w.state[STEP])
        m.partial[c, 7] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        if w.state[STOP] == RUNNING:
            rz = total(m, 7)
            w.state[STEP] = rz / w.state[RZ]
            w.state[RZ] = rz
            w.state[COUNT] = w.state[COUNT] + 1.0
    for i in range(m.n_nodes):
        if w.state[STOP] == RUNNING:
            w.p[i] = w.z[i] + ti.cast(w.state[STEP], m.real) * w.p[i]


@dataclass(frozen=True)
class LinearResult:
    """What a solve did."""

    iterations: int
    converged: bool
    negative: bool  # negative curvature was met; y holds the iterate before it


def solve(m: Model, A: BlockCsr, w: PcgWork, tolerance: float, max_iterations: int) -> LinearResult:
    """Fill w.y. tolerance: sqrt(r.z) relative to the start."""
    if m.serial:
        start_serial(m, A, w)
        batch = max(1, SERIAL_WORK // (2 * A.n_edges + m.n_nodes))
    else:
        start_parallel(m, A, w)
        batch = PARALLEL_BATCH
    done = 0
    while True:
        n = min(batch, max_iterations - done)
        if m.serial:
            iterate_serial(m, A, w, n, tolerance)
        else:
            for _ in range(n + 1):  # convergence is noticed at the start of the next iteration
                iterate_parallel(m, A, w, tolerance)
        state = w.state.to_numpy()
        done, stop = int(state[COUNT]), int(state[STOP])
        if stop != RUNNING or done >= max_iterations:
            return LinearResult(done, stop == CONVERGED, stop == NEGATIVE)
