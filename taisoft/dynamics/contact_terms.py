"""Contact terms of an implicit stage: their contributions to residual, objective and matrix.

With multipliers lambda (impulses) and friction disk radii rho, both fixed, the stage minimises
    Phi(v) + sum_c psi_c(lambda - R u),   u = J v + b,
with gradient grad Phi - J^T p, p = prox(lambda - R u), and Hessian A + J^T D J, D = R dp/dz, z = lambda - R u.
psi of the normal part is max(0, z_n)^2 / 2 R_n; of the tangential part |z_t|^2 / 2 R_t inside the disk and
(rho |z_t| - rho^2 / 2) / R_t outside. The normal velocity u_n is the gap at the stage's end over beta, minus its target.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.contact.problem import ContactProblem, residual_of, to_world
from taisoft.contact.prox import OPEN, dvec, into_disk, prox, scaled, state_of
from taisoft.contact.targets import contact_offset_of
from taisoft.fem.model import Model
from taisoft.fem.state import HAS_FRICTION, IMPULSE_SQUARE, LAW, WORST_GAP
from taisoft.linear.block_csr import BLOCK
from taisoft.linear.coupling import NO_COUPLING, Coupling, build_coupling

# largest part of its target that a contact's gap may miss at the end; smallest such target, over the contact offset
MAX_MISSED, MIN_KEPT = 0.5, 1e-3
ROUNDING = 4.0 * 2.0**-52  # of the largest coordinate: that of a gap, as of positions in f64
PAST = 2  # multiplier updates that are stored
KEEP, TO_IMPULSES, OF_IMPULSES = range(3)  # new multipliers, see `update_impulses`


@dataclass(frozen=True, eq=False)
class ContactStageWork:
    """Fields of a stage with contacts."""

    multiplier: Any  # (capacity) 3-vectors f64: lambda [N s]
    radius: Any  # (capacity) f64: rho [N s]
    past_impulse: Any  # (PAST capacity) 3-vectors f64: impulses at the last multiplier updates, latest first [N s]
    past_change: Any  # (PAST capacity) 3-vectors f64: those minus the multipliers that gave them [N s]
    tangential_offset: Any  # (capacity) 3-vectors f64: J (x_start - x_hat) minus obstacle displacement [m]
    gap_minus_target: Any  # (capacity) f64: gap - target at the start, minus obstacle displacement along the normal [m]
    velocity: Any  # (capacity) 3-vectors f64: u at the present x [m/s]
    rate: Any  # (capacity) 3-vectors f64: derivative of u along the step [m/s]
    kept: Any  # (capacity) 3-vectors f64: impulses at linearisation [N s]
    world_impulse: Any  # (capacity) 3-vectors f64: impulse in world axes [N s]
    prox_residual: Any  # (capacity) 3-vectors f64: squared norms of the prox residual and of its scale; residual of the gap
    gap_weight: Any  # (capacity) f64: residual per length by which the gap misses its target [1/m]
    rounding: Any  # (capacity) f64: velocity by which the rounding of positions moves a gap, over the tolerance [m/s]
    block: Any  # (capacity) 12-vectors: D in world axes; J^T D J consists of weights times this
    active: Any  # (capacity) i32: 1 if the block is not 0


@dataclass(frozen=True, eq=False)
class StageContacts:
    """Contact data for the kernels of a stage and of its linear solve."""

    problem: Any  # ContactProblem
    work: ContactStageWork
    coupling: Coupling  # of J^T D J
    x_start: Any  # (n_nodes) 3-vectors f64: positions at which gaps were measured [m]
    displacement: Any  # (n_nodes) 3-vectors f64: displacement from x_start [m]
    x_linear: Any  # (n_nodes) 3-vectors f64: positions at linearisation [m]
    residual_linear: Any  # (n_nodes) 3-vectors: residual without contacts of a linearised stage [N s]

    @property
    def any(self) -> bool:
        """Whether there can be contacts."""
        return self.problem is not None


NO_CONTACTS = StageContacts(None, None, NO_COUPLING, *[None] * 4)


@kernel
def begin_contacts(
    m: ti.template(),
    stage: ti.template(),
    contacts: ti.template(),
    impact: ti.template(),
    beta: ti.f64,
    dt: ti.f64,
    common_offset: ti.f64,
    tolerance: ti.f64,
):
    """Set the constant contact data of a stage, in a step of dt [s].

    impact: whether the contacts' velocity must be `min_velocity`, regardless of gaps. common_offset: contact offset between
    different bodies [m]. tolerance: of the laws' residual. scalars: HAS_FRICTION.
    """
    rows, work = ti.static((contacts.problem, contacts.work))
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.state.scalars[HAS_FRICTION] = 0.0
    ti.loop_config(serialize=rows.serial)
    for c in range(rows.count[0]):
        offset = -(beta / dt) * rows.obstacle_displacement[c]
        if ti.static(not impact):  # in an impact x_hat is x_start
            for e in range(rows.first[c], rows.first[c] + rows.arity[c]):
                i = rows.node[e]
                offset += rows.weight[e] * (contacts.x_start[i] - stage.x_hat[i])
        work.tangential_offset[c] = offset
        if rows.friction[c] != 0.0:
            m.state.scalars[HAS_FRICTION] = 1.0
        work.rounding[c] = ti.cast(ROUNDING, ti.f64) * ti.abs(rows.point[c]).max() / (beta * tolerance)
        if ti.static(impact):
            work.gap_minus_target[c] = -beta * rows.min_velocity[c] - (beta / dt) * rows.normal[c].dot(
                rows.obstacle_displacement[c]
            )
            work.gap_weight[c] = 0.0
        else:
            target, wanted = rows.target[c], contact_offset_of(rows, c, common_offset)
            if rows.min_opening[c] > 0.0:
                target = ti.max(target, rows.gap[c] + rows.min_opening[c])
            work.gap_minus_target[c] = rows.gap[c] - target - rows.normal[c].dot(rows.obstacle_displacement[c])
            work.gap_weight[c] = 0.0
            if target > 0.0:
                work.gap_weight[c] = tolerance / (MAX_MISSED * ti.min(ti.max(target, ti.cast(MIN_KEPT, ti.f64) * wanted), wanted))


@kernel
def predict(m: ti.template(), stage: ti.template(), contacts: ti.template(), beta: ti.f64):
    """Move the nodes to where they would be at the end of a linearised step without forces; stage.base keeps where they were."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        stage.base[i] = m.state.x[i]
        contacts.displacement[i] = beta * (m.state.v[i] + m.free[i] * stage.v_hat[i])
        m.state.x[i] = contacts.x_start[i] + contacts.displacement[i]


