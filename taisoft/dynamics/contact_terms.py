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
from taisoft.contact.problem import CHANGED, NODES, RESIDUAL, SIZE, residual_of
from taisoft.contact.prox import dvec, into_disk, prox, scaled
from taisoft.fields import FieldArena
from taisoft.linear.block_csr import BLOCK
from taisoft.linear.coupling import NO_COUPLING, Coupling, build_coupling
from taisoft.model import Model
from taisoft.runtime import kernel
from taisoft.scalars import CONTACT_POTENTIAL


@dataclass(frozen=True, eq=False)
class ContactStageWork:
    """Fields of a stage with contacts."""

    multiplier: Any  # (capacity) 3-vectors f64: lambda [N s]
    radius: Any  # (capacity) f64: rho [N s]
    lag: Any  # (capacity) 3-vectors f64: what J makes of x_start - x_hat, less the way of an obstacle [m]
    short: Any  # (capacity) f64: gap - goal at the start, less the way of an obstacle along the normal [m]
    kept: Any  # (capacity) 3-vectors f64: impulses where the stage was linearised [N s]
    push: Any  # (capacity) 3-vectors f64: the impulse in the world [N s]
    misfit: Any  # (capacity) 3-vectors f64: of the natural map, and psi_c [J]
    block: Any  # (capacity) 12-vectors: J^T D J is made of weights times this
    active: Any  # (capacity) i32: 1 where the block is not 0


@dataclass(frozen=True, eq=False)
class StageContacts:
    """What the kernels of a stage and of its linear solve need to know of the contacts."""

    problem: Any  # ContactProblem
    found: Any  # FoundContacts
    work: ContactStageWork
    coupling: Coupling  # of J^T D J
    x_start: Any  # (n_nodes) 3-vectors f64: where the gaps were taken [m]
    way: Any  # (n_nodes) 3-vectors f64: from there [m]
    x_linear: Any  # (n_nodes) 3-vectors f64: where a linearly implicit stage was linearised; the next two, too
    residual_linear: Any  # (n_nodes) 3-vectors
    change: Any  # (n_nodes) 3-vectors [m/s]

    @property
    def any(self) -> bool:
        """Whether there can be contacts."""
        return self.problem is not None


NO_CONTACTS = StageContacts(None, None, None, NO_COUPLING, *[None] * 5)


@ti.func
def _set_out(s: ti.template(), k: ti.template(), c, beta, dt, standoff, fast, slow, fastest, impact: ti.template()):
    """The impulse of contact c becomes its multiplier, and the disk opens as far as that says; what x does not change.

    impact: whether the contact's velocity must be `leave`, whatever its gap.
    """
    p, f, w = ti.static((k.problem, k.found, k.work))
    w.multiplier[c] = p.r[c]
    w.radius[c] = p.friction[c] * p.r[c][0]
    lag = -(beta / dt) * f.carry[c]
    for j in range(p.arity[c]):
        i = p.node[c, j]
        lag += p.weight[c, j] * (k.x_start[i] - s.x_hat[i])
    w.lag[c] = lag
    if ti.static(impact):
        w.short[c] = -beta * f.leave[c] - (beta / dt) * p.normal[c].dot(f.carry[c])
    else:
        goal = short_of_goal(f, c, dt, standoff, fast, slow, fastest, f.rise[c])
        w.short[c] = goal - p.normal[c].dot(f.carry[c])


@ti.func
def _stage_velocity_of(k: ti.template(), c, beta):
    """u of contact c at the present x: (normal, t1, t2) [m/s]."""
    p, w = ti.static((k.problem, k.work))
    way = dvec(0.0)
    for j in range(p.arity[c]):
        way += p.weight[c, j] * k.way[p.node[c, j]]
    n, t, v = p.normal[c], p.tangent[c], way + w.lag[c]
    return dvec(w.short[c] + n.dot(way), t.dot(v), n.cross(t).dot(v)) / beta


@ti.func
def _press(m: ti.template(), k: ti.template(), c, beta, stiffness):
    """Impulse p.r of contact c at the present x, its block of the matrix, and its part in the laws' residual."""
    p, w = ti.static((k.problem, k.work))
    u = _stage_velocity_of(k, c, beta)
    Rn, Rt = stiffness * p.factor[c][0], stiffness * p.factor[c][1]
    z = w.multiplier[c] - dvec(Rn * u[0], Rt * u[1], Rt * u[2])
    rho = w.radius[c]
    size = ti.sqrt(z[1] * z[1] + z[2] * z[2])
    r = into_disk(dvec(ti.max(z[0], 0.0), z[1], z[2]), rho)
    if Rn == 0.0:  # nothing can move it
        r = dvec(0.0)
    p.r[c] = r
    # D in the contact's frame, then in the world
    Dn = ti.select(z[0] > 0.0, Rn, 0.0)
    along, across = Rt, Rt  # along z_t, and across it
    if size > rho or rho == 0.0:  # slips; without a disk nothing resists, not even where nothing moves yet
        along, across = 0.0 * Rt, 0.0 * Rt
        if size > 0.0:
            across = Rt * rho / size
    n, t1 = p.normal[c], p.tangent[c]
    t2 = n.cross(t1)
    w.push[c] = r[0] * n + r[1] * t1 + r[2] * t2
    e = t1
    if size > 0.0:
        e = (z[1] * t1 + z[2] * t2) / size
    g = n.cross(e)
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            w.block[c][4 * j + i] = ti.cast(Dn * n[i] * n[j] + along * e[i] * e[j] + across * g[i] * g[j], m.real)
    w.active[c] = int(Dn > 0.0 or along > 0.0 or across > 0.0)
    d = r - prox(r - scaled(p.factor[c], u), p.friction[c])
    psi = ti.cast(0.0, ti.f64)
    if Rn > 0.0:
        psi += 0.5 * ti.max(z[0], 0.0) ** 2 / Rn
    if Rt > 0.0:
        psi += ti.select(size > rho, rho * (size - 0.5 * rho), 0.5 * size * size) / Rt
    w.misfit[c] = dvec(d.dot(d), r.dot(r), psi)


