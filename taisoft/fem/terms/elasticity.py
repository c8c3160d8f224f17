"""Elasticity: f_a = -sum_e V sum_q w_q P(F_q) grad N_a, psi = sum_e V sum_q w_q psi(F_q).

Each tet writes its nodal forces to a buffer, and each node gathers them in a fixed order, so the result does not depend on
threading. The blocks -df/dx are in `linear.element_blocks`. The differential, without assembly, is Algorithm 8 of She, "Soft Body
Simulation" (University of Copenhagen), at every quadrature point, with two corrections: dH = -V dP(F; dF) M^T with M = Dm^-1
(M^-T there), and the fourth corner's force belongs to vertex 0.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.chunks import block_first
from taisoft.fem.dependents import place_all
from taisoft.fem.lanes import (
    add_forces,
    broadcast,
    deformation_gradient,
    differences,
    gather,
    gradient_at,
    law_constants,
    position_differences,
    rest_gradients,
    rest_gradients_of_F,
    store_forces,
    volumes,
    weight_at,
    with_additions,
    zero_forces,
)
from taisoft.fem.laws import dpk1_projected, prepare_projected
from taisoft.fem.math3 import determinant, matmul_nt, matmul_tn
from taisoft.fem.mean_dilatation import find_dilatations, find_rates, patch_energy, patch_values, stress_constants
from taisoft.fem.state import FAILED, INVERTED_NOW, LOWEST_J, OTHER_SUM, SUM

SWITCH, LOAD, ACCELERATION, STIFFNESS, PREPARED = None, False, False, False, False
HUGE = 1e30  # above any volume ratio
EXPLODED = 1e9  # |J| of an inverted tet beyond which a motion has diverged: stretched a thousandfold along every axis


@ti.func
def element_force(m: ti.template(), g: ti.template(), damped: ti.template(), b):
    """Write the nodal forces of block b of group g at x, and with `damped` the stiffness damping -c K(x) v.

    Returns the smallest J = det F over each tet's quadrature points.
    """
    X, N = position_differences(m, g, b), rest_gradients_of_F(m, g, b)
    M = rest_gradients(m, b, g.real)
    p = stress_constants(m, g, b, g.real)
    S = zero_forces(m, g)
    lowest = broadcast(ti.cast(HUGE, m.real), m.lanes)
    if ti.static(damped):
        V = differences(m, g, m.state.v, b, g.real)
        c = broadcast(ti.cast(m.damping[m.block_body[b], 1], g.real), m.lanes)
        for q in range(g.n_points):
            F = deformation_gradient(m, g, X, N, b, q, g.real)
            dF = gradient_at(m, g, V, M, b, q, g.real)
            c_q = with_additions(m, g, p, b, q, g.real)
            K = prepare_projected(g.law, F, c_q)
            D = dpk1_projected(g.law, K, dF)
            P = g.law.pk1(F, c_q)
            Q = [P[k] + c * D[k] for k in ti.static(range(9))]
            if ti.static(g.mean_dilatation):
                G = g.law.dilatation_gradient(F)
                r = c * patch_values(m, b, m.mean.rate, m.real)
                add_forces(m, g, S, [Q[k] + r * G[k] for k in ti.static(range(9))], M, b, q)
            else:
                add_forces(m, g, S, Q, M, b, q)
            lowest = ti.min(lowest, ti.cast(determinant(F), m.real))
    else:
        for q in range(g.n_points):
            F = deformation_gradient(m, g, X, N, b, q, g.real)
            P = g.law.pk1(F, with_additions(m, g, p, b, q, g.real))
            add_forces(m, g, S, P, M, b, q)
            lowest = ti.min(lowest, ti.cast(determinant(F), m.real))
    store_forces(m, g, b, S)
    return lowest


@ti.func
def force(m: ti.template(), i):
    """Force on node i [N], after `element_force` has run over all blocks."""
    return gather(m, i)


@ti.func
def count_inverted(m: ti.template(), b, J):
    """Per lane, 1 if the tet has J <= 0, else 0. Padding lanes, whose volume is 0, count 0."""
    V = volumes(m, b, m.real)
    zero = broadcast(ti.cast(0, ti.i32), m.lanes)
    return ti.select((J <= 0.0) & (V > 0.0), zero + 1, zero)


@ti.func
def record_volumes(m: ti.template(), J, bad):
    """Update the scalars LOWEST_J and INVERTED_NOW by lanes of J and of inverted tets; set FAILED if a tet has exploded.

    Most tets change neither, and atomics on one address wait for each other.
    """
    low, count = lowest_and_count(m, J, bad)
    if ti.cast(low, ti.f64) < m.state.scalars[LOWEST_J]:
        ti.atomic_min(m.state.scalars[LOWEST_J], ti.cast(low, ti.f64))
    if count > 0:
        ti.atomic_add(m.state.scalars[INVERTED_NOW], ti.cast(count, ti.f64))
    if not low > -EXPLODED:
        m.state.scalars[FAILED] = 1.0


@ti.func
def lowest_and_count(m: ti.template(), J, bad):
    """Smallest J and sum of `bad` over the lanes."""
    return J.min(), bad.sum()


@ti.func
def sum_elements(m: ti.template()):
    """Run `element_force` over all blocks and prepare other terms, as top-level loops of a kernel."""
    place_all(m)
    find_dilatations(m)
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            element_force(m, g, False, b)
    prepare_terms(m)


@ti.func
def prepare_terms(m: ti.template()):
    """Prepare the forces of other terms, as top-level loops of a kernel."""
    for term in ti.static(m.terms):
        if ti.static(term.PREPARED):
            ti.loop_config(serialize=m.serial)
            for k in range(term.count(m)):
                term.prepare(m, k)


@ti.func
def sum_elements_with_damping(m: ti.template(), go):
    """As `sum_elements` over all blocks, with stiffness damping if it is on.

    go: 1, or 0 to leave out the elements. scalars: LOWEST_J, INVERTED_NOW, FAILED.
    """
    place_all(m)
    find_dilatations(m)
    if ti.static(m.stiffness_damping):
        find_rates(m, m.state.v)
    if ti.static(m.on_cpu):
        ti.loop_config(serialize=m.serial)
        for task in range(m.chunks * m.spread):
            if task % m.spread == 0 and go == 1:
                J, bad = sum_chunk(m, task // m.spread)
                low, count = lowest_and_count(m, J, bad)
                m.state.partial[task // m.spread, SUM] = ti.cast(low, ti.f64)
                m.state.partial[task // m.spread, OTHER_SUM] = ti.cast(count, ti.f64)
        ti.loop_config(serialize=True)
        for c in range(go * m.chunks):
            low = m.state.partial[c, SUM]
            m.state.scalars[LOWEST_J] = ti.min(m.state.scalars[LOWEST_J], low)
            m.state.scalars[INVERTED_NOW] = m.state.scalars[INVERTED_NOW] + m.state.partial[c, OTHER_SUM]
            if not low > -EXPLODED:
                m.state.scalars[FAILED] = 1.0
    else:
        for g in ti.static(m.groups):
            for b in range(g.first, ti.select(go == 1, g.last, g.first)):
                J = element_force(m, g, m.stiffness_damping, b)
                record_volumes(m, J, count_inverted(m, b, J))
    prepare_terms(m)


@ti.func
def sum_chunk(m: ti.template(), c):
    """Run `element_force` over the blocks of chunk c. Return the smallest J and the number of inverted tets, per lane."""
    lowest = broadcast(ti.cast(HUGE, m.real), m.lanes)
    inverted = broadcast(ti.cast(0, ti.i32), m.lanes)
    for g in ti.static(m.groups):
        for b in range(block_first(g, c, m.chunks), block_first(g, c + 1, m.chunks)):
            J = element_force(m, g, m.stiffness_damping, b)
            lowest = ti.min(lowest, J)
            inverted += count_inverted(m, b, J)
    return lowest, inverted


@ti.func
def element_energy(m: ti.template(), g: ti.template(), b):
    """Elastic energy [J], smallest J over the quadrature points and softening flag of block b of group g, per lane, in f64.

    The flag is 1 if the law softens below a stretch s and the tet is compressed below s at a quadrature point, else 0. It is
    if F^T F - s^2 I is not positive definite, which is tested by its leading minors.
    """
    X = differences(m, g, m.state.x, b, ti.f64)
    M = rest_gradients(m, b, ti.f64)
    p = law_constants(m, g, b, ti.f64)
    V = volumes(m, b, ti.f64)
    energy = broadcast(ti.cast(0.0, ti.f64), m.lanes)
    if ti.static(g.mean_dilatation):
        energy += V * patch_energy(m, b)
    lowest = broadcast(ti.cast(HUGE, ti.f64), m.lanes)
    minor = broadcast(ti.cast(HUGE, ti.f64), m.lanes)
    for q in range(g.n_points):
        F = gradient_at(m, g, X, M, b, q, ti.f64)
        energy += weight_at(m, g, b, q, ti.f64) * V * g.law.psi(F, with_additions(m, g, p, b, q, ti.f64))
        lowest = ti.min(lowest, determinant(F))
        if ti.static(g.law.SOFTENS_BELOW > 0.0):
            C = matmul_tn(F, F)
            square = ti.static(g.law.SOFTENS_BELOW**2)
            D = [C[k] - (square if ti.static(k % 4 == 0) else 0.0) for k in ti.static(range(9))]
            minor = ti.min(minor, D[0], D[0] * D[4] - D[1] * D[3], determinant(D))
    one = broadcast(ti.cast(1, ti.i32), m.lanes)
    return energy, lowest, ti.select(minor <= 0.0, one, one - 1)


@kernel
def elastic_forces(m: ti.template()):
    """Fill the element force buffer from x; `gather_forces` sums it over nodes."""
    sum_elements(m)


@kernel
def force_differential(m: ti.template(), dx: ti.template(), df: ti.template()):
    """Compute df = (df/dx)(x) dx, matrix-free: (n_nodes) 3-vectors, dx [m], df [N]."""
    find_dilatations(m)
    find_rates(m, dx)
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            X, N = position_differences(m, g, b), rest_gradients_of_F(m, g, b)
            dX = differences(m, g, dx, b, m.real)
            M = rest_gradients(m, b, m.real)
            p = stress_constants(m, g, b, m.real)
            S = zero_forces(m, g)
            for q in range(g.n_points):
                F = deformation_gradient(m, g, X, N, b, q, m.real)
                dF = gradient_at(m, g, dX, M, b, q, m.real)
                K = g.law.prepare(F, with_additions(m, g, p, b, q, m.real))
                dP = g.law.dpk1(F, K, dF)
                if ti.static(g.mean_dilatation):
                    G = g.law.dilatation_gradient(F)
                    r = patch_values(m, b, m.mean.rate, m.real)
                    add_forces(m, g, S, [dP[k] + r * G[k] for k in ti.static(range(9))], M, b, q)
                else:
                    add_forces(m, g, S, dP, M, b, q)
            store_forces(m, g, b, S)
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        df[i] = force(m, i)


@kernel
def gather_forces(m: ti.template(), f: ti.template()):
    """Compute f (n_nodes) [N], the sum of the tets' forces."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        f[i] = force(m, i)


