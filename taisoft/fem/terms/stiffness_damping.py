"""Stiffness damping: f = -b K_d v, b [s] of the node's body, K_d the projected stiffness.

Explicit steps evaluate K_d at the present x inside the element loop (`elasticity.element_force`); implicit steps assemble it at
the start of the step.
"""

import taichi as ti


@ti.func
def rate(m: ti.template(), i):
    """b of node i [s]."""
    return m.damping[m.node_body[i], 1]


@ti.func
def force(m: ti.template(), i, Kv):
    """Force on node i [N]. Kv: its row of K_d v [N/s]."""
    return -rate(m, i) * Kv
