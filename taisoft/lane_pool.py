"""Memory of what kernels write in SIMD lanes: the forces and stiffness blocks of elements, which nodes then gather.

LLVM puts four neighbouring numbers into one store only where it knows that their addresses are neighbours, and all other SIMD
of a kernel starts from such stores. An array argument's address is read anew before every store, so it never knows; that of a
Taichi field it reads once. So these buffers, and they alone, are ranges of one field. It is made as the first after Taichi starts
and always of one size, since compiled code, and its place in the cache on disk, depend on which field it is and on its size.
A buffer too large for it takes a field of its own, for which kernels are compiled. That field stays for later buffers, which so
find these kernels, until a larger one takes its place.
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
    """The field and which of its ranges are taken, and the fields of large buffers."""

    def __init__(self, dtype):
        self.memory = ti.field(dtype)
        place(self.memory, ENTRIES)
        self._dtype = dtype
        self._taken: dict[int, int] = {}  # first entry -> one past the last
        self._large: dict[Any, tuple[int, Any]] = {}  # field -> its entries, its tree
        self._busy: set = set()  # of these

    def take(self, count: int) -> Lanes:
        """A range, the lowest that is free, or a field of its own. It is free again once nobody holds it.

        Raises RuntimeError where memory does not suffice.
        """
        at = 0
        for first in sorted(self._taken):
            if first - at >= count:
                break
            at = self._taken[first]
        if at + count > ENTRIES:
            return self._take_large(count)
        size = -(-count // 64) * 64  # ranges begin where cache lines do
        self._taken[at] = at + size
        lanes = Lanes(self.memory, at, count, ENTRIES - 1)
        weakref.finalize(lanes, self._taken.pop, at, None)
        return lanes

    def _take_large(self, count: int) -> Lanes:
        idle = [(entries, field) for field, (entries, _) in self._large.items() if field not in self._busy]
        fitting = [one for one in idle if one[0] >= count]
        if fitting:
            _, field = min(fitting, key=lambda one: one[0])
        else:  # it will also serve what those served that lie idle
            free([self._large.pop(one)[1] for _, one in idle])
            field, entries = ti.field(self._dtype), size_class(count)
            self._large[field] = entries, place(field, entries)
        self._busy.add(field)
        lanes = Lanes(field, 0, count, OWN_MASK)
        weakref.finalize(lanes, self._busy.discard, field)
        return lanes


def size_class(count: int) -> int:
    """The next of 4, 5, 6, 7 times a power of two, so that few sizes serve all: at most a quarter more than count."""
    unit = 1 << max(count.bit_length() - 3, 0)
    return -(-count // unit) * unit


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
