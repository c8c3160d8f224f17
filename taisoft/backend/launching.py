"""Kernels over records of arrays: compiled once per structure, launched with any arrays and sizes of that structure.

A kernel's template arguments are records (dataclasses) of arrays, single arrays, modules and constants. Taichi would recompile
a kernel for each record. Here a record is flattened: its arrays and its numbers marked `Count` become arguments, and the rest
(types, all extents but the first, flags, laws) is the structure that the code is compiled for. Inside the kernel the record is
rebuilt around those arguments, so the kernel's source reads as if it had received the record.
A record may contain records and tuples of records. Only the fields named by a kernel and the functions it calls are passed.

A launch through Taichi looks up the type of every argument. A launch here whose records are known only sets numbers and
addresses in a context that is created once. This relies on Taichi 1.7.4, the version that taisoft requires: see `tracing`.
"""

import ast
import dataclasses
import inspect
import itertools
import linecache
import operator
import types
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import DTYPES, Array, Count, View
from taisoft.backend.private import AutodiffMode, Kernel, impl, ndarray_type, primitive_types, template
from taisoft.backend.tracing import FAST_TRACING, source_of

RECORD, ARRAY, COUNT, TUPLE, CONSTANT = range(5)
REAL, INTEGER, HOST_ARRAY = range(3)
PUBLIC = not FAST_TRACING  # launch only through Taichi's public interface: 20 us or more a launch, at most 64 arguments


# --- names that a kernel uses -------------------------------------------------------------------------------------------


