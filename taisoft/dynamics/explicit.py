"""Explicit steps: symplectic Euler and velocity Verlet, many sub-steps per kernel launch.

Symplectic Euler (semi-implicit Euler): v += dt a(x, v); x += dt v. First order, stable for dt < 2/omega_max.
Velocity Verlet: half kick, drift, force, half kick. Second order, same cost and stability limit.
Damping: the stiffness part -c K(x) v enters the force (K projected positive), as that of springs does; Verlet extrapolates v to
the force's time, which keeps it second order; the mass part is a factor on v, exact in Verlet and `1 - dt a` in Euler.
Maxwell branches move with x: before the forces of Verlet, at the end of a sub-step of Euler.
A small mesh runs all its sub-steps in one serial kernel; a large one takes two parallel loops per sub-step.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.dynamics.rigid_motion import project_all, turn_all
from taisoft.fem import viscosity
from taisoft.fem.dependents import force_with_dependents, place_all
from taisoft.fem.state import FAILED, INVERTED_NOW, LOWEST_J, MOST_INVERTED, STEPS_DONE
from taisoft.fem.terms import elasticity, rayleigh_damping
from taisoft.fem.terms.elasticity import HUGE


@ti.func
def nonfinite(value):
    """Return whether an f64 is NaN, infinite or beyond the range of f32, by its bits after rounding to f32."""
    bits = ti.bit_cast(ti.cast(value, ti.f32), ti.i32)
    return (bits & 0x7F800000) == 0x7F800000


@ti.func
def forces(m: ti.template(), i):
    """Return (force [N], acceleration [m/s^2]) of node i from all terms, including stiffness damping."""
    f, a = ti.Vector([0.0, 0.0, 0.0], m.real), ti.Vector([0.0, 0.0, 0.0], m.real)
    for term in ti.static(m.terms):
        if ti.static(term.ACCELERATION):
            a += term.acceleration(m, i)
        else:
            f += force_with_dependents(m, term, i)
    return f, a


@ti.func
def acceleration(m: ti.template(), i):
    """Return the acceleration of node i [m/s^2]; 0 on constrained axes."""
    f, a = forces(m, i)
    return m.free[i] * (f / m.mass[i] + a)


@ti.func
def euler_velocity(m: ti.template(), i, dt):
    """Return the velocity of node i after an Euler step."""
    a = acceleration(m, i)
    v = m.state.v[i] + dt * ti.cast(a, ti.f64)
    if ti.static(m.damped):
        v -= dt * rayleigh_damping.mass_rate(m, i) * m.state.v[i]
    return v


@ti.func
def euler_node(m: ti.template(), i, dt):
    v = euler_velocity(m, i, dt)
    m.state.v[i] = v
    m.state.x[i] = m.state.x[i] + dt * v
    return v


@ti.func
def keep_decays(m: ti.template(), s: ti.template(), dt):
    """Compute `verlet_decay` of every node once in a launch of many sub-steps: it takes as long as the rest of a node."""
    if ti.static(s.keeps_decays):
        for i in range(m.n_nodes):
            s.decay[i] = rayleigh_damping.mass_decay(m, i, ti.cast(0.5 * dt, m.real))


@ti.func
def verlet_decay(m: ti.template(), s: ti.template(), i, dt):
    """Return the factor by which mass damping slows node i in half a sub-step of Verlet."""
    decay = ti.cast(1.0, m.real)
    if ti.static(s.keeps_decays):
        decay = s.decay[i]
    elif ti.static(m.damped):
        decay = rayleigh_damping.mass_decay(m, i, ti.cast(0.5 * dt, m.real))
    return decay


@ti.func
def verlet_half(m: ti.template(), s: ti.template(), i, dt, decay):
    """Return the velocity after the first half kick. decay: `verlet_decay` of node i."""
    v = m.state.v[i]
    if ti.static(m.damped):
        v *= decay
    return v + 0.5 * dt * ti.cast(s.acceleration[i], ti.f64)


@ti.func
def verlet_drift(m: ti.template(), s: ti.template(), i, dt, half):
    """Drift by the mid-step velocity; if forces depend on v, then extrapolate it to their time."""
    m.state.x[i] = m.state.x[i] + dt * half
    if ti.static(m.depends_on_velocity):
        s.half_velocity[i] = half
        m.state.v[i] = half + 0.5 * dt * ti.cast(s.acceleration[i], ti.f64)
    else:
        m.state.v[i] = half


@ti.func
def verlet_kick(m: ti.template(), s: ti.template(), i, dt, decay):
    """Apply the second half kick and return v. decay: as in `verlet_half`. dt: 0 to set the acceleration alone."""
    a = acceleration(m, i)
    half = m.state.v[i]
    if ti.static(m.depends_on_velocity):
        half = ti.select(dt > 0.0, s.half_velocity[i], half)
    v = half + 0.5 * dt * ti.cast(a, ti.f64)
    if ti.static(m.damped):
        v *= decay
    s.acceleration[i] = a
    m.state.v[i] = v
    return v


@ti.func
def prescribe(m: ti.template(), s: ti.template(), row, dt):
    """Move the prescribed nodes to their targets for this sub-step; set their velocity to displacement over dt."""
    prescribe_velocities(m, s, row, dt)
    prescribe_positions(m, s, row)


@ti.func
def prescribe_velocities(m: ti.template(), s: ti.template(), row, dt):
    """Set the velocity of the prescribed nodes to their displacement over dt. A loop of its own: on the CPU on one thread, since
    several would take longer to start."""
    ti.loop_config(serialize=m.on_cpu)
    for k in range(s.n_prescribed):
        i = s.prescribed_nodes[k]
        for a in ti.static(range(3)):
            if s.prescribed_axes[k][a] != 0:
                m.state.v[i][a] = (s.targets[row * s.n_prescribed + k][a] - s.before[k][a]) / dt


@ti.func
def prescribe_positions(m: ti.template(), s: ti.template(), row):
    """Move the prescribed nodes to their targets, in such a loop."""
    ti.loop_config(serialize=m.on_cpu)
    for k in range(s.n_prescribed):
        i = s.prescribed_nodes[k]
        for a in ti.static(range(3)):
            if s.prescribed_axes[k][a] != 0:
                m.state.x[i][a] = s.targets[row * s.n_prescribed + k][a]


@ti.func
def save_prescribed_positions(m: ti.template(), s: ti.template()):
    """Save the positions of the prescribed nodes, in such a loop."""
    ti.loop_config(serialize=m.on_cpu)
    for k in range(s.n_prescribed):
        s.before[k] = m.state.x[s.prescribed_nodes[k]]


@ti.func
def set_loads(m: ti.template(), s: ti.template(), row):
    """Set the loads that follow paths for this sub-step, in such loops."""
    if ti.static(s.has_varied_nodes):
        ti.loop_config(serialize=m.on_cpu)
        for k in range(s.n_varied):
            m.loads[s.varied_nodes[k]] = ti.cast(s.load_rows[row * s.n_varied + k], m.real)
    if ti.static(s.has_varied_amplitudes):
        ti.loop_config(serialize=m.on_cpu)
        for k in range(s.n_amplitudes):
            m.amplitudes[k] = s.amplitude_rows[row * s.n_amplitudes + k]


@ti.func
def compute_reactions(m: ti.template(), s: ti.template(), dt, n):
    """Compute the constraint force on the first n held nodes, m (v_new - v_old)/dt - f [N], v_old from `held_velocity`."""
    ti.loop_config(serialize=m.on_cpu)
    for k in range(n):
        i = s.held[k]
        mass = m.mass[i]
        f, a = forces(m, i)
        f += mass * a
        if ti.static(m.damped):
            v = m.state.v[i]
            if ti.static(not s.verlet):
                v = s.held_velocity[k]
            f += ti.cast(rayleigh_damping.mass_force(m, i, v), m.real)
        change = (m.state.v[i] - s.held_velocity[k]) / dt
        s.reaction[k] = (1.0 - m.free[i]) * (mass * ti.cast(change, m.real) - f)


@ti.func
def save_held_velocities(m: ti.template(), s: ti.template(), n):
    """Save the velocities of the first n held nodes: of all before the last sub-step, whose reactions need them."""
    ti.loop_config(serialize=m.on_cpu)
    for k in range(n):
        s.held_velocity[k] = m.state.v[s.held[k]]


def begins_alone(m, s) -> bool:
    """Whether sub-steps begin apart from the loop over nodes that ends the one before, because more happens there."""
    return s.has_prescribed or s.has_varied_loads or m.has_rigid_tets


# --- loops: at the top level of a kernel, or inside the loop of `advance_alone` -----------------------------------------


@ti.func
def begin_substep(m: ti.template(), s: ti.template(), row, dt, saves, drifts):
    """Run the part of a sub-step before the elements. saves: 1 in the last one; drifts: 0 if the nodes have drifted already."""
    if ti.static(s.has_held):
        save_held_velocities(m, s, saves * s.n_held)
    if ti.static(s.has_prescribed):
        save_prescribed_positions(m, s)
    if ti.static(s.verlet):
        for i in range(drifts * m.n_nodes):
            verlet_drift(m, s, i, dt, verlet_half(m, s, i, dt, verlet_decay(m, s, i, dt)))
        turn_all(m, s, dt)
        if ti.static(s.has_prescribed):
            prescribe(m, s, row, dt)
    if ti.static(s.has_varied_loads):
        set_loads(m, s, row)


@ti.func
def end_substep(m: ti.template(), s: ti.template(), row, dt, drift):
    """Run the part of a sub-step after the elements. scalars: STEPS_DONE, MOST_INVERTED, FAILED.

    drift: 1 to begin the next sub-step of Verlet, which `begin_substep` would do in a loop of its own.
    """
    for i in range(m.n_nodes):
        v = ti.Vector([0.0, 0.0, 0.0], ti.f64)
        if ti.static(s.verlet):
            decay = verlet_decay(m, s, i, dt)
            v = verlet_kick(m, s, i, dt, decay)
            if ti.static(not begins_alone(m, s)):
                if drift == 1:
                    verlet_drift(m, s, i, dt, verlet_half(m, s, i, dt, decay))
        else:
            v = euler_node(m, i, dt)
        if nonfinite(v[0] + v[1] + v[2]):
            m.state.scalars[FAILED] = 1.0
    if ti.static(s.verlet):
        project_all(m)
    else:
        turn_all(m, s, dt)
    if ti.static(s.has_prescribed):
        prescribe(m, s, row, dt)
    place_all(m)
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.state.scalars[MOST_INVERTED] = ti.max(m.state.scalars[MOST_INVERTED], m.state.scalars[INVERTED_NOW])
        m.state.scalars[INVERTED_NOW] = 0.0
        if m.state.scalars[FAILED] == 0.0:
            m.state.scalars[STEPS_DONE] = m.state.scalars[STEPS_DONE] + 1.0


@ti.func
def reset_counters(m: ti.template()):
    """Begin to count, inside a loop on one thread."""
    m.state.scalars[STEPS_DONE], m.state.scalars[LOWEST_J], m.state.scalars[FAILED] = 0.0, HUGE, 0.0
    m.state.scalars[MOST_INVERTED], m.state.scalars[INVERTED_NOW] = 0.0, 0.0


# --- kernels ------------------------------------------------------------------------------------------------------------


@kernel
def advance_alone(m: ti.template(), s: ti.template(), n: ti.i32, dt: ti.f64, restart: ti.i32):
    """Take n sub-steps of dt on one thread. scalars: STEPS_DONE, LOWEST_J, MOST_INVERTED.

    Stop after a sub-step with a non-finite velocity or an exploded tet. restart: recompute Verlet's stale acceleration.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        row, begun, starting = 0, 0, False
        reset_counters(m)
        if ti.static(s.verlet):
            starting = restart != 0
            keep_decays(m, s, dt)
        if ti.static(m.viscous):
            viscosity.set_interval(m, dt)
        while starting or (row < n and m.state.scalars[FAILED] == 0.0):
            if not starting:
                begin_substep(m, s, row, dt, int(row == n - 1), 1 - begun)
                if ti.static(s.verlet):
                    viscosity.follow(m)
            elasticity.sum_elements_with_damping(m, 1)
            if starting:  # forces alone, in the loop of the sub-steps: another copy of them takes long to compile
                if ti.static(s.verlet):
                    for i in range(m.n_nodes):
                        s.acceleration[i] = acceleration(m, i)
                reset_counters(m)
                starting = False
            else:
                if ti.static(s.verlet and not begins_alone(m, s)):
                    begun = int(row < n - ti.static(2 if s.has_held else 1))  # held: velocities before the last one are needed
                end_substep(m, s, row, dt, begun)
                if ti.static(not s.verlet):
                    viscosity.follow(m)
                row += 1
        if ti.static(s.has_held):
            compute_reactions(m, s, dt, s.n_held)


@kernel
def begin_batch(m: ti.template()):
    """Reset the counters of a batch."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        reset_counters(m)


@kernel
def run_elements(m: ti.template()):
    """Run the element loop of a sub-step. scalars: LOWEST_J, INVERTED_NOW, FAILED."""
    elasticity.sum_elements_with_damping(m, 1)


@kernel
def find_acceleration(m: ti.template(), s: ti.template()):
    """Compute Verlet's acceleration of the present state, after `run_elements`."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        s.acceleration[i] = acceleration(m, i)


@kernel
def begin_shared(m: ti.template(), s: ti.template(), row: ti.i32, dt: ti.f64):
    """See `begin_substep`."""
    begin_substep(m, s, row, dt, 1, 1)


@kernel
def end_shared(m: ti.template(), s: ti.template(), row: ti.i32, dt: ti.f64, drift: ti.i32):
    """See `end_substep`."""
    end_substep(m, s, row, dt, drift)


@kernel
def find_reactions(m: ti.template(), s: ti.template(), dt: ti.f64):
    """Compute the reactions of the last sub-step of a batch."""
    compute_reactions(m, s, dt, s.n_held)
