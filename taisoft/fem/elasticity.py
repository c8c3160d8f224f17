"""Elastic kernels over a whole scene: forces, their differential, stresses, energies and volume ratios.

The differential is Algorithm 8 of She, "Soft Body Simulation" (University of Copenhagen), at every quadrature point, with two
corrections: dH = -V dP(F; dF) M^T with M = Dm^-1 (M^-T there), and the fourth corner's force belongs to vertex 0.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem import terms
from taisoft.fem.lanes import (
    add_forces,
    broadcast,
    deformation_gradient,
    differences,
    gradient_at,
    law_constants,
    position_differences,
    rest_gradients,
    rest_gradients_of_F,
    store_forces,
    weight_at,
    zero_forces,
)
from taisoft.fem.mass import mass_times
from taisoft.fem.math3 import determinant, matmul_nt
from taisoft.fem.scalars import ELASTIC, FIRST_SOFTENED, GRAVITY, KINETIC, LOADS, MIN_J, N_INVERTED
from taisoft.fem.subset import EVERYTHING
from taisoft.fem.terms import elasticity
from taisoft.fem.terms.elasticity import HUGE

NO_TET = 2**31 - 1  # above any tet index


@kernel
def elastic_forces(m: ti.template()):
    """Fill the element force buffer from x; `gather_forces` sums it over nodes."""
    elasticity.sum_elements(m, EVERYTHING)


@kernel
def force_differential(m: ti.template(), dx: ti.template(), df: ti.template()):
    """Compute df = (df/dx)(x) dx, matrix-free: (n_nodes) 3-vectors, dx [m], df [N]."""
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            X, N = position_differences(m, g, b), rest_gradients_of_F(m, b)
            dX = differences(m, g, dx, b, m.real)
            M = rest_gradients(m, b, m.real)
            p = law_constants(m, b, m.real)
            S = zero_forces(m, g)
            for q in range(g.n_points):
                F = deformation_gradient(m, g, X, N, q)
                dF = gradient_at(m, g, dX, M, q, m.real)
                K = g.law.prepare(F, p)
                dP = g.law.dpk1(F, K, dF)
                add_forces(m, g, S, dP, M, q)
            store_forces(m, g, b, S)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        df[i] = elasticity.force(m, i)


@kernel
def gather_forces(m: ti.template(), f: ti.template()):
    """Compute f (n_nodes) [N], the sum of the tets' forces."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        f[i] = elasticity.force(m, i)


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
    """Compute energies and volume ratios of the present state, in f64 with sums in a fixed order.

    scalars: ELASTIC, MIN_J, N_INVERTED, KINETIC, GRAVITY, LOADS, and FIRST_SOFTENED, which is NO_TET if there is none.
    """
    ti.loop_config(serialize=m.serial)
    for c in range(m.chunks):
        energy = broadcast(ti.cast(0.0, ti.f64), m.lanes)
        lowest = broadcast(ti.cast(HUGE, ti.f64), m.lanes)
        inverted = broadcast(ti.cast(0, ti.i32), m.lanes)
        no_tets = broadcast(ti.cast(NO_TET, ti.i32), m.lanes)
        softened = no_tets
        blocks_per_chunk = (m.n_blocks + m.chunks - 1) // m.chunks
        for g in ti.static(m.groups):
            for b in range(ti.max(g.first, c * blocks_per_chunk), ti.min(g.last, (c + 1) * blocks_per_chunk)):
                psi, J, soft = elasticity.element_energy(m, g, b)
                energy += psi
                lowest = ti.min(lowest, J)
                inverted += elasticity.count_inverted(m, b, J)
                tets = ti.Vector([b * m.lanes + q for q in ti.static(range(m.lanes))])
                softened = ti.min(softened, ti.select(soft == 1, tets, no_tets))
        m.state.partial[c, ELASTIC] = _lane_sum(energy)
        m.state.partial[c, MIN_J] = _lane_min(lowest)
        m.state.partial[c, N_INVERTED] = ti.cast(_lane_sum(inverted), ti.f64)
        kinetic, gravity, loads = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        nodes_per_chunk = (m.n_nodes + m.chunks - 1) // m.chunks
        for i in range(c * nodes_per_chunk, ti.min(m.n_nodes, (c + 1) * nodes_per_chunk)):
            kinetic += 0.5 * ti.cast(m.state.v[i], ti.f64).dot(mass_times(m, i, m.state.v))
            gravity += terms.gravity.energy(m, i)
            if ti.static(m.loaded):
                loads += terms.dead_loads.energy(m, i)
        m.state.partial[c, KINETIC], m.state.partial[c, GRAVITY], m.state.partial[c, LOADS] = kinetic, gravity, loads
        m.state.partial[c, FIRST_SOFTENED] = ti.cast(_lane_min(softened), ti.f64)
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
    """Compute the mean of sigma = P F^T / J over each deformed tet, (n_blocks * lanes, 9) [Pa]; not finite for flat tets."""
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            X = differences(m, g, m.state.x, b, ti.f64)
            M = rest_gradients(m, b, ti.f64)
            p = law_constants(m, b, ti.f64)
            volume_ratio = broadcast(ti.cast(0.0, ti.f64), m.lanes)  # deformed volume / rest volume: sum of w_q J_q
            for k in range(9):
                for q in ti.static(range(m.lanes)):
                    sigma[b * m.lanes + q, k] = 0.0
            for q in range(g.n_points):
                F = gradient_at(m, g, X, M, q, ti.f64)
                w = weight_at(m, g, q, ti.f64)
                P = g.law.pk1(F, p)
                T = matmul_nt(P, F)
                volume_ratio += w * determinant(F)
                for k in ti.static(range(9)):
                    for l in ti.static(range(m.lanes)):
                        sigma[b * m.lanes + l, k] += w * T[k][l]
            for k in range(9):
                for q in ti.static(range(m.lanes)):
                    sigma[b * m.lanes + q, k] /= volume_ratio[q]
