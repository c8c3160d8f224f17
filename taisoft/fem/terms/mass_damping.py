"""Mass damping: f = -a M v, a [1/s] of the node's body.

Symplectic Euler scales v by 1 - dt a, velocity Verlet twice by exp(-dt a / 2).
"""

import taichi as ti


@ti.func
def rate(m: ti.template(), i):
    """a of node i [1/s]."""
    return m.damping[m.node_body[i], 0]


@ti.func
def force(m: ti.template(), i, v):
    """Force on node i with lumped mass [N]."""
    return -rate(m, i) * m.mass[i] * v


@ti.func
def decay(m: ti.template(), i, time):
    """Factor by which a free velocity decays over a time [s]."""
    return ti.exp(-time * rate(m, i))
