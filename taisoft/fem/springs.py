"""Springs, tendons and attachments of a scene as one kind of element, in arrays for kernels and in NumPy.

An element stretches the vector e = sum_j c_j x_j + g between two points, where c are the weights of the one minus those of the
other, and g the position of a point of an obstacle. With its length l = |e| it pulls with the tension
    T = k (l - L) + T_0,
k the stiffness, L the rest length, T_0 the tension of a tendon, one element for each of its segments; plus c_d e.e' / l of its
damping c_d. An attachment has an element of rest length 0 for each node. Force of node j: -c_j T e / l.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, download, upload
from taisoft.fem.dependents import dependent_table
from taisoft.fem.loads import tension_slots
from taisoft.fem.node_graph import NodeGraph
from taisoft.ranges import owners
from taisoft.scene.body import Body
from taisoft.scene.connections import Attachment, Point, coincide, locate_nodes, start_of
from taisoft.scene.locate import locate
from taisoft.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class SpringTable:
    """All elements of a scene, e of them with s entries in all."""

    start: np.ndarray  # (e + 1) first entry of each
    node: np.ndarray  # (s,) of all nodes of the scene, distinct within an element, ascending
    weight: np.ndarray  # (s,) c_j
    offset: np.ndarray  # (e,3) g [m]
    stiffness: np.ndarray  # (e,) k [N/m]
    rest_length: np.ndarray  # (e,) L [m]
    damping: np.ndarray  # (e,) c_d [N s/m]
    slot: np.ndarray  # (e,) amplitude that is T_0, -1: none
    elements: dict[str, slice]  # of each connection, by name

    @property
    def element(self) -> np.ndarray:
        """Element (s,) of each entry."""
        return owners(np.diff(self.start))

    def vectors(self, x: np.ndarray) -> np.ndarray:
        """e (e,3) [m] of node positions (n,3), or its rate of velocities if the offsets are left out."""
        return self.rates(x) + self.offset

    def rates(self, v: np.ndarray) -> np.ndarray:
        """sum_j c_j v_j (e,3)."""
        return np.add.reduceat(self.weight[:, None] * v[self.node], self.start[:-1], axis=0)

    def given(self, amplitudes: np.ndarray) -> np.ndarray:
        """T_0 (e,) [N]; amplitudes: of all loads, see `fem.loads`."""
        return np.append(amplitudes, 0.0)[self.slot]

    def tensions(self, x: np.ndarray, v: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """Tension (e,) [N] with damping; negative: it pushes."""
        length, d = _length_and_direction(self.vectors(x))
        return (
            self.stiffness * (length - self.rest_length) + self.given(amplitudes) + self.damping * (self.rates(v) * d).sum(axis=1)
        )

    def pulls(self, x: np.ndarray, v: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """Force (e,3) [N] of each element on its first point."""
        d, rate = _length_and_direction(self.vectors(x))[1], self.rates(v)
        across = rate - (rate * d).sum(axis=1)[:, None] * d
        damped = np.where(self.is_isotropic, self.damping, 0.0)
        return -(self.tensions(x, v, amplitudes)[:, None] * d + damped[:, None] * across)

    def stiffness_blocks(self, e: np.ndarray, given: np.ndarray) -> np.ndarray:
        """S (e,3,3) [N/m] of stretched vectors (e,3) and given tensions (e,)."""
        length, d = _length_and_direction(e)
        t = self.stiffness + (given - self.stiffness * self.rest_length) / np.where(length > 0.0, length, np.inf)
        t = np.where(self.is_isotropic, self.stiffness, t)[:, None, None]
        return t * np.eye(3) + (self.stiffness[:, None, None] - t) * d[:, :, None] * d[:, None, :]

    @property
    def is_isotropic(self) -> np.ndarray:
        """Whether (e,) an element has no rest length and no given tension: it then pulls by k e, and damps in all directions."""
        return (self.rest_length == 0.0) & (self.slot < 0)


def _length_and_direction(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """l (k,) and d (k,3) of vectors (k,3); d is 0 where l is."""
    length = np.linalg.norm(e, axis=1)
    return length, e / np.where(length > 0.0, length, 1.0)[:, None]


@dataclass(frozen=True, eq=False)
class Springs:
    """A `SpringTable` on the device, with what kernels derive from it."""

    n: Count
    start: Any  # (n + 1) i32
    node: Any  # (s) i32
    weight: Any  # (s) f64
    element: Any  # (s) i32 of each entry
    offset: Any  # (n) 3-vectors f64
    numbers: Any  # (n, 3) f64: k, L, c_d
    slot: Any  # (n) i32
    node_start: Any  # (n_nodes + 1) i32: first of each node in node_entry
    node_entry: Any  # (s) i32: entries of each node
    pair_start: Any  # (s) i32: first of each entry in pair_at
    pair_at: Any  # i32: for each pair of entries of an element, its block in the stiffness matrix, -1 on the diagonal; or None
    pull: Any  # (n) 3-vectors f64 [N]: scratch, force along e
    has_tendons: bool


def spring_table(scene: Scene) -> SpringTable | None:
    """The elements of a scene; None if it has none."""
    made, slots = _Builder(scene), tension_slots(scene)
    for spring in scene.springs:
        length = spring.rest_length
        if length is None:
            a, b = (start_of(scene, point) for point in spring.points)
            length = 0.0 if coincide(scene, *spring.points) else float(np.linalg.norm(a - b))
        made.add(spring.name, [made.between(*spring.points)], spring.stiffness, length, spring.damping, -1)
    for tendon in scene.tendons:
        segments = [made.between(p, q) for p, q in zip(tendon.points, tendon.points[1:])]
        made.add(tendon.name, segments, 0.0, 0.0, 0.0, slots[tendon.name])
    for attachment in [one for one in scene.attachments if one.stiffness is not None]:
        made.add(attachment.name, made.attached(attachment), attachment.stiffness, 0.0, attachment.damping, -1)
    return made.table() if made.elements else None


class _Builder:
    """Collects elements; one is (nodes, weights, offset (3,))."""

    def __init__(self, scene: Scene):
        self.scene, self.elements = scene, {}
        self._starts = scene.first_nodes
        self._entries, self._numbers = [], []

    def between(self, p: Point, q: Point):
        """The element between two points."""
        (nodes_p, weights_p, at_p), (nodes_q, weights_q, at_q) = self._side(p), self._side(q)
        return np.concatenate([nodes_p, nodes_q]), np.concatenate([weights_p, -weights_q]), at_p - at_q

    def attached(self, attachment: Attachment) -> list:
        """The elements of an attachment."""
        a, b = self.scene.body(attachment.a), self.scene.collider(attachment.b)
        own = self._starts[a.name] + attachment.nodes
        if isinstance(b, Body):
            nodes, weights = locate_nodes(self.scene, attachment)
            nodes = nodes + self._starts[b.name]
            return [(np.append(i, j), np.append(1.0, -w), np.zeros(3)) for i, j, w in zip(own, nodes, weights)]
        places = a.rest_positions[attachment.nodes] + a.position
        return [(np.array([i]), np.ones(1), -place) for i, place in zip(own, places)]

    def _side(self, point: Point):
        owner = self.scene.collider(point.owner)
        if not isinstance(owner, Body):
            return np.zeros(0, dtype=np.int64), np.zeros(0), point.position
        nodes, weights, _ = locate(owner, point.position[None])
        return self._starts[owner.name] + nodes[0], weights[0], np.zeros(3)

    def add(self, name: str, elements: list, *numbers: float) -> None:
        """Add the elements of a connection, which have the same numbers."""
        elements, first = [one for one in elements if len(one[0])], len(self._entries)  # not those between two obstacles
        self.elements[name] = slice(first, first + len(elements))
        self._entries += elements
        self._numbers += [numbers] * len(elements)

    def table(self) -> SpringTable:
        """All elements, without nodes of weight 0."""
        nodes, weights, dependents = [], [], dependent_table(self.scene)
        for own, c, _ in self._entries:
            if dependents is not None:
                row = sp.csr_matrix((c, (np.zeros(len(own), dtype=int), own)), shape=(1, dependents.n_nodes)) @ dependents.matrix
                own, c = row.indices, row.data
            distinct, place = np.unique(own, return_inverse=True)
            total = np.bincount(place, c)
            nodes.append(distinct[total != 0.0])
            weights.append(total[total != 0.0])
        stiffness, length, damping, slot = (np.array(column) for column in zip(*self._numbers))
        return SpringTable(
            np.cumsum([0, *map(len, nodes)]),
            np.concatenate(nodes),
            np.concatenate(weights),
            np.array([offset for _, _, offset in self._entries]),
            stiffness,
            length,
            damping,
            slot,
            self.elements,
        )


def node_pairs(start: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Pairs (k,2) of nodes that share an element, the lower first. start, node: as in `SpringTable`."""
    pairs = [np.stack(np.triu_indices(n, 1), axis=1) + first for first, n in zip(start, np.diff(start))]
    return node[np.concatenate(pairs)].astype(np.int64)


