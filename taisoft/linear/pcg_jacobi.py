"""Conjugate gradients with a block-Jacobi preconditioner, in parallel loops, for `pcg` on CUDA."""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.chunks import chunk_entry, chunk_size, fold, total
from taisoft.fem.node_graph import n_nodes_of, node_of
from taisoft.fem.state import OTHER_SUM, SUM
from taisoft.linear.block_csr import block_times, off_diagonal_times
from taisoft.linear.coupling import form_product, gather_products
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


@kernel
def start_jacobi(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), same_matrix: ti.i32):
    """Set the diagonal and its inverse B, y = 0, r = rhs, z = p = B r."""
    for c in range(m.chunks):
        s = ti.cast(0.0, ti.f64)
        n = n_nodes_of(m, w.subset)
        for at in range(chunk_size(m, c, n)):
            i = node_of(w.subset, chunk_entry(m, c, at, n))
            precondition(m, A, k, w, i, same_matrix)
            r = m.free[i] * w.rhs[i]
            z = block_times(w.inverse[i], r)
            w.y[i] = ti.Vector([0.0, 0.0, 0.0], m.real)
            w.r[i], w.z[i], w.p[i] = r, z, z
            s += dot64(r, z)
        m.state.partial[c, SUM] = s
    fold(m, SUM, SUM, ())
    ti.loop_config(serialize=True)
    for _ in range(1):
        rz = total(m, SUM)
        w.state[RZ], w.state[RZ_START], w.state[COUNT], w.state[STATUS] = rz, rz, 0.0, RUNNING


@kernel
def iterate_jacobi(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), tolerance: ti.f64):
    """Run one iteration, or nothing if the status is not RUNNING.

    The status becomes NEGATIVE_PENDING with the last change of y, and NEGATIVE only in the next iteration.
    """
    if ti.static(k.width > 0):
        for c in range(m.chunks):  # as below, fewer launches than loops whose length is only known on the device
            for j in range(chunk_size(m, c, k.count[0])):
                form_product(m, k, chunk_entry(m, c, j, k.count[0]), w.p)
    for c in range(m.chunks):
        s = ti.cast(0.0, ti.f64)
        if w.state[STATUS] == RUNNING:
            n = n_nodes_of(m, w.subset)
            for at in range(chunk_size(m, c, n)):
                i = node_of(w.subset, chunk_entry(m, c, at, n))
                product = off_diagonal_times(m, A, 0, i, w.p)
                if ti.static(k.width > 0):
                    product += block_times(k.base[i], w.p[i]) + gather_products(m, k, i)
                else:
                    product += block_times(A.diagonal[i], w.p[i])
                q = m.free[i] * product
                w.q[i] = q
                s += dot64(w.p[i], q)
        m.state.partial[c, SUM] = s
    fold(m, SUM, SUM, ())
    ti.loop_config(serialize=True)
    for _ in range(1):
        if w.state[STATUS] == NEGATIVE_PENDING:  # of the iteration before
            w.state[STATUS] = NEGATIVE
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
        s = ti.cast(0.0, ti.f64)
        if w.state[STATUS] == RUNNING:
            a = ti.cast(w.state[STEP], m.real)
            n = n_nodes_of(m, w.subset)
            for at in range(chunk_size(m, c, n)):
                i = node_of(w.subset, chunk_entry(m, c, at, n))
                w.y[i] = w.y[i] + a * w.p[i]
                r = w.r[i] - a * w.q[i]
                z = block_times(w.inverse[i], r)
                w.r[i], w.z[i] = r, z
                s += dot64(r, z)
        m.state.partial[c, OTHER_SUM] = s
    fold(m, OTHER_SUM, OTHER_SUM, ())
    ti.loop_config(serialize=True)
    for _ in range(1):
        if w.state[STATUS] == RUNNING:
            rz = total(m, OTHER_SUM)
            w.state[STEP] = rz / w.state[RZ]
            w.state[RZ] = rz
            w.state[COUNT] = w.state[COUNT] + 1.0
            if rz <= tolerance * tolerance * w.state[RZ_START]:
                w.state[STATUS] = CONVERGED
    for c in range(m.chunks):
        n = n_nodes_of(m, w.subset)
        for at in range(chunk_size(m, c, n)):
            i = node_of(w.subset, chunk_entry(m, c, at, n))
            if w.state[STATUS] == RUNNING:
                w.p[i] = w.z[i] + ti.cast(w.state[STEP], m.real) * w.p[i]
            elif w.state[STATUS] == NEGATIVE_PENDING:
                w.y[i] = w.y[i] + ti.cast(w.state[STEP], m.real) * w.p[i]
