"""A kernel compiled for one structure of its arguments, and its launches.

It relies on Taichi 1.7.4, see `tracing`, except `Public`. Its arguments are in a pack, on CUDA in a parameter each, see `pack`.
NumPy arrays are parameters of their own, which Taichi copies to a GPU and back: they suit kernels that are seldom launched.
"""

import struct
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import taichi as ti

from taisoft.backend.arrays import Array, on_cuda
from taisoft.backend.pack import CODES, Arguments
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

    def __init__(self, function: Callable, kinds: dict[str, Any], structures: list[tuple | None], examples: list, packed: bool):
        """kinds: annotation by parameter. structures: one each, None if it is no template. examples: the argument if it is a host
        array, else None."""
        self.structures, self._names, self.packed = structures, list(kinds), packed
        self._numbers = [k for k, kind in enumerate(kinds.values()) if structures[k] is None and is_number(kind)]
        self._hosts = [k for k, example in enumerate(examples) if example is not None]
        leaves = [leaf for structure in structures if structure is not None for leaf in leaf_structures(structure)]
        returned = function.__annotations__.get("return")  # several: a tuple[...]
        arrays, n_returned = sum(leaf[0] != COUNT for leaf in leaves), len(get_args(returned)) or int(returned is not None)
        self.signature = Signature(function.__name__, arrays, len(self._hosts), n_returned)
        self.path = f"{function.__module__}.{function.__name__}"
        self._arguments = Arguments([list(kinds.values())[k] for k in self._numbers], leaves, packed)
        self._compile(function, [examples[k] for k in self._hosts])

    def _compile(self, function: Callable, hosts: list) -> None:
        def declare() -> tuple:
            members = self._arguments.declare()
            numbers, leaves = dict(zip(self._numbers, members)), iter(members[len(self._numbers) :])
            values = [(numbers.get(k), s) for k, s in enumerate(self.structures) if k not in self._hosts]
            return tuple([number if s is None else rebuild(s, leaves) for number, s in values])

        inside = [name for k, name in enumerate(self._names) if k not in self._hosts]
        self._kernel = Kernel(generate(function, dict.fromkeys(inside), declare), AutodiffMode.NONE)
        key = self._kernel.ensure_compiled(*hosts)
        self._is_queued = on_cuda()  # whether launches return before they end
        # methods of a context that read a value
        reads = {ti.f64: "get_struct_ret_float", ti.i32: "get_struct_ret_int"}
        self._returned = [reads[kind] for kind in self._kernel.return_type or ()]
        self._cpp, program = self._kernel.compiled_kernels[key], impl.get_runtime().prog
        self.program, self.data = program, program.compile_kernel(program.config(), program.get_device_caps(), self._cpp)

    def bind(self, arguments: tuple) -> tuple[Any, Any]:
        """What launches with these records need: a context with their addresses, and the function that writes the numbers.

        None and the records' arrays and counts, if each launch needs a context of its own.
        """
        leaves = [leaf for value, s in zip(arguments, self.structures) if s is not None for leaf in leaves_of(value, s)]
        return self._context_with(leaves) if self._arguments.kept else (None, leaves)

    def _context_with(self, leaves: list[Array | int]) -> tuple[Any, Callable | None]:
        context = self._cpp.make_launch_context()
        return context, self._arguments.bind(context, leaves)

    def launch(self, bound: Any, arguments: tuple) -> Any:
        """Launch and return the kernel's result. bound: from `bind` of these arguments."""
        return self._launch(bound, arguments)

    def _launch(self, bound: Any, arguments: tuple) -> Any:
        context, write = bound if self._arguments.kept else self._context_with(bound[1])
        numbers = [arguments[k] for k in self._numbers]
        for slot, k in enumerate(self._hosts):
            if not (array := arguments[k]).flags.c_contiguous:
                raise ValueError(f"{self.signature.kernel} takes only contiguous arrays")
            context.set_arg_external_array_with_shape((slot,), array.ctypes.data, array.nbytes, array.shape, 0)
        if write is not None:
            try:
                write(*numbers)
            except struct.error:
                raise self.refusal(*numbers) from None
        self.program.launch_kernel(self.data, context)
        return self.result(context)

    def refusal(self, *numbers: Any) -> TypeError:
        """The error of a launch with these numbers."""
        return TypeError(f"{self.signature.kernel}: {self._arguments.explain([self._names[k] for k in self._numbers], numbers)}")

    def result(self, context: Any) -> Any:
        """What the kernel returned, None if it returns nothing."""
        if not self._returned:
            return None
        if self._is_queued:
            ti.sync()
        values = [getattr(context, read)((k,)) for k, read in enumerate(self._returned)]
        return values[0] if len(values) == 1 else values


class Public(Compiled):
    """By Taichi's public interface alone: 20 us or more a launch, at most 64 arguments."""

    def _compile(self, function: Callable, hosts: list) -> None:
        self._public = ti.kernel(generate(function, {n: s for n, s in zip(self._names, self.structures) if s is not None}))

    def bind(self, arguments: tuple) -> tuple[None, None]:
        """Nothing is kept."""
        return None, None

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
    if isinstance(annotation, ndarray_type.NdarrayType) and (
        annotation.dtype is None or id(annotation.dtype) in primitive_types.type_ids
    ):
        return False
    if annotation in CODES:
        return True
    raise TypeError(f"a kernel cannot take a parameter of type {annotation}")
