"""The elastic operator: forces, their differential, energy, and what a state tells about itself.

f_a = -sum_e V sum_q w_q P(F_q) grad N_a; each tet writes the forces on its nodes to a buffer, each node gathers them in a
fixed order, so the result does not depend on threads. The differential is Algorithm 8 of She, "Soft Body Simulation"
(University of Copenhagen), at every quadrature point, with its last factor corrected: dH = -V dP(F; dF) M^T with
M = Dm^-1 (M^-T there), and the fourth corner's force belongs to vertex 0.
"""

import taichi as ti

from taisoft.elements.lanes import (
    add_forces,
    broadcast,
    deformation_gradient,
    differences,
    gather,
    gradient_at,
    law_constants,
    no_forces,
    position_differences,
    rest_gradients,
    rest_gradients_of_F,
    store_forces,
    volumes,
    weight_at,
)
from taisoft.mass import mass_times
from taisoft.materials.projection import dpk1_projected, prepare_projected
from taisoft.math3 import determinant, matmul_nt, matmul_tn
from taisoft.runtime import kernel
from taisoft.scalars import ELASTIC, FIRST_SOFTENED, GRAVITY, KINETIC, LOADS, MIN_J, N_INVERTED

HUGE = 1e30  # above any volume ratio
NO_TET = 2**31 - 1  # above any number of a tet


@ti.func
def element_force(m: ti.template(), g: ti.template(), damped: ti.template(), b):
    """Nodal forces of block b of group g from x (and from v, where the stiffness damping -c K(x) v is on).

    Returns the least J = det F over each tet's quadrature points.
    """
    X, N = position_differences(m, g, b), rest_gradients_of_F(m, b)
    M = rest_gradients(m, b, m.real)
    p = law_constants(m, b, m.real)
    S = no_forces(m, g)
    lowest = broadcast(ti.cast(HUGE, m.real), m.lanes)
    if ti.static(damped):
        V = differences(m, g, m.state.v, b, m.real)
        c = broadcast(m.damping[m.block_body[b], 1], m.lanes)
        for q in range(g.n_points):
            F = deformation_gradient(m, g, X, N, q)
            dF = gradient_at(m, g, V, M, q, m.real)
            K = prepare_projected(g.law, F, p)
            D = dpk1_projected(K, dF)
            P = g.law.pk1(F, p)
            Q = [P[k] + c * D[k] for k in ti.static(range(9))]
            add_forces(m, g, S, Q, M, q)
            lowest = ti.min(lowest, determinant(F))
    else:
        for q in range(g.n_points):
            F = deformation_gradient(m, g, X, N, q)
            P = g.law.pk1(F, p)
            add_forces(m, g, S, P, M, q)
            lowest = ti.min(lowest, determinant(F))
    store_forces(m, g, b, S)
    return lowest


@ti.func
def count_inverted(m: ti.template(), b, J):
    """Per lane, 1 where a real tet has J <= 0 (padding lanes have no volume)."""
    V = volumes(m, b, m.real)
    zero = broadcast(ti.cast(0, ti.i32), m.lanes)
    return ti.select((J <= 0.0) & (V > 0.0), zero + 1, zero)


@kernel
def elastic_forces(m: ti.template()):
    """Fill the buffer of tets' forces from x; returns nothing, nodes gather."""
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            element_force(m, g, False, b)


@kernel
def force_differential(m: ti.template(), dx: ti.template(), df: ti.template()):
    """df = (df/dx)(x) dx, matrix-free: (n_nodes) 3-vectors [m] to [N]."""
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            X, N = position_differences(m, g, b), rest_gradients_of_F(m, b)
            dX = differences(m, g, dx, b, m.real)
            M = rest_gradients(m, b, m.real)
            p = law_constants(m, b, m.real)
            S = no_forces(m, g)
            for q in range(g.n_points):
                F = deformation_gradient(m, g, X, N, q)
                dF = gradient_at(m, g, dX, M, q, m.real)
                K = g.law.prepare(F, p)
                dP = g.law.dpk1(F, K, dF)
                add_forces(m, g, S, dP, M, q)
            store_forces(m, g, b, S)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        df[i] = gather(m, i)


