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
import sys
import weakref
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np

from taisoft.backend.arrays import Array, on_cuda
from taisoft.backend.compiled import Compiled, Public
from taisoft.backend.private import impl, ndarray_type, template
from taisoft.backend.structure import holders, names_in, names_of_types, structure_of
from taisoft.backend.tracing import FAST_TRACING
from taisoft.errors import SimulationError

PUBLIC = not FAST_TRACING  # launch only through Taichi's public interface
PACK = os.environ.get("TAISOFT_PACK", "")  # "0" or "1": whether arguments are packed; by default, they are on the CPU


def packs() -> bool:
    """Whether arguments are packed. Raises SimulationError for another value of TAISOFT_PACK."""
    if PACK not in ("", "0", "1"):
        raise SimulationError(f"the environment variable TAISOFT_PACK must be 0 or 1, not '{PACK}'")
    return PACK == "1" if PACK else not on_cuda()


class Ready(NamedTuple):
    """A kernel with what its launches with certain records need. program: None if `Kernels.launcher` must not launch it."""

    program: Any
    launch: Callable | None  # of the program
    data: Any  # compiled code
    context: Any  # these two from `Compiled.bind`
    write: Any
    compiled: Compiled
    references: list


class Kernels:
    """All compiled versions of one kernel."""

    every: ClassVar[list["Kernels"]] = []
    watched: ClassVar[bool] = False  # by `counters`: every launch passes through `Compiled.launch`

    def __init__(self, function: Callable):
        self._function = function
        signature = inspect.signature(function)
        self._kinds = {name: parameter.annotation for name, parameter in signature.parameters.items()}
        self._templates = [k for k, kind in enumerate(self._kinds.values()) if isinstance(kind, template)]
        self._arrays = [k for k, kind in enumerate(self._kinds.values()) if isinstance(kind, ndarray_type.NdarrayType)]
        self._used: set[str] | None = None
        self._ready: dict[Any, Ready] = {}  # by key of the arguments
        self.forget()
        self.every.append(self)

    def forget(self) -> None:
        """Drop everything compiled: Taichi has been re-initialised."""
        self._compiled: dict[tuple, Compiled] = {}
        self._ready.clear()

    @classmethod
    def watch(cls, watched: bool) -> None:
        """Let every launch pass through `Compiled.launch`, or no longer."""
        cls.watched = watched
        for kernels in cls.every:
            kernels._ready.clear()

    @property
    def n_compiled(self) -> int:
        """Number of structures that the kernel has been compiled for."""
        return len(self._compiled)

    def launcher(self, prepare: Callable) -> Callable:
        """Return a function with the kernel's parameters that launches it, and calls `prepare` instead where it cannot.

        It is the shortest Python can be: one look-up, one call that writes the numbers, one that launches.
        """
        names, templates = list(self._kinds), [list(self._kinds)[k] for k in self._templates]
        numbers, given = ", ".join(name for name in names if name not in templates), ", ".join(names)
        lines = [f"def {self._function.__name__}({given}):"]
        if not self._arrays:
            lines += [
                f"    _entry = _find(({', '.join(f'id({name})' for name in templates)}))",
                "    if _entry is not None and _entry[0] is _taichi.pytaichi.prog:",
                "        _, _launch, _data, _context, _write, _compiled, _ = _entry",
                "        if _write is not None:",
                "            try:",
                f"                _write({numbers})",
                "            except _Wrong:",
                f"                raise _compiled.refusal({numbers}) from None",
                "        _launch(_data, _context)",
                "        return _compiled.result(_context)" if "return" in self._function.__annotations__ else "        return",
            ]
        lines.append(f"    return _prepare({given})")
        scope = {"_find": self._ready.get, "_taichi": impl, "_Wrong": struct.error, "_prepare": prepare}
        exec("\n".join(lines), scope)
        return functools.wraps(self._function)(scope[self._function.__name__])

    def _key(self, arguments: tuple) -> Any:
        """Identities of the templates, and types of the host's arrays; no tuple around a single one, which would take longer."""
        key = [id(arguments[k]) for k in self._templates]
        for k in self._arrays:
            key += arguments[k].dtype, arguments[k].ndim
        return key[0] if len(key) == 1 else tuple(key)

    def find(self, arguments: tuple) -> Ready | None:
        """What `prepare` returned for these arguments, or None if they are new."""
        return self._ready.get(self._key(arguments))

    def prepare(self, arguments: tuple) -> Ready:
        """Compile the kernel if it is new for the structure of these arguments, and bind them."""
        names = self._names_for(arguments)
        structures = [structure_of(a, names) if k in self._templates else None for k, a in enumerate(arguments)]
        kind = tuple(structures), tuple([(arguments[k].dtype, arguments[k].ndim) for k in self._arrays])
        if kind not in self._compiled:
            examples = [a if k in self._arrays else None for k, a in enumerate(arguments)]
            make = Public if PUBLIC else Compiled
            self._compiled[kind] = make(self._function, self._kinds, structures, examples, packs())
        compiled, key = self._compiled[kind], self._key(arguments)
        direct = compiled.packed and not (PUBLIC or self.watched)
        program, launch, data = (compiled.program, compiled.program.launch_kernel, compiled.data) if direct else (None,) * 3
        entry = Ready(program, launch, data, *compiled.bind(arguments), compiled, self._references(key, arguments))
        if all(_is_known_by_id(arguments[k]) for k in self._templates):
            self._ready[key] = entry
        return entry

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

    def _references(self, key: Any, arguments: tuple) -> list:
        """Weak references that remove the entry `key` as soon as one of its records or arrays is collected.

        Modules, functions and all else are held, so that no other object takes that id.
        """
        ready = self._ready
        return [
            weakref.ref(arguments[k], lambda _, key=key: ready.pop(key, None))
            if isinstance(arguments[k], Array) or dataclasses.is_dataclass(arguments[k])
            else arguments[k]
            for k in self._templates
        ]


def _is_known_by_id(argument: Any) -> bool:
    """Whether an argument is not made anew for each launch, as numbers, texts and tuples may be; Python keeps some of these."""
    if isinstance(argument, str):
        return sys.intern(argument) is argument
    is_small = type(argument) in (bool, int) and -5 <= argument <= 256
    return is_small or not isinstance(argument, (int, float, tuple, np.generic))
