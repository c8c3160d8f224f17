"""The elastic operator: forces, their differential, energy, and what a state tells about itself.

f_a = -sum_e V P(F) grad N_a; each tet writes its corner forces to a buffer, each node gathers them in a fixed order, so
the result does not depend on threads. The differential is Algorithm 8 of She, "Soft Body Simulation" (University of
Copenhagen), with its last factor corrected: dH = -V dP(F; dF) M^T with M = Dm^-1 (M^-T there), and the fourth corner's
force belongs to vertex 0.
"""

import taichi as ti

from taisoft.elements import broadcast, edge_gradient, gather, law_constants, store_corner_forces, volumes
from taisoft.materials.projection import dpk1_projected, prepare_projected
from taisoft.math3 import determinant
from taisoft.runtime import kernel

HUGE = 1e30  # above any volume ratio


@ti.func
def element_force(m: ti.template(), law: ti.template(), damped: ti.template(), b):
    """Corner forces of block b from x (and from v, where the stiffness damping -c K(x) v is on); returns J = det F."""
    F = edge_gradient(m, m.x, b, m.real)
    p = law_constants(m, b, m.real)
    P = law.pk1(F, p)
    if ti.static(damped):
        S = prepare_projected(law, F, p)
        dF = edge_gradient(m, m.v, b, m.real)
        D = dpk1_projected(S, dF)
        c = broadcast(m.damping[m.block_body[b], 1], m.lanes)
        Q = [P[k] + c * D[k] for k in ti.static(range(9))]
        store_corner_forces(m, b, Q)
    else:
        store_corner_forces(m, b, P)
    return determinant(F)


@ti.func
def count_inverted(m: ti.template(), b, J):
    """Per lane, 1 where a real tet has J <= 0 (padding lanes have no volume)."""
    V = volumes(m, b, m.real)
    zero = broadcast(ti.cast(0, ti.i32), m.lanes)
    return ti.select((J <= 0.0) & (V > 0.0), zero + 1, zero)


@kernel
def elastic_forces(m: ti.template()):
    """Fill the corner buffer from x; returns nothing, nodes gather."""
    for law, first, last in ti.static(m.laws):
        ti.loop_config(serialize=m.serial)
        for b in range(first, last):
            element_force(m, law, False, b)


@kernel
def force_differential(m: ti.template(), dx: ti.template(), df: ti.template()):
    """df = (df/dx)(x) dx, matrix-free: (n_nodes) 3-vectors [m] to [N]."""
    for law, first, last in ti.static(m.laws):
        ti.loop_config(serialize=m.serial)
        for b in range(first, last):
            F = edge_gradient(m, m.x, b, m.real)
            dF = edge_gradient(m, dx, b, m.real)
            p = law_constants(m, b, m.real)
            S = law.prepare(F, p)
            dP = law.dpk1(F, S, dF)
            store_corner_forces(m, b, dP)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        df[i] = gather(m, i)


@kernel
def gather_forces(m: ti.template(), f: ti.template()):
    """f = sum of corner forces (n_nodes) [N]."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        f[i] = gather(m, i)


@ti.func
def _lane_sum(values):
    total = values[0]
    for q in ti.static(range(1, values.n)):
        total += values[q]
    return total


@ti.func
def _lane_min(values):
    low = values[0]
    for q in ti.static(range(1, values.n)):
        low = ti.min(low, values[q])
    return low


@kernel
def measure(m: ti.template()):
    """Energies and volume ratios of the present state, in f64 with sums in a fixed order.

    scalars 0..4: elastic [J], smallest J, number of inverted tets, kinetic [J], gravity [J].
    """
    ti.loop_config(serialize=m.serial)
    for c in range(m.chunks):
        energy = broadcast(ti.cast(0.0, ti.f64), m.lanes)
        lowest = broadcast(ti.cast(HUGE, ti.f64), m.lanes)
        inverted = broadcast(ti.cast(0, ti.i32), m.lanes)
        size = (m.n_blocks + m.chunks - 1) // m.chunks
        for law, first, last in ti.static(m.laws):
            for b in range(ti.max(first, c * size), ti.min(last, (c + 1) * size)):
                F = edge_gradient(m, m.x, b, ti.f64)
                p = law_constants(m, b, ti.f64)
                energy += volumes(m, b, ti.f64) * law.psi(F, p)
                J = determinant(F)
                lowest = ti.min(lowest, J)
                inverted += count_inverted(m, b, J)
        m.partial[c, 0] = _lane_sum(energy)
        m.partial[c, 1] = _lane_min(lowest)
        m.partial[c, 2] = ti.cast(_lane_sum(inverted), ti.f64)
        kinetic, gravity = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        size_n = (m.n_nodes + m.chunks - 1) // m.chunks
        for i in range(c * size_n, ti.min(m.n_nodes, (c + 1) * size_n)):
            mass, v = ti.cast(m.mass[i], ti.f64), ti.cast(m.v[i], ti.f64)
            kinetic += 0.5 * mass * v.dot(v)
            gravity -= mass * ti.cast(m.gravity[0], ti.f64).dot(m.x[i])
        m.partial[c, 3], m.partial[c, 4] = kinetic, gravity
    ti.loop_config(serialize=True)
    for _ in range(1):
        for k in ti.static(range(5)):
            total = m.partial[0, k]
            for c in range(1, m.chunks):
                value = m.partial[c, k]
                if ti.static(k == 1):
                    total = ti.min(total, value)
                else:
                    total += value
            m.scalars[k] = total


@kernel
def cauchy_stress(m: ti.template(), sigma: ti.types.ndarray()):
    """sigma = P F^T / J per tet, (n_blocks * lanes, 9) [Pa]; not finite where a tet is flat."""
    for law, first, last in ti.static(m.laws):
        ti.loop_config(serialize=m.serial)
        for b in range(first, last):
            F = edge_gradient(m, m.x, b, ti.f64)
            P = law.pk1(F, law_constants(m, b, ti.f64))
            J = determinant(F)
            for i in ti.static(range(3)):
                for j in ti.static(range(3)):
                    s = (P[3 * i] * F[3 * j] + P[3 * i + 1] * F[3 * j + 1] + P[3 * i + 2] * F[3 * j + 2]) / J
                    for q in ti.static(range(m.lanes)):
                        sigma[b * m.lanes + q, 3 * i + j] = s[q]
