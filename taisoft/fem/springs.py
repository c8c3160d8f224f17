"""Springs, tendons and attachments: the elements of a scene, see `spring_table`, and what kernels derive from them."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, download, upload
from taisoft.fem.dependent_table import DependentTable
from taisoft.fem.loads import scalar_loads, tendon_slots
from taisoft.fem.model import Setup
from taisoft.fem.node_graph import NodeGraph
from taisoft.fem.spring_table import LENGTH, MULTIPLIER, PLAIN, SMOOTHED, TENSION, MovingEnds, SpringTable
from taisoft.scene.connection_records import Connection
from taisoft.scene.connections import coincide, lines_of, start_of
from taisoft.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Springs:
    """A `SpringTable` on the device, with what kernels derive from it."""

    n_lines: Count
    line_start: Any  # (n_lines + 1) i32
    line: Any  # (n) i32
    start: Any  # (n + 1) i32
    node: Any  # (s) i32
    weight: Any  # (s) f64
    element: Any  # (s) i32 of each entry
    offset: Any  # (n) 3-vectors f64
    has_moving: bool  # ends, with obstacles
    moving: Any  # (n) i32: first of the three amplitudes that are the offset, -1 if it does not move; or None
    rate_after: Count  # amplitudes from an offset that moves to its rate
    numbers: Any  # (n, 4) f64: k, L, c_d, s
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


def spring_table(scene: Scene, dependents: DependentTable | None = None) -> SpringTable | None:
    """The elements of a scene at the nodes that its `dependents` depend on, or where they end; None if it has none."""
    if not scene.has_springs:
        return None
    made, slots = _Builder(scene), tendon_slots(scene)
    for spring in scene.springs:
        length = spring.rest_length
        if length is None:
            a, b = (start_of(scene, point) for point in spring.points)
            length = 0.0 if coincide(scene, *spring.points) else float(np.linalg.norm(a - b))
        made.add(spring.name, _elements(scene, spring), PLAIN, spring.stiffness, length, spring.damping)
    for tendon in scene.tendons:
        (segments,) = _elements(scene, tendon)
        kind = LENGTH if tendon.is_elastic else MULTIPLIER if tendon.is_inextensible else TENSION
        if kind == TENSION:  # segments between two obstacles move nothing
            segments = [one for one in segments if len(one[0])]
        made.add(tendon.name, [segments], kind, tendon.stiffness or 0.0, slot=slots[tendon.name])
    for attachment in [one for one in scene.attachments if one.stiffness is not None]:
        made.add(attachment.name, _elements(scene, attachment), PLAIN, attachment.stiffness, damping=attachment.damping)
    return made.table(dependents)


def _elements(scene: Scene, connection: Connection) -> list[list[tuple]]:
    """The elements of each line of a connection."""
    return [
        [
            (np.concatenate([p.nodes, q.nodes]), np.concatenate([p.weights, -q.weights]), p[2:], q[2:])
            for p, q in itertools.pairwise(line)
        ]
        for line in lines_of(scene, connection)
    ]


class _Builder:
    """Collects elements; one is (nodes, weights, points (2,3) of obstacles, obstacles or None of the two ends)."""

    def __init__(self, scene: Scene):
        self.scene, self.elements = scene, {}
        self._entries, self._numbers, self._n_lines = [], [], 0

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

    def table(self, dependents: DependentTable | None) -> SpringTable:
        """All elements, without nodes of weight 0."""
        nodes, weights = [], []
        for own, c, *_ in self._entries:
            if dependents is not None:
                row = sp.csr_matrix((c, (np.zeros(len(own), dtype=int), own)), shape=(1, dependents.n_nodes)) @ dependents.matrix
                own, c = row.indices, row.data
            distinct, place = np.unique(own, return_inverse=True)
            total = np.bincount(place, c)
            nodes.append(distinct[total != 0.0])
            weights.append(total[total != 0.0])
        line, kind, slot, stiffness, length, damping = (np.array(column) for column in zip(*self._numbers))
        offset = np.array([p - q for _, _, (p, _), (q, _) in self._entries])
        return SpringTable(
            n_nodes=sum(body.n_nodes for body in self.scene.bodies),
            start=np.cumsum([0, *map(len, nodes)]),
            node=np.concatenate(nodes),
            weight=np.concatenate(weights),
            offset=offset,
            line=line,
            kind=kind,
            stiffness=stiffness,
            rest_length=length,
            damping=damping,
            smoothing=SMOOTHED * np.where(kind == PLAIN, length, self._lengths(offset)),
            slot=slot,
            elements=self.elements,
            moving=self._moving(bool(damping.any())),
        )

    def _lengths(self, offset: np.ndarray) -> np.ndarray:
        """|e| (e,) [m] of all elements at the start."""
        x = np.concatenate([body.rest_positions + body.position for body in self.scene.bodies])
        return np.array([np.linalg.norm(c @ x[own] + g) for (own, c, *_), g in zip(self._entries, offset)])

    def _moving(self, damped: bool) -> MovingEnds | None:
        ends = [(sign, n, *end) for n, (_, _, *both) in enumerate(self._entries) for sign, end in zip((1.0, -1.0), both)]
        moves = [owner is not None and owner.path is not None for *_, owner in ends]
        if not any(moves):
            return None
        element = np.unique([n for (_, n, *_), move in zip(ends, moves) if move])
        fixed, found = np.zeros((len(element), 3)), {}
        for (sign, n, place, owner), move in zip(ends, moves):
            at = int(np.searchsorted(element, n))
            if move:
                found.setdefault(owner.name, (owner, [], [], []))
                for values, value in zip(found[owner.name][1:], (at, sign, place)):
                    values.append(value)
            elif at < len(element) and element[at] == n:
                fixed[at] += sign * place
        grouped = [
            (owner, np.array(places), np.array(signs), owner.undisplaced(np.array(points)))
            for owner, places, signs, points in found.values()
        ]
        return MovingEnds(len(scalar_loads(self.scene)), damped, element, fixed, grouped)


def node_pairs(springs: Springs) -> np.ndarray:
    """Pairs (k,2) of nodes that stiffness couples, the lower first."""
    node, coupled = (a.astype(np.int64) for a in download([springs.node, springs.coupled]))
    groups = [np.unique(node[first:last]) for first, last in np.unique(coupled, axis=0)]
    return np.concatenate([own[np.stack(np.triu_indices(len(own), 1), axis=1)] for own in groups])


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: springs, tendons and attachments, if there are any."""
    if not setup.on["springs"]:
        return {}
    table, arena = setup.layout.springs, setup.arena
    coupled, n, n_lines = table.coupled, len(table.offset), len(table.line_start) - 1
    counts = np.diff(coupled, axis=1).reshape(-1)[table.element]  # of the entries that each entry is coupled with
    node_start = np.cumsum([0, *np.bincount(table.node, minlength=table.n_nodes)])
    numbers = np.stack([table.stiffness, table.rest_length, table.damping, table.smoothing], axis=1)
    moving, n_moving = np.full(n, -1), 0
    if table.moving is not None:
        n_moving = len(table.moving.element)
        moving[table.moving.element] = table.moving.first + 3 * np.arange(n_moving)
    springs = Springs(
        n_lines=n_lines,
        line_start=arena.filled("spring_line_start", ti.i32, table.line_start),
        line=arena.filled("spring_line", ti.i32, table.line),
        start=arena.filled("spring_start", ti.i32, table.start),
        node=arena.filled("spring_node", ti.i32, table.node),
        weight=arena.filled("spring_weight", ti.f64, table.weight),
        element=arena.filled("spring_element", ti.i32, table.element),
        offset=arena.vectors("spring_offset", ti.f64, n, table.offset),
        has_moving=n_moving > 0,
        moving=arena.filled("spring_moving", ti.i32, moving) if n_moving else None,
        rate_after=3 * n_moving,
        numbers=arena.filled("spring_numbers", ti.f64, numbers),
        kind=arena.filled("spring_kind", ti.i32, table.kind),
        slot=arena.filled("spring_slot", ti.i32, table.slot),
        node_start=arena.filled("spring_node_start", ti.i32, node_start),
        node_entry=arena.filled("spring_node_entry", ti.i32, np.argsort(table.node, kind="stable")),
        coupled=arena.filled("spring_coupled", ti.i32, coupled),
        pair_start=arena.filled("spring_pair_start", ti.i32, np.cumsum([0, *counts])[:-1]),
        pair_at=arena.field("spring_pair_at", ti.i32, int(counts.sum())) if setup.on["assembled_stiffness"] else None,
        pull=arena.vectors("spring_pull", ti.f64, n),
        direction=arena.vectors("spring_direction", ti.f64, n),
        length=arena.field("spring_length", ti.f64, n),
        elastic=arena.field("spring_elastic", ti.f64, n_lines),
        has_tensions=bool(np.isin(table.kind, (TENSION, MULTIPLIER)).any()),
        has_lengths=bool((table.kind == LENGTH).any()),
    )
    return {"has_springs": True, "springs": springs, "spring_damping": setup.on["spring_damping"]}


def set_pair_entries(springs: Springs, graph: NodeGraph) -> None:
    """Set `pair_at` for a matrix with this pattern."""
    node, element, coupled = (a.astype(np.int64) for a in download([springs.node, springs.element, springs.coupled]))
    ranges = coupled[element]
    rows = np.repeat(node, np.diff(ranges, axis=1).reshape(-1))
    columns = np.concatenate([node[first:last] for first, last in ranges])
    upload([(springs.pair_at, np.where(rows == columns, -1, graph.entries(rows, columns)))])
