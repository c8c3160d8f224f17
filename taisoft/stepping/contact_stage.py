"""Kernels of an implicit stage with contacts: what they add to the residual, the objective and the matrix.

With multipliers lambda (impulses) and radii rho of the friction disks that stay while v is sought, the stage minimises
    Phi(v) + sum_c psi_c(lambda - R u),   u = J v + b,
whose gradient is that of Phi less J^T p, p = prox(lambda - R u), and whose second derivative is A + J^T D J with D = R dp/dz.
psi of the normal part is max(0, z_n)^2 / 2 R_n; of the tangential part |z_t|^2 / 2 R_t inside the disk and
(rho |z_t| - rho^2 / 2) / R_t outside. The normal velocity u_n is the gap at the stage's end over beta, less its goal.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.contact.assemble import FoundContacts, short_of_goal
from taisoft.contact.problem import CHANGED, NODES, RESIDUAL, SIZE, impulse_on, residual_of
from taisoft.contact.prox import dvec, into_disk, prox, scaled
from taisoft.linear.block_csr import BLOCK, block_times, part_times
from taisoft.linear.coupling import Coupling, coupling_diagonal
from taisoft.linear.pcg import dot64, total
from taisoft.model import Model
from taisoft.runtime import FieldArena, kernel
from taisoft.stepping.stage import norm2


@dataclass(frozen=True, eq=False)
class ContactStageWork:
    """Fields of a stage with contacts."""

    multiplier: Any  # (capacity) 3-vectors f64: lambda [N s]
    radius: Any  # (capacity) f64: rho [N s]
    energy: Any  # (capacity) f64: psi [J]
    misfit: Any  # (capacity) 2-vectors f64: of the natural map
    block: Any  # (capacity) 12-vectors: J^T D J is made of weights times this
    active: Any  # (capacity) i32: 1 where the block is not 0
    totals: Any  # (1) f64: sum of psi


@dataclass(frozen=True, eq=False)
class StageContacts:
    """What the kernels of a stage and of its linear solve need to know of the contacts."""

    problem: Any  # ContactProblem
    found: Any  # FoundContacts
    work: ContactStageWork
    coupling: Coupling  # of J^T D J
    base: Any  # (n_nodes) 12-vectors: diagonal of the matrix without contacts
    x_start: Any  # (n_nodes) 3-vectors f64: where the gaps were taken [m]
    x_linear: Any  # (n_nodes) 3-vectors f64: where a linearly implicit stage was linearised; the next two, too
    residual_linear: Any  # (n_nodes) 3-vectors
    change: Any  # (n_nodes) 3-vectors [m/s]


@kernel
def set_multipliers(k: ti.template()):
    """lambda = the present impulses; the disks open as far as their normal parts say."""
    p, w = ti.static((k.problem, k.work))
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        w.multiplier[c] = p.r[c]
        w.radius[c] = p.friction[c] * p.r[c][0]


@ti.func
def _stage_velocity_of(m: ti.template(), s: ti.template(), k: ti.template(), c, beta, dt, standoff, fast, slow, fastest):
    """u of contact c at the present x: (normal, t1, t2) [m/s]."""
    p, f = ti.static((k.problem, k.found))
    way, v = -f.carry[c], -f.carry[c] / dt
    for j in range(p.arity[c]):
        i, weight = p.node[c, j], p.weight[c, j]
        way += weight * (m.x[i] - k.x_start[i])
        v += weight * ((m.x[i] - s.x_hat[i]) / beta)
    n, t = p.normal[c], p.tangent[c]
    return dvec((short_of_goal(f, c, dt, standoff, fast, slow, fastest) + n.dot(way)) / beta, t.dot(v), n.cross(t).dot(v))


@kernel
def press(
    m: ti.template(), s: ti.template(), k: ti.template(), beta: ti.f64, dt: ti.f64, standoff: ti.f64, fast: ti.f64, slow: ti.f64,
    fastest: ti.f64, stiffness: ti.f64,
):  # fmt: skip
    """Impulses p.r, energy and matrix blocks of the contacts at the present x, and the residual of their laws.

    stiffness: R over the r-factors.
    """
    p, w = ti.static((k.problem, k.work))
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        u = _stage_velocity_of(m, s, k, c, beta, dt, standoff, fast, slow, fastest)
        Rn, Rt = stiffness * p.factor[c][0], stiffness * p.factor[c][1]
        z = w.multiplier[c] - dvec(Rn * u[0], Rt * u[1], Rt * u[2])
        rho = w.radius[c]
        size = ti.sqrt(z[1] * z[1] + z[2] * z[2])
        r = into_disk(dvec(ti.max(z[0], 0.0), z[1], z[2]), rho)
        if Rn == 0.0:  # nothing can move it
            r = dvec(0.0)
        p.r[c] = r
        psi = ti.cast(0.0, ti.f64)
        if Rn > 0.0:
            psi += 0.5 * r[0] * r[0] / Rn
        # D in the contact's frame, then in the world
        Dn = ti.select(z[0] > 0.0, Rn, 0.0)
        along, across = Rt, Rt  # along z_t, and across it
        if size > rho or rho == 0.0:  # slips; without a disk nothing resists, not even where nothing moves yet
            along, across = 0.0 * Rt, 0.0 * Rt
            if size > 0.0:
                across = Rt * rho / size
        if Rt > 0.0:
            psi += 0.5 * size * size / Rt if size <= rho else (rho * size - 0.5 * rho * rho) / Rt
        w.energy[c] = psi
        n, t1 = p.normal[c], p.tangent[c]
        t2 = n.cross(t1)
        e = t1
        if size > 0.0:
            e = (z[1] * t1 + z[2] * t2) / size
        g = n.cross(e)
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                w.block[c][4 * j + i] = ti.cast(Dn * n[i] * n[j] + along * e[i] * e[j] + across * g[i] * g[j], m.real)
        w.active[c] = int(Dn > 0.0 or along > 0.0 or across > 0.0)
        d = r - prox(r - scaled(p.factor[c], u), p.friction[c])
        w.misfit[c][0], w.misfit[c][1] = d.dot(d), r.dot(r)
    ti.loop_config(serialize=True)
    for _ in range(1):
        changed, size, energy = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for c in range(p.count[0]):
            changed += w.misfit[c][0]
            size += w.misfit[c][1]
            energy += w.energy[c]
        p.state[CHANGED], p.state[SIZE] = changed, size
        p.state[RESIDUAL] = residual_of(changed, size)
        w.totals[0] = energy


@kernel
def add_impulses(m: ti.template(), s: ti.template(), k: ti.template(), pcg: ti.template(), norms: ti.types.ndarray()):
    """Take J^T p from the residual, and find its norms anew: norms[0] on the free axes, norms[4] on the others; scalars 12:
    its slope along the last direction, pcg.y."""
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=m.serial)
    for chunk in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        on, off, slope = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for i in range(chunk * size, ti.min(m.n_nodes, (chunk + 1) * size)):
            r, free = s.residual[i] - ti.cast(impulse_on(p, i), m.real), m.free[i]
            s.residual[i] = r
            pcg.rhs[i] = -free * r
            on += norm2(free * r)
            off += norm2((1.0 - free) * r)
            slope += dot64(free * r, pcg.y[i])
        m.partial[chunk, 0], m.partial[chunk, 4], m.partial[chunk, 5] = on, off, slope
    ti.loop_config(serialize=True)
    for _ in range(1):
        norms[0], norms[4] = total(m, 0), total(m, 4)
        m.scalars[12] = total(m, 5)


@kernel
def keep_diagonal(m: ti.template(), A: ti.template(), k: ti.template()):
    """The matrix has been formed: its diagonal without contacts, and the masses that the r-factors rest on, diag(A)^-1."""
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        k.base[i] = A.diagonal[i]
        for a in ti.static(range(3)):
            d = ti.cast(A.diagonal[i][5 * a], ti.f64)
            p.inverse_mass[i][a] = ti.select(d > 0.0, ti.cast(m.free[i][a], ti.f64) / d, 0.0)


@kernel
def stiffen(m: ti.template(), A: ti.template(), k: ti.template()):
    """Diagonal of A + J^T D J; the rest of J^T D J stays in factors, see `linear.coupling`."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        A.diagonal[i] = coupling_diagonal(m, k.coupling, i, k.base[i])


