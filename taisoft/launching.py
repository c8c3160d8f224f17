"""Launches of compiled kernels without the parts of Taichi's launch that find out anew what has not changed.

Taichi looks every argument's type up, digests templates, and asks its compiler for the kernel at each launch: 20 us and more,
5 us for each number on top, where kernels of a small scene take less themselves. A kernel that has run before with the same
templates needs none of that: numbers and addresses go into a context, and the context to the compiled code.
Where fields are freed, Taichi forgets its compiled kernels, whose code stays; a launch at hand goes on with that.
This rests on 1.7.4, the version that taisoft asks for.
"""

import operator
from collections.abc import Callable

import numpy as np
import taichi as ti
from taichi.lang import impl
from taichi.lang.kernel_impl import template
from taichi.types import ndarray_type, primitive_types


class Launch:
    """A kernel compiled for certain templates and types of arrays, to be used only while Taichi is not initialised anew."""

    def __init__(self, kernel, compiled, setters: list[tuple[int, tuple[int], int]], templates: tuple):
        self._kernel, self._compiled, self._setters = kernel, compiled, setters
        self._templates = templates  # held, so that no other object gets the address by which they are known
        self._program = impl.get_runtime().prog
        self._data = self._program.compile_kernel(self._program.config(), self._program.get_device_caps(), compiled)

    def __call__(self, arguments: tuple):
        """Launch with these arguments, templates included. Returns what the kernel returns."""
        context = self._compiled.make_launch_context()
        for at, slot, kind in self._setters:
            value = arguments[at]
            if kind == REAL:
                context.set_arg_float(slot, value)
            elif kind == WHOLE:
                context.set_arg_int(slot, operator.index(value))
            else:
                context.set_arg_external_array_with_shape(slot, value.ctypes.data, value.nbytes, value.shape, 0)
        self._program.launch_kernel(self._data, context)
        returned = self._kernel.return_type
        if returned is None:
            return None
        ti.sync()
        values = [self._kernel.construct_kernel_ret(context, kind, (i,)) for i, kind in enumerate(returned)]
        return values[0] if len(values) == 1 else values


REAL, WHOLE, ARRAY = range(3)


def places_of(compiled: Callable) -> tuple[int, list[int], list[int]]:
    """How many arguments a `ti.kernel` has, which are templates, and which arrays."""
    kinds = [declared.annotation for declared in compiled._primal.arguments]
    return (
        len(kinds),
        [k for k, kind in enumerate(kinds) if isinstance(kind, template)],
        [k for k, kind in enumerate(kinds) if isinstance(kind, ndarray_type.NdarrayType)],
    )


def prepare(compiled: Callable, arguments: tuple) -> Launch | None:
    """A launch of a `ti.kernel` that has just run with these arguments; None where it needs Taichi's own way."""
    kernel, setters, templates = compiled._primal, [], []
    if ti.cfg.debug:  # errors in kernels are raised there
        return None
    for at, (declared, value) in enumerate(zip(kernel.arguments, arguments)):
        kind = declared.annotation
        if isinstance(kind, template):
            templates.append(value)
            continue
        slot = (at - len(templates),)
        if id(kind) in primitive_types.real_type_ids:
            setters.append((at, slot, REAL))
        elif kind in (ti.i32, ti.i64):
            setters.append((at, slot, WHOLE))
        elif isinstance(kind, ndarray_type.NdarrayType) and isinstance(value, np.ndarray) and kind.dtype is None:
            setters.append((at, slot, ARRAY))
        else:
            return None
    return Launch(kernel, kernel.compiled_kernels[kernel.ensure_compiled(*arguments)], setters, tuple(templates))
