"""Small arrays read together: each reading waits for a GPU, so there a kernel gathers their numbers, and the host reads once."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import DTYPES, Array, FieldArena
from taisoft.backend.paths import on_gpu_path
from taisoft.backend.runtime import kernel

ROOM = 64  # numbers in all


@dataclass(frozen=True, eq=False)
class _Part:
    """An array of n numbers, and the place of the first one among all."""

    array: Any
    first: int
    n: int


@dataclass(frozen=True, eq=False)
class _Parts:
    every: tuple  # of _Part
    gathered: Any  # (ROOM) f64


@kernel
def gather(parts: ti.template()):
    """Copy the numbers of all arrays to one."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        for part in ti.static(parts.every):
            for k in ti.static(range(part.n)):
                parts.gathered[part.first + k] = ti.cast(part.array[k], ti.f64)


def read_each(arrays: list[Array]) -> list[list]:
    """Return the numbers of each array."""
    found = [array.host for array in arrays]
    return [array.to_numpy().tolist() if host is None else host.tolist() for array, host in zip(arrays, found)]


class Reader:
    """Reads arrays of scalars, up to ROOM in all."""

    def __init__(self, arena: FieldArena, name: str):
        self._gathered = arena.field(f"{name}_gathered", ti.f64, ROOM) if on_gpu_path() else None
        self._kept: dict[tuple, _Parts] = {}  # by the identities of the arrays, which they keep alive

    def __call__(self, arrays: list[Array]) -> list[list]:
        """Return the numbers of each array."""
        if self._gathered is None:
            return read_each(arrays)
        sizes = [array.shape[0] for array in arrays]
        ends = np.cumsum(sizes).tolist()
        key = tuple(id(array) for array in arrays)
        if key not in self._kept:
            if ends[-1] > ROOM:
                raise ValueError(f"{ends[-1]} numbers are to be read together, and there is room for {ROOM}")
            parts = tuple(_Part(array, end - n, n) for array, end, n in zip(arrays, ends, sizes))
            self._kept[key] = _Parts(parts, self._gathered)
        gather(self._kept[key])
        numbers = self._gathered.to_numpy(ends[-1])
        return [numbers[end - n : end].astype(DTYPES[a.dtype]).tolist() for a, end, n in zip(arrays, ends, sizes)]