def build_springs(scene: Scene, arena: FieldArena, n_nodes: int, assembled: bool) -> Springs:
    """Copy a scene's elements to the device. assembled: there will be a stiffness matrix, see `set_pair_entries`."""
    table = spring_table(scene)
    by_node = np.argsort(table.node, kind="stable")
    counts, numbers = np.diff(table.start), np.stack([table.stiffness, table.rest_length, table.damping], axis=1)
    return Springs(
        n=len(table.offset),
        start=_ids(arena, "spring_start", table.start),
        node=_ids(arena, "spring_node", table.node),
        weight=arena.field("spring_weight", ti.f64, len(table.weight), table.weight),
        element=_ids(arena, "spring_element", table.element),
        offset=arena.vectors("spring_offset", ti.f64, len(table.offset), table.offset),
        numbers=arena.field("spring_numbers", ti.f64, (len(table.offset), 3), numbers),
        slot=_ids(arena, "spring_slot", table.slot),
        node_start=_ids(arena, "spring_node_start", np.cumsum([0, *np.bincount(table.node, minlength=n_nodes)])),
        node_entry=_ids(arena, "spring_node_entry", by_node),
        pair_start=_ids(arena, "spring_pair_start", np.cumsum([0, *np.repeat(counts, counts)])[:-1]),
        pair_at=arena.field("spring_pair_at", ti.i32, int((counts**2).sum())) if assembled else None,
        pull=arena.vectors("spring_pull", ti.f64, len(table.offset)),
        has_tendons=bool((table.slot >= 0).any()),
    )


def set_pair_entries(springs: Springs, graph: NodeGraph) -> None:
    """Set `pair_at` for a matrix with this pattern."""
    start, node = (a.astype(np.int64) for a in download([springs.start, springs.node]))
    groups = [node[first:last] for first, last in zip(start, start[1:])]
    rows = np.concatenate([np.repeat(own, len(own)) for own in groups])
    columns = np.concatenate([np.tile(own, len(own)) for own in groups])
    upload([(springs.pair_at, np.where(rows == columns, -1, graph.entries(rows, columns)))])


def _ids(arena: FieldArena, name: str, data: np.ndarray):
    return arena.field(name, ti.i32, len(data), data.astype(np.int32))
