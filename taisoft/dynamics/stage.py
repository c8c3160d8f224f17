"""Fields and kernels of one implicit stage; see `stage_system` for the formulas.

After a Newton step `move` updates the state and computes elastic forces, `contact_terms.update_impulses` computes contact
impulses, and `form_residual` adds everything. A linearised stage moves by `linearised.advance` instead, which updates the
residual without contacts.
"""

import math
from dataclasses import dataclass
from typing import Any, Protocol

import taichi as ti

from taisoft.backend.arrays import Count
from taisoft.backend.runtime import kernel
from taisoft.contact.problem import ContactProblem
from taisoft.dynamics.contact_terms import impulse_on_node
from taisoft.fem.chunks import chunk_entry, chunk_size, fold, total_by_team
from taisoft.fem.dependents import force_with_dependents, is_dependent
from taisoft.fem.lanes import mass_times
from taisoft.fem.state import END_SLOPE, N_NORMS, NORMS, OTHER_SUM, START_SLOPE, SUM
from taisoft.fem.terms import elasticity, rayleigh_damping
from taisoft.linear.block_csr import block_times, stiffness_times
from taisoft.linear.pcg_work import PcgWork, dot64

STAY, STEP, AGAIN = range(3)  # modes of `move`: stay, full step, another length of the same step
ELASTIC_STAGE, LINEARISED, IMPACT = range(3)  # kinds of stages; IMPACT: see `impact`


@dataclass(frozen=True)
class Stage:
    """Parameters of a stage. tolerance: of |r| over scale; contact_tolerance: of the residual of the contact laws."""

    c: float  # 1: a time step; 0: statics
    beta: float  # [s]
    dt: float  # [s] of the step
    tolerance: float
    contact_tolerance: float = math.inf
    max_newton: int = 50
    linear_tolerance: float | None = None  # of every linear solve; None: adaptive
    linearised: bool = False  # elastic forces are linear from the first iterate on
    prescribed_fraction: float = 1.0  # see `begin_stage`
    renews: bool = True  # whether contacts take their geometry at the iterates
    law_aim: float = 0.0  # residual to which the laws are solved where they can be


class StepContacts(Protocol):
    """Contacts of a step, as found by its search."""

    problem: ContactProblem

    @property
    def n_contacts(self) -> int:
        """Number of contacts."""

    @property
    def contact_offset(self) -> float:
        """Contact offset between different bodies [m]."""

    def renew(self, x_start: Any, displacement: Any) -> bool:
        """Take their geometry at displacements from x_start; return whether it changed. `problem` may then be another one."""


@dataclass(frozen=True, eq=False)
class StageWork:
    """Fields of a stage; (n_nodes) 3-vectors."""

    x_hat: Any  # f64
    v_hat: Any  # f64
    base: Any  # f64: x before the trial step
    residual: Any  # on all axes; on constrained ones, beta times the constraint force
    prescribed_nodes: Any  # (n_prescribed) i32
    prescribed_axes: Any  # (n_prescribed, 3) i32
    targets: Any  # (n_prescribed) f64 3-vectors
    prescribed_acceleration: Any  # (n_prescribed) f64 3-vectors, only with a consistent mass
    n_prescribed: Count
    change: Any  # f64: velocity change that the mass multiplies, see `set_change`
    moved: Any  # f64: displacement by `correct_rigid_motion`
    damper: Any  # BlockCsr or None
    pieces: Any  # PieceWork
    pcg: PcgWork  # right side -r; y, the change of v in a Newton step

    @property
    def has_prescribed(self) -> bool:
        """Whether nodes have prescribed motion."""
        return self.prescribed_nodes is not None


@ti.func
def stage_velocity(m: ti.template(), stage: ti.template(), i, beta):
    """Return (x - x_hat) / beta of node i."""
    return (m.state.x[i] - stage.x_hat[i]) / beta


@kernel
def begin_stage(m: ti.template(), stage: ti.template(), beta: ti.f64, prescribed_fraction: ti.f64):
    """Set x from the first iterate v; prescribed nodes move to their targets, which gives their v.

    v_hat of a prescribed node is set so that (v - v_hat) / beta is its acceleration. With a lumped mass, which affects only the
    reactions, that is the velocity change of a step, of which prescribed_fraction happens in the stage. A consistent mass
    couples to the neighbours, so there the acceleration comes from the path.
    """
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = stage.x_hat[i] + beta * m.state.v[i]
    if ti.static(stage.has_prescribed):
        ti.loop_config(serialize=m.on_cpu)
        for k in range(stage.n_prescribed):
            i = stage.prescribed_nodes[k]
            for a in ti.static(range(3)):
                if stage.prescribed_axes[k][a] != 0:
                    v = (stage.targets[k][a] - stage.x_hat[i][a]) / beta
                    if ti.static(m.consistent):
                        stage.v_hat[i][a] = v - beta * stage.prescribed_acceleration[k][a]
                    else:
                        stage.v_hat[i][a] = v - prescribed_fraction * (v - stage.v_hat[i][a])
                    m.state.v[i][a] = v
                    m.state.x[i][a] = stage.targets[k][a]


