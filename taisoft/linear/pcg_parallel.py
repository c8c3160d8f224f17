"""CG with block-Jacobi in parallel loops. Dot products are summed by chunks in a fixed order, independent of threads."""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.node_graph import n_nodes_of, node_of
from taisoft.fem.state import OTHER_SUM, SUM
from taisoft.linear.block_csr import block_times, partial_row_times, row_times
from taisoft.linear.coupling import form_product, gather_products, has_terms, prepare_terms
from taisoft.linear.pcg import (
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
    total,
)


@kernel
def start(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), same_matrix: ti.i32):
    """Set the diagonal and its inverse B, y = 0, r = rhs, z = p = B r."""
    for c in range(m.chunks):
        n = n_nodes_of(m, w.subset)
        size = (n + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        for at in range(c * size, ti.min(n, (c + 1) * size)):
            i = node_of(w.subset, at)
            if ti.static(k.width > 0):
                if same_matrix == 0 or has_terms(k, i):
                    A.diagonal[i] = prepare_terms(m, k, i)
                    precondition(m, w, i, A.diagonal[i])
            else:
                precondition(m, w, i, A.diagonal[i])
            r = m.free[i] * w.rhs[i]
            z = block_times(w.inverse[i], r)
            w.y[i] = ti.Vector([0.0, 0.0, 0.0], m.real)
            w.r[i], w.z[i], w.p[i] = r, z, z
            s += dot64(r, z)
        m.state.partial[c, SUM] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        rz = total(m, SUM)
        w.state[RZ], w.state[RZ_START], w.state[COUNT], w.state[STATUS] = rz, rz, 0.0, RUNNING


def iterate(m, A, coupling, w, n: int, tolerance: float, begin: bool, same_matrix: bool) -> tuple[int, int]:
    """Run up to n iterations, from y = 0 if `begin`. Return the iterations so far and the status."""
    if begin:
        start(m, A, coupling, w, int(same_matrix))
    for _ in range(n):
        iterate_once(m, A, coupling, w, tolerance)
    return int(w.state[COUNT]), int(w.state[STATUS])


@kernel
def iterate_once(m: ti.template(), A: ti.template(), coupling: ti.template(), w: ti.template(), tolerance: ti.f64):
    """Run one iteration, or nothing if the status is not RUNNING."""
    if ti.static(coupling.width > 0):
        for c in range(coupling.count[0]):
            form_product(m, coupling, c, w.p)
    for c in range(m.chunks):
        n = n_nodes_of(m, w.subset)
        size = (n + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        if w.state[STATUS] == RUNNING:
            for at in range(c * size, ti.min(n, (c + 1) * size)):
                i = node_of(w.subset, at)
                product = ti.Vector([0.0, 0.0, 0.0], m.real)
                if ti.static(coupling.width > 0):
                    product = partial_row_times(m, A, A.row_start[i], A.row_start[i + 1], w.p)
                    product += block_times(coupling.base[i], w.p[i]) + gather_products(m, coupling, i)
                else:
                    product = row_times(m, A, i, w.p)
                q = m.free[i] * product
                w.q[i] = q
                s += dot64(w.p[i], q)
        m.state.partial[c, SUM] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        if w.state[STATUS] == RUNNING:
            curvature = total(m, SUM)
            if w.state[RZ] <= tolerance * tolerance * w.state[RZ_START]:
                w.state[STATUS] = CONVERGED
            elif not curvature > 0.0:
                w.state[STATUS], w.state[STEP] = NEGATIVE_PENDING, MAX_NEGATIVE_STEP
                if curvature < 0.0:
                    w.state[STEP] = ti.min(w.state[RZ] / -curvature, MAX_NEGATIVE_STEP)
            else:
                w.state[STEP] = w.state[RZ] / curvature
    for c in range(m.chunks):
        n = n_nodes_of(m, w.subset)
        size = (n + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        if w.state[STATUS] == RUNNING:
            a = ti.cast(w.state[STEP], m.real)
            for at in range(c * size, ti.min(n, (c + 1) * size)):
                i = node_of(w.subset, at)
                w.y[i] = w.y[i] + a * w.p[i]
                r = w.r[i] - a * w.q[i]
                z = block_times(w.inverse[i], r)
                w.r[i], w.z[i] = r, z
                s += dot64(r, z)
        m.state.partial[c, OTHER_SUM] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        if w.state[STATUS] == RUNNING:
            rz = total(m, OTHER_SUM)
            w.state[STEP] = rz / w.state[RZ]
            w.state[RZ] = rz
            w.state[COUNT] = w.state[COUNT] + 1.0
            if rz <= tolerance * tolerance * w.state[RZ_START]:
                w.state[STATUS] = CONVERGED
    for at in range(n_nodes_of(m, w.subset)):
        i = node_of(w.subset, at)
        if w.state[STATUS] == RUNNING:
            w.p[i] = w.z[i] + ti.cast(w.state[STEP], m.real) * w.p[i]
        elif w.state[STATUS] == NEGATIVE_PENDING:
            w.y[i] = w.y[i] + ti.cast(w.state[STEP], m.real) * w.p[i]
    ti.loop_config(serialize=True)
    for _ in range(1):
        if w.state[STATUS] == NEGATIVE_PENDING:
            w.state[STATUS] = NEGATIVE
