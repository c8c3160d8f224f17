"""The arrays of a simulator: made and counted by name, refused where they do not fit into memory, released together."""

import math
import weakref

import numpy as np
import taichi as ti

from taisoft.arrays import DTYPES, Array, index_mask
from taisoft.errors import SimulationError
from taisoft.lane_pool import OWN_MASK, Lanes
from taisoft.memory import available_memory, format_bytes
from taisoft.runtime import lane_pool

SMALL = 2**20  # bytes that are not worth a look at what is free


class FieldArena:
    """Makes the arrays of one simulator. bytes: of each, by name."""

    def __init__(self) -> None:
        self.bytes: dict[str, int] = {}
        self._lanes: list[Lanes] = []
        self._arrays: weakref.WeakSet[Array] = weakref.WeakSet()

    def field(self, name: str, dtype, shape: tuple[int, ...] | int, data: np.ndarray | None = None) -> Array:
        """Scalars, filled from data when given (else zero)."""
        return self._make(name, dtype, shape, 0, data)

    def vectors(self, name: str, dtype, shape: int, data: np.ndarray | None = None, n: int = 3) -> Array:
        """n-vectors, filled from data (shape, n) when given (else zero)."""
        return self._make(name, dtype, shape, n, data)

    def lanes(self, name: str, dtype, count: int) -> Lanes:
        """A buffer that kernels write in SIMD lanes; what it holds at first is anybody's."""
        pool = lane_pool()
        if pool is None:
            return Lanes(self.field(name, dtype, count), 0, count, OWN_MASK)
        needed = self._ask_for(name, dtype, count, OWN_MASK)
        try:
            lanes = pool.take(count)
        except RuntimeError:
            raise SimulationError(self._no_memory(name, needed, available_memory())) from None
        self.bytes[name] = needed
        self._lanes.append(lanes)
        return lanes

    def _make(self, name: str, dtype, shape, n: int, data: np.ndarray | None) -> Array:
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        numbers = max(n, 1) * math.prod(shape[1:])
        needed = self._ask_for(name, dtype, shape[0] * numbers, index_mask(n, shape[1:]) * numbers)
        on_host = ti.cfg.arch != ti.cuda
        try:
            array = Array(dtype, shape, n, on_host)
        except (MemoryError, RuntimeError):  # the second's text is the C++ layer's
            raise SimulationError(self._no_memory(name, needed, available_memory() if on_host else None)) from None
        if data is not None:
            array.from_numpy(data)
        self.bytes[name] = needed
        self._arrays.add(array)
        return array

    def _ask_for(self, name: str, dtype, count: int, most: int) -> int:
        """Bytes of so many entries. Raises SimulationError where they are too many or do not fit into memory."""
        if name in self.bytes:
            raise ValueError(f"array '{name}' is allocated twice")
        if count > most:
            raise SimulationError(f"array '{name}' needs {count} numbers, more than the {most} that fit")
        needed = count * np.dtype(DTYPES[dtype]).itemsize
        free = available_memory() if ti.cfg.arch != ti.cuda and needed > SMALL else None
        if free is not None and needed > free:
            raise SimulationError(self._no_memory(name, needed, free))
        return needed

    def _no_memory(self, name: str, needed: int, free: int | None) -> str:
        return f"not enough memory for the array '{name}': {format_bytes(needed)} are needed, available: {format_bytes(free)}"

    def release(self) -> None:
        """Free all memory, also that of arrays that somebody still refers to: kernels must not be launched with them."""
        self._lanes.clear()
        for array in self._arrays:
            array.release()
        self._arrays.clear()
        self.bytes.clear()
