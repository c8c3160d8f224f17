"""The arrays of a simulator: allocated and counted by name, refused if they do not fit into memory, released together."""

import math
import weakref

import numpy as np
import taichi as ti

from taisoft.backend.arrays import DTYPES, Array, index_mask
from taisoft.backend.lane_pool import OWN_MASK, Lanes
from taisoft.backend.runtime import lane_pool
from taisoft.errors import SimulationError
from taisoft.memory import available_memory, format_bytes

SMALL = 2**20  # bytes up to which available memory is not checked


class FieldArena:
    """Allocator of one simulator's arrays. bytes: size of each array, by name."""

    def __init__(self) -> None:
        self.bytes: dict[str, int] = {}
        self._lanes: list[Lanes] = []
        self._arrays: weakref.WeakSet[Array] = weakref.WeakSet()

    def field(self, name: str, dtype, shape: tuple[int, ...] | int, data: np.ndarray | None = None) -> Array:
        """Allocate scalars, filled from data if given, else with zeros."""
        return self._allocate(name, dtype, shape, 0, data)

    def vectors(self, name: str, dtype, shape: int, data: np.ndarray | None = None, n: int = 3) -> Array:
        """Allocate n-vectors, filled from data (shape, n) if given, else with zeros."""
        return self._allocate(name, dtype, shape, n, data)

    def lanes(self, name: str, dtype, count: int) -> Lanes:
        """Allocate a buffer that kernels write in SIMD lanes; its initial contents are undefined."""
        pool = lane_pool()
        if pool is None:
            return Lanes(self.field(name, dtype, count), 0, count, OWN_MASK)
        needed = self._checked_bytes(name, dtype, count, OWN_MASK)
        try:
            lanes = pool.take(count)
        except RuntimeError:
            raise SimulationError(self._memory_message(name, needed, available_memory())) from None
        self.bytes[name] = needed
        self._lanes.append(lanes)
        return lanes

    def _allocate(self, name: str, dtype, shape, n: int, data: np.ndarray | None) -> Array:
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        numbers = max(n, 1) * math.prod(shape[1:])
        needed = self._checked_bytes(name, dtype, shape[0] * numbers, index_mask(n, shape[1:]) * numbers)
        on_host = ti.cfg.arch != ti.cuda
        try:
            array = Array(dtype, shape, n, on_host)
        except (MemoryError, RuntimeError):  # RuntimeError has the text of Taichi's C++ layer
            raise SimulationError(self._memory_message(name, needed, available_memory() if on_host else None)) from None
        if data is not None:
            array.from_numpy(data)
        self.bytes[name] = needed
        self._arrays.add(array)
        return array

    def _checked_bytes(self, name: str, dtype, count: int, max_count: int) -> int:
        """Return the bytes of count numbers. Raises SimulationError if count exceeds max_count or memory does not suffice."""
        if name in self.bytes:
            raise ValueError(f"array '{name}' is allocated twice")
        if count > max_count:
            raise SimulationError(f"array '{name}' needs {count} numbers, more than the {max_count} that fit")
        needed = count * np.dtype(DTYPES[dtype]).itemsize
        free = available_memory() if ti.cfg.arch != ti.cuda and needed > SMALL else None
        if free is not None and needed > free:
            raise SimulationError(self._memory_message(name, needed, free))
        return needed

    def _memory_message(self, name: str, needed: int, free: int | None) -> str:
        return f"not enough memory for the array '{name}': {format_bytes(needed)} are needed, available: {format_bytes(free)}"

    def release(self) -> None:
        """Free all memory, including that of arrays still referenced: kernels must not be launched with them."""
        self._lanes.clear()
        for array in self._arrays:
            array.release()
        self._arrays.clear()
        self.bytes.clear()
