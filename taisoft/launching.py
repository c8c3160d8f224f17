"""Kernels over records of arrays: compiled once for each structure, launched with whatever arrays and sizes have it.

A kernel's template arguments are records (dataclasses) of arrays, single arrays, modules and constants. Taichi would compile a
kernel anew for each record. Here a record is taken apart: its arrays and its numbers marked `Count` become arguments, and what is
left of it (types, extents but the first, flags, laws) is the structure that the code is compiled for. Inside the kernel the
record is put together again around those arguments, so the kernel's source reads as if it had been handed the record.
A record may hold others, and tuples of them. Only what a kernel and the functions it calls name is taken from a record.

A launch through Taichi looks every argument's type up; one that is known by its records needs only numbers and addresses in a
context that is made once. This rests on 1.7.4, the version that taisoft asks for: see `tracing`.
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
from taichi.lang import impl
from taichi.lang.enums import AutodiffMode
from taichi.lang.kernel_impl import Kernel, template
from taichi.types import ndarray_type, primitive_types

from taisoft.arrays import DTYPES, Array, Count, View
from taisoft.tracing import QUICK, source_of

RECORD, ARRAY, COUNT, TUPLE, CONSTANT = range(5)
REAL, WHOLE, HOST_ARRAY = range(3)
PUBLIC = not QUICK  # launch through Taichi's public interface alone, which takes 20 us and more, and at most 64 arguments


# --- what of a record a kernel names ------------------------------------------------------------------------------------


def names_in(function: Callable, seen: set) -> set[str]:
    """Every name that a function and the functions it can reach by name use, attributes too."""
    function = inspect.unwrap(function)
    if function in seen or not isinstance(function, types.FunctionType):
        return set()
    seen.add(function)
    names, codes = set(), [function.__code__]
    while codes:
        code = codes.pop()
        names.update(code.co_names)
        codes += [one for one in code.co_consts if isinstance(one, types.CodeType)]
    cells = dict(zip(function.__code__.co_freevars, (cell.cell_contents for cell in function.__closure__ or ())))
    reached = [cells.get(name, function.__globals__.get(name)) for name in names | set(cells)]
    for one in reached:
        if _is_ours(one):
            names |= names_in(one, seen)
        elif isinstance(one, types.ModuleType) and one.__name__.startswith("taisoft"):
            for attribute in names & set(vars(one)):
                if _is_ours(getattr(one, attribute)):
                    names |= names_in(getattr(one, attribute), seen)
    return names


def _is_ours(one: Any) -> bool:
    return isinstance(one, types.FunctionType) and not one.__module__.startswith("taichi")


def _names_of_types(values: Iterator[Any], names: set[str], seen: set) -> set[str]:
    """What the methods of records and the functions of modules among the arguments use, where the kernel names them."""
    found = set()
    for value in values:
        holder = value if isinstance(value, types.ModuleType) else type(value)
        for name, one in vars(holder).items():
            one = one.fget if isinstance(one, property) else one
            if name in names and isinstance(one, types.FunctionType):
                found |= names_in(one, seen)
    return found


def _holders(value: Any) -> Iterator[Any]:
    """Records and modules in an argument."""
    if isinstance(value, types.ModuleType):
        yield value
    elif isinstance(value, tuple):
        for one in value:
            yield from _holders(one)
    elif dataclasses.is_dataclass(value):
        yield value
        for field in dataclasses.fields(value):
            yield from _holders(getattr(value, field.name))


# --- structure ----------------------------------------------------------------------------------------------------------


def structure_of(value: Any, names: set[str]) -> tuple:
    """What code depends on in an argument: equal for arguments that one compiled kernel serves."""
    if isinstance(value, Array):
        return ARRAY, value.structure
    if isinstance(value, tuple):
        return TUPLE, tuple([structure_of(one, names) for one in value])
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
        for one, part in zip(value, structure[1]):
            yield from leaves_of(one, part)
    elif structure[0] == RECORD:
        for name, part in structure[2]:
            yield from leaves_of(getattr(value, name), part)


def kinds_of(structure: tuple) -> Iterator[tuple]:
    """As `leaves_of`: the structures of the leaves."""
    if structure[0] in (ARRAY, COUNT):
        yield structure
    elif structure[0] == TUPLE:
        for part in structure[1]:
            yield from kinds_of(part)
    elif structure[0] == RECORD:
        for _, part in structure[2]:
            yield from kinds_of(part)


def rebuild(structure: tuple, leaves: Iterator[Any]) -> Any:
    """An argument as the kernel's source knows it, around what stands for its leaves inside the kernel."""
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
    """Taichi's type of a leaf."""
    if structure[0] == COUNT:
        return ti.i32
    dtype, n, _ = structure[1]
    return ti.types.ndarray(dtype=ti.types.vector(n, dtype) if n else dtype, ndim=1)


