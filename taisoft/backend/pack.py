"""The pack: one argument, a struct, that holds the lengths and addresses of all arrays of a kernel and its numbers.

At each launch Taichi copies the list of a kernel's parameters and looks up every array among them; the pack is one parameter, and
no array, whatever it holds. Inside the kernel its members are arrays and numbers as any others. A context of a launch is kept for
each set of arrays, and holds them; the numbers, which come first in the pack, are written into it before a launch.

Taichi has no public way to reach the memory of a context's arguments, and one call for each number would cost half a launch.
`_memory` therefore follows three C++ objects of Taichi 1.7.4, compares what they say about each other, and takes the memory only
if numbers set through Taichi's own calls are found where they should be. Otherwise these calls are used.
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


class Pack:
    """numbers: ti.f64 or ti.i32 each. leaves: structures of the arrays and counts, see `structure.leaf_structures`."""

    def __init__(self, numbers: Sequence[Any], leaves: Sequence[tuple]):
        self._numbers, self._leaves = numbers, leaves
        self._struct = struct.Struct("@" + "".join(CODES[number] for number in numbers))
        self._slot = 0  # among the kernel's parameters

    def declare(self) -> list[Any]:
        """Give the kernel that is being traced this parameter; return the members as its variables."""
        kinds = [*self._numbers, *[ti.i32 if leaf[0] == COUNT else leaf[1] for leaf in self._leaves]]
        if not kinds:
            return []
        factory, function = core.get_type_factory_instance(), impl.get_runtime().compiling_callable
        types = [
            core.DataType(factory.get_ndarray_struct_type(kind[0], 1, False)) if isinstance(kind, tuple) else kind
            for kind in kinds
        ]
        members = factory.get_struct_type([(member, f"m{k}") for k, member in enumerate(types)])
        (self._slot,) = function.insert_scalar_param(members, "pack")
        function.finalize_params()
        return [self._variable(k, kind) for k, kind in enumerate(kinds)]

    def _variable(self, k: int, kind: Any) -> Any:
        if not isinstance(kind, tuple):
            return Expr(core.make_arg_load_expr([self._slot, k], kind, False, create_load=True))
        dtype, n, _ = kind
        entry = core.get_type_factory_instance().get_tensor_type([n], dtype) if n else dtype
        return AnyArray(core.make_external_tensor_expr(entry, 1, [self._slot, k], False, 0, core.BoundaryMode.UNSAFE))

    def bind(self, context: Any, leaves: Sequence[Array | int]) -> Callable | None:
        """Put arrays and counts into a new context. Returns the function of the numbers to call before each launch, if any."""
        for k, leaf in enumerate(leaves, len(self._numbers)):
            if isinstance(leaf, Array):
                context.set_struct_arg_int((self._slot, k, 0, 0), leaf.entries)  # for index checks in debug mode
                context.set_struct_arg_uint((self._slot, k, 1), leaf.address)
            else:
                context.set_struct_arg_int((self._slot, k), operator.index(leaf))
        if not (self._numbers or on_cuda()):
            return None
        words = self._memory(context)
        if words is None and on_cuda():
            raise SimulationError("TAISOFT_PACK needs the memory layout of Taichi 1.7.4, which is not the one found: unset it")
        if words is None:
            return functools.partial(self._set_numbers, context)
        write = functools.partial(self._struct.pack_into, (ctypes.c_char * self._struct.size).from_address(words[ARGUMENTS]), 0)
        return functools.partial(_restore_and_write, words, write) if on_cuda() else write

    def _set_numbers(self, context: Any, *numbers: float) -> None:
        self._struct.pack(*numbers)  # the same errors
        for k, (kind, number) in enumerate(zip(self._numbers, numbers)):
            if kind == ti.f64:
                context.set_struct_arg_float((self._slot, k), number)
            else:
                context.set_struct_arg_int((self._slot, k), operator.index(number))

    def _memory(self, context: Any) -> Any:
        """The words of a context's builder, if the numbers lie where these say; else None. Sets the numbers."""
        builder = (WORD * (SIZE + 1)).from_address(WORD.from_address(id(context) + VALUE).value)
        if builder[OWNED] != builder[CONTEXT] or not builder[CONTEXT]:
            return None
        inner = (WORD * (LAST + 1)).from_address(builder[CONTEXT])
        same = inner[FIRST] == builder[ARGUMENTS] and inner[LAST] == builder[RESULTS]
        if not (same and builder[ARGUMENTS] and self._struct.size <= builder[SIZE]):
            return None
        examples = [k + 1 for k in range(len(self._numbers))]
        self._set_numbers(context, *examples)
        return builder if ctypes.string_at(builder[ARGUMENTS], self._struct.size) == self._struct.pack(*examples) else None

    def explain(self, names: Sequence[str], numbers: Sequence[Any]) -> str:
        """The first of these numbers that a launch cannot take, as a sentence about the argument of that name."""
        for kind, name, number in zip(self._numbers, names, numbers):
            try:
                struct.pack(CODES[kind], number)
            except struct.error:
                return f"'{name}' must be {'a number' if kind == ti.f64 else 'an integer of 32 bits'}, not {number!r}"
        raise AssertionError("the launch can take these numbers")


def _restore_and_write(words: Any, write: Callable, *numbers: float) -> None:
    """As `write`, on CUDA, where a launch leaves addresses of freed memory in the place of the host's."""
    inner = (WORD * (LAST + 1)).from_address(words[CONTEXT])
    inner[FIRST], inner[LAST] = words[ARGUMENTS], words[RESULTS]
    write(*numbers)
