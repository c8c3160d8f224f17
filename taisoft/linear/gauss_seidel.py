"""Conjugate gradients with symmetric Gauss-Seidel as preconditioner: the CPU's solver of A y = rhs, with or without contacts.

With A = L + D + L^T + E, P positive definite (equal to D where D is), and the preconditioner M = (P + L) P^-1 (P + L)^T, the
vectors stored are s = (P + L)^-1 r and t = (P + L)^T p. Since A p = (P + L) p + t - (2 P - D) p + E p, an iteration consists of
one backward and one forward sweep:
    p = (P + L)^-T t,   q = (P + L)^-1 A p = p + (P + L)^-1 (t - (2 P - D) p + E p),   p.Ap = t.q,   r.z = s.P s.
So it costs no product beside the sweeps, and takes two to three times fewer iterations than block Jacobi (`jacobi`).
Small systems are swept as a whole on one thread, and E = 0. In large ones the nodes are divided by number into chunks, of which
a sweep passes the even ones and then the odd ones: chunks of one parity do not depend on each other, if blocks between them are
in E. Meshes are mostly numbered in layers, which leaves E empty. Several threads share the chunks of one parity, or one thread
runs all in the same order, with the same result: the same loops, at the top of a kernel that runs one iteration, or inside a
kernel that runs many, since a launch costs as much as an iteration of a small system.
Coupling terms belong to L. With the terms in E, contacts of two cubes took two to three times as many iterations. So that chunks
of one parity do not depend on each other through them, a sweep passes some nodes after all chunks, see `sweep_order`. Where terms
are not prepared for that, one thread sweeps all chunks, and E = 0.
Source: Eisenstat, "Efficient Implementation of a Class of Preconditioned Conjugate Gradient Methods", SIAM J. Sci. Stat.
Comput. 2(1), 1981.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.model import Model
from taisoft.fem.state import OTHER_SUM, SUM
from taisoft.linear.block_csr import BlockCsr, block_times
from taisoft.linear.coupling import NO_COUPLING, Coupling, add_products, clear_products, gather_products
from taisoft.linear.pcg_work import (
    COUNT,
    RUNNING,
    STATUS,
    STEP,
    LinearResult,
    PcgWork,
    begin_with,
    dot64,
    end_iteration,
    precondition,
    set_step,
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

SERIAL_WORK = 40_000_000  # block products per launch: about 0.2 s, so that Ctrl-C takes effect
SHARED_FROM = 4  # chunks that several threads share: of fewer, one or two have work at a time
ALL = 2  # beside EVEN and ODD: all chunks, in the order of a forward sweep


def solve(
    model: Model,
    A: BlockCsr,
    work: PcgWork,
    tolerance: float,
    max_iterations: int,
    terms: Coupling = NO_COUPLING,
    same_matrix: bool = False,
    may_share: bool = True,
) -> LinearResult:
    """Solve for work.y given work.rhs. tolerance: sqrt(r.z) relative to the start.

    terms: added to A. The diagonal of A alone must then be in terms.base; A.diagonal is set to that of the sum.
    same_matrix: whether A and the nodes of the terms are those of the last solve; rows without terms then keep their
    preconditioner. may_share: whether several threads may share the sweeps; the result is the same.
    """
    shared = may_share and not model.serial and work.is_shared(terms) and work.n_chunks >= SHARED_FROM
    most = max(1, SERIAL_WORK // (2 * A.n_edges + model.n_nodes))
    if shared:
        start_shared(model, A, terms, work, tolerance, int(same_matrix))
    else:
        run_alone(model, A, terms, work, most, max_iterations, tolerance, 1 + same_matrix)
    while (result := work.result(max_iterations)) is None:
        if shared:
            iterate_shared(model, A, terms, work, tolerance)
        else:
            run_alone(model, A, terms, work, most, max_iterations, tolerance, 0)
    return result


@kernel
def start_shared(
    model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), tolerance: ti.f64, same_matrix: ti.i32
):
    """Begin a solve from y = 0 that threads share."""
    start(model, A, terms, work, tolerance, same_matrix, True)


@kernel
def iterate_shared(model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), tolerance: ti.f64):
    """Run one iteration that threads share."""
    take_step(model, A, terms, work, True)
    ti.loop_config(serialize=True)
    for _ in range(1):
        end_iteration(work, tolerance, sum_of_chunks(model, work, OTHER_SUM))


@kernel
def run_alone(
    model: ti.template(),
    A: ti.template(),
    terms: ti.template(),
    work: ti.template(),
    n: ti.i32,
    end: ti.i32,
    tolerance: ti.f64,
    begin: ti.i32,
):
    """Run up to n iterations on one thread, `end` since the start.

    begin: 0 to go on, 1 to start from y = 0, 2 to start with the last solve's matrix.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        if begin > 0:
            start(model, A, terms, work, tolerance, begin - 1, False)
        count = 0
        while count < n and work.state[STATUS] == RUNNING and work.state[COUNT] < end:
            take_step(model, A, terms, work, False)
            end_iteration(work, tolerance, sum_of_chunks(model, work, OTHER_SUM))
            count += 1