@ti.func
def set_change(m: ti.template(), stage: ti.template(), i, c, beta):
    """Set c (v - v_hat), plus beta a v with mass damping, for node i."""
    change = c * (stage_velocity(m, stage, i, beta) - stage.v_hat[i])
    if ti.static(m.damped):
        change += beta * ti.cast(rayleigh_damping.mass_rate(m, i), ti.f64) * m.state.v[i]
    stage.change[i] = change


@ti.func
def loads_on(m: ti.template(), i):
    """Applied loads on node i [N]."""
    f = ti.Vector([0.0, 0.0, 0.0], m.real)
    for term in ti.static(m.terms):
        if ti.static(term.LOAD):
            f += force_with_dependents(m, term, i)
    return f


@ti.func
def internal_on(m: ti.template(), i):
    """All other forces on node i but those of damping [N]."""
    f = ti.Vector([0.0, 0.0, 0.0], m.real)
    for term in ti.static(m.terms):
        if ti.static(not term.LOAD):
            f += force_with_dependents(m, term, i)
    return f


@ti.func
def damping_force(m: ti.template(), stage: ti.template(), chunk, i, v: ti.template()):
    """Force of stiffness damping on node i at velocities v [N], within a chunk of a loop."""
    return rayleigh_damping.stiffness_force(m, i, stiffness_times(m, stage.damper, chunk, i, v))


@ti.func
def residual_parts(m: ti.template(), stage: ti.template(), chunk, i, beta):
    """Return (r, inertia and mass damping, internal forces, loads) of node i without contacts; uses `change`."""
    internal, loads, damping = internal_on(m, i), loads_on(m, i), ti.Vector([0.0, 0.0, 0.0], m.real)
    if ti.static(m.stiffness_damping):
        damping += damping_force(m, stage, chunk, i, m.state.v)
    inertia = ti.cast(mass_times(m, i, stage.change), m.real)
    return inertia - ti.cast(beta, m.real) * (internal + loads + damping), inertia, internal, loads


@ti.func
def impact_jump(m: ti.template(), stage: ti.template(), contacts: ti.template(), i, tau):
    """Velocity jump of node i at its present x in an impact, see `impact_residual`."""
    return (m.state.x[i] - contacts.x_start[i]) / tau - stage.v_hat[i]


@ti.func
def impact_residual(m: ti.template(), stage: ti.template(), A: ti.template(), contacts: ti.template(), i, tau):
    """Return (A D)_i of the jump D = v - v_hat, v = (x - x_start) / tau, without impulses.

    Uses differences between neighbours in f64: stiffness does not resist the common part of the jump, which is most of it, and
    its rounding, tau^2 times as large, would hide the rigid motion.
    """
    inertia = ti.cast(1.0, m.real)
    if ti.static(m.damped):
        inertia += ti.cast(tau, m.real) * rayleigh_damping.mass_rate(m, i)
    velocity_jump, mass = impact_jump(m, stage, contacts, i, tau), m.mass[i]
    if ti.static(m.consistent):
        mass = m.mass_matrix.diagonal[i]
    r = ti.Vector([0.0, 0.0, 0.0], m.real)
    for half in range(2):
        row = i + half * m.n_nodes
        for at in range(A.row_start[row], A.row_start[row + 1]):
            j = A.column[at]
            r += block_times(A.value[at], ti.cast(impact_jump(m, stage, contacts, j, tau) - velocity_jump, m.real))
            if ti.static(m.consistent):
                mass += m.mass_matrix.value[at]
    return r + inertia * mass * ti.cast(velocity_jump, m.real)


@ti.func
def squares(r, inertia, f, external, free):
    """Return the contributions of node i to the norms of `form_residual`."""
    return ti.Vector([norm2(free * r), norm2(free * inertia), norm2(free * f), norm2(free * external), norm2((1.0 - free) * r)])


@ti.func
def norm_weight(stage: ti.template(), i):
    """Weight of node i in squares of norms: that of its piece."""
    weight = ti.cast(1.0, ti.f64)
    if ti.static(stage.pieces.several):
        weight = stage.pieces.weight[stage.pieces.piece[i]]
    return weight


@ti.func
def merit_weight(stage: ti.template(), i):
    """Weight of node i in slopes: components without contacts are independent of each other, each in the norm of its solve."""
    weight = ti.cast(1.0, ti.f64)
    if ti.static(stage.pieces.several):
        weight = stage.pieces.factor[stage.pieces.component[i]] ** 2
    return weight


