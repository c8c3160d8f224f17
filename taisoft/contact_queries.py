"""Contacts and overlaps of a simulator's present state and last step: methods of `Simulator`, as in `queries`."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from taisoft.dynamics.readout import offsets_of
from taisoft.errors import SceneError
from taisoft.fem.reference import gravity_mass
from taisoft.queries import body_index, nodes_of
from taisoft.scene import checks
from taisoft.scene.body import Body

if TYPE_CHECKING:
    from taisoft.collision.contacts import Contacts
    from taisoft.collision.overlap import Overlap
    from taisoft.dynamics.surface_loads import ContactPressure
    from taisoft.simulator import Simulator


def touches(self: "Simulator") -> bool:
    """Whether contact forces are simulated."""
    return self.plan.on["contact_forces"]


def contact_limit(self: "Simulator", a: str, b: str) -> float:
    """Penetration [m] of colliders a and b above which a step counts as deep. Requires contact forces (`touches`)."""
    names = [c.name for c in self.scene.colliders]
    return self._host().contact.search.measures.deep_from(names.index(a), names.index(b))


def contact_offset(self: "Simulator") -> float:
    """Gap [m] that contacts of different bodies keep, `CollisionSettings.offset` of an edge; 0 where nothing can touch.

    Contacts marked as `guard` keep half of it, and parts of one body 5 times it.
    """
    contact = self._open().contact
    return 0.0 if contact is None else contact.contact_offset


def detect_contacts(self: "Simulator") -> "Contacts":
    """Detect the contacts of the present state swept by dt v, with impulses 0, without taking a step.

    `Scene.collision` and each body's `collision` choose the method; the plan lists which one each body and obstacle gets.
    Memory and kernels are made at the first call. Raises MeshError if a distance field cannot be made, SimulationError
    if positions or velocities are not finite or a buffer would grow beyond `max_capacity`.
    """
    found = self._open().find_contacts(self.dt).contacts()
    offsets = offsets_of(self.contact_offset, found.body_a == found.body_b, found.guard)
    return replace(found, clearance=found.gap - offsets)


def contacts(self: "Simulator", areas: bool = False) -> "Contacts":
    """Return the contacts of the last step, with gaps at its end [m] and the impulses it applied [N s].

    After a step that was cut into substeps, those of the last substep: then impulse / duration is the force of a contact, and
    impulse / dt is not; `contact_force` is a mean over the whole step. areas: also find tributary areas, which
    takes longer than all the rest. Empty before the first step and if nothing can touch.
    """
    dynamics = self._open()
    if dynamics.contact is not None:
        return dynamics.contact.contacts(areas)
    from taisoft.collision.contacts import no_contacts

    return no_contacts(self.scene)


def contact_pressure(self: "Simulator", body: str, by: str = "node") -> "ContactPressure":
    """Return pressure, traction, state and slip at the surface of a body by "node" or by "triangle", in the last step.

    The record is of the last substep where the step was cut, as `contacts` is. A skin that touches, and a rigid body, have their
    own nodes. Before the first step nothing presses. Raises SceneError for unknown names, for obstacles, and where contact forces
    are not simulated.
    """
    checks.choice(by, "contact_pressure: by", ("node", "triangle"))
    if not self.touches:
        raise SceneError(f"contact_pressure: contact forces are not simulated here ({self.plan.why('contact_forces')})")
    return self._open().contact.pressure(body_index(self, body), by == "triangle")


def contact_force(self: "Simulator", name: str, other: str | None = None) -> np.ndarray:
    """Return the contact force (3,) on a body or an obstacle [N]: from all others, or from `other`, a body or an obstacle.

    It is the mean over the last step, also where that was cut into substeps; in statics that at its end. Raises SceneError for
    unknown names.
    """
    return _mean_contact(self, "contact_force", name, other)[:3]


def contact_torque(self: "Simulator", name: str, other: str | None = None, about=None) -> np.ndarray:
    """Return the torque (3,) [N m] of `contact_force` about a point (3,) [m]; None: a centre of mass, or an obstacle's pivot."""
    found, one = _mean_contact(self, "contact_torque", name, other), self.scene.collider(name)
    if about is not None:
        centre = checks.array(about, "contact_torque: about", ((3,),))
    elif isinstance(one, Body):
        nodes, (x, _) = nodes_of(self, name), self._host().state.state()
        centre = np.average(x[nodes], axis=0, weights=gravity_mass(one))
    else:
        centre = one.shape.pivot + one.pose(self.time)[0]
    return found[3:6] - np.cross(centre, found[:3])


