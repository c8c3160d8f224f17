"""Forces of connections: of springs, tendons and attachments by springs from their elements, of exact attachments from balance.

Body b acts on an exactly attached node of body a with
    F = m (a - g) + alpha m v - f_el - f_damping - f_loads - f_springs - f_contact + sum w F',
m the node's own mass (its row of the consistent matrix where steps use that), a its mean acceleration in the last step or batch,
f of the node itself at the end: of its own tets with stiffness damping, its loads, springs that end on it, and contacts of the
last substep. F' acts on nodes that are attached to this one by weights w. An attachment to an obstacle has the reaction.
"""

from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.fem import reference
from taisoft.fem.terms.elasticity import sum_elements_with_damping
from taisoft.scene import checks
from taisoft.scene.connection_records import Attachment

if TYPE_CHECKING:
    from taisoft.dynamics.dynamics import Dynamics


@kernel
def _own_forces(m: ti.template(), f: ti.template()):
    """Forces of tets, with stiffness damping, and of loads on the dependent nodes (n) [N], without weight."""
    sum_elements_with_damping(m, 1)
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
    one = scene.connections[checks.index(name, names, "joint_force: no spring, tendon or attachment")]
    if isinstance(one, Attachment) and one.stiffness is None:
        nodes = state.layout.node_start[scene.bodies.index(scene.body(one.a))] + one.nodes
        if one not in scene.dependent_attachments:
            return dynamics.stepper.reactions()[nodes]
        return _dependent_forces(dynamics)[np.searchsorted(state.dependents.node, nodes)]
    x, v = state.state()
    table, is_attachment = state.springs, isinstance(one, Attachment)
    amplitudes = state.amplitudes(state.time)
    forces = (table.pulls if is_attachment else table.tensions)(x, v.astype(np.float64), amplitudes)[table.elements[name]]
    return forces if is_attachment else float(forces[0])


def tensions(dynamics: "Dynamics") -> dict[str, float]:
    """Return the tensions [N] of all springs and tendons, by name."""
    state, scene = dynamics.state, dynamics.scene
    names = [one.name for one in (*scene.springs, *scene.tendons)]
    if not names:
        return {}
    x, v = state.state()
    found = state.springs.tensions(x, v.astype(np.float64), state.amplitudes(state.time))
    return {name: float(found[state.springs.elements[name].start]) for name in names}


def _dependent_forces(dynamics: "Dynamics") -> np.ndarray:
    """The forces F (d,3) [N] on all dependent nodes."""
    state, model, arena = dynamics.state, dynamics.model, FieldArena()
    table, (x, v) = state.dependents, state.state()
    v = v.astype(np.float64)
    state.set_load_time(state.time)
    try:
        own = arena.vectors("own_forces", model.real, model.dependents.n)
        _own_forces(model, own)
        others = own.to_numpy().astype(np.float64)
    finally:
        arena.release()
    if (springs := state.own_springs) is not None:
        pulls = springs.pulls(x, v, state.amplitudes(state.time))[springs.element]
        on_nodes = np.zeros_like(v)
        np.add.at(on_nodes, springs.node, springs.weight[:, None] * pulls)
        others += on_nodes[table.node]
    if dynamics.contact is not None:
        others += dynamics.contact.own_forces()[table.node]
    forces = _inertia(dynamics, v)[table.node] - others
    total = forces
    for _ in dynamics.scene.dependent_attachments:  # longest chain
        total = forces + table.chained.T @ total
    return total


def _inertia(dynamics: "Dynamics", v: np.ndarray) -> np.ndarray:
    """m (a - g) + alpha m v (n_nodes,3) [N] with each body's own masses. v: (n_nodes,3) [m/s]."""
    on, scene, starts = dynamics.plan.on, dynamics.scene, dynamics.state.layout.node_start
    acceleration, total = dynamics.mean_acceleration(np.arange(len(v))), np.zeros_like(v)
    for k, body in enumerate(scene.bodies):
        rows = slice(starts[k], starts[k + 1])
        rates = acceleration[rows] + body.composition.first.mass_damping * v[rows]
        is_quadratic = body.order == 2
        consistent = is_quadratic and on["consistent_mass"]
        total[rows] = reference.consistent_mass(body) @ rates if consistent else reference.lumped_mass(body)[:, None] * rates
        weight = (reference.gravity_mass if is_quadratic and on["consistent_weight"] else reference.lumped_mass)(body)
        total[rows] -= weight[:, None] * scene.gravity
    return total
