"""Find intersecting triangles, within a body and between bodies.

Candidates exclude triangles that share a vertex index, since those always touch. A fold is still found through their neighbours.
Present positions are used, without the motion during the step.
"""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download
from taisoft.backend.runtime import kernel
from taisoft.collision.candidates import Buffer, Candidates, pairs, sum_parts
from taisoft.collision.features import corner
from taisoft.collision.surface import Surface, part_first
from taisoft.collision.triangles import triangles_intersect


@ti.func
def intersect(s: ti.template(), t, u):
    """1 if triangles t and u of the surface intersect or touch, else 0."""
    return triangles_intersect(
        corner(s, t, 0), corner(s, t, 1), corner(s, t, 2), corner(s, u, 0), corner(s, u, 1), corner(s, u, 2)
    )


@kernel(cse=False)
def find_intersections(
    s: ti.template(),
    start: ti.template(),
    end: ti.template(),
    entry: ti.template(),
    pair: ti.template(),
    used: ti.template(),
    total: ti.template(),
    part: ti.i32,
):
    """Find the pairs t < u of the rows that intersect, in ascending order within each part and over the parts."""
    ti.loop_config(serialize=s.serial)
    for task in range(s.chunks * s.spread):
        if task % s.spread == 0:
            c = task // s.spread
            last = (c + 1) * part
            at = c * part
            for t in range(part_first(c, s.n_triangles, s.chunks), part_first(c + 1, s.n_triangles, s.chunks)):
                for e in range(start[t], end[t]):
                    u = entry[e]
                    if t < u and intersect(s, t, u) == 1:
                        if at < last:
                            pair[at] = ti.Vector([t, u], ti.i32)
                        at += 1
            used[c] = at - c * part
    ti.loop_config(serialize=True)
    for _ in range(1):
        sum_parts(used, total, s.chunks)


class Intersections:
    """Find the intersecting triangles among candidates."""

    def __init__(self, surface: Surface, arena: FieldArena, capacity: int | None = None, max_capacity: int | None = None):
        """capacity, max_capacity: initial and maximum number of pairs; None for the default."""
        self.surface = surface
        self.pairs = Buffer("intersections", pairs, capacity or surface.n_triangles + 64, max_capacity, surface.chunks, arena)

    def find(self, candidates: Candidates) -> np.ndarray:
        """Return the (k,2) triangles t < u that intersect or touch at the present positions, in ascending order.

        Raise SimulationError if the buffer would outgrow its limit.
        """
        found, c = self.pairs, candidates
        while True:
            find_intersections(self.surface, c.start, c.end, c.entry, found.data, found.used, found.count, found.part)
            if not found.grow_if_full():
                break
        data, used = download([found.data, found.used])
        indices = np.arange(found.capacity)
        return data[: found.capacity][indices % found.part < np.repeat(used, found.part)]

    def release(self) -> None:
        """Free the memory of the buffer."""
        self.pairs.release()