# --- source -------------------------------------------------------------------------------------------------------------


_numbers = itertools.count()  # of what is generated


def generate(function: Callable, structures: dict[str, tuple]) -> Callable:
    """The function with its templates, by name, replaced by their leaves.

    Its lines stand where the original's do, in a file of another name that exists in Python's cache of lines alone.
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
        for k, kind in enumerate(kinds_of(structures[name])):
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
    start = first - 1 + body[0].lineno - 1 - head.count("\n")  # lines before the head
    text = "\n" * start + head + "".join(source.splitlines(keepends=True)[body[0].lineno - 1 :])
    name = f"{file}#{function.__name__}-{next(_numbers)}"
    linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    exec(compile(text, name, "exec"), scope)
    made = scope[function.__name__]
    made.__module__ = function.__module__
    return made


# --- launch -------------------------------------------------------------------------------------------------------------


class Compiled:
    """A kernel compiled for one structure, to be used only while Taichi is not initialised anew."""

    def __init__(self, function: Callable, names: list[str], annotations: list[Any], structures: list[tuple | None], examples):
        """structures: of the templates, None for other parameters. examples: host arrays among the arguments, else None."""
        self.structures = structures
        made = generate(function, {n: s for n, s in zip(names, structures) if s is not None})
        self._setters, dummies = [], []  # of the other parameters: (place among the arguments, slot, kind)
        self._leaves: list[tuple[int, int]] = []  # (slot, place among the arguments) of each template's first leaf
        slot = 0
        for at, (structure, annotation) in enumerate(zip(structures, annotations)):
            if structure is None:
                self._setters.append((at, (slot,), _setter(annotation)))
                dummies.append(examples[at] if examples[at] is not None else 0)
                slot += 1
                continue
            self._leaves.append((slot, at))
            kinds = list(kinds_of(structure))
            dummies += [_dummy(kind) for kind in kinds]
            slot += len(kinds)
        self._public = ti.kernel(made) if PUBLIC else None
        if PUBLIC:
            return
        self._kernel = Kernel(made, AutodiffMode.NONE)
        key = self._kernel.ensure_compiled(*dummies)
        self._cpp = self._kernel.compiled_kernels[key]
        program = self._program = impl.get_runtime().prog
        self._data = program.compile_kernel(program.config(), program.get_device_caps(), self._cpp)

    def context(self, arguments: tuple) -> Any:
        """What a launch with the records among these arguments needs; the other arguments are not in it yet."""
        if self._public is not None:
            return None
        context = self._cpp.make_launch_context()
        for slot, at in self._leaves:
            for k, leaf in enumerate(leaves_of(arguments[at], self.structures[at])):
                if not isinstance(leaf, Array):
                    context.set_arg_int((slot + k,), operator.index(leaf))
                elif leaf.host is not None:
                    host = leaf.host
                    entries = host.size // max(leaf.n, 1)  # as the kernel counts them; debug mode checks indices by it
                    context.set_arg_external_array_with_shape((slot + k,), host.ctypes.data, host.nbytes, (entries,), 0)
                else:
                    context.set_arg_ndarray((slot + k,), leaf.device.arr)
        return context

    def launch(self, context: Any, arguments: tuple) -> Any:
        """Launch; returns what the kernel returns. context: of `context`, None where it must be made anew."""
        if self._public is not None:
            return self._launch_publicly(arguments)
        if context is None:
            context = self.context(arguments)
        for at, slot, kind in self._setters:
            value = arguments[at]
            if kind == REAL:
                context.set_arg_float(slot, value)
            elif kind == WHOLE:
                context.set_arg_int(slot, operator.index(value))
            elif value.flags.c_contiguous:
                context.set_arg_external_array_with_shape(slot, value.ctypes.data, value.nbytes, value.shape, 0)
            else:
                raise ValueError(f"{self._kernel.func.__name__} takes contiguous arrays alone")
        self._program.launch_kernel(self._data, context)
        returned = self._kernel.return_type
        if returned is None:
            return None
        ti.sync()
        values = [self._kernel.construct_kernel_ret(context, kind, (i,)) for i, kind in enumerate(returned)]
        return values[0] if len(values) == 1 else values

    def _launch_publicly(self, arguments: tuple) -> Any:
        """As Taichi's own launch takes it. What lies on a device travels: Taichi takes scalars there for no vectors."""
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
        return WHOLE
    if isinstance(annotation, ndarray_type.NdarrayType) and (
        annotation.dtype is None or id(annotation.dtype) in primitive_types.type_ids
    ):
        return HOST_ARRAY
    raise TypeError(f"a kernel cannot take a parameter of type {annotation}")


