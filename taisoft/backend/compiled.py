"""A kernel compiled for one structure of its arguments, in three ways to launch it.

* `Packed`: all arrays and numbers in one argument, see `pack`: a launch costs the host a microsecond, whatever the kernel takes.
* `Flat`: each array and number is an argument. On CUDA, until the pack has been proved there.
* `Public`: as `Flat`, by Taichi's public interface alone: 20 us or more a launch, at most 64 arguments.

The first two rely on Taichi 1.7.4: see `tracing`. NumPy arrays are arguments of their own in all of them: Taichi copies them to a
GPU and back.
"""

import operator
import struct
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import numpy as np
import taichi as ti

from taisoft.backend.arrays import DTYPES, Array, on_cuda
from taisoft.backend.pack import Pack
from taisoft.backend.private import AutodiffMode, Kernel, impl, ndarray_type, primitive_types
from taisoft.backend.structure import COUNT, generate, leaf_structures, leaves_of, rebuild


class Signature(NamedTuple):
    """What a launch hands over: the number of `Array`s, of the host's NumPy arrays, and of values returned to the host."""

    kernel: str
    arrays: int
    host_arrays: int
    returned: int


class Compiled:
    """A kernel compiled for one structure; valid until Taichi is re-initialised."""

    def __init__(self, function: Callable, names: list[str], annotations: list[Any], structures: list[tuple | None], examples):
        """structures: one per parameter, None if it is no template. examples: the argument if it is a host array, else None."""
        self.structures, self._names, self._annotations = structures, names, annotations
        self._numbers = [k for k, kind in enumerate(annotations) if structures[k] is None and is_number(kind)]
        self._host_arrays = [k for k, example in enumerate(examples) if example is not None]
        self._leaves = [leaf for structure in structures if structure is not None for leaf in leaf_structures(structure)]
        returned = function.__annotations__.get("return")  # several: a tuple[...]
        arrays = sum(leaf[0] != COUNT for leaf in self._leaves)
        n_returned = len(get_args(returned)) or int(returned is not None)
        self.signature = Signature(function.__name__, arrays, len(self._host_arrays), n_returned)
        self._compile(function, examples)

    def _compile(self, function: Callable, examples: list) -> None:
        raise NotImplementedError

    def bind(self, arguments: tuple) -> Any:
        """What launches with these records need."""
        raise NotImplementedError

    def launch(self, bound: Any, arguments: tuple) -> Any:
        """Launch and return the kernel's result. bound: from `bind` of these arguments."""
        return self._launch(bound, arguments)

    def _leaves_of(self, arguments: tuple) -> list[Array | int]:
        return [leaf for value, s in zip(arguments, self.structures) if s is not None for leaf in leaves_of(value, s)]

    def _build(self, generated: Callable, *examples: Any) -> None:
        """Compile a function without templates through Taichi's own objects."""
        self._kernel = Kernel(generated, AutodiffMode.NONE)
        key = self._kernel.ensure_compiled(*examples)
        self.program = impl.get_runtime().prog
        self._cpp = self._kernel.compiled_kernels[key]
        self.data = self.program.compile_kernel(self.program.config(), self.program.get_device_caps(), self._cpp)

    def _set_host_array(self, context: Any, slot: int, array: np.ndarray) -> None:
        if not array.flags.c_contiguous:
            raise ValueError(f"{self.signature.kernel} takes only contiguous arrays")
        context.set_arg_external_array_with_shape((slot,), array.ctypes.data, array.nbytes, array.shape, 0)

    def result(self, context: Any) -> Any:
        """What the kernel returned, None if it returns nothing."""
        kinds = self._kernel.return_type
        if kinds is None:
            return None
        ti.sync()
        values = [self._kernel.construct_kernel_ret(context, kind, (i,)) for i, kind in enumerate(kinds)]
        return values[0] if len(values) == 1 else values


class Packed(Compiled):
    """Arrays and numbers in a pack; the host's arrays are the first arguments."""

    def _compile(self, function: Callable, examples: list) -> None:
        pack = self._pack = Pack([self._annotations[k] for k in self._numbers], self._leaves)

        def declare() -> tuple:
            members = pack.declare()
            numbers, leaves = dict(zip(self._numbers, members)), iter(members[len(self._numbers) :])
            values = [(numbers.get(k), s) for k, s in enumerate(self.structures) if k not in self._host_arrays]
            return tuple([number if s is None else rebuild(s, leaves) for number, s in values])

        inside = [name for k, name in enumerate(self._names) if k not in self._host_arrays]
        self._build(generate(function, dict.fromkeys(inside), declare), *[examples[k] for k in self._host_arrays])

    def bind(self, arguments: tuple) -> tuple[Any, Callable | None]:
        context = self._cpp.make_launch_context()
        return context, self._pack.bind(context, self._leaves_of(arguments))

    def _launch(self, bound: tuple, arguments: tuple) -> Any:
        context, write = bound
        numbers = [arguments[k] for k in self._numbers]
        for slot, k in enumerate(self._host_arrays):
            self._set_host_array(context, slot, arguments[k])
        if write is not None:
            try:
                write(*numbers)
            except struct.error:
                raise self.refusal(*numbers) from None
        self.program.launch_kernel(self.data, context)
        return self.result(context)

    def refusal(self, *numbers: Any) -> TypeError:
        """The error of a launch with these numbers."""
        return TypeError(f"{self.signature.kernel}: {self._pack.explain([self._names[k] for k in self._numbers], numbers)}")


