"""Contacts of surfaces that touch or will touch within the step: fields for kernels, and a record for the host.

A contact has a side a and a side b, each a point on up to three nodes, of mortar contacts more, with weights that sum to 1; an
obstacle is always b and has no nodes. The normal is a unit vector from b to a; the gap is the signed distance of the two points
along it, negative in penetration. A feature identifies the pair of mesh features in contact, and persists while they stay in
contact.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Array, FieldArena
from taisoft.backend.reader import read_each
from taisoft.collision.candidates import Buffer
from taisoft.collision.surface import dvec, ivec
from taisoft.display import short_repr
from taisoft.ranges import expand
from taisoft.scene.scene import Scene

# kinds of contacts; their two ids are: vertex and triangle; edge and edge (3 triangle + local edge); vertex and collider;
# triangle and collider; a passage (`passages`); vertex and collider (`mortar`)
VERTEX_FACE, EDGE_EDGE, VERTEX_FIELD, FACE_FIELD, FACE_FACE, MORTAR = range(6)
STATES = ("open", "stick", "slip")
KINDS = ("vertex_face", "edge_edge", "vertex_field", "face_field", "face_face", "mortar")
# capacity for vertices of mortar contacts, over that for contacts: at first; at most, since a list that does not fit is overrated
LISTED, MOST_LISTED = 8, 64


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
    weights_a: Any  # 3-vectors f64, 0 for mortar contacts
    weights_b: Any
    guard: Any  # i32: 1 where a mortar contact carries the load
    area: Any  # f64: of mortar contacts, 0 for others [m^2]
    carried: Any  # 3-vectors f64: of mortar contacts, displacement of the obstacle in the step [m]
    entries: Any  # 3-vectors i32: of mortar contacts, the first of their vertices, how many are of side a, and of both
    vertex: Any = None  # i32; None if there can be no mortar contacts
    weight: Any = None  # f64: of those vertices, with a sum of 1 on each side

    @property
    def has_mortar(self) -> bool:
        """Whether there can be mortar contacts."""
        return self.vertex is not None

    @ti.func
    def is_mortar(self, at):
        """Whether a contact is a mortar contact."""
        result = False
        if ti.static(self.has_mortar):
            result = self.feature[at][0] == MORTAR
        return result

    @ti.func
    def moved(self, at, x: ti.template()):
        """Difference (3,) between the sides of a mortar contact in the mean of a field of vertices, that of an obstacle 0."""
        total = dvec(0.0)
        if ti.static(self.has_mortar):
            first, n_a = self.entries[at][0], self.entries[at][1]
            for k in range(first, first + self.entries[at][2]):
                total += ti.select(k - first < n_a, self.weight[k], -self.weight[k]) * x[self.vertex[k]]
        return total


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts on the host, all arrays (k, ...), in order of bodies, as added, kind and feature, so that order and sides stay.

    An attribute of a record from `sim.contacts()` holds for the last step, or for its last substep if it was cut into several.
    point, normal, gap: geometry at its end, but point and normal of an explicit step, and of contacts that keep the geometry of
    the start, at its start; impulse: of normal force and friction together; impulse / duration is the force. kind: what meets, a
    vertex and a triangle, two edges, a vertex or a triangle and a distance field or obstacle, two triangles that would pass
    through each other, or two meshes around a node ("mortar", a mean). Contacts of points near each other are merged into one:
    there were `found`.
    """

    point: np.ndarray  #: (k,3) midway between the two surface points [m]
    normal: np.ndarray  #: (k,3) unit vectors from b to a
    gap: np.ndarray  #: (k,) [m], negative for a penetration
    impulse: np.ndarray  #: (k,3) on a [N s], with friction; b gets the opposite
    body_a: np.ndarray  #: (k,) names
    body_b: np.ndarray  #: (k,) names; an obstacle is always b
    nodes: np.ndarray  #: (k,2w) w of each side, at least three, numbered over all bodies, -1 where there is none
    weights: np.ndarray  #: (k,2w) of these nodes, 0 where there is none
    kind: np.ndarray  #: (k,) "vertex_face", "edge_edge", "vertex_field", "face_field", "face_face" or "mortar"
    feature: np.ndarray  #: (k,2) ids that stay while the same two features meet
    friction: np.ndarray  #: (k,) of the pair
    restitution: np.ndarray  #: (k,) of the pair
    guard: np.ndarray  #: (k,) bool: keeps half the contact offset only, since a mortar contact carries the load
    area: np.ndarray  #: (k,) [m^2] over which a mortar contact is a mean, 0 for others
    pressure: np.ndarray  #: (k,) [Pa] at the node of a mortar contact: its normal force over its area; nan for others
    state: np.ndarray  #: (k,) "open", "stick" or "slip" at the end, as the solver left it
    slip: np.ndarray  #: (k,3) [m] tangential displacement of a relative to b in `duration`
    clearance: np.ndarray  #: (k,) [m] gap minus the offset that this contact keeps: at guards half, within a body 5 times it
    tributary_area: np.ndarray  #: (k,) [m^2] of the loaded surface, divided among contacts by force; nan unless asked for
    found: int  #: contacts before the reduction
    unmapped: int  #: triangles whose tet is inverted, so that a distance field could not be used
    duration: float = 0.0  #: in which the impulses acted [s]: the step, or its last substep; 0 without a step

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.gap)

    @property
    def tangential_impulse(self) -> np.ndarray:
        """The tangential part (k,3) of `impulse` [N s], which is friction."""
        return self.impulse - (self.impulse * self.normal).sum(axis=1, keepdims=True) * self.normal

    def to_dict(self) -> dict[str, np.ndarray]:
        """Return the columns of a table with a row for each contact, which pandas.DataFrame takes.

        A vector has three, such as point_x, point_y and point_z, and feature two; nodes and weights are left out.
        """
        columns = {name: values for name, values in vars(self).items() if np.ndim(values) == 1}
        vectors = dict.fromkeys(("point", "normal", "impulse", "tangential_impulse", "slip"), "xyz")
        for name, axes in (vectors | {"feature": "01"}).items():
            columns |= {f"{name}_{axis}": column for axis, column in zip(axes, getattr(self, name).T)}
        return columns


