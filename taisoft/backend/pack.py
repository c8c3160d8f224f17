"""The arguments of a kernel: its numbers, counts and arrays, all in one struct, the pack, or a parameter each.

At each launch Taichi copies the list of a kernel's parameters and looks up every array among them; the pack is one parameter, and
no array, whatever it holds. Inside the kernel its members are arrays and numbers as any others. A context of a launch is kept for
each set of arrays, with their addresses; the numbers, which come first in the pack, are written into it before a launch.

Taichi has no public way to reach the memory of a context's arguments, and one call for each number would cost half a launch.
`_memory` therefore follows three C++ objects of Taichi 1.7.4, compares what they say about each other, and takes the memory only
if numbers set through Taichi's own calls are found where they should be. Otherwise these calls are used.

A context on CUDA can be launched only once, unless it holds a pack and two words are restored that a launch overwrites.
"""

import ctypes
import functools
import operator
import struct
from collections.abc import Callable, Sequence
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Array, on_cuda
from taisoft.backend.private import AnyArray, Expr, core, impl
from taisoft.backend.structure import COUNT
from taisoft.errors import SimulationError

CODES = {ti.f64: "d", ti.i32: "i"}  # of numbers, for Python's struct module
WORD = ctypes.c_uint64
VALUE = 16  # bytes of a Python object before what it holds
# words of a context's builder: address of the context, twice; the arguments and results; bytes of the arguments
OWNED, CONTEXT, ARGUMENTS, RESULTS, SIZE = 1, 2, 3, 4, 6
FIRST, LAST = 0, 3  # words of a context: its arguments and results


class Arguments:
    """numbers: ti.f64 or ti.i32 each. leaves: structures of the arrays and counts, see `structure.leaf_structures`."""

    def __init__(self, numbers: Sequence[Any], leaves: Sequence[tuple], packed: bool):
        self._kinds = [*numbers, *[ti.i32 if leaf[0] == COUNT else leaf[1] for leaf in leaves]]
        self._n_numbers, self._packed, self.kept = len(numbers), packed, packed or not on_cuda()
        self._struct = struct.Struct("@" + "".join(CODES[number] for number in numbers))
        self._at: list[list[int]] = []  # indices of the members among the kernel's parameters

    def declare(self) -> list[Any]:
        """Give them to the kernel that is being traced, as parameters; return its variables."""
        factory, kernel = core.get_type_factory_instance(), impl.get_runtime().compiling_callable
        entries = [_entry(kind) for kind in self._kinds]
        if self._packed and entries:
            types = [core.DataType(factory.get_ndarray_struct_type(k[0], 1, False)) if _is_array(k) else k for k in self._kinds]
            members = factory.get_struct_type([(member, f"m{k}") for k, member in enumerate(types)])
            (slot,) = kernel.insert_scalar_param(members, "pack")
            self._at = [[slot, k] for k in range(len(entries))]
        else:
            self._at = [
                kernel.insert_ndarray_param(entry, 1, "a", False) if _is_array(kind) else kernel.insert_scalar_param(kind, "n")
                for kind, entry in zip(self._kinds, entries)
            ]
        kernel.finalize_params()
        return [
            AnyArray(core.make_external_tensor_expr(entry, 1, at, False, 0, core.BoundaryMode.UNSAFE))
            if _is_array(kind)
            else Expr(core.make_arg_load_expr(at, kind, False, create_load=True))
            for at, kind, entry in zip(self._at, self._kinds, entries)
        ]

    def bind(self, context: Any, leaves: Sequence[Array | int]) -> Callable | None:
        """Put arrays and counts into a new context. Returns the function of the numbers to call before each launch, if any."""
        for at, leaf in zip(self._at[self._n_numbers :], leaves):
            if not isinstance(leaf, Array):
                context.set_struct_arg_int(at, operator.index(leaf))
            elif self._packed:
                context.set_struct_arg_int([*at, 0, 0], leaf.entries)  # for index checks in debug mode
                context.set_struct_arg_uint([*at, 1], leaf.address)
            elif leaf.memory is None:
                context.set_arg_ndarray(at, leaf.device.arr)
            else:
                context.set_arg_external_array_with_shape(at, leaf.address, leaf.memory.nbytes, (leaf.entries,), 0)
        words = self._memory(context) if self._packed and (self._n_numbers or on_cuda()) else None
        if words is None and self._packed and on_cuda():
            raise SimulationError("TAISOFT_PACK needs the memory layout of Taichi 1.7.4, which is not the one found: unset it")
        if words is None:
            return functools.partial(self._set_numbers, context) if self._n_numbers else None
        write = functools.partial(self._struct.pack_into, (ctypes.c_char * self._struct.size).from_address(words[ARGUMENTS]), 0)
        return functools.partial(_restore_and_write, words, write) if on_cuda() else write

    def _set_numbers(self, context: Any, *numbers: float) -> None:
        self._struct.pack(*numbers)  # the same errors
        for at, kind, number in zip(self._at, self._kinds, numbers):
            if kind == ti.f64:
                context.set_struct_arg_float(at, number)
            else:
                context.set_struct_arg_int(at, operator.index(number))

    def _memory(self, context: Any) -> Any:
        """The words of a context's builder, if the numbers lie where these say; else None. Sets the numbers."""
        builder = (WORD * (SIZE + 1)).from_address(WORD.from_address(id(context) + VALUE).value)
        if builder[OWNED] != builder[CONTEXT] or not builder[CONTEXT]:
            return None
        inner = (WORD * (LAST + 1)).from_address(builder[CONTEXT])
        same = inner[FIRST] == builder[ARGUMENTS] and inner[LAST] == builder[RESULTS]
        if not (same and builder[ARGUMENTS] and self._struct.size <= builder[SIZE]):
            return None
        examples = range(1, self._n_numbers + 1)
        self._set_numbers(context, *examples)
        return builder if ctypes.string_at(builder[ARGUMENTS], self._struct.size) == self._struct.pack(*examples) else None

    def explain(self, names: Sequence[str], numbers: Sequence[Any]) -> str:
        """The first of these numbers that a launch cannot take, as a sentence about the argument of that name."""
        for kind, name, number in zip(self._kinds, names, numbers):
            try:
                struct.pack(CODES[kind], number)
            except struct.error:
                return f"'{name}' must be {'a number' if kind == ti.f64 else 'an integer of 32 bits'}, not {number!r}"
        raise AssertionError("the launch can take these numbers")


def _is_array(kind: Any) -> bool:
    return isinstance(kind, tuple)


def _entry(kind: Any) -> Any:
    """Taichi type of a number, or of an array's entries."""
    if not _is_array(kind):
        return kind
    dtype, n, _ = kind
    return core.get_type_factory_instance().get_tensor_type([n], dtype) if n else dtype


def _restore_and_write(words: Any, write: Callable, *numbers: float) -> None:
    """As `write`, on CUDA, where a launch leaves addresses of freed memory in the place of the host's."""
    inner = (WORD * (LAST + 1)).from_address(words[CONTEXT])
    inner[FIRST], inner[LAST] = words[ARGUMENTS], words[RESULTS]
    write(*numbers)
