"""Arrays of a simulator: kernels take them as arguments, so that compiled code knows neither their size nor whose they are.

On the CPU the memory is NumPy's, which the host reads and writes as it is; on CUDA it is Taichi's.
"""

import math
from typing import Annotated

import numpy as np
import taichi as ti
from taichi.lang import impl

DTYPES = {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32, ti.u8: np.uint8}

# Annotation of a number in a record of arrays that kernels read at run time. Other numbers, flags and modules of such a record
# are structure: they are known to the compiler, and a kernel is compiled for each set of them.
Count = Annotated[int, "run time"]


def index_mask(n: int, extents: tuple[int, ...]) -> int:
    """Bits of the first index of an array of so many numbers an entry, all of which 31 bits can count; 2^31 - 1 of scalars."""
    numbers = max(n, 1) * math.prod(extents)
    return 2 ** (31 - (numbers - 1).bit_length()) - 1


class Array:
    """shape: of its entries, each a scalar or, where n > 0, a vector of n components. Only the first extent may vary at run
    time: a kernel is compiled for the others."""

    __slots__ = ("dtype", "n", "shape", "host", "device", "__weakref__")

    def __init__(self, dtype, shape: tuple[int, ...], n: int, on_host: bool):
        self.dtype, self.n, self.shape = dtype, n, shape
        self.host = np.empty(self.whole, dtype=DTYPES[dtype]) if on_host else None
        if on_host:
            self.host.fill(0)  # written, so that the next array is held against what memory is left
        # scalars only: Taichi never frees arrays of vectors
        self.device = None if on_host else ti.ndarray(dtype, (math.prod(self.whole),))

    @property
    def whole(self) -> tuple[int, ...]:
        """Shape of all its numbers."""
        return (*self.shape, self.n) if self.n else self.shape

    @property
    def structure(self) -> tuple:
        """What compiled code depends on."""
        return self.dtype, self.n, self.shape[1:]

    def to_numpy(self, rows: int | None = None) -> np.ndarray:
        """A copy of the array, or of its first rows."""
        if self.host is not None:
            return (self.host if rows is None else self.host[:rows]).copy()
        whole = self.device.to_numpy().reshape(self.whole)
        return whole if rows is None else whole[:rows].copy()

    def check(self, data: np.ndarray) -> None:
        """Raises ValueError unless data has the array's shape."""
        if data.shape != self.whole:
            raise ValueError(f"an array of shape {self.whole} cannot take one of shape {data.shape}")

    def from_numpy(self, data: np.ndarray) -> None:
        """Take numbers of the array's shape. Raises ValueError for any other, before anything is written."""
        self.check(data)
        if self.host is not None:
            np.copyto(self.host, data, casting="unsafe")
        else:
            self.device.from_numpy(np.ascontiguousarray(data, dtype=DTYPES[self.dtype]).reshape(-1))

    def fill(self, value: float) -> None:
        """The same number everywhere."""
        if self.host is not None:
            self.host[...] = value
        else:
            self.device.fill(value)

    def release(self) -> None:
        """Give the memory back: the array then has no entries."""
        self.shape = (0, *self.shape[1:])
        self.host = np.empty(self.whole, dtype=DTYPES[self.dtype]) if self.host is not None else None
        self.device = None

    def __getitem__(self, at):
        """One entry, on the host."""
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
    """An array inside a kernel. Of several dimensions it is flat in memory, with extents after the first that the compiler knows.

    Indices of entries of several numbers are masked, which changes none of them: so the compiler sees that no address overflows,
    and takes neighbouring numbers for neighbours.
    """

    def __init__(self, flat, n: int, extents: tuple[int, ...]):
        self._flat, self._extents, self._mask = flat, extents, index_mask(n, extents)

    @property
    def shape(self):
        """Of an array of vectors: how many there are."""
        if self._extents:
            raise TypeError("an array of several dimensions has no shape inside a kernel: pass a Count")
        return self._flat.shape

    def __getitem__(self, indices):
        first, rest = (indices[0], indices[1:]) if isinstance(indices, tuple) else (indices, ())
        at = first if isinstance(first, int) else first & self._mask
        for index, extent in zip(rest, self._extents):
            at = at * extent + index
        return impl.subscript(None, self._flat, at)
