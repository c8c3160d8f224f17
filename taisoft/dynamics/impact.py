"""Impact with restitution before an implicit step: a velocity jump at x_n.

    (M + tau^2 K)(v+ - v_n) = J^T p,   u = J v+ - min_velocity,   tau = SPREAD dt,
with Signorini's and Coulomb's laws between p and u; `min_velocity` is the required separation speed of a contact
(`contact.restitution`). With M alone the nodes at the contact would reverse while the body behind them moves on. It would
vibrate, and implicit Euler dissipates vibrations whose period is not many steps. tau^2 K suppresses these: a mode of angular
frequency w gets 1 / (1 + (w tau)^2) of its part of the impulse. With w tau = 1, implicit Euler loses 1 - 1/e of the energy in
a period, which gives SPREAD = 2 pi. A body that waves cross within the step rebounds as a whole. A soft one, or one in short
steps, rebounds at its contacts alone, and elasticity does the rest.

The impact must not create energy. With D = v+ - v_n, scaled by s, the kinetic energy changes by
    E(s) = s (D.M v_n + p.u_fixed) + s^2 D.M D / 2,   required: E(s) <= s sum p_n max(0, min_velocity - |u_n|) / 2,
where u_fixed is the part of u_n from obstacles and prescribed nodes, whose work is external, and the right side is energy that
implicit Euler lost before and may be given back. Newton's law violates this if friction reverses the slip (Kane's paradox), or
if bodies vibrate: then the jump is scaled by s < 1. The slack of the inequality is the energy taken by tau^2 K. In the step
after the impact, contacts are constrained to their rebound displacement, which pushes on the lagging body behind them. That
work must not exceed the slack, else the contacts are released from this constraint, and the iterations go on.

Weakness: within tau the impulse reaches further than sound does. Bodies that waves cross in a few steps rebound lower than e
requires. Fixed nodes act as walls: bodies attached to them absorb the impact.
"""

import math
from dataclasses import replace

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.problem import to_world
from taisoft.contact.prox import dvec
from taisoft.dynamics.newton import Newton, solve
from taisoft.dynamics.results import StageResult, merge
from taisoft.dynamics.stage import Stage, impact_jump
from taisoft.dynamics.stage_system import StageSystem
from taisoft.fem.chunks import chunk_entry, chunk_size, fold, total_by_team
from taisoft.fem.lanes import mass_times
from taisoft.fem.state import IMPACT_CURVATURE, IMPACT_SLOPE, N_NORMS, NORMS, OTHER_SUM, SUM

SPREAD = 2.0 * math.pi  # tau / dt
TOLERANCE = 1e-3  # of the contact laws' residual in an impact; the step after it corrects the rest


