"""Conjugate gradients with symmetric Gauss-Seidel as preconditioner, for `pcg` on the CPU.

With A = L + D + L^T + E, P positive definite (equal to D where D is), and the preconditioner M = (P + L) P^-1 (P + L)^T, the
vectors stored are s = (P + L)^-1 r and t = (P + L)^T p. Since A p = (P + L) p + t - (2 P - D) p + E p, an iteration consists of
one backward and one forward sweep:
    p = (P + L)^-T t,   q = (P + L)^-1 A p = p + (P + L)^-1 (t - (2 P - D) p + E p),   p.Ap = t.q,   r.z = s.P s.
Small systems are swept as a whole on one thread, and E = 0. In large ones the nodes are divided by number into chunks, of which
a sweep passes the even ones and then the odd ones: chunks of one parity do not depend on each other, if blocks between them are
in E. Meshes are mostly numbered in layers, which leaves E empty. One thread runs the chunks in turn within one launch, or several
threads share them, with the same result.
Coupling terms belong to L. With the terms in E, contacts of two cubes took two to three times as many iterations. So that chunks
of one parity do not depend on each other through them, a sweep passes some nodes after all chunks, see `sweep_order`. Where terms
are not prepared for that, one thread sweeps all chunks, and E = 0.
Source: Eisenstat, "Efficient Implementation of a Class of Preconditioned Conjugate Gradient Methods", SIAM J. Sci. Stat.
Comput. 2(1), 1981.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.node_graph import node_of
from taisoft.fem.state import OTHER_SUM, SUM
from taisoft.linear.block_csr import block_times
from taisoft.linear.coupling import add_products, clear_products, gather_products
from taisoft.linear.pcg_work import (
    CONVERGED,
    COUNT,
    MAX_NEGATIVE_STEP,
    NEGATIVE,
    NEGATIVE_PENDING,
    RUNNING,
    RZ,
    RZ_START,
    STATUS,
    STEP,
    dot64,
    precondition,
)
from taisoft.linear.sweep_order import (
    EVEN,
    ODD,
    chunk_range,
    clear_last,
    is_later,
    node_at,
    times_above,
    times_apart,
    times_below,
    times_last_above,
)

# --- one chunk --------------------------------------------------------------------------------------------------------


@ti.func
def _start_chunk(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), c, same_matrix, last: ti.template()):
    """Set the diagonal and P, y = 0, s = (P + L)^-1 rhs, t = P s. Return r.z."""
    rz = ti.cast(0.0, ti.f64)
    first, end = chunk_range(m, k, w, c, last)
    for at in range(first, end):
        i = node_at(k, w, at, last)
        if is_later(k, w, i, last):
            continue
        precondition(m, A, k, w, i, same_matrix)
        below = times_below(m, A, k, w, c, i, w.r, last)
        if ti.static(k.width > 0):
            below += gather_products(m, k, i)
        s = block_times(w.inverse[i], w.rhs[i] - below)
        add_products(m, k, i, s)
        t = block_times(w.block[i], s)
        w.r[i], w.q[i] = s, t
        w.y[i], w.z[i] = ti.Vector.zero(m.real, 3), ti.Vector.zero(m.real, 3)
        rz += dot64(s, t)
    return rz


@ti.func
def _sweep_backward(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), c, beta, last: ti.template()):
    """Set t = P s + beta t and p = (P + L)^-T t, with P s of the last update in w.q."""
    first, end = chunk_range(m, k, w, c, last)
    for reverse in range(end - first):
        i = node_at(k, w, end - 1 - reverse, last)
        if is_later(k, w, i, last):
            continue
        t = w.q[i] + ti.cast(beta, m.real) * w.z[i]
        w.z[i] = t
        above = times_above(m, A, k, w, c, i, w.p, last)
        if ti.static(k.width > 0):
            above += gather_products(m, k, i)
        if ti.static(w.has_last(k) and not last):
            above += times_last_above(m, A, k, w, i, w.p)
        p = block_times(w.inverse[i], t - above)
        w.p[i] = p
        add_products(m, k, i, p)


@ti.func
def _sweep_forward(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), c, last: ti.template()):
    """Set w.q = (P + L)^-1 (t - (2 P - D) p + E p). Return p.Ap."""
    curvature = ti.cast(0.0, ti.f64)
    first, end = chunk_range(m, k, w, c, last)
    for at in range(first, end):
        i = node_at(k, w, at, last)
        if is_later(k, w, i, last):
            continue
        p, t = w.p[i], w.z[i]
        rest = t - block_times(w.mirror[i], p) - times_below(m, A, k, w, c, i, w.q, last)
        if ti.static(A.crossed and w.is_shared(k) and not last):
            rest += times_apart(m, A, k, w, c, i, w.p)
        if ti.static(k.width > 0):
            rest -= gather_products(m, k, i)
        s = block_times(w.inverse[i], rest)
        add_products(m, k, i, s)
        w.q[i] = s
        curvature += dot64(t, p + s)
    return curvature


@ti.func
def _update(m: ti.template(), k: ti.template(), w: ti.template(), c, step):
    """Take a step along p. Return r.z."""
    rz = ti.cast(0.0, ti.f64)
    first, end = chunk_range(m, k, w, c, False)
    for at in range(first, end):
        i = node_of(w.subset, at)
        p = w.p[i]
        w.y[i] = w.y[i] + step * p
        s = w.r[i] - step * (p + w.q[i])
        w.r[i] = s
        t = block_times(w.block[i], s)
        w.q[i] = t
        rz += dot64(s, t)
    return rz


@ti.func
def _add_direction(m: ti.template(), k: ti.template(), w: ti.template(), c, length):
    """y += length p."""
    first, end = chunk_range(m, k, w, c, False)
    for at in range(first, end):
        i = node_of(w.subset, at)
        w.y[i] = w.y[i] + length * w.p[i]


@ti.func
def _negative_step(rz, curvature):
    """Length of the step along a direction of negative curvature."""
    length = ti.cast(MAX_NEGATIVE_STEP, ti.f64)
    if curvature < 0.0:
        length = ti.min(rz, -MAX_NEGATIVE_STEP * curvature) / -curvature
    return length


# --- on one thread ----------------------------------------------------------------------------------------------------


@ti.func
def _n_chunks(w: ti.template()):
    """Number of chunks."""
    n = 1
    if ti.static(w.in_chunks):
        n = w.n_chunks
    return n


@ti.func
def _n_of_parity(w: ti.template(), parity):
    """Number of chunks of one parity."""
    return (w.n_chunks + 1 - parity) // 2


@ti.func
def _in_order(w: ti.template(), step):
    """Chunk of a step of the forward sweep: the even ones, then the odd ones."""
    n_even, c = _n_of_parity(w, EVEN), 2 * step
    if step >= n_even:
        c = 2 * (step - n_even) + 1
    return c


@ti.func
def sum_of_chunks(m: ti.template(), w: ti.template(), column: ti.template()):
    """Sum of the chunks' partial sums, in a fixed order."""
    s = ti.cast(0.0, ti.f64)
    for c in range(_n_chunks(w)):
        s += m.state.partial[c, column]
    return s


