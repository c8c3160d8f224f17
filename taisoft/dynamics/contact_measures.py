"""What is measured of the contacts found by a search: penetration, crossing triangles, closing speed.

The closing ratio of a contact is how far it closes in a step, relative to a limit below which no collision is missed. Two sides
that close by no more than half the thinner one's thickness cannot pass through each other unnoticed: even if their contact were
lost, the next search would find them penetrating by less than half of it. Two sides with a larger gap may move relative to each
other by that gap in any direction. They touch nothing before, since the gap is the smallest distance nearby (conservative
advancement: Mirtich 1996). A contact's ratio is the smaller of
    closing / (thickness / 2)   and   |relative motion| / max(gap, thickness / 2),
and a step in which no contact's ratio exceeds 1 is short enough. Weakness: a surface that protrudes behind the nearest one is a
separate contact only if its distance has a local minimum there.

Where nothing crosses, implicit steps need no such limit, since what they miss is found along their paths: there `drop_uncertain`
drops the contacts that it would be for, unless they close head-on.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.contacts import FACE_FACE
from taisoft.collision.detector import Detection
from taisoft.collision.intersections import CROSSING_DEPTH, CROSSINGS, DEPTH_OVER_EDGE
from taisoft.collision.near_list import leaving
from taisoft.collision.surface import dvec
from taisoft.contact.build import obstacle_displacement_at
from taisoft.fem.state import DEVIATION

MAX_CLOSING = 0.5  # of the thinner side's thickness: how far a contact may close in one step
# indices into the result of `measure_closing`; LEFT: contacts that `drop_uncertain` has left
DEPTH, CLOSING_RATIO, SPEED, WHICH, RELATIVE_PENETRATION, LEFT = range(6)
DEEP_PENETRATION = 0.02  # of the finer side's mean surface edge: penetration reported as a problem


@dataclass(frozen=True)
class Crossing:
    """How deep triangles cross and colliders lie inside each other at the last search."""

    depth: float = 0.0  # [m]
    relative: float = 0.0  # over the finer side's mean surface edge
    n_pairs: int = 0  # of crossing triangles
    inside: tuple[tuple[int, int, float], ...] = ()  # colliders inside each other, and depth [m]


class ContactMeasures:
    """Measures of the contacts of a detection's last search."""

    def __init__(self, detection: Detection, arena: FieldArena):
        self.detection = detection
        self._closing = arena.field("closing", ti.f64, 6)  # result of `measure_closing`,
        self._measured: np.ndarray | None = None  # and a copy of it; None: outdated
        self._dt = 0.0  # [s] of the last search

    def begin(self, dt: float) -> None:
        """Discard the measures, before another search, for a step of dt [s]."""
        self._measured, self._dt = None, dt

    @property
    def closing(self) -> np.ndarray:
        """The result of `measure_closing` for the step of the last search."""
        if self._measured is None:
            self._measure(self.detection.counts.contacts)
        return self._measured

    def _measure(self, n: int) -> None:
        measure_closing(*self.detection.found, n, self._dt, self._closing)
        self._measured = self._closing.to_numpy()

    @property
    def closing_ratio(self) -> float:
        """Largest closing ratio of a contact in that step."""
        return float(self.closing[CLOSING_RATIO])

    def drop_uncertain(self) -> None:
        """Drop the contacts of the last search that may never touch, where the check of paths finds those that would: a plane
        across the nearest features also stops what flies past them."""
        detection = self.detection
        drop_uncertain(*detection.found, detection.counts.contacts, self._closing)
        if not detection.model.on_cpu:  # one reading for both
            self._measure(-1)
        detection.counts.contacts = int((self._closing if self._measured is None else self._measured)[LEFT])

    def crossing(self) -> Crossing:
        """Measure crossing triangles and contained colliders."""
        crossings, edges = self.detection.crossings(), self.detection.edges
        depth, relative, inside = float(crossings[CROSSING_DEPTH]), float(crossings[DEPTH_OVER_EDGE]), {}
        for one in self.detection.contained():
            pair = min(one.a, one.b), max(one.a, one.b)
            inside[pair] = max(inside.get(pair, 0.0), one.depth)
            # a piece thinner than an edge counts as deep if its middle is half as deep in the other as in itself
            scale = min(edges[one.a], edges[one.b], 0.5 * one.room / DEEP_PENETRATION if one.room > 0.0 else np.inf)
            depth, relative = max(depth, one.depth), max(relative, one.depth / scale)
        return Crossing(depth, relative, int(crossings[CROSSINGS]), tuple((*pair, d) for pair, d in inside.items()))

    def deep_from(self, a: int, b: int) -> float:
        """Return the penetration [m] of two colliders above which a step counts as deep."""
        return DEEP_PENETRATION * float(min(self.detection.edges[a], self.detection.edges[b]))

    def describe_fast_closing(self, dt: float, substeps: int = 1) -> str:
        """Return a sentence that names the two colliders closing too fast for a step of dt, their speed, the thickness of the
        thinner one, and a sufficient dt. substeps: maximum number per step."""
        closing, detection = self.closing, self.detection
        a, b = detection.buffer.data.body[detection.kept[int(closing[WHICH])]]
        names = [detection.scene.colliders[k].name for k in (a, b)]
        thin, speed = float(min(detection.thickness[a], detection.thickness[b])), float(closing[SPEED])
        cut = f"even in {substeps} substeps " if substeps > 1 else ""
        return (
            f"'{names[0]}' and '{names[1]}' close at {speed:.3g} m/s, {speed * dt:.3g} m in a step of {dt:.3g} s, "
            f"and the thinner of them is {thin:.3g} m thick, so {cut}they could pass each other unseen: take dt <= "
            f"{substeps * MAX_CLOSING * thin / speed:.3g} s"
        )


