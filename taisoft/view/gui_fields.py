"""Taichi fields for its renderer, which draws nothing else. Released together: Taichi frees only whole trees of fields."""

import numpy as np
import taichi as ti
from taichi.lang import impl

from taisoft.arrays import DTYPES


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
        builder = ti.FieldsBuilder()
        builder.dense(ti.i, len(data) if count is None else count).place(field)
        self._trees.append(builder.finalize())
        if data is not None:
            move([(field, data)])
        return field

    def release(self) -> None:
        """Free the fields, where Taichi was not initialised anew since, which has freed them."""
        while self._trees:
            tree = self._trees.pop()
            if tree.prog is impl.get_runtime().prog:
                tree.destroy()


def move(pairs: list[tuple]) -> None:
    """pairs: a field, and what it is to hold."""
    for field, data in pairs:
        field.from_numpy(np.ascontiguousarray(data, dtype=DTYPES[field.dtype]))
