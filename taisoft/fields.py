"""Taichi fields of a simulator: made in groups, counted by name, filled from arrays, released together."""

import contextlib
from collections.abc import Iterator

import numpy as np
import taichi as ti
from taichi.lang import impl

from taisoft.errors import SimulationError
from taisoft.memory import available_memory, told
from taisoft.runtime import trees
from taisoft.transfer import DTYPES, placed, removed, upload

MAX_TREES = 480  # of field memory that may be open at once
SMALL = 2**20  # bytes of a tree that are not worth a look at what is free


class FieldArena:
    """Fields of one simulator: counted by name, released together.

    Taichi holds each separately placed part of memory, a tree, in a table of 512 rows whose end it does not watch. So fields
    that are made together share a tree, see `group`, and no more than MAX_TREES are open at once.
    """

    def __init__(self) -> None:
        self.bytes: dict[str, int] = {}
        self._trees: list = []
        self._group: tuple[ti.FieldsBuilder, list] | None = None

    def field(self, name: str, dtype, shape: tuple[int, ...] | int, data: np.ndarray | None = None):
        """A scalar field, filled from data when given (else zero)."""
        return self._place(name, lambda: ti.field(dtype), dtype, 1, shape, data)

    def vectors(self, name: str, dtype, shape: int, data: np.ndarray | None = None, n: int = 3):
        """A field of n-vectors, filled from data (shape, n) when given (else zero)."""
        return self._place(name, lambda: ti.Vector.field(n, dtype), dtype, n, shape, data)

    @contextlib.contextmanager
    def group(self) -> Iterator[None]:
        """Fields made inside share a tree; they can be used, and hold their data, once the outermost group has ended."""
        if self._group is not None:
            yield
            return
        self._group = ti.FieldsBuilder(), []
        try:
            yield
        finally:  # in any case: a field that is never placed stops every later kernel
            (builder, fields), self._group = self._group, None
            if fields:
                self._finalize(builder, [field for field, _, _ in fields], [name for _, _, name in fields])
        upload([(field, data) for field, data, _ in fields if data is not None])

    def _place(self, name, make, dtype, components, shape, data):
        if name in self.bytes:
            raise ValueError(f"field '{name}' is allocated twice")
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        count = int(np.prod(shape, dtype=np.int64))
        if count * components >= 2**31:
            raise SimulationError(f"field '{name}' needs {count * components} entries, more than 2^31 - 1")
        with self.group():
            builder, fields = self._group
            field = make()  # not before: a field that is never placed stops every later kernel
            if shape == ():
                builder.place(field)
            else:
                builder.dense((ti.i, ti.ij, ti.ijk, ti.ijkl)[len(shape) - 1], shape).place(field)
            fields.append((field, None if data is None else np.ascontiguousarray(data), name))
            self.bytes[name] = count * components * np.dtype(DTYPES[dtype]).itemsize
        return field

    def _finalize(self, builder: ti.FieldsBuilder, fields: list, names: list[str]) -> None:
        on_cpu = ti.cfg.arch != ti.cuda
        needed = sum(self.bytes[name] for name in names)
        free = available_memory() if on_cpu and needed > SMALL else None
        problem = None
        if trees["open"] >= MAX_TREES:
            problem = f"too many simulators are open for Taichi to hold field '{names[0]}' and others: close one first"
        elif free is not None and needed > free:
            problem = self._no_memory(names, needed, free)
        if problem is not None:
            impl.get_runtime().finalize_fields_builder(builder)  # what is left open stops every later kernel
            raise SimulationError(problem)
        try:
            self._trees.append((builder.finalize(), fields))
        except RuntimeError:  # whose text is the C++ layer's
            raise SimulationError(self._no_memory(names, needed, available_memory() if on_cpu else None)) from None
        trees["open"] += 1
        placed(fields)

    def _no_memory(self, names: list[str], needed: int, free: int | None) -> str:
        """A sentence about fields that do not fit, which names the largest of them."""
        largest = max(names, key=lambda name: self.bytes[name])
        return (
            f"not enough memory for the field '{largest}' and {len(names) - 1} made with it: {told(needed)} are needed, "
            f"available: {told(free)}"
        )

    def release(self) -> None:
        """Give the memory back to Taichi, where it was not initialised anew since, which has freed it."""
        while self._trees:
            tree, fields = self._trees.pop()
            removed(fields)
            if tree.prog is impl.get_runtime().prog:
                tree.destroy()
                trees["open"] -= 1
        self.bytes.clear()