@ti.func
def _relative_displacement(s: ti.template(), o: ti.template(), found: ti.template(), at):
    """Displacement of side a relative to side b of the contact at a buffer index in the searched step, (3,) [m]."""
    displacement = dvec(0.0)
    if ti.static(o.any):
        if found.nodes_b[at][0] < 0:
            displacement -= obstacle_displacement_at(o, found.body[at][1], found.point[at])
    for j in ti.static(range(3)):
        if found.nodes_a[at][j] >= 0:
            displacement += found.weights_a[at][j] * s.move[found.nodes_a[at][j]]
        if found.nodes_b[at][j] >= 0:
            displacement -= found.weights_b[at][j] * s.move[found.nodes_b[at][j]]
    if found.is_mortar(at):
        displacement += found.moved(at, s.move) - found.carried[at]
    return displacement


@kernel
def drop_uncertain(
    s: ti.template(), o: ti.template(), found: ti.template(), kept: ti.template(), n: ti.i32, closing_data: ti.template()
):
    """Leave out of kept[:n] the contacts whose sides close by more than MAX_CLOSING of the thinner one's thickness in the
    searched step, and move aside by as much before they meet: they may never touch. Passages remain. closing_data: LEFT, the
    number left."""
    (team,) = ti.static((s.team,))
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        left = 0
        for j in range(team.rounds(n)):
            c = t + j * team.threads
            at = kept[ti.min(c, n - 1)]
            displacement, normal = _relative_displacement(s, o, found, at), found.normal[at]
            closing = -displacement.dot(normal)
            allowed = MAX_CLOSING * ti.min(s.thickness[found.body[at][0]], s.thickness[found.body[at][1]])
            is_certain = found.feature[at][0] == FACE_FACE or closing <= allowed
            if not is_certain:
                until = ti.min(ti.max(found.gap[at], 0.0) / closing, 1.0)
                is_certain = until * (displacement + closing * normal).norm() <= allowed
            before, certain = team.count(t, int(is_certain and c < n))
            if is_certain and c < n:  # no thread reads this far any more
                kept[left + before] = at
            left += certain
        if t == 0:
            closing_data[LEFT] = left


@kernel
def measure_closing(
    s: ti.template(),
    o: ti.template(),
    found: ti.template(),
    kept: ti.template(),
    n: ti.i32,
    dt: ti.f64,
    closing_data: ti.template(),
):
    """Measure the closing of n contacts in the coming step of dt; n = -1: of those left by `drop_uncertain`.

    closing_data (6,): deepest penetration [m]; largest closing ratio of a contact (see above); its closing speed [m/s]; its
    number among the kept ones; deepest penetration over the finer side's mean surface edge.
    """
    (team,) = ti.static((s.team,))
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads):
        depth, largest_ratio, speed, which = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), -1
        relative_penetration = ti.cast(0.0, ti.f64)
        size = ti.select(n < 0, ti.cast(closing_data[LEFT], ti.i32), n)
        for j in range(team.share(t, size)):
            c = team.entry(t, j, size)
            at = kept[c]
            depth = ti.max(depth, -found.gap[at])
            a, b = found.body[at][0], found.body[at][1]
            relative_penetration = ti.max(relative_penetration, -found.gap[at] / ti.min(s.edge[a], s.edge[b]))
            displacement = _relative_displacement(s, o, found, at)
            closing = -displacement.dot(found.normal[at])
            allowed = MAX_CLOSING * ti.min(s.thickness[a], s.thickness[b])
            if s.thickness[b] < ti.math.inf and closing > 0.0:
                ratio = ti.min(closing / allowed, displacement.norm() / ti.max(found.gap[at], allowed))
                if ratio > largest_ratio or (ratio == largest_ratio and c < which):
                    largest_ratio, speed, which = ratio, closing / dt, c
        depth, relative_penetration = team.largest(t, depth), team.largest(t, relative_penetration)
        overall = team.largest(t, largest_ratio)
        first = team.least(t, ti.select(which >= 0 and largest_ratio == overall, which, size))  # of several with that ratio
        if t == 0:
            closing_data[DEPTH], closing_data[RELATIVE_PENETRATION] = depth, relative_penetration
            closing_data[CLOSING_RATIO], closing_data[SPEED], closing_data[WHICH] = overall, 0.0, -1.0
        team.sync()
        if which == first:
            closing_data[SPEED], closing_data[WHICH] = speed, which


@kernel
def find_displacement(m: ti.template(), s: ti.template(), x_start: ti.template(), displacement: ti.template()):
    """Compute the displacement (n_nodes) [m] since x_start.

    scalars: DEVIATION, from the straight path that was searched.
    """
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        displacement[i] = m.state.x[i] - x_start[i]
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.state.scalars[DEVIATION] = 0.0
    ti.loop_config(serialize=m.on_cpu)
    for k in range(s.n_verts):
        if s.node[k] >= 0:
            length = leaving(displacement[s.node[k]], s.move[k]).norm()
            if length > m.state.scalars[DEVIATION]:  # few do, and atomics on one address wait for each other
                ti.atomic_max(m.state.scalars[DEVIATION], length)