def _dummy(structure: tuple) -> Any:
    """A value of a leaf's type, for the compiler."""
    if structure[0] == COUNT:
        return 1
    dtype, n, _ = structure[1]
    return np.zeros((1, n) if n else 1, dtype=DTYPES[dtype])


class Kernels:
    """All that has been compiled of one kernel's source."""

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
        """Taichi has been initialised anew."""
        self._compiled: dict[tuple, Compiled] = {}
        self._ready: dict[tuple, tuple] = {}  # by which the records are: compiled kernel, context, and references to them

    @property
    def n_compiled(self) -> int:
        """How many structures the kernel has been compiled for."""
        return len(self._compiled)

    def find(self, arguments: tuple) -> tuple | None:
        """The ready (compiled, context) for these arguments, None where they are new. Raises TypeError for too many or few."""
        if len(arguments) != len(self._names):
            raise TypeError(f"{self._function.__name__} takes {len(self._names)} arguments, not {len(arguments)}")
        return self._ready.get(self._key(arguments))

    def _key(self, arguments: tuple) -> tuple:
        """By which the arguments are known again: which record or array each is, of a constant its value."""
        key = [
            (a, kind) if _is_constant[kind := type(a := arguments[k])] else id(a)  # 1, 1.0 and True are equal
            for k in self._templates
        ]
        for k in self._arrays:
            key += arguments[k].dtype, arguments[k].ndim
        return tuple(key)

    def prepare(self, arguments: tuple) -> tuple:
        """As `find`, compiling the kernel where it has not been compiled for the structure of these arguments."""
        names = self._names_for(arguments)
        structures = [structure_of(a, names) if k in self._templates else None for k, a in enumerate(arguments)]
        kind = tuple([(a.dtype, a.ndim) for a in (arguments[k] for k in self._arrays)])
        compiled = self._compiled.get((tuple(structures), kind))
        if compiled is None:
            examples = [a if k in self._arrays else None for k, a in enumerate(arguments)]
            compiled = Compiled(self._function, self._names, self._annotations, structures, examples)
            self._compiled[tuple(structures), kind] = compiled
        key = self._key(arguments)
        # one with Taichi's own arrays in it serves once
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
        """So held that what is known of records and arrays goes with the first of them."""
        ready = self._ready
        return [
            weakref.ref(arguments[k], lambda _, key=key: ready.pop(key, None))
            for k in self._templates
            if isinstance(arguments[k], Array) or dataclasses.is_dataclass(arguments[k])
        ]


class _Constants(dict):
    """Whether an argument of a type is known by its value. A launch asks it of every argument, so it is a look-up."""

    def __missing__(self, kind: type) -> bool:
        self[kind] = issubclass(kind, (bool, int, float, str, tuple))
        return self[kind]


_is_constant = _Constants()