@kernel
def begin_impact(m: ti.template(), stage: ti.template(), contacts: ti.template(), tau: ti.f64):
    """Begin the impact's stage at v_n without impulses, after the matrix was formed; save the last step's in `impact_impulse`.

    scalars: NORMS, as in `form_residual`; the scale is the momentum of all nodes at the largest speed change of a contact.
    """
    (rows,) = ti.static((contacts.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = contacts.x_start[i] + tau * stage.v_hat[i]
        stage.x_hat[i] = contacts.x_start[i]
    ti.loop_config(serialize=rows.team.alone, block_dim=rows.team.threads)
    for t in range(rows.team.threads):
        speed, mass = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for j in range(rows.team.share(t, rows.count[0])):
            c = rows.team.term(t, j)
            rows.impact_impulse[c] = rows.r[c]
            rows.r[c] = dvec(0.0)
            speed = ti.max(speed, rows.min_velocity[c] - rows.approach[c])
        for j in range(rows.team.share(t, m.n_nodes)):
            mass += ti.cast(m.mass[rows.team.term(t, j)], ti.f64) ** 2
        speed, mass = rows.team.largest(t, speed), rows.team.total(t, mass)
        if t == 0:
            for j in ti.static(range(N_NORMS)):
                m.state.scalars[NORMS + j] = 0.0
            m.state.scalars[NORMS + 1] = mass * speed * speed


@kernel
def measure_impact(m: ti.template(), stage: ti.template(), contacts: ti.template(), tau: ti.f64):
    """Store the jump in stage.change. scalars: IMPACT_SLOPE, IMPACT_CURVATURE, of E(s) minus its bound."""
    (rows,) = ti.static((contacts.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        stage.change[i] = impact_jump(m, stage, contacts, i, tau)
    ti.loop_config(serialize=m.serial)
    for task in range(m.chunks * m.spread):
        if task % m.spread == 0:
            chunk = task // m.spread
            slope, curvature = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            for j in range(chunk_size(m, chunk, m.n_nodes)):
                i = chunk_entry(m, chunk, j, m.n_nodes)
                d = mass_times(m, i, stage.change)
                slope += d.dot(stage.v_hat[i])
                curvature += d.dot(stage.change[i])
            m.state.partial[chunk, SUM], m.state.partial[chunk, OTHER_SUM] = slope, curvature
    fold(m, SUM, OTHER_SUM, ())
    ti.loop_config(serialize=rows.team.alone, block_dim=rows.team.threads)
    for t in range(rows.team.threads):
        slope, curvature = total_by_team(m, t, SUM), total_by_team(m, t, OTHER_SUM)
        slope = ti.select(t == 0, slope, 0.0)
        for j in range(rows.team.share(t, rows.count[0])):
            c = rows.team.term(t, j)
            u_fixed = -(SPREAD / tau) * rows.obstacle_displacement[c]
            for e in range(rows.first[c], rows.first[c] + rows.arity[c]):
                i = rows.node[e]
                u_fixed += rows.weight[e] * (1.0 - ti.cast(m.free[i], ti.f64)) * stage.v_hat[i]
            slope += to_world(rows, c, rows.r[c]).dot(u_fixed)
            if rows.min_opening[c] > 0.0:
                slope -= 0.5 * rows.r[c][0] * ti.max(0.0, rows.min_velocity[c] + rows.approach[c])
        slope = rows.team.total(t, slope)
        if t == 0:
            m.state.scalars[IMPACT_SLOPE], m.state.scalars[IMPACT_CURVATURE] = slope, curvature


@kernel
def apply_impact(m: ti.template(), stage: ti.template(), contacts: ti.template(), fraction: ti.f64):
    """Apply that fraction of the jump to v_hat; restore the last step's impulses, and set `impact_impulse` to the impact's."""
    (rows,) = ti.static((contacts.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = contacts.x_start[i]
        stage.v_hat[i] += fraction * stage.change[i]
    ti.loop_config(serialize=rows.serial)
    for c in range(rows.count[0]):
        struck = fraction * rows.r[c]
        rows.r[c] = rows.impact_impulse[c]
        rows.impact_impulse[c] = struck


@kernel
def start_from(m: ti.template(), stage: ti.template(), still: ti.f64):
    """Set the first iterate after an impact: v_hat, or 0 if the step is linearised at x_n (still = 1)."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = stage.x_hat[i]
        m.state.v[i] = (1.0 - still) * m.free[i] * stage.v_hat[i]


@kernel
def rebound_work(contacts: ti.template(), beta: ti.f64) -> ti.f64:
    """Return the work of contacts constrained to their rebound displacement, at the end of the step [J]."""
    rows, work = ti.static((contacts.problem, contacts.work))
    total_work = ti.cast(0.0, ti.f64)
    ti.loop_config(serialize=rows.team.alone, block_dim=rows.team.threads)
    for t in range(rows.team.threads):
        own = ti.cast(0.0, ti.f64)
        for j in range(rows.team.share(t, rows.count[0])):
            c = rows.team.term(t, j)
            if rows.min_opening[c] > 0.0:
                displacement = work.tangential_offset[c]
                for e in range(rows.first[c], rows.first[c] + rows.arity[c]):
                    displacement += rows.weight[e] * contacts.displacement[rows.node[e]]
                own += rows.r[c][0] * rows.normal[c].dot(displacement) / beta
        own = rows.team.total(t, own)
        if t == 0:
            total_work += own
    return total_work


@kernel
def release_contacts(rows: ti.template()):
    """Release all contacts from their rebound displacement."""
    ti.loop_config(serialize=rows.serial)
    for c in range(rows.count[0]):
        rows.min_opening[c] = 0.0


def warm_up(system: StageSystem) -> None:
    """Launch the kernels of an impact on the present stage, whose state is then invalid."""
    m, w, k, tau = system.model, system.work, system.contacts, SPREAD * system.stage.dt
    begin_impact(m, w, k, tau)
    measure_impact(m, w, k, tau)
    apply_impact(m, w, k, 1.0)
    release_contacts(k.problem)
    start_from(m, w, 0.0)
    rebound_work(k, tau)


def solve_bouncing(system: StageSystem, stage: Stage) -> StageResult:
    """Solve a step of implicit Euler with restitution: the impact, then the stage, whose rebounds do no more work than it has."""
    m, w, tau = system.model, system.work, SPREAD * stage.dt
    impact_stage = replace(stage, beta=tau, contact_tolerance=max(stage.contact_tolerance, TOLERANCE))
    k = system.begin_impact(impact_stage)
    begin_impact(m, w, k, tau)
    impact = Newton(system, impact_stage).run(fresh=True)
    measure_impact(m, w, k, tau)
    slope, curvature = m.state.scalars.to_numpy()[[IMPACT_SLOPE, IMPACT_CURVATURE]]
    gain = slope + 0.5 * curvature
    fraction = 1.0 if gain <= 0.0 else max(0.0, -2.0 * slope / curvature)
    slack = max(0.0, -fraction * (slope + 0.5 * fraction * curvature))  # 0 except for rounding if the jump is scaled down
    apply_impact(m, w, k, fraction)
    if fraction < 1.0:
        release_contacts(k.problem)
    start_from(m, w, float(stage.linearised))

    def rebounds_hold() -> bool:
        if rebound_work(k, stage.dt) <= slack:
            return True
        release_contacts(k.problem)
        if stage.linearised:
            start_from(m, w, 1.0)
            system.move_to_velocities()
        else:
            system.begin_contacts()
        return False

    result = solve(system, replace(stage, beta=stage.dt, prescribed_fraction=1.0), rebounds_hold)
    return merge([impact, result])
