"""Mass damping: f = -a M v, a [1/s] of the node's body. Symplectic Euler takes it as 1 - dt a, Verlet as exp(-dt a / 2) twice."""

import taichi as ti


@ti.func
def rate(m: ti.template(), i):
    """a of node i [1/s]."""
    return m.damping[m.node_body[i], 0]


@ti.func
def force(m: ti.template(), i, v):
    """On node i with lumped mass [N]."""
    return -rate(m, i) * m.mass[i] * v


@ti.func
def decay(m: ti.template(), i, time):
    """What a free velocity keeps over a time [s]."""
    return ti.exp(-time * rate(m, i))
