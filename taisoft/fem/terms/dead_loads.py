"""Dead loads: tractions and nodal forces of constant direction and magnitude, f_a = F_a, psi = -sum_a F_a.x_a."""

import taichi as ti

SWITCH, LOAD, ACCELERATION = "loads", True, False


@ti.func
def force(m: ti.template(), i):
    """Force on node i [N]."""
    return m.loads[i]


@ti.func
def energy(m: ti.template(), i):
    """Node i's part of the potential [J]."""
    return -ti.cast(m.loads[i], ti.f64).dot(m.state.x[i])