@kernel
def return_to_base(m: ti.template(), stage: ti.template()):
    """Move the nodes back to stage.base."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = stage.base[i]


@ti.func
def set_multiplier(contacts: ti.template(), c):
    """Set the multiplier of contact c to its impulse, and the friction disk accordingly."""
    contacts.work.multiplier[c] = contacts.problem.r[c]
    open_disk(contacts, c)


@ti.func
def open_disk(contacts: ti.template(), c):
    """Set the friction disk's radius from the multiplier of contact c."""
    contacts.work.radius[c] = contacts.problem.friction[c] * contacts.work.multiplier[c][0]


@ti.func
def stage_velocity_of(contacts: ti.template(), c, beta):
    """Return u of contact c at the present x: (normal, t1, t2) [m/s]."""
    rows, work = ti.static((contacts.problem, contacts.work))
    displacement = dvec(0.0)
    for e in range(rows.first[c], rows.first[c] + rows.arity[c]):
        displacement += rows.weight[e] * contacts.displacement[rows.node[e]]
    n, t, v = rows.normal[c], rows.tangent[c], displacement + work.tangential_offset[c]
    return dvec(work.gap_minus_target[c] + n.dot(displacement), t.dot(v), n.cross(t).dot(v)) / beta


@ti.func
def unprojected_impulse(contacts: ti.template(), c, u, r_scale):
    """Return z = lambda - R u of contact c."""
    R = r_scale * contacts.problem.factor[c]
    return contacts.work.multiplier[c] - dvec(R[0] * u[0], R[1] * u[1], R[1] * u[2])


@ti.func
def is_open(contacts: ti.template(), c, z):
    """Whether prox(z) is 0 with the friction disk fixed, and so is its derivative, without a look at tangents."""
    return z[0] <= 0.0 and contacts.work.radius[c] == 0.0


@ti.func
def projected_impulse(contacts: ti.template(), c, z):
    """Return p = prox(z) with the friction disk fixed; 0 if no node of the contact can move."""
    p = dvec(0.0)
    if not (is_open(contacts, c, z) or contacts.problem.factor[c][0] == 0.0):
        p = into_disk(dvec(ti.max(z[0], 0.0), z[1], z[2]), contacts.work.radius[c])
    return p


