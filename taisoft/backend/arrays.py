"""Arrays of a simulator. Kernels take them as arguments, so compiled code does not depend on their size or owner.

On the CPU the memory is a NumPy array, which the host accesses directly; on CUDA it is Taichi's.
"""

import math
from typing import Annotated

import numpy as np
import taichi as ti

from taisoft.backend.private import impl

DTYPES = {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32, ti.u8: np.uint8}

# Annotation of a number that kernels read from a record of arrays at run time. Other numbers, flags and modules of such a record
# are compile-time structure: a kernel is compiled for each set of them.
Count = Annotated[int, "run time"]


def index_mask(n: int, extents: tuple[int, ...]) -> int:
    """Mask of the first index of an array of n-vectors with these other extents, so that 31 bits can index all its numbers.

    It is 2^31 - 1 for scalars.
    """
    numbers = max(n, 1) * math.prod(extents)
    return 2 ** (31 - (numbers - 1).bit_length()) - 1


class Array:
    """An array of scalars, or of vectors of n components if n > 0.

    shape: extents of its entries. Only the first may vary at run time: a kernel is compiled for the others.
    """

    __slots__ = ("dtype", "n", "shape", "host", "device", "__weakref__")

    def __init__(self, dtype, shape: tuple[int, ...], n: int, on_host: bool):
        self.dtype, self.n, self.shape = dtype, n, shape
        self.host = np.empty(self.full_shape, dtype=DTYPES[dtype]) if on_host else None
        if on_host:
            self.host.fill(0)  # touch the pages, so that later checks of available memory count them
        # as scalars, because Taichi never frees arrays of vectors
        self.device = None if on_host else ti.ndarray(dtype, (math.prod(self.full_shape),))

    @property
    def full_shape(self) -> tuple[int, ...]:
        """Shape including vector components."""
        return (*self.shape, self.n) if self.n else self.shape

    @property
    def structure(self) -> tuple:
        """The properties that compiled code depends on."""
        return self.dtype, self.n, self.shape[1:]

    def to_numpy(self, rows: int | None = None) -> np.ndarray:
        """Return a copy of the array, or of its first `rows` rows."""
        if self.host is not None:
            return (self.host if rows is None else self.host[:rows]).copy()
        data = self.device.to_numpy().reshape(self.full_shape)
        return data if rows is None else data[:rows].copy()

    def check(self, data: np.ndarray) -> None:
        """Raise ValueError unless data has the array's shape."""
        if data.shape != self.full_shape:
            raise ValueError(f"an array of shape {self.full_shape} cannot take one of shape {data.shape}")

    def from_numpy(self, data: np.ndarray) -> None:
        """Copy data into the array. Raises ValueError, before writing anything, unless it has the array's shape."""
        self.check(data)
        if self.host is not None:
            np.copyto(self.host, data, casting="unsafe")
        else:
            self.device.from_numpy(np.ascontiguousarray(data, dtype=DTYPES[self.dtype]).reshape(-1))

    def fill(self, value: float) -> None:
        """Set every number to value."""
        if self.host is not None:
            self.host[...] = value
        else:
            self.device.fill(value)

    def release(self) -> None:
        """Free the memory; the array then has no entries."""
        self.shape = (0, *self.shape[1:])
        self.host = np.empty(self.full_shape, dtype=DTYPES[self.dtype]) if self.host is not None else None
        self.device = None

    def __getitem__(self, at):
        """Return a copy of one entry, on the host."""
        entry = (self.host if self.host is not None else self.to_numpy())[at]
        return entry.copy() if entry.ndim else entry.item()

    def __setitem__(self, at, value) -> None:
        if self.host is not None:
            self.host[at] = value
        else:
            data = self.to_numpy()
            data[at] = value
            self.from_numpy(data)


class View:
    """An array inside a kernel: flat memory, with compile-time extents after the first.

    The first index is masked, which changes no valid index but shows the compiler that no address overflows, so that it can
    vectorise adjacent accesses.
    """

    def __init__(self, flat, n: int, extents: tuple[int, ...]):
        self._flat, self._extents, self._mask = flat, extents, index_mask(n, extents)

    @property
    def shape(self):
        """Shape (number of vectors,) of an array of vectors; raises TypeError for several dimensions."""
        if self._extents:
            raise TypeError("an array of several dimensions has no shape inside a kernel: pass a Count")
        return self._flat.shape

    def __getitem__(self, indices):
        first, rest = (indices[0], indices[1:]) if isinstance(indices, tuple) else (indices, ())
        at = first if isinstance(first, int) else first & self._mask
        for index, extent in zip(rest, self._extents):
            at = at * extent + index
        return impl.subscript(None, self._flat, at)