@ti.func
def impulse_on_node(k: ti.template(), i):
    """(J^T r) of node i [N s]; as `impulse_on`, which has no impulses in the world at hand."""
    p, w = ti.static((k.problem, k.work))
    d = dvec(0.0)
    for e in range(p.entry_start[i], p.entry_start[i + 1]):
        c, own = p.entry[e] // NODES, p.entry[e] % NODES
        d += p.weight[c, own] * w.push[c]
    return d


@ti.func
def _sum_residual(m: ti.template(), k: ti.template()):
    """Residual of the laws over all contacts. scalars: CONTACT_POTENTIAL."""
    p, w = ti.static((k.problem, k.work))
    changed, size, psi = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for c in range(p.count[0]):
        changed += w.misfit[c][0]
        size += w.misfit[c][1]
        psi += w.misfit[c][2]
    m.state.scalars[CONTACT_POTENTIAL] = psi
    p.state[CHANGED], p.state[SIZE] = changed, size
    p.state[RESIDUAL] = residual_of(changed, size)


@kernel
def press(
    m: ti.template(), s: ti.template(), k: ti.template(), impact: ti.template(), multiply: ti.i32, beta: ti.f64, dt: ti.f64,
    standoff: ti.f64, fast: ti.f64, slow: ti.f64, fastest: ti.f64, stiffness: ti.f64,
):  # fmt: skip
    """Find the impulses of all contacts where `move` has gone, their blocks of the matrix, and the residual of their laws.

    impact: as `_set_out`. multiply: whether the impulses are made the multipliers first, and the disks opened as far as these
    say. stiffness: R over the r-factors.
    """
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=p.serial)
    for n in range(p.count[0]):
        if multiply == 1:
            _set_out(s, k, n, beta, dt, standoff, fast, slow, fastest, impact)
        _press(m, k, n, beta, stiffness)
    ti.loop_config(serialize=True)
    for _ in range(1):
        _sum_residual(m, k)


@kernel
def keep_diagonal(m: ti.template(), A: ti.template(), k: ti.template()):
    """The matrix has been formed: its diagonal without contacts, and the masses that the r-factors rest on, diag(A)^-1."""
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        k.coupling.base[i] = A.diagonal[i]
        for a in ti.static(range(3)):
            d = ti.cast(A.diagonal[i][5 * a], ti.f64)
            p.inverse_mass[i][a] = ti.select(d > 0.0, ti.cast(m.free[i][a], ti.f64) / d, 0.0)


@kernel
def keep_linear(m: ti.template(), s: ti.template(), k: ti.template()):
    """The stage is linearised here: x, the residual without contacts, and the impulses."""
    p, w = ti.static((k.problem, k.work))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        k.x_linear[i] = m.state.x[i]
        k.residual_linear[i] = s.residual[i] + ti.cast(impulse_on_node(k, i), m.real)
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        w.kept[c] = p.r[c]


@kernel
def leave_linear(m: ti.template(), s: ti.template(), k: ti.template(), pcg: ti.template(), taken: ti.i32):
    """Back to where the stage was linearised, with the way from there as y, and the impulses of here as the multipliers.

    taken: 0 where what was found is dropped: the impulses are those of then.
    """
    p, w = ti.static((k.problem, k.work))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        pcg.y[i] = m.free[i] * k.change[i]
        s.base[i] = k.x_linear[i]
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        if taken == 0:
            p.r[c] = w.kept[c]


def build_stage_contacts(arena: FieldArena, model: Model, found: FoundContacts, x_start: Any) -> StageContacts:
    """Room for the contacts of `found`. x_start: (n_nodes) 3-vectors f64, filled by the caller."""
    p, n, real = found.problem, model.n_nodes, model.real
    work = ContactStageWork(
        arena.vectors("multiplier", ti.f64, p.capacity), arena.field("friction_radius", ti.f64, p.capacity),
        arena.vectors("contact_lag", ti.f64, p.capacity), arena.field("contact_short", ti.f64, p.capacity),
        arena.vectors("contact_kept", ti.f64, p.capacity),
        arena.vectors("contact_push", ti.f64, p.capacity), arena.vectors("contact_misfit", ti.f64, p.capacity),
        arena.vectors("contact_block", real, p.capacity, n=BLOCK), arena.field("contact_active", ti.i32, p.capacity),
    )  # fmt: skip
    coupling = build_coupling(
        arena, real, n, p.count, p.node, p.arity, p.weight, p.entry_start, p.entry, work.block, work.active,
        arena.vectors("base_diagonal", real, n, n=BLOCK),
    )  # fmt: skip
    return StageContacts(
        p, found, work, coupling, x_start, arena.vectors("contact_way", ti.f64, n),
        arena.vectors("x_linear", ti.f64, n), arena.vectors("residual_linear", real, n), arena.vectors("linear_change", real, n),
    )  # fmt: skip
