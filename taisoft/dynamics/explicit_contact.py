"""Kernels of an explicit sub-step with contacts: predict the velocity without them, then apply the impulses.

Symplectic Euler: v* = v_n + dt a(x_n), v = v* + M^-1 J^T r, x = x_n + dt v. Velocity Verlet: the impulses act on the mid-step
velocity, which moves the nodes. M is lumped, so M^-1 is diagonal (report, section 2.4, corrected).
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.build import relative_velocity
from taisoft.contact.problem import impulse_on, to_frame
from taisoft.contact.prox import dvec
from taisoft.contact.restitution import explicit_opening
from taisoft.contact.targets import gap_minus_target
from taisoft.dynamics.explicit import (
    compute_reactions,
    euler_velocity,
    nonfinite,
    prescribe_positions,
    prescribe_velocities,
    save_held_velocities,
    save_prescribed_positions,
    verlet_decay,
    verlet_drift,
    verlet_half,
    verlet_kick,
)
from taisoft.dynamics.rigid_motion import project_all, turn_all
from taisoft.fem.dependents import place_all
from taisoft.fem.state import FAILED, INVERTED_NOW, MOST_INVERTED
from taisoft.fem.terms import elasticity


@kernel
def predict(m: ti.template(), s: ti.template(), dt: ti.f64):
    """Compute v* of every node. scalars: LOWEST_J, INVERTED_NOW.

    Verlet uses the stored acceleration; Euler computes the forces here.
    """
    if ti.static(not s.verlet):
        elasticity.sum_elements_with_damping(m)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if ti.static(s.has_held):
            save_held_velocities(m, s, s.n_held)
        if ti.static(s.has_prescribed):
            save_prescribed_positions(m, s)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        if ti.static(s.verlet):
            m.state.v[i] = verlet_half(m, s, i, dt, verlet_decay(m, s, i, dt))
        else:
            m.state.v[i] = euler_velocity(m, i, dt)
    project_all(m)
    if ti.static(s.has_prescribed):
        ti.loop_config(serialize=True)
        for _ in range(1):
            prescribe_velocities(m, s, 0, dt)


@kernel
def set_free_velocities(
    m: ti.template(),
    s: ti.template(),
    p: ti.template(),
    dt: ti.f64,
    contact_offset: ti.f64,
    penetration_correction: ti.f64,
    offset_correction: ti.f64,
    max_speed: ti.f64,
):
    """Compute b of every contact from v*, and the inverse masses."""
    kick_before_impact = ti.static(0.0 if s.verlet else 0.5)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        p.inverse_mass[i] = ti.cast(m.free[i], ti.f64) / ti.cast(m.mass[i], ti.f64)
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        b = to_frame(p, c, relative_velocity(p, m, c, dt))
        rise = explicit_opening(p, c, dt, contact_offset, b[0], kick_before_impact)
        gap = gap_minus_target(p, c, dt, contact_offset, penetration_correction, offset_correction, max_speed, rise, 0.0)
        p.b[c] = dvec(b[0] + gap / dt, b[1], b[2])


@ti.func
def close_substep(m: ti.template(), s: ti.template(), p: ti.template(), dt, has_contacts):
    """Compute the reactions and update the counter MOST_INVERTED."""
    if ti.static(s.has_held):
        compute_reactions(m, s, dt)
        subtract_contacts(m, s, p, dt, has_contacts)
    m.state.scalars[MOST_INVERTED] = ti.max(m.state.scalars[MOST_INVERTED], m.state.scalars[INVERTED_NOW])
    m.state.scalars[INVERTED_NOW] = 0.0


@ti.func
def subtract_contacts(m: ti.template(), s: ti.template(), p: ti.template(), dt, has_contacts):
    """Subtract contact forces from the reactions of held nodes."""
    if has_contacts == 1:
        for k in range(s.n_held):
            i = s.held[k]
            s.reaction[k] -= (1.0 - m.free[i]) * ti.cast(impulse_on(p, i) / dt, m.real)


@kernel
def move(m: ti.template(), s: ti.template(), p: ti.template(), dt: ti.f64, has_contacts: ti.i32):
    """Apply impulses to v, then move x. has_contacts: 1 if there are contacts. scalars: FAILED.

    With Verlet `finish_verlet` follows.
    """
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        v = m.state.v[i]
        if has_contacts == 1:
            v += p.inverse_mass[i] * impulse_on(p, i)
        if nonfinite(v[0] + v[1] + v[2]):
            m.state.scalars[FAILED] = 1.0
        if ti.static(s.verlet):
            verlet_drift(m, s, i, dt, v)
        else:
            m.state.v[i] = v
            m.state.x[i] = m.state.x[i] + dt * v
    turn_all(m, s, dt)
    if ti.static(s.has_prescribed):
        ti.loop_config(serialize=True)
        for _ in range(1):
            prescribe_positions(m, s, 0)
    place_all(m)
    ti.loop_config(serialize=True)
    for _ in range(1):
        if ti.static(not s.verlet):
            close_substep(m, s, p, dt, has_contacts)


@kernel
def finish_verlet(m: ti.template(), s: ti.template(), p: ti.template(), dt: ti.f64, has_contacts: ti.i32):
    """Apply the second half kick by the forces at the new positions, after `run_elements`; scalars as in `predict` and `move`."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        v = verlet_kick(m, s, i, dt, verlet_decay(m, s, i, dt))
        if nonfinite(v[0] + v[1] + v[2]):
            m.state.scalars[FAILED] = 1.0
    project_all(m)
    if ti.static(s.has_prescribed):
        ti.loop_config(serialize=True)
        for _ in range(1):
            prescribe_velocities(m, s, 0, dt)
    place_all(m)
    ti.loop_config(serialize=True)
    for _ in range(1):
        close_substep(m, s, p, dt, has_contacts)