@kernel
def gather_forces(m: ti.template(), f: ti.template()):
    """f = sum of the tets' forces (n_nodes) [N]."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        f[i] = gather(m, i)


@ti.func
def element_state(m: ti.template(), g: ti.template(), b):
    """Of block b of group g, per lane and in f64: elastic energy [J], least J over the quadrature points, and, where the law
    softens below a stretch s, whether the tet is squeezed below it at one of them (1 or 0).

    It is where F^T F - s^2 I is not positive definite, which its leading minors tell.
    """
    X = differences(m, g, m.state.x, b, ti.f64)
    M = rest_gradients(m, b, ti.f64)
    p = law_constants(m, b, ti.f64)
    V = volumes(m, b, ti.f64)
    energy = broadcast(ti.cast(0.0, ti.f64), m.lanes)
    lowest = broadcast(ti.cast(HUGE, ti.f64), m.lanes)
    minor = broadcast(ti.cast(HUGE, ti.f64), m.lanes)
    for q in range(g.n_points):
        F = gradient_at(m, g, X, M, q, ti.f64)
        energy += weight_at(m, g, q, ti.f64) * V * g.law.psi(F, p)
        lowest = ti.min(lowest, determinant(F))
        if ti.static(g.law.SOFTENS_BELOW > 0.0):
            C = matmul_tn(F, F)
            square = ti.static(g.law.SOFTENS_BELOW**2)
            D = [C[k] - (square if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]
            minor = ti.min(minor, D[0], D[0] * D[4] - D[1] * D[3], determinant(D))
    one = broadcast(ti.cast(1, ti.i32), m.lanes)
    return energy, lowest, ti.select(minor <= 0.0, one, one - 1)


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


@kernel(cse=False)
def measure(m: ti.template()):
    """Energies and volume ratios of the present state, in f64 with sums in a fixed order.

    scalars: ELASTIC, MIN_J, N_INVERTED, KINETIC, GRAVITY, LOADS, and FIRST_SOFTENED, NO_TET where there is none.
    """
    ti.loop_config(serialize=m.serial)
    for c in range(m.chunks):
        energy = broadcast(ti.cast(0.0, ti.f64), m.lanes)
        lowest = broadcast(ti.cast(HUGE, ti.f64), m.lanes)
        inverted = broadcast(ti.cast(0, ti.i32), m.lanes)
        none = broadcast(ti.cast(NO_TET, ti.i32), m.lanes)
        squeezed = none
        size = (m.n_blocks + m.chunks - 1) // m.chunks
        for g in ti.static(m.groups):
            for b in range(ti.max(g.first, c * size), ti.min(g.last, (c + 1) * size)):
                psi, J, soft = element_state(m, g, b)
                energy += psi
                lowest = ti.min(lowest, J)
                inverted += count_inverted(m, b, J)
                tets = ti.Vector([b * m.lanes + q for q in ti.static(range(m.lanes))])
                squeezed = ti.min(squeezed, ti.select(soft == 1, tets, none))
        m.state.partial[c, ELASTIC] = _lane_sum(energy)
        m.state.partial[c, MIN_J] = _lane_min(lowest)
        m.state.partial[c, N_INVERTED] = ti.cast(_lane_sum(inverted), ti.f64)
        kinetic, gravity, loads = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        size_n = (m.n_nodes + m.chunks - 1) // m.chunks
        for i in range(c * size_n, ti.min(m.n_nodes, (c + 1) * size_n)):
            kinetic += 0.5 * ti.cast(m.state.v[i], ti.f64).dot(mass_times(m, i, m.state.v))
            gravity -= ti.cast(m.weight[i], ti.f64) * ti.cast(m.gravity[0], ti.f64).dot(m.state.x[i])
            if ti.static(m.loaded):
                loads -= ti.cast(m.loads[i], ti.f64).dot(m.state.x[i])
        m.state.partial[c, KINETIC], m.state.partial[c, GRAVITY], m.state.partial[c, LOADS] = kinetic, gravity, loads
        m.state.partial[c, FIRST_SOFTENED] = ti.cast(_lane_min(squeezed), ti.f64)
    ti.loop_config(serialize=True)
    for _ in range(1):
        for k in ti.static((ELASTIC, MIN_J, N_INVERTED, KINETIC, GRAVITY, LOADS, FIRST_SOFTENED)):
            total = m.state.partial[0, k]
            for c in range(1, m.chunks):
                value = m.state.partial[c, k]
                if ti.static(k == MIN_J or k == FIRST_SOFTENED):
                    total = ti.min(total, value)
                else:
                    total += value
            m.state.scalars[k] = total


@kernel
def cauchy_stress(m: ti.template(), sigma: ti.types.ndarray()):
    """Mean of sigma = P F^T / J over the deformed tet, (n_blocks * lanes, 9) [Pa]; not finite where a tet is flat."""
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            X = differences(m, g, m.state.x, b, ti.f64)
            M = rest_gradients(m, b, ti.f64)
            p = law_constants(m, b, ti.f64)
            size = broadcast(ti.cast(0.0, ti.f64), m.lanes)  # sum of w_q J_q: the deformed volume over the rest volume
            for k in range(9):
                for q in ti.static(range(m.lanes)):
                    sigma[b * m.lanes + q, k] = 0.0
            for q in range(g.n_points):
                F = gradient_at(m, g, X, M, q, ti.f64)
                w = weight_at(m, g, q, ti.f64)
                P = g.law.pk1(F, p)
                T = matmul_nt(P, F)
                size += w * determinant(F)
                for k in ti.static(range(9)):
                    for l in ti.static(range(m.lanes)):
                        sigma[b * m.lanes + l, k] += w * T[k][l]
            for k in range(9):
                for q in ti.static(range(m.lanes)):
                    sigma[b * m.lanes + q, k] /= size[q]
