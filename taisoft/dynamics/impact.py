"""The impact before an implicit step in which surfaces meet with restitution: a jump of the velocity at x_n.

    (M + tau^2 K)(v+ - v_n) = J^T p,   u = J v+ - min_velocity,   tau = SPREAD dt,
with Signorini's and Coulomb's laws between p and u; `min_velocity` is the speed with which a contact must part
(`contact.restitution`). With M alone the nodes at the contact would turn round and the body behind them go on: it would
vibrate, and implicit Euler takes the energy of vibrations whose period is not many steps. tau^2 K keeps these out: a motion
of frequency w takes 1 / (1 + (w tau)^2) of its part of the impulse. With w tau = 1, implicit Euler loses 1 - 1/e of the
energy in a period, which is what SPREAD = 2 pi says. A body that waves cross within the step is thrown back as a whole; a
soft one, or short steps, at its contacts alone, and its elasticity does the rest.

No energy may come of it. The kinetic energy changes by
    E(s) = s (D.M v_n + p.u_fixed) + s^2 D.M D / 2 <= s sum p_n max(0, min_velocity - |u_n|) / 2,   D = v+ - v_n,
u_fixed what obstacles and prescribed nodes add to u_n, whose work is theirs; the right side is what implicit Euler lost
before and may get back. Newton's law breaks this where friction turns the slip round (Kane's paradox), or where bodies
vibrate: then the jump is scaled down by s < 1. What is left of it, the slack, is what tau^2 K took. In the step after it
contacts are held to their way, so that the body behind them, which lags, is pushed on; that work must not exceed the slack,
else the step is done again without.

Weak: within tau the impulse reaches further than sound does. Bodies in between, which waves cross in some steps, are thrown
back lower than e says. Held nodes are walls: what hangs on them takes the blow.
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from taisoft.contact.problem import to_world
from taisoft.contact.prox import dvec
from taisoft.fem.terms import mass_damping
from taisoft.linear.block_csr import block_times
from taisoft.linear.pcg import total
from taisoft.mass import mass_times
from taisoft.runtime import kernel
from taisoft.scalars import OTHER_SUM, SUM

if TYPE_CHECKING:
    from taisoft.dynamics.stage_result import StageResult
    from taisoft.dynamics.stage_system import Stage, StageSystem

SPREAD = 2.0 * math.pi  # tau / dt
SOLVES = 400  # linear solves of an impact
TOLERANCE = 1e-3  # of the contact laws' residual in an impact: what it leaves undone the step after it does


@ti.func
def impact_residual(m: ti.template(), A: ti.template(), k: ti.template(), i, tau):
    """(A D)_i of the jump D = (x - x_linear) / tau, without impulses.

    By differences between neighbours, in f64: stiffness does not resist what all nodes share, which is most of the jump, and its
    rounding, tau^2 times as large, would hide the motion of the whole body.
    """
    inertia = ti.cast(1.0, m.real)
    if ti.static(m.damped):
        inertia += ti.cast(tau, m.real) * mass_damping.rate(m, i)
    own, mass = (m.state.x[i] - k.x_linear[i]) / tau, m.mass[i]
    if ti.static(m.consistent):
        mass = m.mass_matrix.diagonal[i]
    r = ti.Vector([0.0, 0.0, 0.0], m.real)
    for at in range(A.row_start[i], A.row_start[i + 1]):
        j = A.column[at]
        r += block_times(A.value[at], ti.cast((m.state.x[j] - k.x_linear[j]) / tau - own, m.real))
        if ti.static(m.consistent):
            mass += m.mass_matrix.value[at]
    return r + inertia * mass * ti.cast(own, m.real)


@kernel
def begin_impact(m: ti.template(), s: ti.template(), k: ti.template(), tau: ti.f64, norms: ti.types.ndarray()):
    """The impact's stage at v_n, without impulses; `impact_impulse` keeps those of the last step. The matrix has been formed.

    norms: as `form_residual` tells; the scale is the momentum of all nodes at the highest speed that a contact must gain.
    """
    p, f = ti.static((k.problem, k.found))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = k.x_start[i] + tau * ti.cast(s.v_hat[i], ti.f64)
        s.x_hat[i] = k.x_start[i]
        k.x_linear[i] = m.state.x[i]
    ti.loop_config(serialize=True)
    for _ in range(1):
        speed, mass = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for c in range(p.count[0]):
            f.impact_impulse[c] = p.r[c]
            p.r[c] = dvec(0.0)
            speed = ti.max(speed, f.min_velocity[c] - f.approach[c])
        for i in range(m.n_nodes):
            mass += ti.cast(m.mass[i], ti.f64) ** 2
        for j in ti.static(range(5)):
            norms[j] = 0.0
        norms[1] = mass * speed * speed


@kernel
def measure_impact(m: ti.template(), s: ti.template(), k: ti.template(), tau: ti.f64, out: ti.types.ndarray()):
    """The jump into s.change, and of E(s): out = (its slope at s = 0 less what may be given back, its second derivative)."""
    p, f = ti.static((k.problem, k.found))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        s.change[i] = (m.state.x[i] - k.x_linear[i]) / tau
    ti.loop_config(serialize=m.serial)
    for chunk in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        slope, curvature = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for i in range(chunk * size, ti.min(m.n_nodes, (chunk + 1) * size)):
            d = mass_times(m, i, s.change)
            slope += d.dot(ti.cast(s.v_hat[i], ti.f64))
            curvature += d.dot(s.change[i])
        m.state.partial[chunk, SUM], m.state.partial[chunk, OTHER_SUM] = slope, curvature
    ti.loop_config(serialize=True)
    for _ in range(1):
        slope = total(m, SUM)
        for c in range(p.count[0]):
            fixed = -(SPREAD / tau) * f.obstacle_displacement[c]
            for j in range(p.arity[c]):
                i = p.node[c, j]
                fixed += p.weight[c, j] * (1.0 - ti.cast(m.free[i], ti.f64)) * ti.cast(s.v_hat[i], ti.f64)
            slope += to_world(p, c, p.r[c]).dot(fixed)
            if f.min_opening[c] > 0.0:
                slope -= 0.5 * p.r[c][0] * ti.max(0.0, f.min_velocity[c] + f.approach[c])
        out[0], out[1] = slope, total(m, OTHER_SUM)


@kernel
def apply_impact(m: ti.template(), s: ti.template(), k: ti.template(), share: ti.f64):
    """Start the step with that share of the jump; impulses become those of the last step, `impact_impulse` the impact's."""
    p, f = ti.static((k.problem, k.found))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = k.x_start[i]
        s.v_hat[i] += ti.cast(share * s.change[i], m.real)
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        struck = share * p.r[c]
        p.r[c] = f.impact_impulse[c]
        f.impact_impulse[c] = struck