def names_in(function: Callable, seen: set) -> set[str]:
    """All names, attributes included, used by a function and by the functions it can reach by name."""
    function = inspect.unwrap(function)
    if function in seen or not isinstance(function, types.FunctionType):
        return set()
    seen.add(function)
    names, codes = set(), [function.__code__]
    while codes:
        code = codes.pop()
        names.update(code.co_names)
        codes += [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    cells = dict(zip(function.__code__.co_freevars, (cell.cell_contents for cell in function.__closure__ or ())))
    reached = [cells.get(name, function.__globals__.get(name)) for name in names | set(cells)]
    for value in reached:
        if _is_ours(value):
            names |= names_in(value, seen)
        elif isinstance(value, types.ModuleType) and value.__name__.startswith("taisoft"):
            for attribute in names & set(vars(value)):
                if _is_ours(getattr(value, attribute)):
                    names |= names_in(getattr(value, attribute), seen)
    return names


def _is_ours(value: Any) -> bool:
    return isinstance(value, types.FunctionType) and not value.__module__.startswith("taichi")


def _names_of_types(values: Iterator[Any], names: set[str], seen: set) -> set[str]:
    """Names used by those methods of records and functions of modules among the arguments that the kernel names."""
    found = set()
    for value in values:
        holder = value if isinstance(value, types.ModuleType) else type(value)
        for name, member in vars(holder).items():
            member = member.fget if isinstance(member, property) else member
            if name in names and isinstance(member, types.FunctionType):
                found |= names_in(member, seen)
    return found


def _holders(value: Any) -> Iterator[Any]:
    """The records and modules in an argument."""
    if isinstance(value, types.ModuleType):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from _holders(item)
    elif dataclasses.is_dataclass(value):
        yield value
        for field in dataclasses.fields(value):
            yield from _holders(getattr(value, field.name))


# --- structure ----------------------------------------------------------------------------------------------------------


def structure_of(value: Any, names: set[str]) -> tuple:
    """The part of an argument that code depends on: equal for arguments that can share one compiled kernel."""
    if isinstance(value, Array):
        return ARRAY, value.structure
    if isinstance(value, tuple):
        return TUPLE, tuple([structure_of(item, names) for item in value])
    if dataclasses.is_dataclass(value):
        parts = []
        for field in dataclasses.fields(value):
            if field.name in names:
                part = (COUNT,) if field.type is Count else structure_of(getattr(value, field.name), names)
                parts.append((field.name, part))
        return RECORD, type(value), tuple(parts)
    return CONSTANT, type(value), value


def leaves_of(value: Any, structure: tuple) -> Iterator[Array | int]:
    """The arrays and numbers of an argument that become arguments of the compiled kernel, in order."""
    if structure[0] in (ARRAY, COUNT):
        yield value
    elif structure[0] == TUPLE:
        for item, part in zip(value, structure[1]):
            yield from leaves_of(item, part)
    elif structure[0] == RECORD:
        for name, part in structure[2]:
            yield from leaves_of(getattr(value, name), part)


def leaf_structures(structure: tuple) -> Iterator[tuple]:
    """The structures of the leaves, in the order of `leaves_of`."""
    if structure[0] in (ARRAY, COUNT):
        yield structure
    elif structure[0] == TUPLE:
        for part in structure[1]:
            yield from leaf_structures(part)
    elif structure[0] == RECORD:
        for _, part in structure[2]:
            yield from leaf_structures(part)


def rebuild(structure: tuple, leaves: Iterator[Any]) -> Any:
    """Rebuild an argument inside the kernel around the kernel's own variables for its leaves."""
    if structure[0] == ARRAY:
        (_, n, extents), flat = structure[1], next(leaves)
        return View(flat, n, extents) if n or extents else flat
    if structure[0] == COUNT:
        return next(leaves)
    if structure[0] == TUPLE:
        return tuple([rebuild(part, leaves) for part in structure[1]])
    if structure[0] == RECORD:
        record = object.__new__(structure[1])
        for name, part in structure[2]:
            object.__setattr__(record, name, rebuild(part, leaves))
        return record
    return structure[2]


def _annotation(structure: tuple) -> Any:
    """Taichi type of a leaf."""
    if structure[0] == COUNT:
        return ti.i32
    dtype, n, _ = structure[1]
    return ti.types.ndarray(dtype=ti.types.vector(n, dtype) if n else dtype, ndim=1)


# --- source -------------------------------------------------------------------------------------------------------------


_numbers = itertools.count()  # of generated functions


def generate(function: Callable, structures: dict[str, tuple]) -> Callable:
    """Return the function with its template parameters, given by name, replaced by their leaves.

    Its lines keep their original numbers, in a file of another name that exists only in Python's line cache.
    """
    file, _, first, source = source_of(function)
    tree = ast.parse(source).body[0]
    body = tree.body[1:] if isinstance(tree.body[0], ast.Expr) and isinstance(tree.body[0].value, ast.Constant) else tree.body
    scope = {**function.__globals__, **inspect.getclosurevars(function).nonlocals}
    parameters, handles = [], []
    for name, parameter in inspect.signature(function).parameters.items():
        if name not in structures:
            scope[f"_type_{name}"] = parameter.annotation
            parameters.append(f"{name}: _type_{name}")
            continue
        for k, kind in enumerate(leaf_structures(structures[name])):
            scope[f"_type_{name}_{k}"] = _annotation(kind)
            parameters.append(f"_{name}_{k}: _type_{name}_{k}")
            handles.append(f"_{name}_{k}")

    def records(*leaves):
        remaining = iter(leaves)
        return tuple([rebuild(structure, remaining) for structure in structures.values()])

    scope |= {"_records": records, "_static": ti.static, "_returned": function.__annotations__.get("return")}
    returned = " -> _returned" if scope["_returned"] is not None else ""
    head = f"def {function.__name__}({', '.join(parameters)}){returned}:\n"
    if structures:
        head += f"    {', '.join(structures)}, = _static(_records({', '.join(handles)}))\n"
    start = first - 1 + body[0].lineno - 1 - head.count("\n")  # blank lines before the head
    text = "\n" * start + head + "".join(source.splitlines(keepends=True)[body[0].lineno - 1 :])
    name = f"{file}#{function.__name__}-{next(_numbers)}"
    linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    exec(compile(text, name, "exec"), scope)
    generated = scope[function.__name__]
    generated.__module__ = function.__module__
    return generated


# --- launch -------------------------------------------------------------------------------------------------------------


class Compiled:
    """A kernel compiled for one structure; valid until Taichi is re-initialised."""

    def __init__(self, function: Callable, names: list[str], annotations: list[Any], structures: list[tuple | None], examples):
        """structures: one per parameter, None if it is no template. examples: the argument if it is a host array, else None."""
        self.structures = structures
        generated = generate(function, {n: s for n, s in zip(names, structures) if s is not None})
        self._setters, dummies = [], []  # setters: (argument index, slot, kind) of non-template parameters
        self._leaves: list[tuple[int, int]] = []  # (first slot, argument index) of each template
        slot = 0
        for index, (structure, annotation) in enumerate(zip(structures, annotations)):
            if structure is None:
                self._setters.append((index, (slot,), _setter(annotation)))
                dummies.append(examples[index] if examples[index] is not None else 0)
                slot += 1
                continue
            self._leaves.append((slot, index))
            kinds = list(leaf_structures(structure))
            dummies += [_dummy(kind) for kind in kinds]
            slot += len(kinds)
        self._public = ti.kernel(generated) if PUBLIC else None
        if PUBLIC:
            return
        self._kernel = Kernel(generated, AutodiffMode.NONE)
        key = self._kernel.ensure_compiled(*dummies)
        self._cpp = self._kernel.compiled_kernels[key]
        program = self._program = impl.get_runtime().prog
        self._data = program.compile_kernel(program.config(), program.get_device_caps(), self._cpp)

    def context(self, arguments: tuple) -> Any:
        """Create a launch context that holds the records among the arguments; `launch` sets the other arguments."""
        if self._public is not None:
            return None
        context = self._cpp.make_launch_context()
        for slot, index in self._leaves:
            for k, leaf in enumerate(leaves_of(arguments[index], self.structures[index])):
                if not isinstance(leaf, Array):
                    context.set_arg_int((slot + k,), operator.index(leaf))
                elif leaf.host is not None:
                    host = leaf.host
                    entries = host.size // max(leaf.n, 1)  # as the kernel counts them, for index checks in debug mode
                    context.set_arg_external_array_with_shape((slot + k,), host.ctypes.data, host.nbytes, (entries,), 0)
                else:
                    context.set_arg_ndarray((slot + k,), leaf.device.arr)
        return context

    def launch(self, context: Any, arguments: tuple) -> Any:
        """Launch and return the kernel's result. context: from `context`; None to create one for this launch."""
        if self._public is not None:
            return self._launch_public(arguments)
        if context is None:
            context = self.context(arguments)
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
                    if leaf.host is None and id(leaf) not in copies:
                        copies[id(leaf)] = leaf, leaf.to_numpy()
                    host = copies[id(leaf)][1] if leaf.host is None else leaf.host
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
        self._ready: dict[tuple, tuple] = {}  # key of the arguments -> compiled kernel, context, weak references

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
            (a, kind) if _is_constant[kind := type(a := arguments[k])] else id(a)  # 1, 1.0 and True are equal
            for k in self._templates
        ]
        for k in self._arrays:
            key += arguments[k].dtype, arguments[k].ndim
        return tuple(key)

    def prepare(self, arguments: tuple) -> tuple:
        """As `find`, but compile the kernel if it is new for the structure of these arguments."""
        names = self._names_for(arguments)
        structures = [structure_of(a, names) if k in self._templates else None for k, a in enumerate(arguments)]
        kind = tuple([(a.dtype, a.ndim) for a in (arguments[k] for k in self._arrays)])
        compiled = self._compiled.get((tuple(structures), kind))
        if compiled is None:
            examples = [a if k in self._arrays else None for k, a in enumerate(arguments)]
            compiled = Compiled(self._function, self._names, self._annotations, structures, examples)
            self._compiled[tuple(structures), kind] = compiled
        key = self._key(arguments)
        # a context that holds Taichi's own arrays can be launched only once
        context = compiled.context(arguments) if ti.cfg.arch != ti.cuda else None
        ready = compiled, context, self._references(key, arguments)
        self._ready[key] = ready
        return ready

    def _names_for(self, arguments: tuple) -> set[str]:
        seen: set = set()
        if self._used is None:
            self._used = names_in(self._function, seen)
        names, before = set(self._used), -1
        while len(names) > before:
            before = len(names)
            for k in self._templates:
                names |= _names_of_types(_holders(arguments[k]), names, seen)
        return names

    def _references(self, key: tuple, arguments: tuple) -> list:
        """Weak references that remove the entry `key` as soon as one of its records or arrays is collected."""
        ready = self._ready
        return [
            weakref.ref(arguments[k], lambda _, key=key: ready.pop(key, None))
            for k in self._templates
            if isinstance(arguments[k], Array) or dataclasses.is_dataclass(arguments[k])
        ]


class _Constants(dict):
    """Whether arguments of a type are keyed by value. A dict, because a launch checks every argument."""

    def __missing__(self, kind: type) -> bool:
        self[kind] = issubclass(kind, (bool, int, float, str, tuple))
        return self[kind]


_is_constant = _Constants()
