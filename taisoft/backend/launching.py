"""Kernels over records of arrays: compiled once per structure, launched with any arrays and sizes of that structure.

A kernel's template arguments are records (dataclasses) of arrays, single arrays, modules and constants. Taichi would recompile
a kernel for each record. Here a record is flattened: its arrays and its numbers marked `Count` become arguments, and the rest
(types, all extents but the first, flags, laws) is the structure that the code is compiled for. Inside the kernel the record is
rebuilt around those arguments, so the kernel's source reads as if it had received the record.
A record may contain records and tuples of records. Only the fields named by a kernel and the functions it calls are passed.

A launch through Taichi looks up the type of every argument. A launch here whose records are known only sets numbers and
addresses in a context, which on the CPU is created once. This relies on Taichi 1.7.4: see `tracing`.
"""

import dataclasses
import functools
import inspect
import operator
import weakref
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import numpy as np
import taichi as ti

from taisoft.backend.arrays import DTYPES, Array, on_cuda
from taisoft.backend.private import AutodiffMode, Kernel, impl, ndarray_type, primitive_types, template
from taisoft.backend.structure import COUNT, generate, holders, leaf_structures, leaves_of, names_in, names_of_types, structure_of
from taisoft.backend.tracing import FAST_TRACING

REAL, INTEGER, HOST_ARRAY = range(3)
PUBLIC = not FAST_TRACING  # launch only through Taichi's public interface: 20 us or more a launch, at most 64 arguments


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
        self.structures = structures
        generated = generate(function, {n: s for n, s in zip(names, structures) if s is not None})
        self._setters, dummies = [], []  # setters: (argument index, slot, kind) of non-template parameters
        self._leaves: list[tuple[int, int]] = []  # (first slot, argument index) of each template
        for index, (structure, annotation) in enumerate(zip(structures, annotations)):
            if structure is None:
                self._setters.append((index, (len(dummies),), _setter(annotation)))
                dummies.append(examples[index] if examples[index] is not None else 0)
            else:
                self._leaves.append((len(dummies), index))
                dummies += [_dummy(kind) for kind in leaf_structures(structure)]
        arrays = sum(kind[0] != COUNT for s in structures if s is not None for kind in leaf_structures(s))
        host_arrays = sum(example is not None for example in examples)
        returned = function.__annotations__.get("return")  # several: a tuple[...]
        self.signature = Signature(function.__name__, arrays, host_arrays, len(get_args(returned)) or int(returned is not None))
        self._public = ti.kernel(generated) if PUBLIC else None
        if PUBLIC:
            return
        self._kernel = Kernel(generated, AutodiffMode.NONE)
        key = self._kernel.ensure_compiled(*dummies)
        self._cpp = self._kernel.compiled_kernels[key]
        program = self._program = impl.get_runtime().prog
        self._data = program.compile_kernel(program.config(), program.get_device_caps(), self._cpp)

    def bind(self, arguments: tuple) -> Any:
        """What launches with these records need: a context that holds the records, or what to put into one, or None.

        A context that holds Taichi's own arrays can be launched only once: of those, each launch creates one.
        """
        if self._public is not None:
            return None
        bound = [
            (slot + k, leaf)
            for slot, index in self._leaves
            for k, leaf in enumerate(leaves_of(arguments[index], self.structures[index]))
        ]
        if on_cuda():
            return [(slot, leaf.device.arr if isinstance(leaf, Array) else operator.index(leaf)) for slot, leaf in bound]
        context = self._cpp.make_launch_context()
        for slot, leaf in bound:
            if isinstance(leaf, Array):
                host = leaf.memory
                entries = host.size // max(leaf.n, 1)  # as the kernel counts them, for index checks in debug mode
                context.set_arg_external_array_with_shape((slot,), host.ctypes.data, host.nbytes, (entries,), 0)
            else:
                context.set_arg_int((slot,), operator.index(leaf))
        return context

    def _context_of(self, bound: list[tuple[int, Any]]) -> Any:
        """Create a context that holds Taichi's arrays and numbers."""
        context = self._cpp.make_launch_context()
        for slot, value in bound:
            if type(value) is int:
                context.set_arg_int((slot,), value)
            else:
                context.set_arg_ndarray((slot,), value)
        return context

    def launch(self, bound: Any, arguments: tuple) -> Any:
        """Launch and return the kernel's result. bound: from `bind` of these arguments."""
        if self._public is not None:
            return self._launch_public(arguments)
        context = self._context_of(bound) if isinstance(bound, list) else bound
        for index, slot, kind in self._setters:
            value = arguments[index]
            if kind == REAL:
                context.set_arg_float(slot, value)
            elif kind == INTEGER:
                context.set_arg_int(slot, operator.index(value))
            elif value.flags.c_contiguous:
                context.set_arg_external_array_with_shape(slot, value.ctypes.data, value.nbytes, value.shape, 0)
            else:
                raise ValueError(f"{self._kernel.func.__name__} takes only contiguous arrays")
        self._program.launch_kernel(self._data, context)
        returned = self._kernel.return_type
        if returned is None:
            return None
        ti.sync()
        values = [self._kernel.construct_kernel_ret(context, kind, (i,)) for i, kind in enumerate(returned)]
        return values[0] if len(values) == 1 else values

    def _launch_public(self, arguments: tuple) -> Any:
        """Launch through Taichi's public interface.

        Device arrays are copied to the host and back: Taichi rejects scalar device arrays as vector arguments.
        """
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


