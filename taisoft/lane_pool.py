"""Memory of what kernels write in SIMD lanes: the forces and stiffness blocks of elements, which nodes then gather.

LLVM puts four neighbouring numbers into one store only where it knows that their addresses are neighbours, and all other SIMD
of a kernel starts from such stores. An array argument's address is read anew before every store, so it never knows; that of a
Taichi field it reads once. So these buffers, and they alone, are ranges of one field. It is made as the first after Taichi starts
and always of one size, since compiled code, and its place in the cache on disk, depend on which field it is and on its size.
A buffer too large for it gets a field of its own, for which kernels are compiled anew.
"""

import weakref
from dataclasses import dataclass
from typing import Any

import taichi as ti
from taichi.lang import impl

ENTRIES = 2**24  # of the pool: enough for the forces and the stiffness of 250,000 linear tets
OWN_MASK = 2**30 - 1  # of indices into a field of its own: so many entries at most


@dataclass(frozen=True, eq=False)
class Lanes:
    """A buffer: entries [at, at + count) of `memory`, a Taichi field or an `Array`. mask: bits of an index into it."""

    memory: Any
    at: int
    count: int
    mask: int


class LanePool:
    """The field, and which of its ranges are taken."""

    def __init__(self, dtype):
        self.memory = ti.field(dtype)
        place(self.memory, ENTRIES)
        self._taken: dict[int, int] = {}  # first entry -> one past the last

    def take(self, count: int) -> Lanes | None:
        """A range, the lowest that is free; None where none is large enough. It is free again once nobody holds it."""
        at = 0
        for first in sorted(self._taken):
            if first - at >= count:
                break
            at = self._taken[first]
        if at + count > ENTRIES:
            return None
        size = -(-count // 64) * 64  # ranges begin where cache lines do
        self._taken[at] = at + size
        lanes = Lanes(self.memory, at, count, ENTRIES - 1)
        weakref.finalize(lanes, self._taken.pop, at, None)
        return lanes


def own_field(dtype, count: int) -> tuple[Lanes, Any]:
    """A buffer with a field of its own, and the tree to destroy when it is no longer needed."""
    memory = ti.field(dtype)
    return Lanes(memory, 0, count, OWN_MASK), place(memory, count)


def place(field: Any, count: int) -> Any:
    """Give a field memory for so many entries. Returns its tree: Taichi frees only whole trees of fields."""
    builder = ti.FieldsBuilder()
    builder.dense(ti.i, count).place(field)
    return builder.finalize()


def free(trees: list) -> None:
    """Destroy and forget trees, but those that were freed when Taichi was initialised anew since."""
    while trees:
        tree = trees.pop()
        if tree.prog is impl.get_runtime().prog:
            tree.destroy()