class Flat(Compiled):
    """Every array and number is an argument, set by a call of Taichi."""

    def _compile(self, function: Callable, examples: list) -> None:
        taken = {name: s for name, s in zip(self._names, self.structures) if s is not None}
        self._slots: list[tuple[int, int]] = []  # (argument, slot) of what is no template
        self._templates: list[int] = []  # slots of the leaves
        dummies: list = []
        for k, structure in enumerate(self.structures):
            if structure is None:
                self._slots.append((k, len(dummies)))
                dummies.append(0 if examples[k] is None else examples[k])
            else:
                kinds = list(leaf_structures(structure))
                self._templates += range(len(dummies), len(dummies) + len(kinds))
                dummies += [_dummy(kind) for kind in kinds]
        self._build_flat(generate(function, taken), dummies)

    def _build_flat(self, generated: Callable, dummies: list) -> None:
        self._build(generated, *dummies)

    def bind(self, arguments: tuple) -> Any:
        """A context that holds the records; on CUDA, where it can be launched only once, what to put into one."""
        leaves = list(zip(self._templates, self._leaves_of(arguments)))
        if on_cuda():
            return [(slot, leaf.device.arr if isinstance(leaf, Array) else operator.index(leaf)) for slot, leaf in leaves]
        context = self._cpp.make_launch_context()
        for slot, leaf in leaves:
            if isinstance(leaf, Array):
                context.set_arg_external_array_with_shape((slot,), leaf.address, leaf.memory.nbytes, (leaf.entries,), 0)
            else:
                context.set_arg_int((slot,), operator.index(leaf))
        return context

    def _context_of(self, bound: list[tuple[int, Any]]) -> Any:
        context = self._cpp.make_launch_context()
        for slot, value in bound:
            if type(value) is int:
                context.set_arg_int((slot,), value)
            else:
                context.set_arg_ndarray((slot,), value)
        return context

    def _launch(self, bound: Any, arguments: tuple) -> Any:
        context = self._context_of(bound) if isinstance(bound, list) else bound
        for k, slot in self._slots:
            value = arguments[k]
            if k in self._host_arrays:
                self._set_host_array(context, slot, value)
            elif self._annotations[k] == ti.f64:
                context.set_arg_float((slot,), value)
            else:
                context.set_arg_int((slot,), operator.index(value))
        self.program.launch_kernel(self.data, context)
        return self.result(context)


class Public(Flat):
    """As `Flat`, but launched as any kernel of Taichi."""

    def _build_flat(self, generated: Callable, dummies: list) -> None:
        self._public = ti.kernel(generated)

    def bind(self, arguments: tuple) -> None:
        return None

    def _launch(self, bound: None, arguments: tuple) -> Any:
        """Device arrays are copied to the host and back: Taichi rejects scalar device arrays as vector arguments."""
        flat, copies = [], {}
        for argument, structure in zip(arguments, self.structures):
            for leaf in [argument] if structure is None else leaves_of(argument, structure):
                if isinstance(leaf, Array):
                    if leaf.memory is None and id(leaf) not in copies:
                        copies[id(leaf)] = leaf, leaf.to_numpy()
                    host = copies[id(leaf)][1] if leaf.memory is None else leaf.memory
                    leaf = host.reshape((-1, leaf.n) if leaf.n else -1)
                flat.append(leaf)
        returned = self._public(*flat)
        for leaf, host in copies.values():
            leaf.from_numpy(host)
        return returned


def is_number(annotation: Any) -> bool:
    """Whether a parameter without a template is a number, else it is an array of the host. Raises TypeError for other types."""
    if annotation in (ti.f64, ti.i32):
        return True
    if isinstance(annotation, ndarray_type.NdarrayType) and (
        annotation.dtype is None or id(annotation.dtype) in primitive_types.type_ids
    ):
        return False
    raise TypeError(f"a kernel cannot take a parameter of type {annotation}")


def _dummy(structure: tuple) -> Any:
    """A value of a leaf's type, to compile with."""
    if structure[0] == COUNT:
        return 1
    dtype, n, _ = structure[1]
    return np.zeros((1, n) if n else 1, dtype=DTYPES[dtype])
