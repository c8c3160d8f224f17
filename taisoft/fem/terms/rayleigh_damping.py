"""Rayleigh damping: f = -(a M + b K_d) v, with a [1/s] and b [s] of the node's body and K_d the projected stiffness.

Mass damping a: symplectic Euler scales v by 1 - dt a, velocity Verlet twice by exp(-dt a / 2).
Stiffness damping b: explicit steps evaluate K_d at the present x inside the element loop (`elasticity.element_force`); implicit
steps assemble it at the start of the step.
"""

from typing import Any

import numpy as np
import taichi as ti

from taisoft.fem.model import Setup
from taisoft.ranges import owners
from taisoft.scene.scene import Scene


def damping_table(scene: Scene) -> np.ndarray:
    """Mass damping [1/s] and stiffness damping [s] of each body (n_bodies, 2)."""
    materials = [body.composition.first for body in scene.bodies]
    return np.array([[material.mass_damping, material.stiffness_damping] for material in materials])


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: the rates of each body, and the body of each node, if any is damped."""
    by_stiffness = setup.on["stiffness_damping"]
    if not (setup.on["mass_damping"] or by_stiffness):
        return {}
    return {
        "damped": True,
        "stiffness_damping": by_stiffness,
        "node_body": setup.arena.filled("node_body", ti.i32, owners(np.diff(setup.layout.node_start))),
        "damping": setup.arena.filled("damping", setup.runtime.real, damping_table(setup.scene)),
    }


@ti.func
def mass_rate(m: ti.template(), i):
    """a of node i [1/s]."""
    return m.damping[m.node_body[i], 0]


@ti.func
def mass_force(m: ti.template(), i, v):
    """Force of mass damping on node i with lumped mass [N]."""
    return -mass_rate(m, i) * m.mass[i] * v


@ti.func
def mass_decay(m: ti.template(), i, time):
    """Factor by which mass damping slows a free velocity over a time [s]."""
    return ti.exp(-time * mass_rate(m, i))


@ti.func
def stiffness_rate(m: ti.template(), i):
    """b of node i [s]."""
    return m.damping[m.node_body[i], 1]


@ti.func
def stiffness_force(m: ti.template(), i, Kv):
    """Force of stiffness damping on node i [N]. Kv: its row of K_d v [N/s]."""
    return -stiffness_rate(m, i) * Kv
