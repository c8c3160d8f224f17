"""Motion of rigid bodies in explicit steps: their nodes move together, and elasticity does no work.

A sub-step first moves the nodes of a tet as if they were free, to x_n + dt v. Their momentum and their angular momentum L about
their centre of mass are those that the body has. From them follow the velocity v_c and, with the moments of inertia I of the
nodes, the spin: w = I(x_n)^-1 L, then w_m = I(R(w dt/2) x_n)^-1 L in the middle of the step. The body moves by v_c dt and turns
by w_m dt, both exactly, and its nodes get the velocity of the rigid motion with the same momenta. That is the midpoint rule for
the rotation: of second order, with momentum and angular momentum kept to rounding (Krysl and Endres, "Explicit Newmark/Verlet
algorithm for time integration of the rotational dynamics of rigid bodies", Int. J. Numer. Meth. Engng. 62, 2005).
A body turns about an axis only if its nodes are free in both directions across it.
"""

import taichi as ti

from taisoft.scene.rigid import FRAME


@ti.func
def _free_axes(m: ti.template(), k):
    """1 along the axes that no node of tet k is constrained on, else 0."""
    free = ti.Vector([1.0, 1.0, 1.0], ti.f64)
    for a in range(FRAME):
        free = ti.min(free, ti.cast(m.free[m.rigid_tets.node[FRAME * k + a]], ti.f64))
    return free


@ti.func
def _turned(r, w):
    """r turned by the rotation vector w."""
    angle = w.norm()
    first, second = ti.cast(1.0, ti.f64), ti.cast(0.5, ti.f64)
    if angle > 0.0:
        half = ti.sin(0.5 * angle) / angle
        first, second = ti.sin(angle) / angle, 2.0 * half * half
    once = w.cross(r)
    return r + first * once + second * w.cross(once)


@ti.func
def _spin(I, L, free):
    """Angular velocity of angular momentum L about the axes that may turn."""
    w = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    if free.sum() > 2.5:
        w = I.inverse() @ L
    else:
        for j in ti.static(range(3)):
            if free[(j + 1) % 3] + free[(j + 2) % 3] > 1.5:
                w[j] = L[j] / I[j, j]
    return w


@ti.func
def _centre(m: ti.template(), k, v: ti.template(), dt):
    """Centre and velocity of tet k, dt before its present x."""
    mass, c, u = ti.cast(0.0, ti.f64), ti.Vector([0.0, 0.0, 0.0], ti.f64), ti.Vector([0.0, 0.0, 0.0], ti.f64)
    for a in range(FRAME):
        i = m.rigid_tets.node[FRAME * k + a]
        own = ti.cast(m.mass[i], ti.f64)
        mass += own
        c += own * _before(m, i, v, dt)
        u += own * v[i]
    return c / mass, u / mass


@ti.func
def _before(m: ti.template(), i, v: ti.template(), dt):
    """Position of node i before it moved for dt."""
    return m.state.x[i] - dt * v[i]


@ti.func
def _momenta(m: ti.template(), k, v: ti.template(), dt, c, w):
    """Inertia of tet k about its centre c, with its nodes dt before their present x and then turned by w; its angular momentum,
    without turning."""
    I, L = ti.Matrix.zero(ti.f64, 3, 3), ti.Vector([0.0, 0.0, 0.0], ti.f64)
    for a in range(FRAME):
        i = m.rigid_tets.node[FRAME * k + a]
        own, arm = ti.cast(m.mass[i], ti.f64), _before(m, i, v, dt) - c
        r = _turned(arm, w)
        I += own * (r.dot(r) * ti.Matrix.identity(ti.f64, 3) - r.outer_product(r))
        L += own * arm.cross(v[i])
    return I, L


@ti.func
def project_velocities(m: ti.template(), k):
    """Replace the velocities of tet k by those of the rigid motion with their momentum and angular momentum."""
    zero, free = ti.Vector([0.0, 0.0, 0.0], ti.f64), _free_axes(m, k)
    none = ti.cast(0.0, ti.f64)
    c, u = _centre(m, k, m.state.v, none)
    I, L = _momenta(m, k, m.state.v, none, c, zero)
    w = _spin(I, L, free)
    for a in range(FRAME):
        i = m.rigid_tets.node[FRAME * k + a]
        v = u + w.cross(m.state.x[i] - c)
        m.state.v[i] = free * v + (1.0 - free) * m.state.v[i]


@ti.func
def turn(m: ti.template(), k, v: ti.template(), dt):
    """Move tet k, whose nodes have moved by dt v, as a rigid body instead, and make v that of the rigid motion."""
    zero, free = ti.Vector([0.0, 0.0, 0.0], ti.f64), _free_axes(m, k)
    c, u = _centre(m, k, v, dt)
    I, L = _momenta(m, k, v, dt, c, zero)
    I_middle, _L = _momenta(m, k, v, dt, c, 0.5 * dt * _spin(I, L, free))
    angle = dt * _spin(I_middle, L, free)
    for a in range(FRAME):
        i = m.rigid_tets.node[FRAME * k + a]
        x = c + dt * u + _turned(_before(m, i, v, dt) - c, angle)
        m.state.x[i] = free * x + (1.0 - free) * m.state.x[i]
    none = ti.cast(0.0, ti.f64)
    end, _u = _centre(m, k, v, none)
    I_end, _L_end = _momenta(m, k, v, none, end, zero)
    w = _spin(I_end, L, free)
    for a in range(FRAME):
        i = m.rigid_tets.node[FRAME * k + a]
        own = u + w.cross(m.state.x[i] - end)
        v[i] = free * own + (1.0 - free) * v[i]


@ti.func
def turn_all(m: ti.template(), s: ti.template(), dt):
    """Move all rigid bodies after the drift of their nodes, as a top-level loop of a kernel."""
    if ti.static(m.has_rigid_tets):
        ti.loop_config(serialize=m.serial)
        for k in range(m.rigid_tets.n):
            turn_drifted(m, s, k, dt)


@ti.func
def turn_drifted(m: ti.template(), s: ti.template(), k, dt):
    """`turn` tet k by the velocities that its nodes have drifted with; Verlet extrapolates them to the forces' time."""
    if ti.static(s.verlet and m.depends_on_velocity):
        turn(m, k, s.half_velocity, dt)
        for a in range(FRAME):
            i = m.rigid_tets.node[FRAME * k + a]
            m.state.v[i] = s.half_velocity[i] + 0.5 * dt * s.acceleration[i]
    else:
        turn(m, k, m.state.v, dt)


@ti.func
def project_all(m: ti.template()):
    """Project the velocities of all rigid bodies, as a top-level loop of a kernel."""
    if ti.static(m.has_rigid_tets):
        ti.loop_config(serialize=m.serial)
        for k in range(m.rigid_tets.n):
            project_velocities(m, k)