# --- loops over chunks: at a kernel's top level if `shared`, else inside a loop on one thread --------------------------------


@ti.func
def start(
    model: ti.template(),
    A: ti.template(),
    terms: ti.template(),
    work: ti.template(),
    tolerance,
    same_matrix,
    shared: ti.template(),
):
    """Begin a solve: diagonal and P, y = 0, s = (P + L)^-1 rhs, t = P s, and the state."""
    spread = ti.static(model.spread if shared else 1)
    if ti.static(terms.any):
        ti.loop_config(serialize=True)
        for _ in range(1):
            clear_products(model, terms)
            clear_last(model, terms, work, work.r)
    for part in ti.static((EVEN, ODD) if shared else (ALL,)):
        ti.loop_config(serialize=model.serial)
        for task in range(_n_chunks(work, part) * spread):
            if task % spread == 0:
                c = _chunk(work, part, task // spread)
                model.state.partial[c, SUM] = _start_chunk(model, A, terms, work, c, same_matrix, False)
    ti.loop_config(serialize=True)
    for _ in range(1):
        rz = sum_of_chunks(model, work, SUM)
        if ti.static(work.has_last(terms)):
            rz += _start_chunk(model, A, terms, work, 0, same_matrix, True)
        begin_with(work, tolerance, rz)


@ti.func
def take_step(model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), shared: ti.template()):
    """Run both sweeps and take the step along p. Partial sums: OTHER_SUM of s.P s."""
    spread = ti.static(model.spread if shared else 1)
    if ti.static(terms.any):
        ti.loop_config(serialize=True)
        for _ in range(1):
            clear_products(model, terms)
            if ti.static(work.has_last(terms)):
                _sweep_backward(model, A, terms, work, 0, work.state[STEP], True)
    for part in ti.static((ODD, EVEN) if shared else (ALL,)):
        ti.loop_config(serialize=model.serial)
        for task in range(_n_chunks(work, part) * spread):
            if task % spread == 0:
                c = _chunk(work, part, _n_chunks(work, part) - 1 - task // spread)
                _sweep_backward(model, A, terms, work, c, work.state[STEP], False)
    if ti.static(terms.any):
        ti.loop_config(serialize=True)
        for _ in range(1):
            clear_products(model, terms)
            clear_last(model, terms, work, work.q)
    for part in ti.static((EVEN, ODD) if shared else (ALL,)):
        ti.loop_config(serialize=model.serial)
        for task in range(_n_chunks(work, part) * spread):
            if task % spread == 0:
                c = _chunk(work, part, task // spread)
                model.state.partial[c, SUM] = _sweep_forward(model, A, terms, work, c, False)
    ti.loop_config(serialize=True)
    for _ in range(1):
        curvature = sum_of_chunks(model, work, SUM)
        if ti.static(work.has_last(terms)):
            curvature += _sweep_forward(model, A, terms, work, 0, True)
        set_step(work, curvature)
    ti.loop_config(serialize=model.serial)
    for task in range(_n_chunks(work, ALL) * spread):
        if task % spread == 0:
            c = task // spread
            model.state.partial[c, OTHER_SUM] = _update(model, terms, work, c, ti.cast(work.state[STEP], model.real))


@ti.func
def _n_chunks(work: ti.template(), part: ti.template()):
    """Number of chunks of a parity, or of all."""
    n = 1
    if ti.static(work.divided):
        n = work.n_chunks
    if ti.static(part != ALL):
        n = (n + 1 - part) // 2
    return n


@ti.func
def _chunk(work: ti.template(), part: ti.template(), at):
    """The chunk at a place in the order of a forward sweep over a parity, or over all: the even ones, then the odd ones."""
    c = 2 * at
    if ti.static(part != ALL):
        c += part
    elif at >= _n_chunks(work, EVEN):
        c = 2 * (at - _n_chunks(work, EVEN)) + 1
    return c


@ti.func
def sum_of_chunks(model: ti.template(), work: ti.template(), column: ti.template()):
    """Sum of the chunks' partial sums, in a fixed order."""
    s = ti.cast(0.0, ti.f64)
    for c in range(_n_chunks(work, ALL)):
        s += model.state.partial[c, column]
    return s


# --- one chunk --------------------------------------------------------------------------------------------------------------


@ti.func
def _start_chunk(
    model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), c, same_matrix, last: ti.template()
):
    """Set the diagonal and P, y = 0, s = (P + L)^-1 rhs, t = P s. Return r.z."""
    rz = ti.cast(0.0, ti.f64)
    first, end = chunk_range(model, terms, work, c, last)
    for at in range(first, end):
        i = node_at(terms, work, at, last)
        if is_later(terms, work, i, last):
            continue
        precondition(model, A, terms, work, i, same_matrix)
        below = times_below(model, A, terms, work, c, i, work.r, last)
        if ti.static(terms.any):
            below += gather_products(model, terms, i)
        s = block_times(work.inverse[i], work.rhs[i] - below)
        add_products(model, terms, i, s)
        t = block_times(work.block[i], s)
        work.r[i], work.q[i] = s, t
        work.y[i], work.z[i] = ti.Vector.zero(model.real, 3), ti.Vector.zero(model.real, 3)
        rz += dot64(s, t)
    return rz


@ti.func
def _sweep_backward(
    model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), c, beta, last: ti.template()
):
    """Set t = P s + beta t and p = (P + L)^-T t, with P s of the last update in work.q."""
    first, end = chunk_range(model, terms, work, c, last)
    for reverse in range(end - first):
        i = node_at(terms, work, end - 1 - reverse, last)
        if is_later(terms, work, i, last):
            continue
        t = work.q[i] + ti.cast(beta, model.real) * work.z[i]
        work.z[i] = t
        above = times_above(model, A, terms, work, c, i, work.p, last)
        if ti.static(terms.any):
            above += gather_products(model, terms, i)
        if ti.static(work.has_last(terms) and not last):
            above += times_last_above(model, A, terms, work, i, work.p)
        p = block_times(work.inverse[i], t - above)
        work.p[i] = p
        add_products(model, terms, i, p)


