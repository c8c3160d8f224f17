"""Springs, tendons and attachments of a scene as lines of elements, in arrays for kernels and in NumPy.

An element stretches the vector e = sum_j c_j x_j + g between two points, where c are the weights of the one minus those of the
other, and g the position of a point of an obstacle. A line is a sequence of elements with one tension,
    T = k (l - L) + T_0,   l = sum |e|,
k the stiffness, L the rest length, T_0 a given tension; plus c_d e.e' / l of its damping c_d. A tendon is a line with an element
for each of its segments: under a given tension k = 0, and an elastic one has T = k max(0, l - L) and a given L. A spring, and
each node of an attachment, is a line of one element. Force of node j: -sum_e c_j T e / |e|.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, download, upload
from taisoft.fem.dependents import dependent_table
from taisoft.fem.loads import tendon_slots
from taisoft.fem.node_graph import NodeGraph
from taisoft.ranges import owners
from taisoft.scene.body import Body
from taisoft.scene.connection_records import Attachment, Point, Tendon
from taisoft.scene.connections import coincide, locate_nodes, start_of
from taisoft.scene.locate import locate
from taisoft.scene.scene import Scene

# What the amplitude of a line is: there is none; its tension; its tension, which is a Lagrange multiplier; its rest length
PLAIN, TENSION, MULTIPLIER, LENGTH = range(4)


@dataclass(frozen=True, eq=False)
class SpringTable:
    """All elements of a scene, e of them with s entries in all; those of a line are consecutive and have its numbers."""

    n_nodes: int
    start: np.ndarray  # (e + 1) first entry of each
    node: np.ndarray  # (s,) of all nodes of the scene, distinct within an element, ascending
    weight: np.ndarray  # (s,) c_j
    offset: np.ndarray  # (e,3) g [m]
    line: np.ndarray  # (e,) ascending from 0
    kind: np.ndarray  # (e,) PLAIN, TENSION, MULTIPLIER or LENGTH
    stiffness: np.ndarray  # (e,) k [N/m]
    rest_length: np.ndarray  # (e,) L [m]; 0 if it is given
    damping: np.ndarray  # (e,) c_d [N s/m]
    slot: np.ndarray  # (e,) its amplitude, -1: none
    elements: dict[str, slice]  # of each connection, by name

    @property
    def element(self) -> np.ndarray:
        """Element (s,) of each entry."""
        return owners(np.diff(self.start))

    @cached_property
    def rows(self) -> sp.csr_matrix:
        """The weights c (e, n_nodes)."""
        return sp.csr_matrix((self.weight, self.node, self.start), shape=(len(self.offset), self.n_nodes))

    @cached_property
    def line_start(self) -> np.ndarray:
        """First element (n_lines + 1) of each line."""
        return np.searchsorted(self.line, np.arange(self.line[-1] + 2))

    @property
    def coupled(self) -> np.ndarray:
        """First and one past the last entry (e,2) that stiffness couples an element's with: its own, or those of its line."""
        whole = self.kind == LENGTH
        first = np.where(whole, self.line_start[self.line], np.arange(len(self.line)))
        last = np.where(whole, self.line_start[self.line + 1], np.arange(len(self.line)) + 1)
        return np.stack([self.start[first], self.start[last]], axis=1)

    def vectors(self, x: np.ndarray) -> np.ndarray:
        """e (e,3) [m] of node positions (n,3), or its rate of velocities if the offsets are left out."""
        return self.rates(x) + self.offset

    def rates(self, v: np.ndarray) -> np.ndarray:
        """sum_j c_j v_j (e,3)."""
        return self.rows @ v

    def given(self, amplitudes: np.ndarray) -> np.ndarray:
        """T_0 (e,) [N]; amplitudes: of all loads, see `fem.loads`."""
        return np.where(self.kind == LENGTH, 0.0, np.append(amplitudes, 0.0)[self.slot])

    def rest_lengths(self, amplitudes: np.ndarray) -> np.ndarray:
        """L (e,) [m]."""
        return np.where(self.kind == LENGTH, np.append(amplitudes, 0.0)[self.slot], self.rest_length)

    def stretching(self, length: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """k (l - L) (e,) [N] of the elements' lengths (e,)."""
        stretch = np.bincount(self.line, length)[self.line] - self.rest_lengths(amplitudes)
        return self.stiffness * np.where(self.kind == LENGTH, np.maximum(stretch, 0.0), stretch)

    def tensions(self, x: np.ndarray, v: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """Tension (e,) [N] with damping; negative: it pushes."""
        length, d = _length_and_direction(self.vectors(x))
        elastic = self.stretching(length, amplitudes)
        return elastic + self.given(amplitudes) + self.damping * (self.rates(v) * d).sum(axis=1)

    def pulls(self, x: np.ndarray, v: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """Force (e,3) [N] of each element on its first point."""
        d, rate = _length_and_direction(self.vectors(x))[1], self.rates(v)
        across = rate - (rate * d).sum(axis=1)[:, None] * d
        damped = np.where(self.is_isotropic, self.damping, 0.0)
        return -(self.tensions(x, v, amplitudes)[:, None] * d + damped[:, None] * across)

    def stiffness_matrix(self, e: np.ndarray, amplitudes: np.ndarray) -> sp.csr_matrix:
        """S (3e,3e) [N/m] of stretched vectors (e,3): the change of the pulls with them."""
        length, d = _length_and_direction(e)
        elastic = self.stretching(length, amplitudes)
        slack = (self.kind == LENGTH) & (elastic == 0.0)
        along = np.where(slack, 0.0, self.stiffness)
        t = (elastic + self.given(amplitudes)) / np.where(length > 0.0, length, np.inf)
        t = np.where(self.is_isotropic, self.stiffness, t)
        blocks = t[:, None, None] * (np.eye(3) - d[:, :, None] * d[:, None, :])
        D = sp.csr_matrix((d.reshape(-1), (np.repeat(self.line, 3), np.arange(3 * len(d)))))  # of each line
        return (sp.block_diag(blocks) + D.T @ sp.diags(along[self.line_start[:-1]]) @ D).tocsr()

    def rest_amplitudes(self, n: int, x: np.ndarray) -> np.ndarray:
        """Amplitudes (n,) without load: 0, and for given rest lengths the lengths at rest positions x (n_nodes,3) [m]."""
        amplitudes = np.zeros(n)
        length = np.bincount(self.line, np.linalg.norm(self.vectors(x), axis=1))
        given = self.kind == LENGTH
        amplitudes[self.slot[given]] = length[self.line[given]]
        return amplitudes

    @property
    def is_isotropic(self) -> np.ndarray:
        """Whether (e,) an element has no rest length and no amplitude: it then pulls by k e, and damps in all directions."""
        return (self.rest_length == 0.0) & (self.kind == PLAIN)


def _length_and_direction(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """l (k,) and d (k,3) of vectors (k,3); d is 0 where l is."""
    length = np.linalg.norm(e, axis=1)
    return length, e / np.where(length > 0.0, length, 1.0)[:, None]


class LengthForm:
    """Minus the length of a tendon as a function of all nodes' positions; the gradient is then that of its tension's forces."""

    def __init__(self, table: SpringTable, name: str):
        rows = table.rows[table.elements[name]]
        self.nodes, self._offset = np.unique(rows.indices), table.offset[table.elements[name]]
        self._rows = rows[:, self.nodes]

    def value_and_gradient(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """-l [m], and its gradient (k,3) at the nodes. x: (n_nodes,3) [m] of the scene."""
        length, d = _length_and_direction(self._rows @ x[self.nodes] + self._offset)
        return -float(length.sum()), -(self._rows.T @ d)


@dataclass(frozen=True, eq=False)
class Springs:
    """A `SpringTable` on the device, with what kernels derive from it."""

    n: Count
    n_lines: Count
    line_start: Any  # (n_lines + 1) i32
    line: Any  # (n) i32
    start: Any  # (n + 1) i32
    node: Any  # (s) i32
    weight: Any  # (s) f64
    element: Any  # (s) i32 of each entry
    offset: Any  # (n) 3-vectors f64
    numbers: Any  # (n, 3) f64: k, L, c_d
    kind: Any  # (n) i32
    slot: Any  # (n) i32
    node_start: Any  # (n_nodes + 1) i32: first of each node in node_entry
    node_entry: Any  # (s) i32: entries of each node
    coupled: Any  # (n, 2) i32
    pair_start: Any  # (s) i32: first of each entry in pair_at
    pair_at: Any  # i32: for each pair of coupled entries, its block in the stiffness matrix, -1 on the diagonal; or None
    pull: Any  # (n) 3-vectors f64 [N]: scratch, force along e without given tension
    direction: Any  # (n) 3-vectors f64: scratch
    length: Any  # (n) f64 [m]: scratch
    elastic: Any  # (n_lines) f64 [N]: scratch, k (l - L)
    has_tensions: bool  # given ones
    has_lengths: bool  # given ones, of elastic tendons


def spring_table(scene: Scene) -> SpringTable | None:
    """The elements of a scene; None if it has none."""
    made, slots = _Builder(scene), tendon_slots(scene)
    for spring in scene.springs:
        length = spring.rest_length
        if length is None:
            a, b = (start_of(scene, point) for point in spring.points)
            length = 0.0 if coincide(scene, *spring.points) else float(np.linalg.norm(a - b))
        made.add(spring.name, [[made.between(*spring.points)]], PLAIN, spring.stiffness, length, spring.damping)
    for tendon in scene.tendons:
        segments, kind = [made.between(p, q) for p, q in zip(tendon.points, tendon.points[1:])], _kind(tendon)
        if kind == TENSION:  # segments between two obstacles move nothing
            segments = [one for one in segments if len(one[0])]
        made.add(tendon.name, [segments], kind, tendon.stiffness or 0.0, slot=slots[tendon.name])
    for attachment in [one for one in scene.attachments if one.stiffness is not None]:
        lines = [[one] for one in made.attached(attachment)]
        made.add(attachment.name, lines, PLAIN, attachment.stiffness, damping=attachment.damping)
    return made.table() if made.elements else None


def _kind(tendon: Tendon) -> int:
    return LENGTH if tendon.is_elastic else MULTIPLIER if tendon.is_inextensible else TENSION


class _Builder:
    """Collects elements; one is (nodes, weights, offset (3,))."""

    def __init__(self, scene: Scene):
        self.scene, self.elements = scene, {}
        self._starts = scene.first_nodes
        self._entries, self._numbers, self._n_lines = [], [], 0

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

    def add(
        self,
        name: str,
        lines: list[list],
        kind: int,
        stiffness: float,
        rest_length: float = 0.0,
        damping: float = 0.0,
        slot: int = -1,
    ) -> None:
        """Add the lines of a connection, which have the same numbers."""
        first = len(self._entries)
        for line in lines:
            self._entries += line
            self._numbers += [(self._n_lines, kind, slot, stiffness, rest_length, damping)] * len(line)
            self._n_lines += 1
        self.elements[name] = slice(first, len(self._entries))

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
        line, kind, slot, stiffness, length, damping = (np.array(column) for column in zip(*self._numbers))
        return SpringTable(
            n_nodes=sum(body.n_nodes for body in self.scene.bodies),
            start=np.cumsum([0, *map(len, nodes)]),
            node=np.concatenate(nodes),
            weight=np.concatenate(weights),
            offset=np.array([offset for _, _, offset in self._entries]),
            line=line,
            kind=kind,
            stiffness=stiffness,
            rest_length=length,
            damping=damping,
            slot=slot,
            elements=self.elements,
        )


def node_pairs(springs: Springs) -> np.ndarray:
    """Pairs (k,2) of nodes that stiffness couples, the lower first."""
    node, coupled = (a.astype(np.int64) for a in download([springs.node, springs.coupled]))
    groups = [np.unique(node[first:last]) for first, last in np.unique(coupled, axis=0)]
    return np.concatenate([own[np.stack(np.triu_indices(len(own), 1), axis=1)] for own in groups])


def build_springs(scene: Scene, arena: FieldArena, n_nodes: int, assembled: bool) -> Springs:
    """Copy a scene's elements to the device. assembled: there will be a stiffness matrix, see `set_pair_entries`."""
    table = spring_table(scene)
    by_node, coupled, n = np.argsort(table.node, kind="stable"), table.coupled, len(table.offset)
    counts = np.diff(coupled, axis=1).reshape(-1)[table.element]  # of the entries that each entry is coupled with
    numbers = np.stack([table.stiffness, table.rest_length, table.damping], axis=1)
    n_lines = len(table.line_start) - 1
    return Springs(
        n=n,
        n_lines=n_lines,
        line_start=_ids(arena, "spring_line_start", table.line_start),
        line=_ids(arena, "spring_line", table.line),
        start=_ids(arena, "spring_start", table.start),
        node=_ids(arena, "spring_node", table.node),
        weight=arena.field("spring_weight", ti.f64, len(table.weight), table.weight),
        element=_ids(arena, "spring_element", table.element),
        offset=arena.vectors("spring_offset", ti.f64, n, table.offset),
        numbers=arena.field("spring_numbers", ti.f64, (n, 3), numbers),
        kind=_ids(arena, "spring_kind", table.kind),
        slot=_ids(arena, "spring_slot", table.slot),
        node_start=_ids(arena, "spring_node_start", np.cumsum([0, *np.bincount(table.node, minlength=n_nodes)])),
        node_entry=_ids(arena, "spring_node_entry", by_node),
        coupled=arena.field("spring_coupled", ti.i32, coupled.shape, coupled.astype(np.int32)),
        pair_start=_ids(arena, "spring_pair_start", np.cumsum([0, *counts])[:-1]),
        pair_at=arena.field("spring_pair_at", ti.i32, int(counts.sum())) if assembled else None,
        pull=arena.vectors("spring_pull", ti.f64, n),
        direction=arena.vectors("spring_direction", ti.f64, n),
        length=arena.field("spring_length", ti.f64, n),
        elastic=arena.field("spring_elastic", ti.f64, n_lines),
        has_tensions=bool(np.isin(table.kind, (TENSION, MULTIPLIER)).any()),
        has_lengths=bool((table.kind == LENGTH).any()),
    )


def set_pair_entries(springs: Springs, graph: NodeGraph) -> None:
    """Set `pair_at` for a matrix with this pattern."""
    node, element, coupled = (a.astype(np.int64) for a in download([springs.node, springs.element, springs.coupled]))
    ranges = coupled[element]
    rows = np.repeat(node, np.diff(ranges, axis=1).reshape(-1))
    columns = np.concatenate([node[first:last] for first, last in ranges])
    upload([(springs.pair_at, np.where(rows == columns, -1, graph.entries(rows, columns)))])


def _ids(arena: FieldArena, name: str, data: np.ndarray):
    return arena.field(name, ti.i32, len(data), data.astype(np.int32))
