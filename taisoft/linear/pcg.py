"""Preconditioned conjugate gradients for A y = rhs on the free axes, with any preconditioner; `gauss_seidel` has its own.

A is a `BlockCsr` that holds the whole system, plus coupling terms J^T D J, plus a border G^T s G of few dense rows.
Used with `Jacobi` on CUDA and for bordered systems, with `Factor` for slender bodies, and with `Volumes` for nearly
incompressible ones. See `pcg_work` for where a solve stops.

With block Jacobi, a team solves small systems in one launch (`run_team`), where one launch for each iteration would take longer
than its work.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.chunks import chunk_entry, chunk_size, fold, total_by_team
from taisoft.fem.model import Model
from taisoft.fem.state import OTHER_SUM, SUM
from taisoft.linear.block_csr import BlockCsr, block_times, off_diagonal_times
from taisoft.linear.coupling import NO_COUPLING, Coupling, form_product, gather_products
from taisoft.linear.jacobi import JACOBI
from taisoft.linear.pcg_work import (
    COUNT,
    FAILED,
    NEGATIVE,
    NEGATIVE_PENDING,
    RUNNING,
    RZ,
    RZ_START,
    STATUS,
    STEP,
    LinearResult,
    PcgWork,
    begin_with,
    dot64,
    end_iteration,
    set_step,
    status_at,
    step_along,
)

BATCH, TEAM_BATCH = 8, 256  # iterations between two readings of the status on CUDA, of launches and of a team


class Preconditioner(Protocol):
    """A record whose functions are part of the kernels; symmetric, positive definite on the free axes, 0 on the others."""

    def prepare(self, model, A, terms, work, i, same_matrix) -> None:
        """Set what node i needs when a solve begins, if the caller has not prepared everything; add coupling terms."""

    def apply(self, model, work) -> None:
        """Set work.z to the preconditioned work.r, in loops at the top level of a kernel. Partial sums: OTHER_SUM of r.z."""


@dataclass(frozen=True, eq=False)
class Border:
    """G^T s G."""

    n: Any = None  # (1) i32: rows
    row: Any = None  # (capacity * n_nodes) 3-vectors f64: G, 0 on constrained axes
    factor: Any = None  # (capacity) f64: s
    product: Any = None  # (capacity) f64: s G p
    any: bool = True


NO_BORDER = Border(any=False)


def iteration_limit(model: Model) -> int:
    """Maximum iterations of a solve."""
    return max(1000, 30 * model.n_nodes)


def solve(
    model: Model,
    A: BlockCsr,
    preconditioner: Preconditioner,
    work: PcgWork,
    tolerance: float,
    max_iterations: int,
    terms: Coupling = NO_COUPLING,
    same_matrix: bool = False,
    border: Border = NO_BORDER,
) -> LinearResult:
    """Solve for work.y given work.rhs. tolerance: of sqrt(r.z); terms, same_matrix: see `gauss_seidel.solve`."""

    left, by_team = max_iterations, work.by_team and preconditioner is JACOBI and not border.any
    given = model, A, preconditioner, terms, work, tolerance, int(same_matrix)
    if by_team:
        run_team(*given, 1, max_iterations)
        while (result := work.result(max_iterations)) is None:
            run_team(*given, 0, max_iterations)
        return result
    start(model, A, preconditioner, terms, work, tolerance, int(same_matrix))
    while (result := work.result(max_iterations)) is None:
        n = 1 if model.on_cpu else min(BATCH, left)
        for _ in range(n):
            iterate(model, A, preconditioner, terms, border, work, tolerance)
        left -= n
    return result


@kernel
def start(
    model: ti.template(),
    A: ti.template(),
    preconditioner: ti.template(),
    terms: ti.template(),
    work: ti.template(),
    tolerance: ti.f64,
    same_matrix: ti.i32,
):
    """Begin a solve from y = 0 with r = rhs and p = z."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        work.state[STATUS] = RUNNING
    ti.loop_config(serialize=model.serial)
    for task in range(model.chunks * model.spread):
        if task % model.spread == 0:
            c, n = task // model.spread, model.n_nodes
            for at in range(chunk_size(model, c, n)):
                i = chunk_entry(model, c, at, n)
                preconditioner.prepare(model, A, terms, work, i, same_matrix)
                _clear_node(model, work, i)
    preconditioner.apply(model, work)
    fold(model, OTHER_SUM, OTHER_SUM, ())
    ti.loop_config(serialize=model.team.alone, block_dim=model.team.threads)
    for t in range(model.team.threads):
        rz = total_by_team(model, t, OTHER_SUM)
        if t == 0:
            begin_with(work, tolerance, rz)
    _turn(model, work)


