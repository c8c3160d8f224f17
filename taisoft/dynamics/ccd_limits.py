"""How far contacts close in a step, against how far they may before things could pass each other unseen.

Two sides that close by no more than half the thinner one's thickness cannot change sides unseen: even if their contact were
lost, the next search would find them in each other, by less than half of it. Two sides with a larger gap between them may move
relative to each other, in whatever direction, by that gap: they can touch nothing before it is used up, since theirs is the
least distance near there (conservative advancement: Mirtich 1996). A contact's ratio is the smaller of
    closing / (thickness / 2)   and   |relative motion| / max(gap, thickness / 2),
and a step in which no contact's ratio exceeds 1 is short enough. Weak where a surface stands out behind what is nearest now: it
is a contact of its own only if its distance has a local minimum there.
"""

import math
from collections.abc import Callable

import taichi as ti

from taisoft.collision.surface import dvec
from taisoft.contact.assemble import obstacle_displacement_at
from taisoft.runtime import kernel

MAX_CLOSING = 0.5  # of the thinner side's thickness: how far a contact may close in one step
DEPTH, CLOSING_RATIO, SPEED, WHICH, RELATIVE_PENETRATION = range(5)  # places in what `measure_closing` finds
GROWTH = 2.0  # a part is at most so many times as long as the one before: after an impact what it set off is followed
ROUNDING = 1e-9  # of a number of parts


@kernel
def measure_closing(
    s: ti.template(), o: ti.template(), found: ti.template(), kept: ti.template(), n: ti.i32, dt: ti.f64,
    found_closing: ti.types.ndarray(),
):  # fmt: skip
    """found_closing (5,): deepest penetration [m]; the largest ratio of a contact in the coming step (see above); the speed at which that
    one closes [m/s]; its number among the kept; the deepest penetration over the finer side's mean surface edge."""
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
        found_closing[DEPTH], found_closing[CLOSING_RATIO], found_closing[SPEED] = depth, largest_ratio, speed
        found_closing[WHICH], found_closing[RELATIVE_PENETRATION] = which, relative_penetration


@kernel
def find_displacement(
    m: ti.template(), s: ti.template(), x_start: ti.template(), displacement: ti.template(), strayed: ti.types.ndarray()
):  # fmt: skip
    """way (n_nodes) [m] since x_start; strayed (1,) [m]: the most by which a vertex left the straight way that was searched."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        displacement[i] = m.state.x[i] - x_start[i]
    ti.loop_config(serialize=True)
    for _ in range(1):
        most = ti.cast(0.0, ti.f64)
        for k in range(s.n_verts):
            if s.node[k] >= 0:
                d, known = displacement[s.node[k]], s.move[k]
                square = known.dot(known)
                share = ti.cast(0.0, ti.f64)
                if square > 0.0:
                    share = ti.min(ti.max(d.dot(known) / square, 0.0), 1.0)
                most = ti.max(most, (d - share * known).norm())
        strayed[0] = most


def next_length(ratio: Callable[[float], float], left: float, length: float, longest: float, may_grow: bool) -> float:
    """How long [s] the next part of a step is: what is left of it, cut equally, so that no contact's ratio exceeds 1.

    ratio: of a part of so many seconds from here; length: of the part before; longest: no part is longer; may_grow: whether the
    part may be longer than the one before.
    """
    length = left / _count(left / length)
    found = ratio(length)
    if may_grow and GROWTH * found <= 1.0 and length < min(left, longest) * (1.0 - ROUNDING):
        # as the search found it: of a longer part it may find more
        length = left / _count(left / min(GROWTH * length, longest))
        found = ratio(length)
    return left / _count(left / length * max(found, 1.0))


def _count(substeps: float) -> int:
    """So many equal parts, or a few more to make it a whole number."""
    return max(1, math.ceil(substeps * (1.0 - ROUNDING)))
