"""Kernels of an explicit sub-step with contacts, in order: predict the velocity without them, solve for their impulses, move.

Symplectic Euler: v* = v_n + dt a(x_n), v = v* + M^-1 J^T r, x = x_n + dt v. Velocity Verlet: the impulses act on the mid-step
velocity, which moves the nodes. M is lumped, so M^-1 is diagonal (report, section 2.4, corrected).

They do nothing in a batch of sub-steps that has ended, see `explicit_batch`. event: number of the event that ends it if they
fail, 0 outside of batches. s: Surface; work: SubstepWork; p: ContactProblem.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.contact.build import relative_velocity
from taisoft.contact.colouring import colour
from taisoft.contact.problem import RESIDUAL, SWEEPS, impulse_on, set_factors, to_frame
from taisoft.contact.prox import dvec
from taisoft.contact.restitution import explicit_opening
from taisoft.contact.solve import CHECK_EVERY, restore_best, sweeps_of_team
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
from taisoft.fem.state import EVENT, FAILED, GO, INVERTED_NOW, MOST_INVERTED
from taisoft.fem.terms import elasticity


@kernel
def predict(
    m: ti.template(),
    work: ti.template(),
    p: ti.template(),
    s: ti.template(),
    dt: ti.f64,
    contact_offset: ti.f64,
    penetration_correction: ti.f64,
    offset_correction: ti.f64,
    max_speed: ti.f64,
):
    """Compute v* of every node; of every contact, b from it, and the r-factors. scalars: LOWEST_J, INVERTED_NOW.

    Verlet uses the stored acceleration; Euler computes the forces here.
    """
    if ti.static(not work.verlet):
        elasticity.sum_elements_with_damping(m, s.run[GO])
    if ti.static(work.has_held):
        save_held_velocities(m, work, s.run[GO] * work.n_held)
    if ti.static(work.has_prescribed):
        save_prescribed_positions(m, work)
    ti.loop_config(serialize=m.serial)
    for i in range(s.run[GO] * m.n_nodes):
        if ti.static(work.verlet):
            m.state.v[i] = verlet_half(m, work, i, dt, verlet_decay(m, work, i, dt))
        else:
            m.state.v[i] = euler_velocity(m, i, dt)
    project_all(m)
    if ti.static(work.has_prescribed):
        prescribe_velocities(m, work, 0, dt)
    ti.loop_config(serialize=m.serial)
    for i in range(int(p.count[0] > 0) * m.n_nodes):
        p.inverse_mass[i] = ti.cast(m.free[i], ti.f64) / ti.cast(m.mass[i], ti.f64)
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        b = to_frame(p, c, relative_velocity(p, m, c, dt))
        rise = explicit_opening(p, c, dt, contact_offset, b[0], ti.static(0.0 if work.verlet else 0.5))
        gap = gap_minus_target(p, c, dt, contact_offset, penetration_correction, offset_correction, max_speed, rise, 0.0)
        p.b[c] = dvec(b[0] + gap / dt, b[1], b[2])
        set_factors(p, c)


@kernel
def begin_solve(
    p: ti.template(),
    team: ti.template(),
    s: ti.template(),
    method: ti.template(),
    tolerance: ti.f64,
    sweeps: ti.i32,
    most: ti.i32,
    event: ti.i32,
):
    """Colour the contacts if `method` needs colours, and take up to so many sweeps of at most `most` in all.

    event: of more sweeps that are needed.
    """
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        if s.run[GO] == 1 and p.count[0] > 0:
            if ti.static(method == "coloured_gauss_seidel"):
                colour(p, team, t)
            sweeps_of_team(p, team, method, t, 1, sweeps, CHECK_EVERY, tolerance, 1)
            if p.sweep.state[RESIDUAL] <= tolerance or p.sweep.state[SWEEPS] >= most:
                restore_best(p, team, t)
            elif t == 0 and event != 0:
                s.run[GO], s.run[EVENT] = 0, event


@ti.func
def _close_substep(m: ti.template(), work: ti.template(), p: ti.template(), s: ti.template(), dt, event):
    """Compute the reactions, and update the counter MOST_INVERTED. Top-level loops of a kernel."""
    if ti.static(work.has_held):
        compute_reactions(m, work, dt, int(dt > 0.0) * s.run[GO] * work.n_held)
        ti.loop_config(serialize=m.on_cpu)
        for k in range(int(dt > 0.0 and p.count[0] > 0) * s.run[GO] * work.n_held):  # without the forces of contacts
            i = work.held[k]
            work.reaction[k] -= (1.0 - m.free[i]) * ti.cast(impulse_on(p, i) / dt, m.real)
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.state.scalars[MOST_INVERTED] = ti.max(m.state.scalars[MOST_INVERTED], m.state.scalars[INVERTED_NOW])
        m.state.scalars[INVERTED_NOW] = 0.0
        if event != 0 and s.run[GO] == 1 and m.state.scalars[FAILED] != 0.0:
            s.run[GO], s.run[EVENT] = 0, event


@kernel
def move(m: ti.template(), work: ti.template(), p: ti.template(), s: ti.template(), dt: ti.f64, event: ti.i32):
    """Apply impulses to v, then move x. scalars: FAILED.

    With Verlet `finish_verlet` follows.
    """
    ti.loop_config(serialize=m.serial)
    for i in range(s.run[GO] * m.n_nodes):
        v = m.state.v[i]
        if p.count[0] > 0:
            v += p.inverse_mass[i] * impulse_on(p, i)
        if nonfinite(v[0] + v[1] + v[2]):
            m.state.scalars[FAILED] = 1.0
        if ti.static(work.verlet):
            verlet_drift(m, work, i, dt, v)
        else:
            m.state.v[i] = v
            m.state.x[i] = m.state.x[i] + dt * v
    turn_all(m, work, dt)
    if ti.static(work.has_prescribed):
        prescribe_positions(m, work, 0)
    place_all(m)
    if ti.static(not work.verlet):
        _close_substep(m, work, p, s, dt, event)


@kernel
def finish_verlet(m: ti.template(), work: ti.template(), p: ti.template(), s: ti.template(), dt: ti.f64, event: ti.i32):
    """Apply the second half kick by the forces at the new positions; scalars as in `predict` and `move`.

    dt: 0 to compute the acceleration alone.
    """
    elasticity.sum_elements_with_damping(m, s.run[GO])
    ti.loop_config(serialize=m.serial)
    for i in range(s.run[GO] * m.n_nodes):
        v = verlet_kick(m, work, i, dt, verlet_decay(m, work, i, dt))
        if nonfinite(v[0] + v[1] + v[2]):
            m.state.scalars[FAILED] = 1.0
    project_all(m)
    if ti.static(work.has_prescribed):
        prescribe_velocities(m, work, 0, dt)
    place_all(m)
    _close_substep(m, work, p, s, dt, event)
