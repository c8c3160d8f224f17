"""Where an implicit stage is out of balance: the node with the largest residual, and the forces there.

Forces of connections, cavities and contacts are evaluated on the host; what remains of the node's balance,
    f_el = (M (v - v_hat) - r) / beta - the others,
is that of its tets, with damping and given loads. Weakness: a consistent mass is taken as lumped.
"""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend.arrays import download
from taisoft.contact.problem import read_entries
from taisoft.fem.pressure import pressures_of
from taisoft.scene.loads import Cavity
from taisoft.scene.rigid import RigidBody

if TYPE_CHECKING:
    from taisoft.dynamics.contact import ContactStep
    from taisoft.dynamics.no_contacts import NoContacts
    from taisoft.dynamics.simulation_state import SimulationState
    from taisoft.dynamics.stage_system import StageSystem

SMALL = 0.1  # of the largest force at the node: those below it are not named
NAMED, PAIRS = 2, 3  # forces and pairs that are named


def describe_imbalance(simulation: "SimulationState", system: "StageSystem", contact: "ContactStep | NoContacts") -> str:
    """Name the node with the largest residual of the stage just solved, and the largest forces there; "" if it is not finite.

    Where the forces are balanced, name the colliders between which the contact laws do not hold.
    """
    if contact.n_contacts and system.is_balanced:
        return f"the contact laws do not hold yet between {_pairs(contact)}"
    m, w, beta, layout = simulation.model, system.work, system.stage.beta, simulation.layout
    free, residual, x, v, x_hat, v_hat, mass = download([m.free, w.residual, m.state.x, m.state.v, w.x_hat, w.v_hat, m.mass])
    size = np.linalg.norm(free * residual.astype(np.float64), axis=1) * system.pieces.node_weights()
    if not np.isfinite(size).all() or not size.any():
        return ""
    i = int(np.argmax(size))
    k = int(np.searchsorted(layout.node_start, i, side="right")) - 1
    forces = _connections(simulation, x, v.astype(np.float64), i) | _cavities(simulation, x, i) | _contacts(contact, i, beta)
    inertia = system.stage.c * mass[i] * ((x[i] - x_hat[i]) / beta - v_hat[i]) / beta
    forces["inertia"] = -inertia
    loaded = m.loaded or simulation.scene.bodies[k].pressures
    forces["its tets" + (" and loads" if loaded else "")] = -residual[i] / beta - sum(forces.values())
    named = sorted(((float(np.linalg.norm(free[i] * f)), name) for name, f in forces.items()), reverse=True)
    texts = [f"{name} ({f:.3g} N)" for f, name in named[:NAMED] if f > SMALL * named[0][0]]
    body = simulation.scene.bodies[k]
    node = "" if isinstance(body, RigidBody) else f"node {i - layout.node_start[k] - body.selectable.start} of "
    return f"least balanced is {node}body '{body.name}', between {' and '.join(texts)}"


def _connections(simulation: "SimulationState", x: np.ndarray, v: np.ndarray, i: int) -> dict[str, np.ndarray]:
    """Force [N] on node i by each spring, tendon and attachment that ends there."""
    table = simulation.springs
    if table is None:
        return {}
    amplitudes = simulation.model.amplitudes
    pulls = table.pulls(x, v, amplitudes.to_numpy() if amplitudes is not None else np.zeros(0))
    entries, found = np.flatnonzero(table.node == i), {}
    element = table.element[entries]
    for one in [one for one in simulation.scene.connections if one.name in table.elements]:
        where = table.elements[one.name]
        own = (element >= where.start) & (element < where.stop)
        if own.any():
            found[f"{type(one).__name__.lower()} '{one.name}'"] = table.weight[entries[own]] @ pulls[element[own]]
    return found


def _cavities(simulation: "SimulationState", x: np.ndarray, i: int) -> dict[str, np.ndarray]:
    """Force [N] on node i by each cavity around it."""
    found, amplitudes = {}, simulation.model.amplitudes
    for (_, load), pressure in zip(pressures_of(simulation.scene), amplitudes.to_numpy() if amplitudes is not None else ()):
        if isinstance(load, Cavity):
            form = simulation.cavity_form(load.name)
            gradient = form.value_and_gradient(x)[1][form.nodes == i]
            if len(gradient):
                found[f"cavity '{load.name}'"] = pressure * gradient.sum(axis=0)
    return found


def _pairs(contact: "ContactStep") -> str:
    """The pairs of colliders in contact, the first few of them."""
    names = [one.name for one in contact.detection.scene.colliders]
    (collider,) = download([contact.problem.body], contact.n_contacts)
    pairs = [f"'{names[a]}' and '{names[b]}'" for a, b in np.unique(collider, axis=0)]
    return ", ".join(pairs[:PAIRS]) + (", ..." if len(pairs) > PAIRS else "")


def _contacts(contact: "ContactStep | NoContacts", i: int, beta: float) -> dict[str, np.ndarray]:
    """Force [N] on node i by its contacts with each pair of colliders."""
    if contact.n_contacts == 0:
        return {}
    problem, names, found = contact.problem, [one.name for one in contact.detection.scene.colliders], {}
    arrays = problem.normal, problem.tangent, problem.r, problem.body
    normal, tangent, r, collider = download(arrays, contact.n_contacts)
    impulse = r[:, :1] * normal + r[:, 1:2] * tangent + r[:, 2:] * np.cross(normal, tangent)
    row, node, weight = read_entries(problem)
    for at in np.flatnonzero(node == i):
        c = row[at]
        what = "contact of " + " and ".join(f"'{names[side]}'" for side in collider[c])
        found[what] = found.get(what, 0.0) + weight[at] * impulse[c] / beta
    return found
