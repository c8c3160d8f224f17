"""Forces of connections: of springs, tendons and attachments by springs from their elements, of exact attachments from balance.

Body b acts on an exactly attached node of body a with m (a - g) - f, where m is the node's own lumped mass, a its acceleration,
the mean over the last step or batch of explicit steps, g gravity, and f the force of its own tets and loads at the end, without
damping. Contacts and springs at the node act on body b at once, and are not part of it.
"""

from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.errors import SceneError
from taisoft.fem import reference
from taisoft.fem.terms.elasticity import elastic_forces
from taisoft.scene.checks import nearest
from taisoft.scene.connection_records import Attachment

if TYPE_CHECKING:
    from taisoft.dynamics.dynamics import Dynamics


@kernel
def _own_forces(m: ti.template(), f: ti.template()):
    """Forces of all terms on the dependent nodes (n) [N], without weight; after `elastic_forces`."""
    ti.loop_config(serialize=m.serial)
    for k in range(m.dependents.n):
        total = ti.Vector([0.0, 0.0, 0.0], m.real)
        for term in ti.static(m.terms):
            if ti.static(not term.ACCELERATION):
                total += term.force(m, m.dependents.node[k])
        f[k] = total


def joint_force(dynamics: "Dynamics", name: str) -> float | np.ndarray:
    """Return the tension [N] of a spring or tendon, or the forces (k,3) [N] on the nodes of an attachment. Raises SceneError."""
    scene, state = dynamics.scene, dynamics.state
    names = [one.name for one in scene.connections]
    if name not in names:
        raise SceneError(f"joint_force: no spring, tendon or attachment is called {name!r}{nearest(str(name), names)}")
    one = scene.connections[names.index(name)]
    if isinstance(one, Attachment) and one.stiffness is None:
        nodes = state.layout.node_start[scene.bodies.index(scene.body(one.a))] + one.nodes
        if one not in scene.dependent_attachments:
            return dynamics.stepper.reactions()[nodes]
        return _exact(dynamics, one, nodes)
    x, v = state.state()
    table, is_attachment = state.springs, isinstance(one, Attachment)
    amplitudes = state.amplitudes(state.time)
    forces = (table.pulls if is_attachment else table.tensions)(x, v.astype(np.float64), amplitudes)[table.elements[name]]
    return forces if is_attachment else float(forces[0])


def _exact(dynamics: "Dynamics", one: Attachment, nodes: np.ndarray) -> np.ndarray:
    state, model, arena = dynamics.state, dynamics.model, FieldArena()
    body = dynamics.scene.body(one.a)
    state.set_load_time(state.time)
    elastic_forces(model)
    try:
        forces = arena.vectors("own_forces", model.real, model.dependents.n)
        _own_forces(model, forces)
        own = forces.to_numpy().astype(np.float64)[np.searchsorted(state.dependents.node, nodes)]
    finally:
        arena.release()
    consistent = dynamics.plan.on["consistent_weight"] and body.order == 2
    weight = (reference.gravity_mass if consistent else reference.lumped_mass)(body)[one.nodes]
    mass = reference.lumped_mass(body)[one.nodes]
    acceleration = dynamics.mean_acceleration(nodes)
    return mass[:, None] * acceleration - weight[:, None] * dynamics.scene.gravity - own
