"""Taichi fields for its renderer, which draws nothing else, released together."""

import numpy as np
import taichi as ti

from taisoft.arrays import DTYPES
from taisoft.lane_pool import free, place


class GuiFields:
    """Makes fields; `release` frees them all."""

    def __init__(self) -> None:
        self._trees: list = []

    def field(self, dtype, data: np.ndarray):
        """A field of scalars that holds data."""
        return self._place(ti.field(dtype), data)

    def vectors(self, dtype, count: int, data: np.ndarray | None = None, n: int = 3):
        """A field of n-vectors that holds data (count, n), else zeros."""
        return self._place(ti.Vector.field(n, dtype), data, count)

    def _place(self, field, data: np.ndarray | None, count: int | None = None):
        self._trees.append(place(field, len(data) if count is None else count))
        if data is not None:
            move([(field, data)])
        return field

    def release(self) -> None:
        """Free the fields."""
        free(self._trees)


def move(pairs: list[tuple]) -> None:
    """pairs: a field, and what it is to hold."""
    for field, data in pairs:
        field.from_numpy(np.ascontiguousarray(data, dtype=DTYPES[field.dtype]))
