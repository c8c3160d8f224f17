"""Explicit steps: symplectic Euler and velocity Verlet, many sub-steps in one kernel launch.

Symplectic Euler (semi-implicit Euler): v += dt a(x, v); x += dt v. First order, stable for dt < 2/omega_max.
Velocity Verlet: half a kick, drift, force, half a kick. The same cost, second order, the same limit.
Damping: the stiffness part -c K(x) v enters the force (K projected positive; Verlet extrapolates v to the force's time,
which keeps it second order); the mass part is a factor on v, exact in Verlet and `1 - dt a` in Euler.
A small mesh runs all its sub-steps in one serial kernel; a large one takes two parallel loops a sub-step.
"""

import taichi as ti

from taisoft.elements.lanes import broadcast
from taisoft.fem.terms import elasticity, mass_damping
from taisoft.fem.terms.elasticity import EXPLODED, HUGE
from taisoft.runtime import kernel
from taisoft.scalars import FAILED, INVERTED_NOW, LOWEST_J, MOST_INVERTED, STEPS_DONE


@ti.func
def nonfinite(value):
    """Whether an f64 is NaN, infinite or past the range of f32, told from its bits after rounding to f32."""
    bits = ti.bit_cast(ti.cast(value, ti.f32), ti.i32)
    return (bits & 0x7F800000) == 0x7F800000


@ti.func
def forces(m: ti.template(), i):
    """(force [N], acceleration [m/s^2]) of node i by all terms, stiffness damping included."""
    f, a = ti.Vector([0.0, 0.0, 0.0], m.real), ti.Vector([0.0, 0.0, 0.0], m.real)
    for term in ti.static(m.terms):
        if ti.static(term.ACCELERATION):
            a += term.acceleration(m, i)
        else:
            f += term.force(m, i)
    return f, a


@ti.func
def acceleration(m: ti.template(), i):
    """Of node i [m/s^2]; 0 on constrained axes."""
    f, a = forces(m, i)
    return m.free[i] * (f / m.mass[i] + a)


@ti.func
def euler_velocity(m: ti.template(), i, dt):
    """The velocity that Euler's step reaches."""
    a = acceleration(m, i)
    v = m.state.v[i] + dt * a
    if ti.static(m.damped):
        v -= dt * mass_damping.rate(m, i) * m.state.v[i]
    return v


@ti.func
def euler_node(m: ti.template(), i, dt):
    v = euler_velocity(m, i, dt)
    m.state.v[i] = v
    m.state.x[i] = m.state.x[i] + ti.cast(dt * v, ti.f64)
    return v


@ti.func
def verlet_half(m: ti.template(), s: ti.template(), i, dt):
    """The velocity after the first half kick."""
    v = m.state.v[i]
    if ti.static(m.damped):
        v *= mass_damping.decay(m, i, 0.5 * dt)
    return v + 0.5 * dt * s.acceleration[i]


@ti.func
def verlet_move(m: ti.template(), s: ti.template(), i, dt, half):
    """Drift by the velocity of the middle; where stiffness damping is on, v is then extrapolated to the force's time."""
    m.state.x[i] = m.state.x[i] + ti.cast(dt * half, ti.f64)
    if ti.static(m.stiffness_damping):
        s.half_velocity[i] = half
        m.state.v[i] = half + 0.5 * dt * s.acceleration[i]
    else:
        m.state.v[i] = half


@ti.func
def verlet_kick(m: ti.template(), s: ti.template(), i, dt):
    """Second half kick."""
    a = acceleration(m, i)
    half = m.state.v[i]
    if ti.static(m.stiffness_damping):
        half = s.half_velocity[i]
    v = half + 0.5 * dt * a
    if ti.static(m.damped):
        v *= mass_damping.decay(m, i, 0.5 * dt)
    s.acceleration[i] = a
    m.state.v[i] = v
    return v


@ti.func
def prescribe(m: ti.template(), s: ti.template(), row, dt):
    """Put the moved nodes on their targets for this sub-step; their velocity is the way per time."""
    prescribe_velocities(m, s, row, dt)
    prescribe_positions(m, s, row)


@ti.func
def prescribe_velocities(m: ti.template(), s: ti.template(), row, dt):
    """The velocity of the moved nodes: their way per time."""
    for k in range(s.n_prescribed):
        i = s.prescribed_nodes[k]
        for a in ti.static(range(3)):
            if s.prescribed_axes[k][a] != 0:
                m.state.v[i][a] = ti.cast((s.targets[row * s.n_prescribed + k][a] - s.before[k][a]) / dt, m.real)


@ti.func
def prescribe_positions(m: ti.template(), s: ti.template(), row):
    """The moved nodes on their targets."""
    for k in range(s.n_prescribed):
        i = s.prescribed_nodes[k]
        for a in ti.static(range(3)):
            if s.prescribed_axes[k][a] != 0:
                m.state.x[i][a] = s.targets[row * s.n_prescribed + k][a]


@ti.func
def remember(m: ti.template(), s: ti.template()):
    for k in range(s.n_prescribed):
        s.before[k] = m.state.x[s.prescribed_nodes[k]]


@ti.func
def react(m: ti.template(), s: ti.template(), dt):
    """Constraint force on held nodes: m (v_new - v_old)/dt - f, with v_old kept in `held_velocity` [N]."""
    for k in range(s.n_held):
        i = s.held[k]
        mass = m.mass[i]
        f, a = forces(m, i)
        f += mass * a
        if ti.static(m.damped):
            v = m.state.v[i]
            if ti.static(not s.verlet):
                v = s.held_velocity[k]
            f += mass_damping.force(m, i, v)
        s.reaction[k] = (1.0 - m.free[i]) * (mass * (m.state.v[i] - s.held_velocity[k]) / dt - f)


