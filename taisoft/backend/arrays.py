"""The arrays of a simulator: allocated and counted by name, refused if they do not fit into memory, released together.

Kernels take arrays as arguments, so compiled code does not depend on their size or owner. On the CPU the memory of an array is
a NumPy array, which the host accesses directly; on CUDA it is Taichi's.
"""

import math
import weakref
from typing import Annotated

import numpy as np
import taichi as ti

from taisoft.backend import device_memory
from taisoft.backend.private import impl
from taisoft.errors import SimulationError
from taisoft.machine import available_memory, format_bytes

DTYPES = {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32, ti.u8: np.uint8}
SMALL = 2**20  # bytes up to which available memory is not checked

# Annotation of a number that kernels read from a record of arrays at run time. Other numbers, flags and modules of such a record
# are compile-time structure: a kernel is compiled for each set of them.
Count = Annotated[int, "run time"]


def on_cuda() -> bool:
    """Whether Taichi runs on a GPU, so that arrays are Taichi's own."""
    return ti.cfg.arch == ti.cuda


def index_mask(n: int, extents: tuple[int, ...]) -> int:
    """Mask of the first index of an array of n-vectors with these other extents, so that 31 bits can index all its numbers.

    It is 2^31 - 1 for scalars.
    """
    numbers = max(n, 1) * math.prod(extents)
    return 2 ** (31 - (numbers - 1).bit_length()) - 1


class Array:
    """An array of scalars, or of vectors of n components if n > 0.

    shape: extents of its entries. Only the first may vary at run time: a kernel is compiled for the others. name: in messages.
    memory: of a CPU's kernels, else None; for access by the host it is called `host`. device: Taichi's array on CUDA, else None.
    """

    __slots__ = ("name", "dtype", "n", "shape", "memory", "device", "__weakref__")

    def __init__(self, dtype, shape: tuple[int, ...], n: int, on_host: bool, name: str = ""):
        self.name, self.dtype, self.n, self.shape = name, dtype, n, shape
        self.memory = self.device = None
        if on_host:
            self.memory = np.empty(self.full_shape, dtype=DTYPES[dtype])
            self.memory.fill(0)  # touch the pages, so that later checks of available memory count them
        else:  # as scalars, because Taichi never frees arrays of vectors; at least one, because CUDA has no empty arrays
            self.device = ti.ndarray(dtype, (max(math.prod(self.full_shape), 1),))

    @property
    def full_shape(self) -> tuple[int, ...]:
        """Shape including vector components."""
        return (*self.shape, self.n) if self.n else self.shape

    @property
    def structure(self) -> tuple:
        """The properties that compiled code depends on."""
        return self.dtype, self.n, self.shape[1:]

    @property
    def entries(self) -> int:
        """Number of entries of the flat array that kernels see."""
        return math.prod(self.shape)

    @property
    def address(self) -> int:
        """Of its memory, on the host or on the device."""
        if self.memory is not None:
            return self.memory.ctypes.data
        return impl.get_runtime().prog.get_ndarray_data_ptr_as_int(self.device.arr)

    def to_numpy(self, rows: int | None = None) -> np.ndarray:
        """Return a copy of the array, or of its first `rows` rows."""
        if self.memory is not None:
            return (self.memory if rows is None else self.memory[:rows]).copy()
        shape = self.full_shape if rows is None else (min(rows, self.shape[0]), *self.full_shape[1:])
        data = np.empty(shape, dtype=DTYPES[self.dtype])
        if data.size:
            device_memory.read(self.device, data)
        return data

    def check(self, data: np.ndarray) -> None:
        """Raise ValueError unless data has the array's shape."""
        if data.shape != self.full_shape:
            raise ValueError(f"an array of shape {self.full_shape} cannot take one of shape {data.shape}")

    def from_numpy(self, data: np.ndarray, first: int | None = None) -> None:
        """Copy data into the array, or into its entries from `first` on. Raises ValueError for a wrong shape, before writing."""
        if first is None:
            self.check(data)
        elif data.shape[1:] != self.full_shape[1:] or not 0 <= first <= self.shape[0] - len(data):
            raise ValueError(f"the entries from {first} on of an array of shape {self.full_shape} cannot take {data.shape}")
        at = first or 0
        if self.memory is not None:
            np.copyto(self.memory[at : at + len(data)], data, casting="unsafe")
        elif data.size:
            data = np.ascontiguousarray(data, dtype=DTYPES[self.dtype])
            device_memory.write(self.device, data, at * data[:1].nbytes)

    def fill(self, value: float) -> None:
        """Set every number to value."""
        if self.memory is not None:
            self.memory[...] = value
        else:
            self.device.fill(value)

    def release(self) -> None:
        """Free the memory; the array then has no entries."""
        self.shape = (0, *self.shape[1:])
        self.memory = np.empty(self.full_shape, dtype=DTYPES[self.dtype]) if self.memory is not None else None
        self.device = None

    def __getitem__(self, at):
        """Return a copy of one entry, or of those at indices (k,), on the host."""
        if self.memory is not None and type(at) is int and not (self.n or len(self.shape) > 1):
            return self.memory.item(at)
        entry = (self.memory if self.memory is not None else self._download())[at]
        return entry.copy() if entry.ndim else entry.item()

    def __setitem__(self, at, value) -> None:
        if self.memory is not None:
            self.memory[at] = value
        else:
            data = self._download()
            data[at] = value
            self._upload(data)

    _download, _upload = to_numpy, from_numpy  # which `counters` does not see