@ti.func
def update_contact(m: ti.template(), contacts: ti.template(), c, beta, r_scale):
    """Compute u and the impulse p.r of contact c at the present x, its matrix block, and its part of the laws' residual."""
    rows, work = ti.static((contacts.problem, contacts.work))
    u = stage_velocity_of(contacts, c, beta)
    work.velocity[c] = u
    z = unprojected_impulse(contacts, c, u, r_scale)
    r, step, opens = projected_impulse(contacts, c, z), scaled(rows.factor[c], u), is_open(contacts, c, z)
    rows.r[c] = r
    state = state_of(dvec(r[0], r[1] - step[1], r[2] - step[2]), work.radius[c])
    if state != OPEN or rows.impact_impulse[c].norm() == 0.0:  # what pressed in an impact alone keeps its state there
        rows.status[c] = state
    world_impulse, d = dvec(0.0), dvec(0.0)
    if not opens:
        world_impulse = to_world(rows, c, r)
        _set_block(m, contacts, c, z, r_scale)
    elif work.active[c] == 1:
        work.block[c], work.active[c] = ti.Vector.zero(m.real, BLOCK), 0
    if not (opens and u[0] >= 0.0):
        d = r - prox(r - step, rows.friction[c])
    work.world_impulse[c] = world_impulse
    # only a node that can move can open a gap
    missed = ti.select(rows.factor[c][0] > 0.0, -u[0] * beta * work.gap_weight[c], 0.0)
    within_rounding = rows.factor[c][0] * work.rounding[c]  # an impulse that only this would change, as between bodies at rest
    work.prox_residual[c] = dvec(d.dot(d), r.dot(r) + within_rounding * within_rounding, missed)


@ti.func
def _set_block(m: ti.template(), contacts: ti.template(), c, z, r_scale):
    """Set the matrix block D of contact c in world axes."""
    rows, work = ti.static((contacts.problem, contacts.work))
    Rn, Rt, rho = r_scale * rows.factor[c][0], r_scale * rows.factor[c][1], work.radius[c]
    size = ti.sqrt(z[1] * z[1] + z[2] * z[2])
    Dn = ti.select(z[0] > 0.0, Rn, 0.0)
    D_along, D_across = Rt, Rt  # along z_t, and perpendicular to it
    if size > rho or rho == 0.0:  # slips; without a disk there is no resistance, even at rest
        D_along, D_across = 0.0 * Rt, 0.0 * Rt
        if size > 0.0:
            D_across = Rt * rho / size
    n, t1 = rows.normal[c], rows.tangent[c]
    e = t1
    if size > 0.0:
        e = (z[1] * t1 + z[2] * n.cross(t1)) / size
    g = n.cross(e)
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            work.block[c][4 * j + i] = ti.cast(Dn * n[i] * n[j] + D_along * e[i] * e[j] + D_across * g[i] * g[j], m.real)
    work.active[c] = int(Dn > 0.0 or D_along > 0.0 or D_across > 0.0)


@ti.func
def impulse_on_node(contacts: ti.template(), i):
    """Return (J^T r) of node i [N s]; as `impulse_on`, but from impulses in world axes."""
    rows, work = ti.static((contacts.problem, contacts.work))
    d = dvec(0.0)
    for at in range(rows.by_node.start[i], rows.by_node.start[i + 1]):
        d += rows.weight[rows.entry[at]] * work.world_impulse[rows.contact[rows.entry[at]]]
    return d


@ti.func
def sum_residual(m: ti.template(), contacts: ti.template(), t):
    """Compute the residual of the laws over all contacts, by all threads t of the team. scalars: LAW and the next two.

    It is relative to all impulses, so that a light contact beside heavy ones could let its gap close. The largest part of its
    target, or of the contact offset if that is less, by which a gap ends short is therefore a residual, too: MAX_MISSED
    corresponds to the tolerance. Impulses that only the rounding of positions causes, as between bodies at rest, are within it.
    """
    rows, work = ti.static((contacts.problem, contacts.work))
    sums, worst = ti.Vector([0.0, 0.0], ti.f64), ti.cast(0.0, ti.f64)
    for j in range(rows.team.share(t, rows.count[0])):
        one = work.prox_residual[rows.team.term(t, j)]
        sums += ti.Vector([one[0], one[1]], ti.f64)
        worst = ti.max(worst, one[2])
    for j in ti.static(range(2)):
        sums[j] = rows.team.total(t, sums[j])
    worst = rows.team.largest(t, worst)
    if t == 0:
        m.state.scalars[LAW] = ti.max(residual_of(sums), worst)
        m.state.scalars[IMPULSE_SQUARE], m.state.scalars[WORST_GAP] = sums[1], worst