@kernel
def cauchy_stress(m: ti.template(), sigma: ti.types.ndarray()):
    """Compute the mean of sigma = P F^T / J over each deformed tet, (n_blocks * lanes, 9) [Pa]; not finite for flat tets."""
    find_dilatations(m)
    for g in ti.static(m.groups):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            X = differences(m, g, m.state.x, b, ti.f64)
            M = rest_gradients(m, b, ti.f64)
            p = stress_constants(m, g, b, ti.f64)
            volume_ratio = broadcast(ti.cast(0.0, ti.f64), m.lanes)  # deformed volume / rest volume: sum of w_q J_q
            for k in range(9):
                for q in ti.static(range(m.lanes)):
                    sigma[b * m.lanes + q, k] = 0.0
            for q in range(g.n_points):
                F = gradient_at(m, g, X, M, b, q, ti.f64)
                w = weight_at(m, g, b, q, ti.f64)
                P = g.law.pk1(F, with_additions(m, g, p, b, q, ti.f64))
                T = matmul_nt(P, F)
                volume_ratio += w * determinant(F)
                for k in ti.static(range(9)):
                    for l in ti.static(range(m.lanes)):
                        sigma[b * m.lanes + l, k] += (w * T[k])[l]
            for k in range(9):
                for q in ti.static(range(m.lanes)):
                    sigma[b * m.lanes + q, k] /= volume_ratio[q]
