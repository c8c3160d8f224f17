"""Memory for buffers that kernels write in SIMD lanes: element forces and stiffness blocks, which nodes then gather.

LLVM merges four adjacent stores into one only if it can prove that their addresses are adjacent, and the rest of a kernel is
vectorised from such stores. The address of an array argument is reloaded before every store, which prevents the proof; that of
a Taichi field is loaded once. So these buffers, and no others, are ranges of one field. It is the first field created after
Taichi starts and always has the same size, since compiled code and its key in the disk cache depend on the field's number and
size. A buffer too large for it gets a separate field, for which kernels are compiled. That field is kept for later buffers,
which can then use the same kernels, until a larger one replaces it.
"""

import weakref
from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.backend.private import impl

ENTRIES = 2**24  # of the pool: enough for forces and stiffness of 250,000 linear tets
OWN_MASK = 2**30 - 1  # index mask of a separate field, and its largest number of entries


@dataclass(frozen=True, eq=False)
class Lanes:
    """A buffer: entries [at, at + count) of `memory`, a Taichi field or an `Array`. mask: index mask."""

    memory: Any
    at: int
    count: int
    mask: int


class LanePool:
    """The shared field with its allocated ranges, and the separate fields of large buffers."""

    def __init__(self, dtype):
        self.memory = ti.field(dtype)
        place(self.memory, ENTRIES)
        self._dtype = dtype
        self._taken: dict[int, int] = {}  # first entry -> one past the last
        self._large: dict[Any, tuple[int, Any]] = {}  # field -> number of entries, SNode tree
        self._busy: set = set()  # the large fields in use

    def take(self, count: int) -> Lanes:
        """Allocate the lowest free range, or a separate field. It is freed when the returned object is collected.

        Raises RuntimeError if memory does not suffice.
        """
        at = 0
        for first in sorted(self._taken):
            if first - at >= count:
                break
            at = self._taken[first]
        if at + count > ENTRIES:
            return self._take_large(count)
        size = -(-count // 64) * 64  # align ranges to cache lines
        self._taken[at] = at + size
        lanes = Lanes(self.memory, at, count, ENTRIES - 1)
        weakref.finalize(lanes, self._taken.pop, at, None)
        return lanes

    def _take_large(self, count: int) -> Lanes:
        idle = [(entries, field) for field, (entries, _) in self._large.items() if field not in self._busy]
        fitting = [entry for entry in idle if entry[0] >= count]
        if fitting:
            _, field = min(fitting, key=lambda entry: entry[0])
        else:  # the new field also replaces the idle ones
            free([self._large.pop(field)[1] for _, field in idle])
            field, entries = ti.field(self._dtype), size_class(count)
            self._large[field] = entries, place(field, entries)
        self._busy.add(field)
        lanes = Lanes(field, 0, count, OWN_MASK)
        weakref.finalize(lanes, self._busy.discard, field)
        return lanes


def size_class(count: int) -> int:
    """Round count up to 4, 5, 6 or 7 times a power of two, at most a quarter more, so that few sizes occur."""
    unit = 1 << max(count.bit_length() - 3, 0)
    return -(-count // unit) * unit


def place(field: Any, count: int) -> Any:
    """Allocate a field with `count` entries. Returns its SNode tree: Taichi frees only whole trees."""
    builder = ti.FieldsBuilder()
    builder.dense(ti.i, count).place(field)
    return builder.finalize()


def free(trees: list) -> None:
    """Destroy trees and empty the list; trees of an earlier initialisation of Taichi are already freed."""
    while trees:
        tree = trees.pop()
        if tree.prog is impl.get_runtime().prog:
            tree.destroy()