@ti.func
def keep_held(m: ti.template(), s: ti.template()):
    for k in range(s.n_held):
        s.held_velocity[k] = m.state.v[s.held[k]]


@kernel
def advance_serial(m: ti.template(), s: ti.template(), n: ti.i32, dt64: ti.f64, restart: ti.i32):
    """n sub-steps of dt on one thread. scalars: STEPS_DONE, LOWEST_J, MOST_INVERTED.

    Stops after the sub-step in which a velocity stops being finite, or that met an exploded tet. restart: Verlet's acceleration
    is stale.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        dt = ti.cast(dt64, m.real)
        done, going = 0, True
        lowest = broadcast(ti.cast(HUGE, m.real), m.lanes)
        low, most = ti.cast(HUGE, m.real), 0
        if ti.static(s.verlet):
            if restart != 0:
                elasticity.sum_elements_serially(m)
                for i in range(m.n_nodes):
                    s.acceleration[i] = acceleration(m, i)
        while done < n and going:
            if ti.static(s.holds):
                if done == n - 1:
                    keep_held(m, s)
            if ti.static(s.has_prescribed):
                remember(m, s)
            if ti.static(s.verlet):
                for i in range(m.n_nodes):
                    verlet_move(m, s, i, dt, verlet_half(m, s, i, dt))
                if ti.static(s.has_prescribed):
                    prescribe(m, s, done, dt64)
            lowest_now, inverted = elasticity.sum_elements_serially(m)
            lowest = ti.min(lowest, lowest_now)
            total = ti.Vector([0.0, 0.0, 0.0], m.real)
            for i in range(m.n_nodes):
                if ti.static(s.verlet):
                    total += verlet_kick(m, s, i, dt)
                else:
                    total += euler_node(m, i, dt)
            if ti.static(s.has_prescribed):
                prescribe(m, s, done, dt64)
            if ti.static(s.holds):
                if done == n - 1:
                    react(m, s, dt)
            count = 0
            for q in ti.static(range(m.lanes)):
                count += inverted[q]
            most = ti.max(most, count)
            low = lowest[0]
            for q in ti.static(range(1, m.lanes)):
                low = ti.min(low, lowest[q])
            going = low > -EXPLODED and not nonfinite(ti.cast(total[0] + total[1] + total[2], ti.f64))
            done += 1
        m.state.scalars[STEPS_DONE] = done - (0 if going else 1)
        m.state.scalars[LOWEST_J], m.state.scalars[MOST_INVERTED] = low, most


@kernel
def set_targets(s: ti.template(), rows: ti.types.ndarray()):
    """Targets of a batch, (sub-steps * n_prescribed, 3) [m]."""
    for k in range(rows.shape[0]):
        for a in ti.static(range(3)):
            s.targets[k][a] = rows[k, a]


@kernel
def elements_parallel(m: ti.template()):
    """One sub-step's element loop over threads; scalars: LOWEST_J, INVERTED_NOW, FAILED."""
    elasticity.sum_elements_with_damping(m)


@kernel
def restart_parallel(m: ti.template(), s: ti.template()):
    """Verlet's acceleration from the tets' forces."""
    for i in range(m.n_nodes):
        s.acceleration[i] = acceleration(m, i)


@kernel
def drift_parallel(m: ti.template(), s: ti.template(), row: ti.i32, dt64: ti.f64):
    """What comes before a sub-step's element loop."""
    if ti.static(s.holds):
        for k in range(s.n_held):
            s.held_velocity[k] = m.state.v[s.held[k]]
    if ti.static(s.has_prescribed):
        for k in range(s.n_prescribed):
            s.before[k] = m.state.x[s.prescribed_nodes[k]]
    if ti.static(s.verlet):
        for i in range(m.n_nodes):
            dt = ti.cast(dt64, m.real)
            verlet_move(m, s, i, dt, verlet_half(m, s, i, dt))
        if ti.static(s.has_prescribed):
            ti.loop_config(serialize=True)
            for _ in range(1):
                prescribe(m, s, row, dt64)


@kernel
def nodes_parallel(m: ti.template(), s: ti.template(), row: ti.i32, dt64: ti.f64):
    """What comes after a sub-step's element loop; scalars: STEPS_DONE, MOST_INVERTED, FAILED."""
    for i in range(m.n_nodes):
        dt = ti.cast(dt64, m.real)
        v = ti.Vector([0.0, 0.0, 0.0], m.real)
        if ti.static(s.verlet):
            v = verlet_kick(m, s, i, dt)
        else:
            v = euler_node(m, i, dt)
        if nonfinite(ti.cast(v[0] + v[1] + v[2], ti.f64)):
            m.state.scalars[FAILED] = 1.0
    if ti.static(s.has_prescribed):
        ti.loop_config(serialize=True)
        for _ in range(1):
            prescribe(m, s, row, dt64)
    if ti.static(s.holds):
        ti.loop_config(serialize=True)
        for _ in range(1):
            react(m, s, ti.cast(dt64, m.real))
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.state.scalars[MOST_INVERTED] = ti.max(m.state.scalars[MOST_INVERTED], m.state.scalars[INVERTED_NOW])
        m.state.scalars[INVERTED_NOW] = 0.0
        if m.state.scalars[FAILED] == 0.0:
            m.state.scalars[STEPS_DONE] = m.state.scalars[STEPS_DONE] + 1.0


@kernel
def begin_parallel(m: ti.template()):
    """Counters of a batch of parallel sub-steps."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.state.scalars[STEPS_DONE], m.state.scalars[LOWEST_J], m.state.scalars[FAILED] = 0.0, HUGE, 0.0
        m.state.scalars[MOST_INVERTED], m.state.scalars[INVERTED_NOW] = 0.0, 0.0