def named_contacts(
    scene: Scene, *, found=0, unmapped=0, duration: float = 0.0, offsets=0.0, tributary_area=np.nan, **rows: np.ndarray
) -> Contacts:
    """Return the record of contacts in a stable order, with names, numbers of the pairs, pressures and clearances.

    rows: arrays (k, ...), of which impulse, state and slip may be missing, for 0; collider: (k,2) indices; offsets: (k,) [m].
    """
    collider, feature = rows.pop("collider"), rows.pop("feature")
    n, names = len(collider), np.array([c.name for c in scene.colliders], dtype=object)
    rows = {"impulse": np.zeros((n, 3)), "state": np.zeros(n, dtype=np.int64), "slip": np.zeros((n, 3))} | rows
    pairs, pair = np.unique(collider, axis=0, return_inverse=True)
    numbers = np.array([scene.contact_numbers(names[a], names[b]) for a, b in pairs]).reshape(-1, 2)[pair.reshape(-1)]
    pressure = np.full(n, np.nan)
    normal_force = (rows["impulse"] * rows["normal"]).sum(axis=1) / (duration or 1.0)
    np.divide(normal_force, rows["area"], out=pressure, where=rows["area"] > 0.0)
    kinds, states = (np.array(words, dtype=object) for words in (KINDS, STATES))
    rows |= {"body_a": names[collider[:, 0]], "body_b": names[collider[:, 1]], "kind": kinds[feature[:, 0]]}
    rows |= {"feature": feature[:, 1:], "friction": numbers[:, 0], "restitution": numbers[:, 1], "pressure": pressure}
    rows |= {"guard": rows["guard"] == 1, "state": states[rows["state"]], "clearance": rows["gap"] - offsets}
    rows["tributary_area"] = np.broadcast_to(tributary_area, n)
    order = np.lexsort(np.hstack([collider, feature])[:, ::-1].T)
    return Contacts(**{name: values[order] for name, values in rows.items()}, found=found, unmapped=unmapped, duration=duration)


def no_contacts(scene: Scene) -> Contacts:
    """Return an empty record."""
    integers = {name: np.zeros((0, n), dtype=np.int64) for name, n in (("collider", 2), ("feature", 3), ("nodes", 6))}
    vectors = {name: np.zeros((0, n)) for name, n in (("point", 3), ("normal", 3), ("weights", 6))}
    return named_contacts(scene, **integers, **vectors, **{name: np.zeros(0) for name in ("gap", "guard", "area")})


def contact_fields(arena: FieldArena, capacity: int) -> ContactFields:
    """Allocate a buffer for `capacity` contacts."""
    vectors = dict.fromkeys(("point", "normal", "weights_a", "weights_b", "carried"), (ti.f64, 3))
    vectors |= dict.fromkeys(("feature", "nodes_a", "nodes_b", "entries"), (ti.i32, 3)) | {"body": (ti.i32, 2)}
    fields = {name: arena.vectors(f"contact_{name}", dtype, capacity, n=n) for name, (dtype, n) in vectors.items()}
    scalars = {"gap": ti.f64, "area": ti.f64, "guard": ti.i32}
    return ContactFields(**fields, **{name: arena.field(f"contact_{name}", dtype, capacity) for name, dtype in scalars.items()})


