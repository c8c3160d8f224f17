"""Fields and kernels of one implicit stage; see `stage_system` for the formulas."""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Count
from taisoft.backend.runtime import kernel
from taisoft.fem.lanes import mass_times
from taisoft.fem.terms import rayleigh_damping
from taisoft.linear.block_csr import row_times
from taisoft.linear.pcg import PcgWork


@dataclass(frozen=True, eq=False)
class StageWork:
    """Fields of a stage; (n_nodes) 3-vectors."""

    x_hat: Any  # f64
    v_hat: Any
    base: Any  # f64: x before the trial step
    residual: Any  # on all axes; on constrained ones, beta times the constraint force
    prescribed_nodes: Any  # (n_prescribed) i32
    prescribed_axes: Any  # (n_prescribed, 3) i32
    targets: Any  # (n_prescribed) f64 3-vectors
    prescribed_acceleration: Any  # (n_prescribed) f64 3-vectors, only with a consistent mass
    n_prescribed: Count
    change: Any  # f64: velocity change that the mass multiplies, see `set_change`
    damper: Any  # BlockCsr or None
    pcg: PcgWork  # right side -r; y, the change of v in a Newton step; subset, the nodes that move

    @property
    def has_prescribed(self) -> bool:
        """Whether nodes have prescribed motion."""
        return self.prescribed_nodes is not None


@ti.func
def stage_velocity(m: ti.template(), w: ti.template(), i, beta):
    """Return (x - x_hat) / beta of node i in f64: an f32 velocity would make neighbours' positions differ by its rounding."""
    return (m.state.x[i] - w.x_hat[i]) / beta


@kernel
def begin_stage(m: ti.template(), w: ti.template(), beta: ti.f64, prescribed_fraction: ti.f64):
    """Set x from the first iterate v; prescribed nodes move to their targets, which gives their v.

    v_hat of a prescribed node is set so that (v - v_hat) / beta is its acceleration. With a lumped mass, which affects only the
    reactions, that is the velocity change of a step, of which prescribed_fraction happens in the stage. A consistent mass
    couples to the neighbours, so there the acceleration comes from the path.
    """
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = w.x_hat[i] + beta * ti.cast(m.state.v[i], ti.f64)
    if ti.static(w.has_prescribed):
        ti.loop_config(serialize=True)
        for k in range(w.n_prescribed):
            i = w.prescribed_nodes[k]
            for a in ti.static(range(3)):
                if w.prescribed_axes[k][a] != 0:
                    v = (w.targets[k][a] - w.x_hat[i][a]) / beta
                    if ti.static(m.consistent):
                        w.v_hat[i][a] = ti.cast(v - beta * w.prescribed_acceleration[k][a], m.real)
                    else:
                        w.v_hat[i][a] = ti.cast(v - prescribed_fraction * (v - ti.cast(w.v_hat[i][a], ti.f64)), m.real)
                    m.state.v[i][a] = ti.cast(v, m.real)
                    m.state.x[i][a] = w.targets[k][a]


@ti.func
def set_change(m: ti.template(), w: ti.template(), i, c, beta):
    """Set c (v - v_hat), plus beta a v with mass damping, for node i."""
    change = c * (stage_velocity(m, w, i, beta) - ti.cast(w.v_hat[i], ti.f64))
    if ti.static(m.damped):
        change += beta * ti.cast(rayleigh_damping.mass_rate(m, i), ti.f64) * ti.cast(m.state.v[i], ti.f64)
    w.change[i] = change


@ti.func
def residual_parts(m: ti.template(), w: ti.template(), i, beta):
    """Return (r, inertia and mass damping, internal forces, loads) of node i without contacts; uses `change`."""
    zero = ti.Vector([0.0, 0.0, 0.0], m.real)
    internal, loads, damping = zero, zero, zero
    for term in ti.static(m.terms):
        if ti.static(term.LOAD):
            loads += term.force(m, i)
        else:
            internal += term.force(m, i)
    if ti.static(m.stiffness_damping):
        damping += rayleigh_damping.stiffness_force(m, i, row_times(m, w.damper, i, m.state.v))
    inertia = ti.cast(mass_times(m, i, w.change), m.real)
    return inertia - ti.cast(beta, m.real) * (internal + loads + damping), inertia, internal, loads


@ti.func
def squares(r, inertia, f, external, free):
    """Return the contributions of node i to the norms of `form_residual`."""
    return ti.Vector([norm2(free * r), norm2(free * inertia), norm2(free * f), norm2(free * external), norm2((1.0 - free) * r)])


@ti.func
def norm2(a):
    b = ti.cast(a, ti.f64)
    return b.dot(b)


@ti.func
def place_node(m: ti.template(), w: ti.template(), i, step_length, beta):
    """Move node i to base + step_length beta y, and set v accordingly; y is 0 on constrained axes."""
    m.state.x[i] = w.base[i]
    if step_length != 0.0:  # so that 0 restores the base even if y is not a number
        m.state.x[i] += step_length * beta * ti.cast(w.pcg.y[i], ti.f64)
    m.state.v[i] = ti.cast(stage_velocity(m, w, i, beta), m.real)


@kernel
def set_direction_to_rest(m: ti.template(), w: ti.template()):
    """Set y = -v on the free axes."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        w.pcg.y[i] = -m.free[i] * m.state.v[i]


@kernel
def negate_direction(m: ti.template(), w: ti.template()):
    """Set y = -y."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        w.pcg.y[i] = -w.pcg.y[i]
