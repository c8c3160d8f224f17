"""Follower pressure: f_i = -p int N_i n dA over the deformed surface, n its outward normal; psi = p V on a closed surface.

V is the volume that the surface encloses, negative where its normals point inward, as those of a cavity do. It is a homogeneous
cubic form, so p V = -sum_i f_i.x_i / 3. On an open surface the force has no potential: its work depends on the border's path.
`fem.pressure` lists the terms of each node. Newton's method takes the symmetric part of -df/dx, which on a closed surface is the
whole; on an open one it converges linearly. A projected matrix leaves it out, since it may be indefinite.
"""

import taichi as ti

SWITCH, LOAD, ACCELERATION, STIFFNESS, PREPARED = "pressure", True, False, True, True


@ti.func
def count(m: ti.template()):
    """Number of nodes in explicit steps, else 0."""
    n = 0
    if ti.static(m.pressure.is_prepared):
        n = m.n_nodes
    return n


@ti.func
def prepare(m: ti.template(), i):
    """Compute the force on node i: explicit steps move one node after the other, which must not change it."""
    if ti.static(m.pressure.is_prepared):
        m.pressure.force[i] = edge_products(m, i, False)


@ti.func
def edge_products(m: ti.template(), i, only_potential: ti.template()):
    """f_i in f64; only_potential: of closed surfaces alone."""
    f = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    x = m.state.x[i]
    for k in range(m.pressure.force_start[i], m.pressure.force_start[i + 1]):
        nodes = m.pressure.force_nodes[k]
        p = m.pressure.force_weight[k] * m.amplitudes[nodes[2]]
        if ti.static(only_potential):
            p *= ti.cast(m.pressure.has_potential[nodes[2]], ti.f64)
        f -= p * (m.state.x[nodes[0]] - x).cross(m.state.x[nodes[1]] - x)
    return f


@ti.func
def force(m: ti.template(), i):
    """Force on node i [N], in explicit steps after `prepare`."""
    f = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    if ti.static(m.pressure.is_prepared):
        f = m.pressure.force[i]
    else:
        f = edge_products(m, i, False)
    return ti.cast(f, m.real)


@ti.func
def energy(m: ti.template(), i):
    """Node i's part of the potential [J], of closed surfaces."""
    return -edge_products(m, i, True).dot(m.state.x[i]) / 3.0


@ti.func
def add_stiffness(m: ti.template(), A: ti.template(), i, beta, projected):
    """Add node i's row of beta^2 times the symmetric part of -df/dx to A."""
    if projected == 0:
        for k in range(m.pressure.stiffness_start[i], m.pressure.stiffness_start[i + 1]):
            nodes = m.pressure.stiffness_nodes[k]
            p = beta * beta * m.pressure.stiffness_weight[k] * m.amplitudes[nodes[2]]
            a = ti.cast(p * (m.state.x[nodes[1]] - m.state.x[nodes[3]]), m.real)
            zero = ti.cast(0.0, m.real)
            cross = ti.Vector([zero, a[2], -a[1], zero, -a[2], zero, a[0], zero, a[1], -a[0], zero, zero])  # [a]x by columns
            if ti.static(m.has_dependents):
                if nodes[0] < 0:
                    A.diagonal[i] = A.diagonal[i] + cross
                else:
                    A.value[nodes[0]] = A.value[nodes[0]] + cross
            else:
                A.value[nodes[0]] = A.value[nodes[0]] + cross