def listed_vertices(arena: FieldArena, capacity: int) -> tuple[Any, Any]:
    """Allocate a buffer for `vertex` and `weight` of contacts."""
    return arena.field("listed_vertex", ti.i32, capacity), arena.field("listed_weight", ti.f64, capacity)


class ContactBuffer(Buffer):
    """A buffer of contacts. lists: that of the vertices of mortar contacts, None if there can be none."""

    def __init__(self, name: str, capacity: int, max_capacity: int | None, chunks: int, arena: FieldArena, has_mortar: bool):
        super().__init__(name, contact_fields, capacity, max_capacity, chunks, arena)
        limits = LISTED * capacity, None if max_capacity is None else MOST_LISTED * max_capacity
        self.lists = Buffer(f"{name}_vertices", listed_vertices, *limits, chunks, arena) if has_mortar else None
        self._join()

    def _join(self) -> None:
        if self.lists is not None:
            vertex, weight = self.lists.data
            self.parts = replace(self.parts, data=replace(self.data, vertex=vertex, weight=weight))

    @property
    def counts(self) -> list[Array]:
        """See Buffer."""
        return [self.count] if self.lists is None else [self.count, self.lists.count]

    def grow_if_full(self, counts: list[list[int]] | None = None) -> bool:
        """See Buffer."""
        counts = counts or read_each(self.counts)
        grown = super().grow_if_full(counts[:1])
        grown |= self.lists is not None and self.lists.grow_if_full(counts[1:])
        if grown:
            self._join()
        return grown

    @property
    def n_listed(self) -> int:
        """Vertices of all mortar contacts."""
        return 0 if self.lists is None else self.lists.total

    @property
    def bytes(self) -> int:
        """See Buffer."""
        return super().bytes + (0 if self.lists is None else self.lists.bytes)

    def release(self) -> None:
        """Free the memory."""
        super().release()
        if self.lists is not None:
            self.lists.release()


def sides_of(found: ContactFields, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and weights (k, 2 w) of contacts at places (k,), see `in_columns`."""
    vertex, weight = (np.hstack([getattr(found, f"{name}_{side}")[at] for side in "ab"]) for name in ("nodes", "weights"))
    mortar = np.flatnonzero(found.feature[at][:, 0] == MORTAR) if len(at) else at
    if len(mortar) == 0:  # in columns already
        return vertex, np.where(vertex >= 0, weight, 0.0)
    vertex[mortar] = -1
    contact, column = np.nonzero(vertex >= 0)
    rows = [contact, column >= 3, vertex[contact, column], weight[contact, column]]
    if len(mortar):
        first, n_a, n = found.entries[at[mortar]].T
        row, entry = expand(first, n)
        of_mortar = mortar[row], entry - first[row] >= n_a[row], found.vertex[entry], found.weight[entry]
        rows = [np.concatenate(parts) for parts in zip(rows, of_mortar)]
    contact, on_b, vertex, weight = (part[np.lexsort(rows[1::-1])] for part in rows)
    return in_columns(np.bincount(contact, minlength=len(at)), np.bincount(contact[~on_b], minlength=len(at)), vertex, weight)


def in_columns(n: np.ndarray, n_a: np.ndarray, node: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights (k, 2 w), w of each side and at least three, -1 and 0 where there is none, from their rows.

    n, n_a: (k,) nodes of each contact, and the first of them, which are of side a; node, weight: of all, row by row.
    """
    contact, place = expand(np.zeros_like(n), n)
    half = max(3, n_a.max(initial=0), (n - n_a).max(initial=0))
    nodes, weights = np.full((len(n), 2 * half), -1), np.zeros((len(n), 2 * half))
    at = contact, place + (place >= n_a[contact]) * (half - n_a[contact])
    nodes[at], weights[at] = node, weight
    return nodes, weights


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
        out.gap[at], out.feature[at], out.guard[at], out.area[at] = gap, feature, 0, 0.0
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


@ti.func
def write_point_contact(s: ti.template(), out: ti.template(), at, last, t, j, w, other, point, n, gap, nodes_b, weights_b):
    """Write the contact of corner j of triangle t with collider `other`; if j is 3, of its point of weights w (3,)."""
    feature, nodes, weights = ivec(FACE_FIELD, t, other), ivec(s.triangle[t, 0], s.triangle[t, 1], s.triangle[t, 2]), dvec(w)
    if j < 3:
        i = s.triangle[t, j]
        feature, nodes, weights = ivec(VERTEX_FIELD, i, other), ivec(i, -1, -1), dvec(1.0, 0.0, 0.0)
    write_contact(out, at, last, s.body[t], other, feature, point, n, gap, nodes, weights, nodes_b, weights_b)