@kernel
def iterate(
    model: ti.template(),
    A: ti.template(),
    preconditioner: ti.template(),
    terms: ti.template(),
    border: ti.template(),
    work: ti.template(),
    tolerance: ti.f64,
):
    """Run one iteration, or nothing if the status is not RUNNING."""
    _multiply(model, A, terms, border, work)
    fold(model, SUM, SUM, ())
    ti.loop_config(serialize=model.team.alone, block_dim=model.team.threads)
    for t in range(model.team.threads):
        curvature = total_by_team(model, t, SUM)
        if t == 0 and work.state[STATUS] == RUNNING:
            set_step(work, curvature)
    ti.loop_config(serialize=model.serial)
    for task in range(model.chunks * model.spread):
        if task % model.spread == 0 and (work.state[STATUS] == RUNNING or work.state[STATUS] == NEGATIVE_PENDING):
            c, n, step = task // model.spread, model.n_nodes, ti.cast(work.state[STEP], model.real)
            for at in range(chunk_size(model, c, n)):
                _move_node(work, chunk_entry(model, c, at, n), step)
    preconditioner.apply(model, work)
    fold(model, OTHER_SUM, OTHER_SUM, ())
    ti.loop_config(serialize=model.team.alone, block_dim=model.team.threads)
    for t in range(model.team.threads):
        rz = total_by_team(model, t, OTHER_SUM)
        if t == 0:
            end_iteration(work, tolerance, rz)
    _turn(model, work)


@ti.func
def _multiply(model: ti.template(), A: ti.template(), terms: ti.template(), border: ti.template(), work: ti.template()):
    """q = A p. Partial sums: SUM of p.q."""
    if ti.static(terms.any):
        ti.loop_config(serialize=model.serial)
        for c in range(model.chunks):
            for at in range(chunk_size(model, c, terms.count[0])):
                form_product(model, terms, chunk_entry(model, c, at, terms.count[0]), work.p)
    if ti.static(border.any):
        ti.loop_config(serialize=model.serial)
        for k in range(border.n[0]):
            s = ti.cast(0.0, ti.f64)
            for i in range(model.n_nodes):
                s += border.row[k * model.n_nodes + i].dot(ti.cast(work.p[i], ti.f64))
            border.product[k] = border.factor[k] * s
    ti.loop_config(serialize=model.serial)
    for task in range(model.chunks * model.spread):
        if task % model.spread == 0:
            c, n, s = task // model.spread, model.n_nodes, ti.cast(0.0, ti.f64)
            if work.state[STATUS] == RUNNING:
                for at in range(chunk_size(model, c, n)):
                    s += _multiply_node(model, A, terms, border, work, c, chunk_entry(model, c, at, n))
            model.state.partial[c, SUM] = s


@ti.func
def _turn(model: ti.template(), work: ti.template()):
    """p = z + STEP p."""
    ti.loop_config(serialize=model.serial)
    for task in range(model.chunks * model.spread):
        if task % model.spread == 0 and work.state[STATUS] == RUNNING:
            c, n, ratio = task // model.spread, model.n_nodes, ti.cast(work.state[STEP], model.real)
            for at in range(chunk_size(model, c, n)):
                _turn_node(work, chunk_entry(model, c, at, n), ratio)


# --- what each node does ----------------------------------------------------------------------------------------------


