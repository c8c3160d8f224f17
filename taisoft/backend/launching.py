"""Kernels over records of arrays: compiled once per structure, launched with any arrays and sizes of that structure.

A kernel's template arguments are records (dataclasses) of arrays, single arrays, modules and constants. Taichi would recompile
a kernel for each record. Here a record is flattened: its arrays and its numbers marked `Count` become arguments, and the rest
(types, all extents but the first, flags, laws) is the structure that the code is compiled for. Inside the kernel the record is
rebuilt around those arguments, so the kernel's source reads as if it had received the record.
A record may contain records and tuples of records. Only the fields named by a kernel and the functions it calls are passed.

A launch through Taichi looks up the type of every argument. A launch here looks up its records, and writes the numbers: see
`compiled` and `pack`.
"""

import dataclasses
import functools
import inspect
import os
import struct
import weakref
from collections.abc import Callable
from typing import Any, ClassVar

from taisoft.backend.arrays import Array, on_cuda
from taisoft.backend.compiled import Compiled, Flat, Packed, Public
from taisoft.backend.private import impl, ndarray_type, template
from taisoft.backend.structure import holders, names_in, names_of_types, structure_of
from taisoft.backend.tracing import FAST_TRACING

PUBLIC = not FAST_TRACING  # launch only through Taichi's public interface
PACK = os.environ.get("TAISOFT_PACK")  # "0" or "1": whether arguments are packed; by default, they are on the CPU
SMALL = -5, 256  # integers that Python keeps one object of each


def way() -> type[Compiled]:
    """How kernels are launched."""
    if PUBLIC:
        return Public
    return Packed if PACK == "1" or (PACK is None and not on_cuda()) else Flat


class Kernels:
    """All compiled versions of one kernel."""

    every: ClassVar[list["Kernels"]] = []
    watched: ClassVar[bool] = False  # by `counters`: every launch passes through `Compiled.launch`

    def __init__(self, function: Callable):
        self._function = function
        signature = inspect.signature(function)
        self._names = list(signature.parameters)
        self._annotations = [p.annotation for p in signature.parameters.values()]
        self._templates = [k for k, kind in enumerate(self._annotations) if isinstance(kind, template)]
        self._arrays = [k for k, kind in enumerate(self._annotations) if isinstance(kind, ndarray_type.NdarrayType)]
        self._used: set[str] | None = None
        self._prepared: dict[tuple, tuple] = {}  # ids of the templates -> what the function of `launcher` needs
        self.forget()
        self.every.append(self)

    def forget(self) -> None:
        """Drop everything compiled: Taichi has been re-initialised."""
        self._compiled: dict[tuple, Compiled] = {}
        self._ready: dict[tuple, tuple] = {}  # key of the arguments -> compiled kernel, what `bind` returned, `_references`
        self._prepared.clear()

    @classmethod
    def watch(cls, watched: bool) -> None:
        """Let every launch pass through `Compiled.launch`, or no longer."""
        cls.watched = watched
        for kernels in cls.every:
            kernels._prepared.clear()

    @property
    def n_compiled(self) -> int:
        """Number of structures that the kernel has been compiled for."""
        return len(self._compiled)

    def launcher(self, prepare: Callable) -> Callable:
        """Return a function with the kernel's parameters that launches it, and calls `prepare` instead for new arguments.

        It is the shortest Python can be: one look-up, one call that writes the numbers, one that launches.
        """
        names = ", ".join(self._names)
        lines = [f"def {self._function.__name__}({names}):"]
        if not self._arrays:
            key = "".join(f"id({self._names[k]}), " for k in self._templates)
            numbers = ", ".join(name for k, name in enumerate(self._names) if k not in self._templates)
            lines += [
                f"    _entry = _find(({key}))",
                "    if _entry is not None and _entry[0] is _taichi.pytaichi.prog:",
                "        _, _write, _launch, _data, _context, _compiled, _ = _entry",
                "        if _write is not None:",
                "            try:",
                f"                _write({numbers})",
                "            except _Wrong:",
                f"                raise _compiled.refusal({numbers}) from None",
                "        _launch(_data, _context)",
                "        return _compiled.result(_context)" if "return" in self._function.__annotations__ else "        return",
            ]
        lines.append(f"    return _prepare({names})")
        scope = {"_find": self._prepared.get, "_taichi": impl, "_Wrong": struct.error, "_prepare": prepare}
        exec("\n".join(lines), scope)
        return functools.wraps(self._function)(scope[self._function.__name__])

    def find(self, arguments: tuple) -> tuple | None:
        """The prepared (compiled, context, references) for these arguments, or None if they are new."""
        found = self._ready.get(self._key(arguments))
        if found is not None:
            self._prepare(arguments, *found)
        return found

    def _prepare(self, arguments: tuple, compiled: Compiled, bound: Any, references: list) -> None:
        """Let `launcher` know these arguments, if each is known by its identity and NumPy arrays are not among them."""
        given = [arguments[k] for k in self._templates]
        if isinstance(compiled, Packed) and not self.watched and not self._arrays and all(map(_is_known_by_id, given)):
            key, (context, write) = tuple(map(id, given)), bound
            held = self._references(self._prepared, key, arguments)
            self._prepared[key] = compiled.program, write, compiled.program.launch_kernel, compiled.data, context, compiled, held

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
            self._compiled[kind] = way()(self._function, self._names, self._annotations, structures, examples)
        compiled, key = self._compiled[kind], self._key(arguments)
        self._ready[key] = compiled, compiled.bind(arguments), self._references(self._ready, key, arguments)
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

    def _references(self, ready: dict, key: tuple, arguments: tuple) -> list:
        """Weak references that remove the entry `key` of `ready` as soon as one of its records or arrays is collected.

        Modules, functions and all else that is keyed by its id are held, so that no other object takes that id.
        """
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


def _is_known_by_id(argument: Any) -> bool:
    """Whether equal values of its type are one object: all but large integers, other numbers, texts and tuples."""
    is_small = type(argument) is int and SMALL[0] <= argument <= SMALL[1]
    return is_small or isinstance(argument, bool) or not _is_constant(type(argument))