def slip_velocity(self: "Simulator", name: str, other: str | None = None) -> np.ndarray:
    """Return the velocity (3,) [m/s] at which a body or an obstacle slips over `other`, or over all others.

    It is the mean of the tangential relative velocity at their contacts in the last step, weighted by normal impulse; 0 where
    nothing presses. Nodes have their velocity at the end of the step, of each of its substeps where it was cut, and an obstacle
    moves by its displacement over that time. Of a thing that spins in place it is near 0. Raises SceneError for unknown names.
    """
    found = _mean_contact(self, "slip_velocity", name, other)
    return found[6:9] / (found[9] or 1.0)


def pairs_in_contact(self: "Simulator") -> list[tuple[str, str]]:
    """Return the names of the two bodies, or body and obstacle, of each pair that pressed on each other in the last step."""
    contact, names = self._open().contact, [c.name for c in self.scene.colliders]
    pairs, sums = ((), ()) if contact is None else contact.pairs()
    return [(names[a], names[b]) for (a, b), own in zip(pairs, sums) if own[-1] > 0.0]  # the last sum is of normal impulses


def _mean_contact(sim: "Simulator", what: str, name: str, other: str | None) -> np.ndarray:
    """Return `ContactRecord.mean_on` a collider, 0 without contacts. Raises SceneError for invalid names."""
    contact, scene = sim._open().contact, sim.scene
    for one in (name, other):
        if one is not None:
            scene.collider(one)
    if name == other:
        raise SceneError(f"{what}: {name!r} exerts no net force on itself: name another body or obstacle")
    names = [c.name for c in scene.colliders]
    pair = names.index(name), None if other is None else names.index(other)
    return np.zeros(10) if contact is None else contact.mean_on(*pair)


def deepest_overlap(self: "Simulator") -> "Overlap | None":
    """Return the deepest overlapping pair in the present state and its depth [m], or None if nothing overlaps.

    Slow: unlike `StepReport.max_penetration` it checks all pairs, whether or not their surfaces meet. The depth is the
    largest over the vertices, nodes, tet centres and triangle-tet cuts of either that lie inside the other. In a sphere or
    a capsule it is the radius minus the body's distance from the centre or axis.
    """
    return next(iter(self.overlaps()), None)


def overlaps(self: "Simulator") -> "list[Overlap]":
    """Return all overlapping pairs in the present state, deepest relative to the smaller one's size first."""
    from taisoft.collision.overlap import find_overlaps

    return find_overlaps(self._open().find_contacts(0.0))


def intersecting_triangles(self: "Simulator") -> list[tuple[str, int, str, int]]:
    """Return the pairs of surface triangles that intersect in the present state: name and triangle of each, each pair once.

    Triangles are rows of `body.nodes.surface`, or of an obstacle's surface. Pairs within one body are included only with
    self_collision; triangles that share a vertex are left out.
    """
    detection = self._open().find_contacts(0.0)
    first, colliders = detection.topology.first, self.scene.colliders
    pairs = detection.intersections()
    owner = np.searchsorted(first, pairs, side="right") - 1
    return [(colliders[a].name, int(t - first[a]), colliders[b].name, int(u - first[b])) for (t, u), (a, b) in zip(pairs, owner)]
