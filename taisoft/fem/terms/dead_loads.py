"""Dead loads: tractions and nodal forces that do not depend on x, f_a = F_a(t), psi = -sum_a F_a(t).x_a.

`fem.loads` computes F_a; steppers set it for the time at which they evaluate forces.
"""

import taichi as ti

SWITCH, LOAD, ACCELERATION, STIFFNESS, PREPARED = "loads", True, False, False, False


@ti.func
def force(m: ti.template(), i):
    """Force on node i [N]."""
    return m.loads[i]


@ti.func
def energy(m: ti.template(), i):
    """Node i's part of the potential [J]."""
    return -ti.cast(m.loads[i], ti.f64).dot(m.state.x[i])
