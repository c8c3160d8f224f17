"""Records of arrays taken apart: the structure that a kernel is compiled for, and the source of the kernel for that structure.

The arrays of a record and its numbers marked `Count` become arguments of the compiled kernel; the rest (types, all extents but
the first, flags, laws) is its structure. Only the fields named by the kernel and the functions it calls are taken.
The generated source rebuilds the record around those arguments, so the kernel reads as if it had received the record.
"""

import ast
import dataclasses
import inspect
import itertools
import linecache
import types
from collections.abc import Callable, Iterator
from typing import Any

import taichi as ti

from taisoft.backend.arrays import Array, Count, View
from taisoft.backend.tracing import source_of

RECORD, ARRAY, COUNT, TUPLE, CONSTANT = range(5)


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


def names_of_types(values: Iterator[Any], names: set[str], seen: set) -> set[str]:
    """Names used by those methods of records and functions of modules among the arguments that the kernel names."""
    found = set()
    for value in values:
        owners = [value] if isinstance(value, types.ModuleType) else type(value).__mro__
        for name, member in itertools.chain.from_iterable(vars(owner).items() for owner in owners):
            member = member.fget if isinstance(member, property) else member
            if name in names and isinstance(member, types.FunctionType):
                found |= names_in(member, seen)
    return found


def holders(value: Any) -> Iterator[Any]:
    """The records and modules in an argument."""
    if isinstance(value, types.ModuleType):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from holders(item)
    elif dataclasses.is_dataclass(value):
        yield value
        for field in dataclasses.fields(value):
            yield from holders(getattr(value, field.name))


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


def leaf_structures(structure: tuple) -> Iterator[tuple]:
    """The structures of the arrays and numbers of an argument that become arguments of the compiled kernel, in order."""
    if structure[0] in (ARRAY, COUNT):
        yield structure
    elif structure[0] == TUPLE:
        for part in structure[1]:
            yield from leaf_structures(part)
    elif structure[0] == RECORD:
        for _, part in structure[2]:
            yield from leaf_structures(part)


def leaves_of(value: Any, structure: tuple) -> Iterator[Array | int]:
    """These arrays and numbers, in the order of `leaf_structures`."""
    if structure[0] in (ARRAY, COUNT):
        yield value
    elif structure[0] == TUPLE:
        for item, part in zip(value, structure[1]):
            yield from leaves_of(item, part)
    elif structure[0] == RECORD:
        for name, part in structure[2]:
            yield from leaves_of(getattr(value, name), part)


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


_numbers = itertools.count()  # of generated functions


def generate(function: Callable, taken: dict[str, Any], make: Callable | None = None) -> Callable:
    """Return the function without the parameters `taken`, with the values that `make` returns while the kernel is traced.

    make: None if the values of `taken` are structures of records, whose leaves then become parameters in their place.
    Its lines keep their original numbers, in a file of another name that exists only in Python's line cache.
    """
    file, _, first, source = source_of(function)
    tree = ast.parse(source).body[0]
    body = tree.body[1:] if isinstance(tree.body[0], ast.Expr) and isinstance(tree.body[0].value, ast.Constant) else tree.body
    scope = {**function.__globals__, **inspect.getclosurevars(function).nonlocals}
    parameters, handles = [], []
    for name, parameter in inspect.signature(function).parameters.items():
        if name not in taken:
            scope[f"_type_{name}"] = parameter.annotation
            parameters.append(f"{name}: _type_{name}")
        elif make is None:
            for k, kind in enumerate(leaf_structures(taken[name])):
                scope[f"_type_{name}_{k}"] = _annotation(kind)
                parameters.append(f"_{name}_{k}: _type_{name}_{k}")
                handles.append(f"_{name}_{k}")

    def records(*leaves):
        remaining = iter(leaves)
        return tuple([rebuild(structure, remaining) for structure in taken.values()])

    scope |= {"_records": make or records, "_static": ti.static, "_returned": function.__annotations__.get("return")}
    returned = " -> _returned" if scope["_returned"] is not None else ""
    head = f"def {function.__name__}({', '.join(parameters)}){returned}:\n"
    if taken:
        head += f"    {', '.join(taken)}, = _static(_records({', '.join(handles)}))\n"
    start = first - 1 + body[0].lineno - 1 - head.count("\n")  # blank lines before the head
    text = "\n" * start + head + "".join(source.splitlines(keepends=True)[body[0].lineno - 1 :])
    name = f"{file}#{function.__name__}-{next(_numbers)}"
    linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    exec(compile(text, name, "exec"), scope)
    generated = scope[function.__name__]
    generated.__module__ = function.__module__
    return generated
