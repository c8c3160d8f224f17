"""Surfaces and contacts at an iterate of an implicit step, with obstacles as they are at the step's end.

The surfaces of the step's start stay, since paths lead from them; those of the end have positions, boxes and normals of their
own. They are searched with the trees or candidates of the start, which cover all paths near the searched ones.
"""

from dataclasses import replace
from typing import Any

import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.analytic import AnalyticObstacles
from taisoft.collision.contacts import ContactBuffer
from taisoft.collision.near_list import leaving
from taisoft.collision.reduction import Reduction
from taisoft.collision.surface import Surface, box_triangles


@kernel
def place_at_end(s: ti.template(), end: ti.template(), displacement: ti.template(), margin: ti.f64, left: ti.template()):
    """Set positions, boxes and normals of surface `end`: displacements (n_nodes) [m] from surface s, where the other vertices are
    displaced as in the searched step. margin [m]: boxes grow by half of it. left[0]: how far the surface has left the searched
    paths [m]."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        left[0] = 0.0
    ti.loop_config(serialize=s.serial_cheap)
    for i in range(s.n_verts):
        move = s.move[i]
        if s.node[i] >= 0:
            move = displacement[s.node[i]]
            length = leaving(move, s.move[i]).norm()
            if length > left[0]:  # few do, and atomics on one address wait for each other
                ti.atomic_max(left[0], length)
        end.x[i] = s.x[i] + move
    box_triangles(end, margin)  # whose move is 0


class EndSearch:
    """Surface and shapes at the end of a step, and the contacts found there."""

    def __init__(self, start: Surface, shapes: AnalyticObstacles, buffer: ContactBuffer, lengths: tuple[float, float]):
        """start, shapes: of the step's start; buffer: whose capacity the new one has; lengths [m]: as of `Reduction`."""
        self._arena, n, v = FieldArena(), max(start.n_triangles, 1), max(start.n_verts, 1)
        own = {name: self._arena.vectors(f"end_{name}", ti.f64, v) for name in ("x", "move")}
        own |= {name: self._arena.vectors(f"end_{name}", ti.f64, n) for name in ("lo", "hi", "normal")}
        self.also: list[list] = []  # numbers that the last search has read for others
        self.left = self._arena.field("end_left", ti.f64, 1)
        self.surface = replace(start, **own, area=self._arena.field("end_area", ti.f64, n))
        self.shapes = replace(shapes, origin=shapes.next_origin, rotation=shapes.next_rotation)
        same = buffer.capacity, buffer.max_capacity, start.chunks, self._arena, buffer.lists is not None
        self.buffer = ContactBuffer("end_contacts", *same)
        self.reduction = Reduction(start, self.buffer, *lengths)

    @property
    def found(self) -> tuple[Surface, Any, Any, int]:
        """The contacts found, for kernels: surface, buffer, the indices there of those that are kept, and their number."""
        return self.surface, self.buffer.data, self.reduction.work.kept, self.reduction.n_kept

    @property
    def bytes(self) -> dict[str, int]:
        """Bytes of the fields by name."""
        return self._arena.bytes | {f"end_{name}": size for name, size in self.reduction.bytes.items()}

    def release(self) -> None:
        """Free the memory."""
        self.buffer.release()
        self.reduction.release()
        self._arena.release()
