"""Fields and kernels of one implicit stage; `newton` drives them. The formulas stand there."""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.elasticity import element_force
from taisoft.elements import gather
from taisoft.linear.block_csr import row_times
from taisoft.linear.pcg import dot64, total
from taisoft.runtime import kernel


@dataclass(frozen=True, eq=False)
class StageWork:
    """Fields of a stage; (n_nodes) 3-vectors."""

    x_hat: Any  # f64
    v_hat: Any
    base: Any  # f64: x before the step that is being tried
    residual: Any  # on all axes; where not free, beta times the constraint force
    moved: Any  # (n_moved) i32
    moved_axes: Any  # (n_moved, 3) i32
    targets: Any  # (n_moved) f64 3-vectors
    n_moved: int
    shift: Any  # (n_nodes) inertia of the system
    damper: Any  # BlockCsr or None


@ti.func
def stage_velocity(m: ti.template(), w: ti.template(), i, beta):
    """(x - x_hat) / beta of node i in f64: an f32 velocity would make neighbours' positions differ by its rounding."""
    return (m.x[i] - w.x_hat[i]) / beta


@kernel
def begin_stage(m: ti.template(), w: ti.template(), beta: ti.f64):
    """x from the first iterate v; led nodes go to their targets, which gives their v."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.x[i] = w.x_hat[i] + beta * ti.cast(m.v[i], ti.f64)
    if ti.static(w.n_moved > 0):
        ti.loop_config(serialize=True)
        for k in range(w.n_moved):
            i = w.moved[k]
            for a in ti.static(range(3)):
                if w.moved_axes[k][a] != 0:
                    m.v[i][a] = ti.cast((w.targets[k][a] - w.x_hat[i][a]) / beta, m.real)
                    m.x[i][a] = w.targets[k][a]


@kernel
def form_residual(
    m: ti.template(), w: ti.template(), p: ti.template(), c: ti.f64, beta: ti.f64
) -> ti.types.vector(5, ti.f64):
    """Elastic forces and residual at the present x and v, -r as CG's right side, inertia of the system.

    Returns |r|^2, |c M dv|^2, |f_el|^2, |f_ext|^2 on the free axes, and |r|^2 on the others.
    """
    for law, first, last in ti.static(m.laws):
        ti.loop_config(serialize=m.serial)
        for b in range(first, last):
            element_force(m, law, False, b)
    ti.loop_config(serialize=m.serial)
    for k in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0], ti.f64)
        for i in range(k * size, ti.min(m.n_nodes, (k + 1) * size)):
            b, mass, free = ti.cast(beta, m.real), m.mass[i], m.free[i]
            inertia = ti.cast(c, m.real) * mass
            f = gather(m, i)
            external = mass * m.gravity[0]
            if ti.static(m.loaded):
                external += m.loads[i]
            drag = ti.Vector([0.0, 0.0, 0.0], m.real)
            if ti.static(m.damped):
                a = m.damping[m.node_body[i], 0]
                drag += a * mass * m.v[i]
                inertia += b * a * mass
            if ti.static(m.stiffness_damping):
                drag += m.damping[m.node_body[i], 1] * row_times(m, w.damper, i, m.v)
            change = ti.cast(c * (stage_velocity(m, w, i, beta) - ti.cast(w.v_hat[i], ti.f64)), m.real) * mass
            r = change - b * (f + external - drag)
            w.residual[i] = r
            p.rhs[i] = -free * r
            w.shift[i] = inertia
            s += ti.Vector(
                [
                    norm2(free * r),
                    norm2(free * change),
                    norm2(free * f),
                    norm2(free * external),
                    norm2((1.0 - free) * r),
                ]
            )
        for j in ti.static(range(5)):
            m.partial[k, j] = s[j]
    return ti.Vector([total(m, j) for j in ti.static(range(5))])


@ti.func
def norm2(a):
    b = ti.cast(a, ti.f64)
    return b.dot(b)


@kernel
def try_step(m: ti.template(), w: ti.template(), y: ti.template(), share: ti.f64, beta: ti.f64):
    """x = base + share beta y, v accordingly; y is 0 on constrained axes."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.x[i] = w.base[i] + share * beta * ti.cast(y[i], ti.f64)
        m.v[i] = ti.cast(stage_velocity(m, w, i, beta), m.real)


@kernel
def keep_base(m: ti.template(), w: ti.template(), y: ti.template()):
    """base = x; scalars 13: slope r.y of the step y (its sign: negative is downhill)."""
    ti.loop_config(serialize=m.serial)
    for k in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        for i in range(k * size, ti.min(m.n_nodes, (k + 1) * size)):
            w.base[i] = m.x[i]
            s += dot64(m.free[i] * w.residual[i], y[i])
        m.partial[k, 5] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.scalars[13] = total(m, 5)


@kernel
def stage_terms(m: ti.template(), w: ti.template(), c: ti.f64, beta: ti.f64):
    """Inertia, loads and damping terms of Phi, in f64: scalars 14."""
    ti.loop_config(serialize=m.serial)
    for k in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        for i in range(k * size, ti.min(m.n_nodes, (k + 1) * size)):
            mass, v = ti.cast(m.mass[i], ti.f64), stage_velocity(m, w, i, beta)
            d = v - ti.cast(w.v_hat[i], ti.f64)
            s += 0.5 * c * mass * d.dot(d)
            if ti.static(m.loaded):
                s -= ti.cast(m.loads[i], ti.f64).dot(m.x[i])
            if ti.static(m.damped):
                s += 0.5 * beta * m.damping[m.node_body[i], 0] * mass * v.dot(v)
            if ti.static(m.stiffness_damping):
                s += 0.5 * beta * m.damping[m.node_body[i], 1] * dot64(m.v[i], row_times(m, w.damper, i, m.v))
        m.partial[k, 5] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.scalars[14] = total(m, 5)