@kernel
def keep_linear(m: ti.template(), s: ti.template(), k: ti.template()):
    """The stage is linearised here: x and the residual without contacts."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        k.x_linear[i] = m.x[i]
        k.residual_linear[i] = s.residual[i]


@kernel
def linear_residual(
    m: ti.template(), s: ti.template(), A: ti.template(), k: ti.template(), beta: ti.f64
):  # fmt: skip
    """The residual without contacts of the stage that was linearised: that of then, and A times the change of v."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        k.change[i] = ti.cast((m.x[i] - k.x_linear[i]) / beta, m.real)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        off = part_times(m, A, A.row_start[i], A.row_start[i + 1], k.change)
        s.residual[i] = k.residual_linear[i] + block_times(k.base[i], k.change[i]) + off


def build_stage_contacts(arena: FieldArena, model: Model, found: FoundContacts, x_start: Any) -> StageContacts:
    """Room for the contacts of `found`. x_start: (n_nodes) 3-vectors f64, filled by the caller."""
    p, n, real = found.problem, model.n_nodes, model.real
    work = ContactStageWork(
        arena.vectors("multiplier", ti.f64, p.capacity), arena.field("friction_radius", ti.f64, p.capacity),
        arena.field("contact_energy", ti.f64, p.capacity), arena.vectors("contact_misfit", ti.f64, p.capacity, n=2),
        arena.vectors("contact_block", real, p.capacity, n=BLOCK), arena.field("contact_active", ti.i32, p.capacity),
        arena.field("contact_totals", ti.f64, 1),
    )  # fmt: skip
    coupling = Coupling(NODES, p.node, p.arity, p.weight, p.entry_start, p.entry, work.block, work.active)
    return StageContacts(
        p, found, work, coupling, arena.vectors("base_diagonal", real, n, n=BLOCK), x_start,
        arena.vectors("x_linear", ti.f64, n), arena.vectors("residual_linear", real, n), arena.vectors("linear_change", real, n),
    )  # fmt: skip