@ti.func
def _sweep_forward(model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), c, last: ti.template()):
    """Set work.q = (P + L)^-1 (t - (2 P - D) p + E p). Return p.Ap."""
    curvature = ti.cast(0.0, ti.f64)
    first, end = chunk_range(model, terms, work, c, last)
    for at in range(first, end):
        i = node_at(terms, work, at, last)
        if is_later(terms, work, i, last):
            continue
        p, t = work.p[i], work.z[i]
        rest = t - block_times(work.mirror[i], p) - times_below(model, A, terms, work, c, i, work.q, last)
        if ti.static(A.crossed and work.is_shared(terms) and not last):
            rest += times_apart(model, A, terms, work, c, i, work.p)
        if ti.static(terms.any):
            rest -= gather_products(model, terms, i)
        s = block_times(work.inverse[i], rest)
        add_products(model, terms, i, s)
        work.q[i] = s
        curvature += dot64(t, p + s)
    return curvature


@ti.func
def _update(model: ti.template(), terms: ti.template(), work: ti.template(), c, step):
    """Take a step along p; at negative curvature, where the solve ends, y alone matters. Return r.z."""
    rz = ti.cast(0.0, ti.f64)
    first, end = chunk_range(model, terms, work, c, False)
    for i in range(first, end):
        p = work.p[i]
        work.y[i] = work.y[i] + step * p
        s = work.r[i] - step * (p + work.q[i])
        work.r[i] = s
        t = block_times(work.block[i], s)
        work.q[i] = t
        rz += dot64(s, t)
    return rz
