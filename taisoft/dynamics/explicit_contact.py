"""One explicit sub-step with contacts: the velocity that it would reach without them, the impulses, and where it gets with them.

Symplectic Euler: v* = v_n + dt a(x_n), v = v* + M^-1 J^T r, x = x_n + dt v. Velocity Verlet: the impulses act on the velocity in
the middle of the step, which is what moves the nodes. M is lumped, so M^-1 is known (report, section 2.4, corrected).
"""

import taichi as ti

from taisoft.contact.assemble import gap_minus_target
from taisoft.contact.problem import impulse_on, to_frame
from taisoft.contact.prox import dvec
from taisoft.contact.restitution import explicit_opening
from taisoft.dynamics.explicit import (
    acceleration,
    euler_velocity,
    keep_held,
    nonfinite,
    prescribe_positions,
    prescribe_velocities,
    react,
    remember,
    verlet_half,
    verlet_kick,
    verlet_move,
)  # fmt: skip
from taisoft.fem.terms import elasticity
from taisoft.runtime import kernel
from taisoft.scalars import FAILED, INVERTED_NOW, MOST_INVERTED


@kernel
def keep_state(m: ti.template(), g: ti.template()):
    """The state before a sub-step, in case it fails."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        g.x[i], g.v[i] = m.state.x[i], m.state.v[i]


@kernel
def predict(m: ti.template(), s: ti.template(), dt64: ti.f64):
    """v* of every node. scalars: LOWEST_J, INVERTED_NOW.

    Verlet rests on the acceleration of the state, Euler finds the forces here.
    """
    if ti.static(not s.verlet):
        elasticity.sum_elements_with_damping(m)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if ti.static(s.holds):
            keep_held(m, s)
        if ti.static(s.has_prescribed):
            remember(m, s)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        dt = ti.cast(dt64, m.real)
        if ti.static(s.verlet):
            m.state.v[i] = verlet_half(m, s, i, dt)
        else:
            m.state.v[i] = euler_velocity(m, i, dt)
    if ti.static(s.has_prescribed):
        ti.loop_config(serialize=True)
        for _ in range(1):
            prescribe_velocities(m, s, 0, dt64)


@kernel
def set_free_velocities(
    m: ti.template(), s: ti.template(), f: ti.template(), dt: ti.f64, contact_offset: ti.f64, fast: ti.f64, slow: ti.f64,
    fastest: ti.f64,
):  # fmt: skip
    """b of every contact from v*, and the inverse masses."""
    kicked = ti.static(0.0 if s.verlet else 0.5)
    (p,) = ti.static((f.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        p.inverse_mass[i] = ti.cast(m.free[i], ti.f64) / ti.cast(m.mass[i], ti.f64)
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        v = -f.obstacle_displacement[c] / dt
        for j in range(p.arity[c]):
            v += p.weight[c, j] * ti.cast(m.state.v[p.node[c, j]], ti.f64)
        b = to_frame(p, c, v)
        rise = explicit_opening(f, c, dt, contact_offset, b[0], kicked)
        p.b[c] = dvec(b[0] + gap_minus_target(f, c, dt, contact_offset, fast, slow, fastest, rise) / dt, b[1], b[2])


@ti.func
def close_substep(m: ti.template(), s: ti.template(), p: ti.template(), dt64, touched):
    """Reactions, and the counters of the sub-step: MOST_INVERTED."""
    if ti.static(s.holds):
        react(m, s, ti.cast(dt64, m.real))
        subtract_contacts(m, s, p, dt64, touched)
    m.state.scalars[MOST_INVERTED] = ti.max(m.state.scalars[MOST_INVERTED], m.state.scalars[INVERTED_NOW])
    m.state.scalars[INVERTED_NOW] = 0.0


@ti.func
def subtract_contacts(m: ti.template(), s: ti.template(), p: ti.template(), dt64, touched):
    """A held node's reaction is what neither inertia, nor elasticity, nor loads, nor contacts bear."""
    if touched == 1:
        for k in range(s.n_held):
            i = s.held[k]
            s.reaction[k] -= (1.0 - m.free[i]) * ti.cast(impulse_on(p, i) / dt64, m.real)


@kernel
def move(m: ti.template(), s: ti.template(), p: ti.template(), dt64: ti.f64, touched: ti.i32):
    """Impulses onto v, then x. touched: 1 where there are contacts. scalars: FAILED.

    With Verlet `finish_verlet` follows.
    """
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        dt = ti.cast(dt64, m.real)
        v = m.state.v[i]
        if touched == 1:
            v += ti.cast(p.inverse_mass[i] * impulse_on(p, i), m.real)
        if nonfinite(ti.cast(v[0] + v[1] + v[2], ti.f64)):
            m.state.scalars[FAILED] = 1.0
        if ti.static(s.verlet):
            verlet_move(m, s, i, dt, v)
        else:
            m.state.v[i] = v
            m.state.x[i] = m.state.x[i] + ti.cast(dt * v, ti.f64)
    if ti.static(s.has_prescribed):
        ti.loop_config(serialize=True)
        for _ in range(1):
            prescribe_positions(m, s, 0)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if ti.static(not s.verlet):
            close_substep(m, s, p, dt64, touched)


@kernel
def finish_verlet(m: ti.template(), s: ti.template(), p: ti.template(), dt64: ti.f64, touched: ti.i32):
    """Forces at the new positions and the second half kick; scalars as in `predict` and `move`."""
    elasticity.sum_elements_with_damping(m)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        v = verlet_kick(m, s, i, ti.cast(dt64, m.real))
        if nonfinite(ti.cast(v[0] + v[1] + v[2], ti.f64)):
            m.state.scalars[FAILED] = 1.0
    if ti.static(s.has_prescribed):
        ti.loop_config(serialize=True)
        for _ in range(1):
            prescribe_velocities(m, s, 0, dt64)
    ti.loop_config(serialize=True)
    for _ in range(1):
        close_substep(m, s, p, dt64, touched)


@kernel
def find_acceleration(m: ti.template(), s: ti.template()):
    """Verlet's acceleration of the present state."""
    elasticity.sum_elements_with_damping(m)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        s.acceleration[i] = acceleration(m, i)