@kernel
def iterate_kernel(
    m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), n: ti.i32, tolerance: ti.f64, begin: ti.i32
):
    """Run up to n iterations. begin: 0 to go on, 1 to start from y = 0, 2 to start with the last solve's matrix."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        if begin > 0:
            start_serial(m, A, k, w, begin - 1)
        count, _status = iterate_serial(m, A, k, w, n, tolerance)
        w.state[COUNT] = w.state[COUNT] + count


@ti.func
def start_serial(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), same_matrix):
    """Begin a solve from y = 0, inside a serial loop."""
    clear_products(m, k)
    clear_last(m, k, w, w.r)
    for step in range(_n_chunks(w)):
        c = _in_order(w, step)
        m.state.partial[c, SUM] = _start_chunk(m, A, k, w, c, same_matrix, False)
    rz = sum_of_chunks(m, w, SUM)
    if ti.static(w.has_last(k)):
        rz += _start_chunk(m, A, k, w, 0, same_matrix, True)
    w.state[RZ], w.state[RZ_START], w.state[STEP] = rz, rz, 0.0
    w.state[COUNT], w.state[STATUS] = 0.0, RUNNING


@ti.func
def iterate_serial(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), n, tolerance):
    """Run up to n iterations from the present state, inside a serial loop. Return their number and the status."""
    rz, beta, status, count = w.state[RZ], w.state[STEP], ti.cast(RUNNING, ti.i32), 0
    limit, n_chunks = tolerance * tolerance * w.state[RZ_START], _n_chunks(w)
    if rz <= limit:
        status = CONVERGED
    while count < n and status == RUNNING:
        clear_products(m, k)
        if ti.static(w.has_last(k)):
            _sweep_backward(m, A, k, w, 0, beta, True)
        for step in range(n_chunks):
            _sweep_backward(m, A, k, w, _in_order(w, n_chunks - 1 - step), beta, False)
        clear_products(m, k)
        clear_last(m, k, w, w.q)
        for step in range(n_chunks):
            c = _in_order(w, step)
            m.state.partial[c, SUM] = _sweep_forward(m, A, k, w, c, False)
        curvature = sum_of_chunks(m, w, SUM)
        if ti.static(w.has_last(k)):
            curvature += _sweep_forward(m, A, k, w, 0, True)
        if not curvature > 0.0:
            status = NEGATIVE
            for c in range(n_chunks):
                _add_direction(m, k, w, c, ti.cast(_negative_step(rz, curvature), m.real))
        else:
            for c in range(n_chunks):
                m.state.partial[c, OTHER_SUM] = _update(m, k, w, c, ti.cast(rz / curvature, m.real))
            next_rz = sum_of_chunks(m, w, OTHER_SUM)
            beta = next_rz / rz
            rz = next_rz
            count += 1
            if rz <= limit:
                status = CONVERGED
    w.state[RZ], w.state[STEP], w.state[STATUS] = rz, beta, status
    return count, status


# --- in loops that several threads may share ----------------------------------------------------------------------------


@kernel
def start_parallel(
    m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), tolerance: ti.f64, same_matrix: ti.i32
):
    """Begin a solve of a divided system from y = 0."""
    if ti.static(w.has_last(k)):
        ti.loop_config(serialize=True)
        for _ in range(1):
            clear_products(m, k)
            clear_last(m, k, w, w.r)
    for parity in ti.static((EVEN, ODD)):
        ti.loop_config(serialize=m.serial)
        for task in range(_n_of_parity(w, parity) * m.spread):
            if task % m.spread == 0:
                c = 2 * (task // m.spread) + parity
                m.state.partial[c, SUM] = _start_chunk(m, A, k, w, c, same_matrix, False)
    ti.loop_config(serialize=True)
    for _ in range(1):
        rz = sum_of_chunks(m, w, SUM)
        if ti.static(w.has_last(k)):
            rz += _start_chunk(m, A, k, w, 0, same_matrix, True)
        begin_with(w, tolerance, rz)


@ti.func
def begin_with(w: ti.template(), tolerance, rz):
    """Set the state before the first iteration."""
    w.state[RZ], w.state[RZ_START], w.state[STEP], w.state[COUNT] = rz, rz, 0.0, 0.0
    w.state[STATUS] = CONVERGED if rz <= tolerance * tolerance * rz else RUNNING


@ti.func
def take_step(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template()):
    """Run both sweeps and take the step along p, in loops at the top level of a kernel. Partial sums: OTHER_SUM of s.P s."""
    if ti.static(w.has_last(k)):
        ti.loop_config(serialize=True)
        for _ in range(1):
            clear_products(m, k)
            _sweep_backward(m, A, k, w, 0, w.state[STEP], True)
    for parity in ti.static((ODD, EVEN)):
        ti.loop_config(serialize=m.serial)
        for task in range(_n_of_parity(w, parity) * m.spread):
            if task % m.spread == 0:
                _sweep_backward(m, A, k, w, 2 * (task // m.spread) + parity, w.state[STEP], False)
    if ti.static(w.has_last(k)):
        ti.loop_config(serialize=True)
        for _ in range(1):
            clear_products(m, k)
            clear_last(m, k, w, w.q)
    for parity in ti.static((EVEN, ODD)):
        ti.loop_config(serialize=m.serial)
        for task in range(_n_of_parity(w, parity) * m.spread):
            if task % m.spread == 0:
                c = 2 * (task // m.spread) + parity
                m.state.partial[c, SUM] = _sweep_forward(m, A, k, w, c, False)
    ti.loop_config(serialize=True)
    for _ in range(1):
        curvature = sum_of_chunks(m, w, SUM)
        if ti.static(w.has_last(k)):
            curvature += _sweep_forward(m, A, k, w, 0, True)
        if not curvature > 0.0:
            w.state[STATUS], w.state[STEP] = NEGATIVE_PENDING, _negative_step(w.state[RZ], curvature)
        else:
            w.state[STEP] = w.state[RZ] / curvature
    ti.loop_config(serialize=m.serial)
    for task in range(w.n_chunks * m.spread):
        if task % m.spread == 0:
            c, step = task // m.spread, ti.cast(w.state[STEP], m.real)
            if w.state[STATUS] == RUNNING:
                m.state.partial[c, OTHER_SUM] = _update(m, k, w, c, step)
            else:
                _add_direction(m, k, w, c, step)


@ti.func
def end_iteration(m: ti.template(), w: ti.template(), tolerance):
    """Set the state after an iteration, from the partial sums of r.z."""
    if w.state[STATUS] == RUNNING:
        rz = sum_of_chunks(m, w, OTHER_SUM)
        w.state[STEP] = rz / w.state[RZ]
        w.state[RZ], w.state[COUNT] = rz, w.state[COUNT] + 1.0
        if rz <= tolerance * tolerance * w.state[RZ_START]:
            w.state[STATUS] = CONVERGED
    else:
        w.state[STATUS] = NEGATIVE


@kernel
def iterate_parallel(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), tolerance: ti.f64):
    """Run one iteration."""
    take_step(m, A, k, w)
    ti.loop_config(serialize=True)
    for _ in range(1):
        end_iteration(m, w, tolerance)