@ti.func
def find_residual(m: ti.template(), contacts: ti.template()):
    """`sum_residual` as a top-level loop of a kernel."""
    ti.loop_config(serialize=contacts.problem.team.alone, block_dim=contacts.problem.team.threads)
    for t in range(contacts.problem.team.threads):
        sum_residual(m, contacts, t)


@kernel
def update_impulses(m: ti.template(), contacts: ti.template(), new_multipliers: ti.i32, beta: ti.f64, r_scale: ti.f64):
    """Compute impulses and matrix blocks of all contacts at the present x, and the residual of their laws.

    new_multipliers: KEEP; TO_IMPULSES: set multipliers to the impulses first, and the friction disks accordingly; OF_IMPULSES:
    set them so that these impulses result. r_scale: R over the r-factors.
    """
    (rows,) = ti.static((contacts.problem,))
    ti.loop_config(serialize=rows.serial)
    for n in range(rows.count[0]):
        if new_multipliers != KEEP:
            set_multiplier(contacts, n)
        if new_multipliers == OF_IMPULSES:
            z = contacts.work.multiplier[n] + scaled(r_scale * rows.factor[n], stage_velocity_of(contacts, n, beta))
            if rows.r[n][0] == 0.0:  # it is open: it must not push where the step is shortened
                z = dvec(ti.min(z[0], 0.0), 0.0, 0.0)
            contacts.work.multiplier[n] = z
        update_contact(m, contacts, n, beta, r_scale)
    find_residual(m, contacts)


@kernel
def save_diagonal(m: ti.template(), A: ti.template(), contacts: ti.template()):
    """Save the new matrix's diagonal without contacts, and diag(A)^-1, the inverse masses for the r-factors."""
    (rows,) = ti.static((contacts.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        contacts.coupling.base[i] = A.diagonal[i]
        for a in ti.static(range(3)):
            # an entry can be negative if tets are strongly compressed
            d = ti.max(ti.abs(ti.cast(A.diagonal[i][5 * a], ti.f64)), ti.cast(m.mass[i], ti.f64))
            rows.inverse_mass[i][a] = ti.cast(m.free[i][a], ti.f64) / d


def build_stage_contacts(
    arena: FieldArena, model: Model, problem: ContactProblem, x_start: Any, shared: bool = False
) -> StageContacts:
    """Allocate storage for the contacts of `problem`. x_start: (n_nodes) 3-vectors f64, filled by the caller.

    shared: as for `build_coupling`.
    """
    p, n, real = problem, model.n_nodes, model.real
    work = ContactStageWork(
        arena.vectors("multiplier", ti.f64, p.capacity),
        arena.field("friction_radius", ti.f64, p.capacity),
        arena.vectors("past_impulse", ti.f64, PAST * p.capacity),
        arena.vectors("past_change", ti.f64, PAST * p.capacity),
        arena.vectors("contact_tangential_offset", ti.f64, p.capacity),
        arena.field("contact_gap_minus_target", ti.f64, p.capacity),
        arena.vectors("contact_velocity", ti.f64, p.capacity),
        arena.vectors("contact_rate", ti.f64, p.capacity),
        arena.vectors("contact_kept", ti.f64, p.capacity),
        arena.vectors("contact_world_impulse", ti.f64, p.capacity),
        arena.vectors("contact_prox_residual", ti.f64, p.capacity),
        arena.field("contact_gap_weight", ti.f64, p.capacity),
        arena.field("contact_rounding", ti.f64, p.capacity),
        arena.vectors("contact_block", real, p.capacity, n=BLOCK),
        arena.field("contact_active", ti.i32, p.capacity),
    )
    coupling = build_coupling(
        arena,
        real,
        n,
        shared,
        count=p.count,
        first=p.first,
        arity=p.arity,
        node=p.node,
        weight=p.weight,
        contact=p.contact,
        entry_start=p.by_node.start,
        entry=p.entry,
        block=work.block,
        active=work.active,
        base=arena.vectors("base_diagonal", real, n, n=BLOCK),
    )
    return StageContacts(
        p,
        work,
        coupling,
        x_start,
        arena.vectors("contact_displacement", ti.f64, n),
        arena.vectors("x_linear", ti.f64, n),
        arena.vectors("residual_linear", real, n),
    )