@ti.func
def _clear_node(model: ti.template(), work: ti.template(), i):
    """y, r and p of node i at the start."""
    work.r[i] = model.free[i] * work.rhs[i]
    work.y[i], work.p[i] = ti.Vector.zero(model.real, 3), ti.Vector.zero(model.real, 3)


@ti.func
def _multiply_node(
    model: ti.template(), A: ti.template(), terms: ti.template(), border: ti.template(), work: ti.template(), c, i
):
    """Set q of node i, in chunk c of a loop, from the products of terms and border; return its p.q."""
    product = off_diagonal_times(model, A, c, i, work.p)
    if ti.static(terms.any):
        product += block_times(terms.base[i], work.p[i]) + gather_products(model, terms, i)
    else:
        product += block_times(A.diagonal[i], work.p[i])
    if ti.static(border.any):
        for k in range(border.n[0]):
            product += ti.cast(border.product[k] * border.row[k * model.n_nodes + i], model.real)
    q = model.free[i] * product
    work.q[i] = q
    return dot64(work.p[i], q)


@ti.func
def _move_node(work: ti.template(), i, step):
    """y and r of node i after a step along p."""
    work.y[i] = work.y[i] + step * work.p[i]
    work.r[i] = work.r[i] - step * work.q[i]


@ti.func
def _turn_node(work: ti.template(), i, ratio):
    """p of node i for the next step."""
    work.p[i] = work.z[i] + ratio * work.p[i]


# --- by a team --------------------------------------------------------------------------------------------------------


@kernel
def run_team(
    model: ti.template(),
    A: ti.template(),
    preconditioner: ti.template(),
    terms: ti.template(),
    work: ti.template(),
    tolerance: ti.f64,
    same_matrix: ti.i32,
    begins: ti.i32,
    max_iterations: ti.i32,
):
    """Begin a solve, or go on with it (begins = 0), by TEAM_BATCH iterations at most; FAILED after max_iterations in all.

    preconditioner: one that needs only a node at a time. All threads compute the same state; the first one stores it.
    """
    ti.loop_config(serialize=work.team.alone, block_dim=work.team.threads)
    for t in range(work.team.threads):
        n, s = model.n_nodes, ti.cast(0.0, ti.f64)
        if begins == 1:
            for j in range(work.team.share(t, n)):
                i = work.team.entry(t, j, n)
                preconditioner.prepare(model, A, terms, work, i, same_matrix)
                _clear_node(model, work, i)
                s += preconditioner.apply_at(work, i)
                _turn_node(work, i, ti.cast(0.0, model.real))
            start = work.team.total(t, s)
            if t == 0:
                begin_with(work, tolerance, start)
            work.team.sync()
        rz, status, count = work.state[RZ], ti.cast(work.state[STATUS], ti.i32), ti.cast(work.state[COUNT], ti.i32)
        last = ti.min(count + TEAM_BATCH, max_iterations)
        while status == RUNNING and count < last:
            if ti.static(terms.any):
                for j in range(work.team.share(t, terms.count[0])):
                    form_product(model, terms, work.team.entry(t, j, terms.count[0]), work.p)
                work.team.sync()
            s = 0.0
            for j in range(work.team.share(t, n)):
                s += _multiply_node(model, A, terms, NO_BORDER, work, 0, work.team.entry(t, j, n))
            pending, step = step_along(rz, work.team.total(t, s))
            s = 0.0
            for j in range(work.team.share(t, n)):
                i = work.team.entry(t, j, n)
                _move_node(work, i, ti.cast(step, model.real))
                s += preconditioner.apply_at(work, i)
            before, rz = rz, work.team.total(t, s)
            if pending == RUNNING:
                status, count = status_at(tolerance, rz, work.state[RZ_START]), count + 1
                for j in range(work.team.share(t, n)):
                    _turn_node(work, work.team.entry(t, j, n), ti.cast(rz / before, model.real))
            else:
                status = NEGATIVE
            work.team.sync()
        if t == 0:
            work.state[RZ], work.state[COUNT] = rz, count
            work.state[STATUS] = ti.select(status == RUNNING and count >= max_iterations, FAILED, status)