Array.host = Array.memory  # the same slot, until `counters` puts a property in place of this name


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


class FieldArena:
    """Allocator of one simulator's arrays. bytes: size of each array, by name."""

    def __init__(self) -> None:
        self.bytes: dict[str, int] = {}
        self._arrays: weakref.WeakSet[Array] = weakref.WeakSet()

    def field(self, name: str, dtype, shape: tuple[int, ...] | int, data: np.ndarray | None = None) -> Array:
        """Allocate scalars, filled from data if given, else with zeros."""
        return self._allocate(name, dtype, shape, 0, data)

    def filled(self, name: str, dtype, data: np.ndarray) -> Array:
        """Allocate scalars of the shape of data, and fill them from it."""
        return self._allocate(name, dtype, data.shape, 0, data)

    def vectors(self, name: str, dtype, shape: int, data: np.ndarray | None = None, n: int = 3) -> Array:
        """Allocate n-vectors, filled from data (shape, n) if given, else with zeros."""
        return self._allocate(name, dtype, shape, n, data)

    def _allocate(self, name: str, dtype, shape, n: int, data: np.ndarray | None) -> Array:
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        numbers = max(n, 1) * math.prod(shape[1:])
        needed = self._checked_bytes(name, dtype, shape[0] * numbers, index_mask(n, shape[1:]) * numbers)
        on_host = not on_cuda()
        try:
            array = Array(dtype, shape, n, on_host, name)
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
        free = None if on_cuda() or needed <= SMALL else available_memory()
        if free is not None and needed > free:
            raise SimulationError(self._memory_message(name, needed, free))
        return needed

    def _memory_message(self, name: str, needed: int, free: int | None) -> str:
        return f"not enough memory for the array '{name}': {format_bytes(needed)} are needed, available: {format_bytes(free)}"

    def release(self) -> None:
        """Free all memory, including that of arrays still referenced: kernels must not be launched with them."""
        for array in self._arrays:
            array.release()
        self._arrays.clear()
        self.bytes.clear()


def upload(pairs: list[tuple[Array, np.ndarray]]) -> None:
    """Copy data into arrays of the same shape. Raises ValueError for a wrong shape, before anything is written."""
    for array, data in pairs:
        array.check(data)
    for array, data in pairs:
        array.from_numpy(data)


def download(arrays: list[Array], rows: int | None = None) -> list[np.ndarray]:
    """Copy arrays to NumPy; only the first `rows` rows if given."""
    return [array.to_numpy(rows) for array in arrays]
