"""Gravity: f_a = m_a g, psi = -sum_a m_a g.x_a.

m_a is the lumped mass, or int rho N_a dV on quadratic tets in implicit steps. Explicit steps use the acceleration g.
"""

import taichi as ti

SWITCH, LOAD, ACCELERATION, STIFFNESS, PREPARED = None, True, True, False, False


@ti.func
def force(m: ti.template(), i):
    """Force on node i [N]."""
    return m.gravity_mass[i] * m.gravity[0]


@ti.func
def acceleration(m: ti.template(), i):
    """Acceleration of node i [m/s^2]."""
    return m.gravity[0]


@ti.func
def energy(m: ti.template(), i):
    """Node i's part of the potential [J]."""
    return -ti.cast(m.gravity_mass[i], ti.f64) * ti.cast(m.gravity[0], ti.f64).dot(m.state.x[i])
