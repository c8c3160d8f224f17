"""CG with symmetric Gauss-Seidel on one thread, all iterations in one launch.

With A = L + D + L^T, P positive definite (equal to D where D is), and the preconditioner M = (P + L) P^-1 (P + L)^T, the
vectors stored are s = (P + L)^-1 r and t = (P + L)^T p. Since A p = (P + L) p + t - (2 P - D) p, an iteration consists of one
backward and one forward sweep:
    p = (P + L)^-T t,   q = (P + L)^-1 A p = p + (P + L)^-1 (t - (2 P - D) p),   p.Ap = t.q,   r.z = s.P s.
Source: Eisenstat, "Efficient Implementation of a Class of Preconditioned Conjugate Gradient Methods", SIAM J. Sci. Stat.
Comput. 2(1), 1981.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.node_graph import n_nodes_of, node_of
from taisoft.linear.block_csr import block_times, partial_row_times, partial_row_times_backward
from taisoft.linear.coupling import add_products, clear_products, gather_products, has_terms, prepare_terms
from taisoft.linear.pcg import (
    CONVERGED,
    COUNT,
    MAX_NEGATIVE_STEP,
    NEGATIVE,
    RUNNING,
    RZ,
    RZ_START,
    STATUS,
    STEP,
    dot64,
    precondition,
)


@ti.func
def start(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), same_matrix):
    """Set the diagonal and P, y = 0, s = (P + L)^-1 rhs, t = P s."""
    rz = ti.cast(0.0, ti.f64)
    if ti.static(k.width > 0):
        clear_products(m, k)
    for j in range(n_nodes_of(m, w.subset)):
        i = node_of(w.subset, j)
        if ti.static(k.width > 0):
            if same_matrix == 0 or has_terms(k, i):
                A.diagonal[i] = prepare_terms(m, k, i)
                precondition(m, w, i, A.diagonal[i])
        else:
            precondition(m, w, i, A.diagonal[i])
        below = partial_row_times(m, A, A.row_start[i], A.row_upper[i], w.r)
        if ti.static(k.width > 0):
            below += gather_products(m, k, i)
        s = block_times(w.inverse[i], w.rhs[i] - below)
        if ti.static(k.width > 0):
            add_products(m, k, i, s)
        t = block_times(w.block[i], s)
        w.r[i], w.q[i] = s, t
        w.z[i] = ti.Vector([0.0, 0.0, 0.0], m.real)
        w.y[i] = ti.Vector([0.0, 0.0, 0.0], m.real)
        rz += dot64(s, t)
    w.state[RZ], w.state[RZ_START], w.state[STEP] = rz, rz, 0.0
    w.state[COUNT], w.state[STATUS] = 0.0, RUNNING


def iterate(m, A, k, w, n: int, tolerance: float, begin: bool, same_matrix: bool) -> tuple[int, int]:
    """Run up to n iterations, from y = 0 if `begin`. Return the iterations so far and the status."""
    count, status = iterate_kernel(m, A, k, w, n, tolerance, int(begin), int(same_matrix))
    return int(count), int(status)


@ti.func
def iterations(m: ti.template(), A: ti.template(), coupling: ti.template(), w: ti.template(), n, tolerance):
    """Run up to n iterations from the present state. Return their number and the status."""
    rz, beta, status, k = w.state[RZ], w.state[STEP], ti.cast(RUNNING, ti.i32), 0
    limit, size = tolerance * tolerance * w.state[RZ_START], n_nodes_of(m, w.subset)
    if rz <= limit:
        status = CONVERGED
    while k < n and status == RUNNING:
        if ti.static(coupling.width > 0):
            clear_products(m, coupling)
        for reverse in range(size):
            i = node_of(w.subset, size - 1 - reverse)
            t = w.q[i] + ti.cast(beta, m.real) * w.z[i]  # w.q holds P s of the last update
            w.z[i] = t
            above = partial_row_times_backward(m, A, A.row_upper[i], A.row_start[i + 1], w.p)
            if ti.static(coupling.width > 0):
                above += gather_products(m, coupling, i)
            p = block_times(w.inverse[i], t - above)
            w.p[i] = p
            if ti.static(coupling.width > 0):
                add_products(m, coupling, i, p)
        if ti.static(coupling.width > 0):
            clear_products(m, coupling)
        curvature = ti.cast(0.0, ti.f64)
        for at in range(size):
            i = node_of(w.subset, at)
            # from here on w.q holds (P + L)^-1 (t - (2 P - D) p), which the following rows need
            p, t = w.p[i], w.z[i]
            below = partial_row_times(m, A, A.row_start[i], A.row_upper[i], w.q)
            if ti.static(coupling.width > 0):
                below += gather_products(m, coupling, i)
            s = block_times(w.inverse[i], t - block_times(w.mirror[i], p) - below)
            if ti.static(coupling.width > 0):
                add_products(m, coupling, i, s)
            w.q[i] = s
            curvature += dot64(t, p + s)
        if not curvature > 0.0:
            status = NEGATIVE
            length = ti.cast(
                ti.min(rz, -MAX_NEGATIVE_STEP * curvature) / -curvature if curvature < 0.0 else MAX_NEGATIVE_STEP, m.real
            )
            for at in range(size):
                i = node_of(w.subset, at)
                w.y[i] = w.y[i] + length * w.p[i]
        else:
            step, next_rz = ti.cast(rz / curvature, m.real), ti.cast(0.0, ti.f64)
            for at in range(size):
                i = node_of(w.subset, at)
                p = w.p[i]
                w.y[i] = w.y[i] + step * p
                s = w.r[i] - step * (p + w.q[i])
                w.r[i] = s
                t = block_times(w.block[i], s)
                w.q[i] = t
                next_rz += dot64(s, t)
            beta = next_rz / rz
            rz = next_rz
            k += 1
            if rz <= limit:
                status = CONVERGED
    w.state[RZ], w.state[STEP], w.state[STATUS] = rz, beta, status
    return k, status


@kernel
def iterate_kernel(
    m: ti.template(),
    A: ti.template(),
    coupling: ti.template(),
    w: ti.template(),
    n: ti.i32,
    tolerance: ti.f64,
    begin: ti.i32,
    same_matrix: ti.i32,
) -> ti.types.vector(2, ti.f64):
    """Run the iterations in one launch. Return (count, status)."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        if begin != 0:
            start(m, A, coupling, w, same_matrix)
        k, _status = iterations(m, A, coupling, w, n, tolerance)
        w.state[COUNT] = w.state[COUNT] + k
    return ti.Vector([w.state[COUNT], w.state[STATUS]])
