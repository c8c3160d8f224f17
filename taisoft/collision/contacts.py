"""Contacts of surfaces that touch or will touch within the step, as fields for kernels and as a record for the host.

A contact has a side a and a side b, each a point on up to three nodes with weights that sum to 1; an obstacle is always b and
has no nodes. The normal is a unit vector from b to a; the gap is the signed distance of the two points along it, negative in
penetration. A feature identifies the pair of mesh features in contact, and persists while they stay in contact.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel

# kinds of contacts; their two ids are: vertex and triangle; edge and edge (3 triangle + local edge); vertex and collider;
# triangle and collider
VERTEX_FACE, EDGE_EDGE, VERTEX_FIELD, FACE_FIELD = 0, 1, 2, 3
KINDS = ("vertex_face", "edge_edge", "vertex_field", "face_field")


@dataclass(frozen=True, eq=False)
class ContactFields:
    """A buffer of contacts, for kernels."""

    point: Any  # 3-vectors f64: midway between the two surface points [m]
    normal: Any  # 3-vectors f64
    gap: Any  # f64 [m]
    body: Any  # 2-vectors i32: colliders
    feature: Any  # 3-vectors i32: kind and two ids
    nodes_a: Any  # 3-vectors i32: vertices of the surface, -1 for unused entries
    nodes_b: Any
    weights_a: Any  # 3-vectors f64
    weights_b: Any


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts on the host, all arrays (k, ...) and in an order that does not depend on threads."""

    point: np.ndarray  #: (k,3) midway between the two surface points [m]
    normal: np.ndarray  #: (k,3) unit vectors from b to a
    gap: np.ndarray  #: (k,) [m], negative for a penetration
    impulse: np.ndarray  #: (k,3) on a [N s]; b gets the opposite
    body_a: np.ndarray  #: (k,) names
    body_b: np.ndarray  #: (k,) names; an obstacle is always b
    nodes: np.ndarray  #: (k,6) three of each side, numbered over all bodies, -1 where there is none
    weights: np.ndarray  #: (k,6) of these nodes, 0 where there is none
    kind: np.ndarray  #: (k,) "vertex_face", "edge_edge", "vertex_field" or "face_field"
    feature: np.ndarray  #: (k,2) ids that stay while the same two features meet
    friction: np.ndarray  #: (k,) of the pair
    restitution: np.ndarray  #: (k,) of the pair
    found: int  #: contacts before the reduction
    unmapped: int  #: triangles whose tet is inverted, so that a distance field could not be used

    def __len__(self) -> int:
        return len(self.gap)


def no_contacts() -> Contacts:
    """Return an empty record."""
    names, integers = np.zeros(0, dtype=object), np.zeros((0, 2), dtype=np.int64)
    vectors, numbers = np.zeros((0, 3)), np.zeros(0)
    return Contacts(
        vectors,
        vectors,
        numbers,
        vectors,
        names,
        names,
        np.zeros((0, 6), dtype=np.int64),
        np.zeros((0, 6)),
        names,
        integers,
        numbers,
        numbers,
        0,
        0,
    )


def contact_fields(arena: FieldArena, capacity: int) -> ContactFields:
    """Allocate a buffer for `capacity` contacts."""

    def vectors(name: str, dtype, n: int = 3):
        return arena.vectors(f"contact_{name}", dtype, capacity, n=n)

    return ContactFields(
        vectors("point", ti.f64),
        vectors("normal", ti.f64),
        arena.field("contact_gap", ti.f64, capacity),
        vectors("body", ti.i32, 2),
        vectors("feature", ti.i32),
        vectors("nodes_a", ti.i32),
        vectors("nodes_b", ti.i32),
        vectors("weights_a", ti.f64),
        vectors("weights_b", ti.f64),
    )


@ti.func
def _lowest_vertex(nodes):
    """Lowest vertex that is not -1."""
    lowest = nodes[0]
    for k in ti.static(range(1, 3)):
        if nodes[k] >= 0 and nodes[k] < lowest:
            lowest = nodes[k]
    return lowest


@ti.func
def write_contact(out: ti.template(), at, last, body_a, body_b, feature, point_a, n, gap, nodes_a, weights_a, nodes_b, weights_b):
    """Write a contact if it fits. n points from b to a.

    Sides are swapped so that a is the collider of lower index or, within one body, the side with the lowest vertex. A contact
    found from both sides is then stored identically.
    """
    if at < last:
        out.point[at] = point_a - 0.5 * gap * n
        out.gap[at] = gap
        out.feature[at] = feature
        sign = ti.cast(1.0, ti.f64)
        lowest_a, lowest_b = _lowest_vertex(nodes_a), _lowest_vertex(nodes_b)
        if body_a > body_b or (body_a == body_b and lowest_a > lowest_b):
            sign = -1.0
        out.normal[at] = sign * n
        out.body[at] = ti.Vector([ti.min(body_a, body_b), ti.max(body_a, body_b)])
        for q in ti.static(range(3)):  # entry by entry: the compiler fails when a vector argument is stored whole
            out.nodes_a[at][q] = ti.select(sign > 0.0, nodes_a[q], nodes_b[q])
            out.nodes_b[at][q] = ti.select(sign > 0.0, nodes_b[q], nodes_a[q])
            out.weights_a[at][q] = ti.select(sign > 0.0, weights_a[q], weights_b[q])
            out.weights_b[at][q] = ti.select(sign > 0.0, weights_b[q], weights_a[q])


@kernel
def gather_contacts(
    out: ti.template(), index: ti.template(), n: ti.i32, floats: ti.types.ndarray(), integers: ti.types.ndarray()
):
    """Copy the contacts index[:n] for `gather`: floats (n,13) and integers (n,11)."""
    ti.loop_config(serialize=True)
    for i in range(n):
        at = index[i]
        floats[i, 12] = out.gap[at]
        for q in ti.static(range(3)):
            floats[i, q], floats[i, 3 + q] = out.point[at][q], out.normal[at][q]
            floats[i, 6 + q], floats[i, 9 + q] = out.weights_a[at][q], out.weights_b[at][q]
            integers[i, 2 + q] = out.feature[at][q]
            integers[i, 5 + q], integers[i, 8 + q] = out.nodes_a[at][q], out.nodes_b[at][q]
        for q in ti.static(range(2)):
            integers[i, q] = out.body[at][q]


def gather(out: ContactFields, index: Any, n: int) -> dict[str, np.ndarray]:
    """Download the contacts at the buffer indices index[:n], (n, ...) each: point, normal, gap, body, feature, and nodes and
    weights (n,6) of both sides."""
    floats, integers = np.zeros((n, 13)), np.zeros((n, 11), dtype=np.int32)
    if n:
        gather_contacts(out, index, n, floats, integers)
    return {
        "point": floats[:, :3],
        "normal": floats[:, 3:6],
        "weights": floats[:, 6:12],
        "gap": floats[:, 12],
        "body": integers[:, :2],
        "feature": integers[:, 2:5],
        "nodes": integers[:, 5:],
    }