@kernel
def start_from(m: ti.template(), s: ti.template(), still: ti.f64):
    """The first iterate of a step that begins with an impact: v_hat, or 0 where it is linearised at x_n (still = 1)."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = s.x_hat[i]
        m.state.v[i] = ti.cast(1.0 - still, m.real) * m.free[i] * s.v_hat[i]


@kernel
def holding_work(k: ti.template(), beta: ti.f64) -> ti.f64:
    """Work of the contacts that are held to their way at the end of the step [J]."""
    p, f, w = ti.static((k.problem, k.found, k.work))
    work = ti.cast(0.0, ti.f64)
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(p.count[0]):
            if f.min_opening[c] > 0.0:
                way = w.tangential_offset[c]
                for j in range(p.arity[c]):
                    way += p.weight[c, j] * k.displacement[p.node[c, j]]
                work += p.r[c][0] * p.normal[c].dot(way) / beta
    return work


@kernel
def let_go(f: ti.template()):
    """No contact is held to its way."""
    (p,) = ti.static((f.problem,))
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        f.min_opening[c] = 0.0


def solve_bouncing(system: "StageSystem", stage: "Stage") -> "StageResult":
    """A step of implicit Euler in which surfaces meet with restitution: the impact, then the stage."""
    from taisoft.dynamics.contact_newton import solve
    from taisoft.dynamics.newton import Newton
    from taisoft.dynamics.stage_result import count_all, merge

    m, w, tau, out = system.model, system.work, SPREAD * stage.dt, np.zeros(2)
    blow = replace(stage, beta=tau, contact_tolerance=max(stage.contact_tolerance, TOLERANCE), max_newton=SOLVES)
    k = system.begin_impact(blow)
    begin_impact(m, w, k, tau, system.norms)
    impact = Newton(system, blow).run(*system.evaluate(new_multipliers=True), fresh=True)
    measure_impact(m, w, k, tau, out)
    slope, curvature = out
    gain = slope + 0.5 * curvature
    share = 1.0 if gain <= 0.0 else max(0.0, -2.0 * slope / curvature)
    slack = max(0.0, -share * (slope + 0.5 * share * curvature))  # 0, but for rounding, where the jump is scaled down
    apply_impact(m, w, k, share)
    if share < 1.0:
        let_go(k.found)
    results = [impact]
    while True:
        start_from(m, w, float(stage.linearised))
        results.append(solve(system, replace(stage, beta=stage.dt, prescribed_share=1.0)))
        if holding_work(k, stage.dt) <= slack:
            return count_all(merge([impact, results[-1]]), results[1:-1])
        let_go(k.found)
