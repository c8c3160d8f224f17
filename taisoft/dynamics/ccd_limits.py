"""Closing ratios of contacts: how far they close in a step, relative to a limit below which no collision is missed.

Two sides that close by no more than half the thinner one's thickness cannot pass through each other unnoticed: even if their
contact were lost, the next search would find them penetrating by less than half of it. Two sides with a larger gap may move
relative to each other by that gap in any direction. They touch nothing before, since the gap is the smallest distance nearby
(conservative advancement: Mirtich 1996). A contact's ratio is the smaller of
    closing / (thickness / 2)   and   |relative motion| / max(gap, thickness / 2),
and a step in which no contact's ratio exceeds 1 is short enough. Weakness: a surface that protrudes behind the nearest one is a
separate contact only if its distance has a local minimum there.
"""

import math
from collections.abc import Callable

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.collision.surface import dvec
from taisoft.contact.build import obstacle_displacement_at

MAX_CLOSING = 0.5  # of the thinner side's thickness: how far a contact may close in one step
DEPTH, CLOSING_RATIO, SPEED, WHICH, RELATIVE_PENETRATION = range(5)  # indices into the result of `measure_closing`
GROWTH = 2.0  # maximum ratio of a substep's length to the previous one, so that the motion after an impact is resolved
ROUNDING = 1e-9  # of a number of substeps


@kernel
def measure_closing(
    s: ti.template(),
    o: ti.template(),
    found: ti.template(),
    kept: ti.template(),
    n: ti.i32,
    dt: ti.f64,
    closing_data: ti.types.ndarray(),
):
    """Measure the contacts' closing in the coming step of dt.

    closing_data (5,): deepest penetration [m]; largest closing ratio of a contact (see above); its closing speed [m/s]; its
    number among the kept ones; deepest penetration over the finer side's mean surface edge.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        depth, largest_ratio, speed, which = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), -1
        relative_penetration = ti.cast(0.0, ti.f64)
        for c in range(n):
            at = kept[c]
            depth = ti.max(depth, -found.gap[at])
            a, b = found.body[at][0], found.body[at][1]
            relative_penetration = ti.max(relative_penetration, -found.gap[at] / ti.min(s.edge[a], s.edge[b]))
            displacement = dvec(0.0)
            if ti.static(o.any):
                if found.nodes_b[at][0] < 0:
                    displacement -= obstacle_displacement_at(o, b, found.point[at])
            for j in ti.static(range(3)):
                if found.nodes_a[at][j] >= 0:
                    displacement += found.weights_a[at][j] * s.move[found.nodes_a[at][j]]
                if found.nodes_b[at][j] >= 0:
                    displacement -= found.weights_b[at][j] * s.move[found.nodes_b[at][j]]
            closing = -displacement.dot(found.normal[at])
            allowed = MAX_CLOSING * ti.min(s.thickness[a], s.thickness[b])
            if s.thickness[b] < ti.math.inf and closing > 0.0:
                ratio = ti.min(closing / allowed, displacement.norm() / ti.max(found.gap[at], allowed))
                if ratio > largest_ratio:
                    largest_ratio, speed, which = ratio, closing / dt, c
        closing_data[DEPTH], closing_data[CLOSING_RATIO], closing_data[SPEED] = depth, largest_ratio, speed
        closing_data[WHICH], closing_data[RELATIVE_PENETRATION] = which, relative_penetration


@kernel
def find_displacement(
    m: ti.template(), s: ti.template(), x_start: ti.template(), displacement: ti.template(), deviation: ti.types.ndarray()
):
    """Compute the displacement (n_nodes) [m] since x_start.

    deviation (1,) [m]: largest distance of a vertex from the straight path that was searched.
    """
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        displacement[i] = m.state.x[i] - x_start[i]
    ti.loop_config(serialize=True)
    for _ in range(1):
        largest = ti.cast(0.0, ti.f64)
        for k in range(s.n_verts):
            if s.node[k] >= 0:
                d, searched = displacement[s.node[k]], s.move[k]
                square = searched.dot(searched)
                along = ti.cast(0.0, ti.f64)
                if square > 0.0:
                    along = ti.min(ti.max(d.dot(searched) / square, 0.0), 1.0)
                largest = ti.max(largest, (d - along * searched).norm())
        deviation[0] = largest


def next_length(ratio: Callable[[float], float], remaining: float, length: float, longest: float, may_grow: bool) -> float:
    """Return the length [s] of the next substep: the remaining time cut equally, so that no contact's ratio exceeds 1.

    ratio: largest closing ratio of a substep of the given length [s] from here; length: of the previous substep; longest: maximum
    length; may_grow: whether the substep may be longer than the previous one.
    """
    length = remaining / _count(remaining / length)
    found = ratio(length)
    if may_grow and GROWTH * found <= 1.0 and length < min(remaining, longest) * (1.0 - ROUNDING):
        # the ratio holds for the searched length; a longer substep may have more contacts
        length = remaining / _count(remaining / min(GROWTH * length, longest))
        found = ratio(length)
    return remaining / _count(remaining / length * max(found, 1.0))


def _count(substeps: float) -> int:
    """Round a number of equal substeps up, except for rounding errors."""
    return max(1, math.ceil(substeps * (1.0 - ROUNDING)))