@ti.func
def norm2(a):
    b = ti.cast(a, ti.f64)
    return b.dot(b)


@ti.func
def place_node(m: ti.template(), stage: ti.template(), i, step_length, beta):
    """Move node i to base + step_length beta y, and set v accordingly; y is 0 on constrained axes."""
    m.state.x[i] = stage.base[i]
    if step_length != 0.0:  # so that 0 restores the base even if y is not a number
        m.state.x[i] += step_length * beta * ti.cast(stage.pcg.y[i], ti.f64)
    m.state.v[i] = stage_velocity(m, stage, i, beta)


@kernel
def set_direction_to_rest(m: ti.template(), stage: ti.template()):
    """Set y so that a full step leads to v = 0 on the free axes."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        stage.pcg.y[i] = ti.cast(-m.free[i] * m.state.v[i], m.real)


@kernel
def move(
    m: ti.template(),
    stage: ti.template(),
    contacts: ti.template(),
    kind: ti.template(),
    mode: ti.i32,
    step_length: ti.f64,
    c: ti.f64,
    beta: ti.f64,
):
    """Move the nodes and compute the elastic forces there.

    mode: STAY; STEP: base = x, then step_length y, y of stage.pcg; AGAIN: base + step_length y. scalars: START_SLOPE of a STEP.
    """
    ti.loop_config(serialize=m.serial)
    for task in range(m.chunks * m.spread):
        if task % m.spread == 0:
            chunk = task // m.spread
            slope = ti.cast(0.0, ti.f64)
            for at in range(chunk_size(m, chunk, m.n_nodes)):
                i = chunk_entry(m, chunk, at, m.n_nodes)
                if mode == STEP:
                    slope += merit_weight(stage, i) * dot64(m.free[i] * stage.residual[i], stage.pcg.y[i])
                    stage.base[i] = m.state.x[i]
                if mode != STAY:
                    place_node(m, stage, i, step_length, beta)
                if ti.static(contacts.any):
                    contacts.displacement[i] = m.state.x[i] - contacts.x_start[i]
                if ti.static(kind == ELASTIC_STAGE):
                    set_change(m, stage, i, c, beta)
            m.state.partial[chunk, OTHER_SUM] = slope
    fold(m, OTHER_SUM, OTHER_SUM, ())
    if ti.static(kind == ELASTIC_STAGE):
        elasticity.sum_elements(m)
    ti.loop_config(serialize=m.team.alone, block_dim=m.team.threads)
    for t in range(m.team.threads):
        if mode == STEP:
            m.state.scalars[START_SLOPE] = total_by_team(m, t, OTHER_SUM)


@kernel
def form_residual(
    m: ti.template(), stage: ti.template(), A: ti.template(), contacts: ti.template(), kind: ti.template(), beta: ti.f64
):
    """Form the residual, and -r as CG's right side, after `move` and `update_impulses`.

    scalars: END_SLOPE, and from NORMS on |r|^2, |inertia and mass damping|^2, |f_el|^2, |f_ext|^2 on the free axes, and |r|^2 on
    the others; only those of r in an impact.
    """
    ti.loop_config(serialize=m.serial)
    for task in range(m.chunks * m.spread):
        if task % m.spread == 0:
            chunk = task // m.spread
            sums, slope = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0], ti.f64), ti.cast(0.0, ti.f64)
            for at in range(chunk_size(m, chunk, m.n_nodes)):
                i = chunk_entry(m, chunk, at, m.n_nodes)
                free = m.free[i]
                zero = ti.Vector([0.0, 0.0, 0.0], m.real)
                r, inertia, f, external = zero, zero, zero, zero
                if ti.static(kind == IMPACT):
                    r = impact_residual(m, stage, A, contacts, i, beta)
                else:
                    r, inertia, f, external = residual_parts(m, stage, chunk, i, beta)
                if ti.static(contacts.any):
                    r -= ti.cast(impulse_on_node(contacts, i), m.real)
                if ti.static(m.has_dependents):  # whose forces act on other nodes
                    if is_dependent(m, i):
                        r = zero
                stage.residual[i] = r
                stage.pcg.rhs[i] = -free * r
                sums += norm_weight(stage, i) * squares(r, inertia, f, external, free)
                slope += merit_weight(stage, i) * dot64(free * r, stage.pcg.y[i])
            for j in ti.static(range(N_NORMS)):
                m.state.partial[chunk, j] = sums[j]
            m.state.partial[chunk, SUM] = slope
    fold(m, 0, SUM, ())
    ti.loop_config(serialize=m.team.alone, block_dim=m.team.threads)
    for t in range(m.team.threads):
        for j in ti.static(range(N_NORMS) if kind == ELASTIC_STAGE else (0, 4)):
            m.state.scalars[NORMS + j] = total_by_team(m, t, j)
        m.state.scalars[END_SLOPE] = total_by_team(m, t, SUM)