def _setter(annotation: Any) -> int:
    if id(annotation) in primitive_types.real_type_ids:
        return REAL
    if annotation in (ti.i32, ti.i64):
        return INTEGER
    if isinstance(annotation, ndarray_type.NdarrayType) and (
        annotation.dtype is None or id(annotation.dtype) in primitive_types.type_ids
    ):
        return HOST_ARRAY
    raise TypeError(f"a kernel cannot take a parameter of type {annotation}")


def _dummy(structure: tuple) -> Any:
    """A value of a leaf's type, to compile with."""
    if structure[0] == COUNT:
        return 1
    dtype, n, _ = structure[1]
    return np.zeros((1, n) if n else 1, dtype=DTYPES[dtype])


class Kernels:
    """All compiled versions of one kernel."""

    def __init__(self, function: Callable):
        self._function = function
        signature = inspect.signature(function)
        self._names = list(signature.parameters)
        self._annotations = [p.annotation for p in signature.parameters.values()]
        self._templates = [k for k, kind in enumerate(self._annotations) if isinstance(kind, template)]
        self._arrays = [k for k, kind in enumerate(self._annotations) if isinstance(kind, ndarray_type.NdarrayType)]
        self._used: set[str] | None = None
        self.forget()

    def forget(self) -> None:
        """Drop everything compiled: Taichi has been re-initialised."""
        self._compiled: dict[tuple, Compiled] = {}
        self._ready: dict[tuple, tuple] = {}  # key of the arguments -> compiled kernel, what `bind` returned, `_references`

    @property
    def n_compiled(self) -> int:
        """Number of structures that the kernel has been compiled for."""
        return len(self._compiled)

    def find(self, arguments: tuple) -> tuple | None:
        """The prepared (compiled, context, references) for these arguments, or None if they are new.

        Raises TypeError for a wrong number of arguments.
        """
        if len(arguments) != len(self._names):
            raise TypeError(f"{self._function.__name__} takes {len(self._names)} arguments, not {len(arguments)}")
        return self._ready.get(self._key(arguments))

    def _key(self, arguments: tuple) -> tuple:
        """Key of the arguments: the identity of each record or array, the value of each constant."""
        key = [
            (a, kind) if _is_constant(kind := type(a := arguments[k])) else id(a)  # 1, 1.0 and True are equal
            for k in self._templates
        ]
        for k in self._arrays:
            key += arguments[k].dtype, arguments[k].ndim
        return tuple(key)

    def prepare(self, arguments: tuple) -> tuple:
        """As `find`, but compile the kernel if it is new for the structure of these arguments."""
        names = self._names_for(arguments)
        structures = [structure_of(a, names) if k in self._templates else None for k, a in enumerate(arguments)]
        kind = tuple(structures), tuple([(arguments[k].dtype, arguments[k].ndim) for k in self._arrays])
        if kind not in self._compiled:
            examples = [a if k in self._arrays else None for k, a in enumerate(arguments)]
            self._compiled[kind] = Compiled(self._function, self._names, self._annotations, structures, examples)
        compiled, key = self._compiled[kind], self._key(arguments)
        self._ready[key] = compiled, compiled.bind(arguments), self._references(key, arguments)
        return self._ready[key]

    def _names_for(self, arguments: tuple) -> set[str]:
        seen: set = set()
        if self._used is None:
            self._used = names_in(self._function, seen)
        names, before = set(self._used), -1
        while len(names) > before:
            before = len(names)
            for k in self._templates:
                names |= names_of_types(holders(arguments[k]), names, seen)
        return names

    def _references(self, key: tuple, arguments: tuple) -> list:
        """Weak references that remove the entry `key` as soon as one of its records or arrays is collected.

        Modules, functions and all else that is keyed by its id are held, so that no other object takes that id.
        """
        ready = self._ready
        return [
            weakref.ref(arguments[k], lambda _, key=key: ready.pop(key, None))
            if isinstance(arguments[k], Array) or dataclasses.is_dataclass(arguments[k])
            else arguments[k]
            for k in self._templates
        ]


@functools.cache
def _is_constant(kind: type) -> bool:
    """Whether arguments of a type are keyed by value. Cached, because a launch asks for every argument."""
    return issubclass(kind, (bool, int, float, str, tuple))
