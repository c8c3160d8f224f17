"""What may be assigned to, and the sentence that refuses the rest.

`Guarded` is for objects that are built step by step and used then: an unknown attribute is refused with the nearest known one, a
read-only one with the call to use, and once the object is frozen every change is. `guarded_record` gives a frozen dataclass the
same sentences. Reading is untouched: getattr, hasattr and dir do what they always do.
"""

import difflib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ClassVar

import numpy as np

from taisoft.errors import MeshError, SceneError, SimulationError

_NOTHING = object()


class SceneAttributeError(SceneError, AttributeError):
    """An attribute of a scene, or of a part of one, that does not exist or cannot change."""


class MeshAttributeError(MeshError, AttributeError):
    """An attribute of a mesh that does not exist or cannot change."""


class SimulationAttributeError(SimulationError, AttributeError):
    """An attribute of a simulator that does not exist or cannot be assigned to."""


class Guarded:
    """Base of classes whose attributes are those that their `__init__` has set by the time it calls `_seal`.

    A class tells what to do instead of an assignment, by attribute: `_instead` at any time, also for names that are no
    attributes, and `_instead_late` once the object is frozen, also for calls.
    """

    _error: ClassVar[type[Exception]] = SceneAttributeError
    _instead: ClassVar[dict[str, str]] = {}
    _instead_late: ClassVar[dict[str, str]] = {}
    _otherwise_late: ClassVar[str] = ""  # for what _instead_late leaves out
    _read_only: ClassVar[frozenset[str]] = frozenset()  # attributes that only the class itself sets
    _contents: ClassVar[dict[str, str]] = {}  # lists and dicts that nothing is put into by hand, and the call that does it
    _sealed = False
    _frozen = False

    def _said(self) -> str:
        """What messages call the object."""
        return type(self).__name__.lower()

    def _seal(self, init: Callable) -> None:
        """From now on the attributes are known. init: the caller's; a subclass with another one may add attributes after it."""
        self._guard_contents()
        if type(self).__init__ is init:
            self.__dict__["_sealed"] = True

    def _guard_contents(self) -> None:
        for name, instead in self._contents.items():
            value = self.__dict__[name]
            held = self.__dict__[name] = FrozenDict(value) if isinstance(value, dict) else GuardedList(value)
            held._refusal = self._error(f"{self._said()}: {name} cannot be changed by hand: {instead}")

    def _freeze(self) -> None:
        """Refuse changes from now on, also of lists, dicts and arrays."""
        for name, value in self.__dict__.items():
            if isinstance(value, (list, dict)):
                held = self.__dict__[name] = FrozenDict(value) if isinstance(value, dict) else FrozenList(value)
                held._refusal = self._late(name)
            elif isinstance(value, np.ndarray):
                value.setflags(write=False)
        self.__dict__["_frozen"] = True

    def _check_open(self, call: str) -> None:
        """Raises the error for a call that would change what is frozen."""
        if self._frozen:
            raise self._late(call)

    def _late(self, name: str) -> Exception:
        call = callable(_declared(type(self), name))
        instead = self._instead_late.get(name, self._otherwise_late)
        return self._error(
            f"{self._said()}: {name} {'cannot be called' if call else 'cannot change'} any more, since a Simulator has taken the "
            f"scene: {instead}"
        )

    def __getstate__(self) -> dict:
        """For copies and pickles: they have lists, dicts and arrays of their own, and those of a frozen object can change."""
        return {name: _own(value) for name, value in self.__dict__.items() if name != "_frozen"}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        self._guard_contents()

    def __setattr__(self, name: str, value) -> None:
        if self._frozen and not name.startswith("_") and name in _public(self):
            raise self._late(name)
        if self._sealed:
            self._check(name, value)
        object.__setattr__(self, name, value)

    def __delattr__(self, name: str) -> None:
        if self._frozen:
            raise self._late(name)
        if self._sealed and name in _public(self) and _declared(type(self), name) is _NOTHING:  # a replaced method may go
            raise self._error(f"{self._said()}: {name} cannot be deleted: {self._rule(name)}")
        object.__delattr__(self, name)

    def _check(self, name: str, value) -> None:
        """Raises the error for what is no attribute, or none that can be assigned to."""
        declared = _declared(type(self), name)
        if declared is _NOTHING and name not in self.__dict__:
            raise self._error(unknown(self._said(), name, _public(self), self._instead))
        kept = self._read_only | self._contents.keys()
        settable = declared.fset is not None if isinstance(declared, property) else name not in kept
        if not settable:
            raise self._error(f"{self._said()}: {name} cannot be set: {self._rule(name)}")
        if callable(declared) and not callable(value):
            hint = f": {self._instead[name]}" if name in self._instead else ""
            raise self._error(f"{self._said()}: {name} is a method and cannot be set{hint}")

    def _rule(self, name: str) -> str:
        """What to do instead of setting what is there but cannot be set."""
        return self._instead.get(name) or self._contents.get(name, "it is read-only")


@contextmanager
def thawed(*items: Guarded) -> Iterator[None]:
    """What is frozen or read-only can be set meanwhile: for a simulator, which changes the numbers of its own copy of the scene,
    and for copies that are put together anew."""
    before = [(one, one._sealed, one._frozen) for one in items]
    for one in items:
        for name, value in one.__dict__.items():
            if isinstance(value, (GuardedList, FrozenDict)):
                one.__dict__[name] = _own(value)
        one.__dict__.update(_sealed=False, _frozen=False)
    try:
        yield
    finally:
        for one, sealed, frozen in before:
            one.__dict__["_sealed"] = sealed
            one._guard_contents()
            if frozen:
                one._freeze()


def guarded_record(what: str, instead: str, error: type[Exception] = SceneAttributeError) -> Callable[[type], type]:
    """A decorator of a frozen dataclass. what: what messages call it, with its name if it has one; instead: what to do instead of
    changing an attribute, with {name} for the attribute. Arrays of its copies and pickles are read-only as its own are."""

    def guard(cls: type) -> type:
        def refuse(self, name: str, value=None) -> None:
            own = getattr(self, "name", None)
            said = what if own is None else f"{what} {own!r}"
            known = _public(self)
            if name in known:
                raise error(f"{said}: {name} cannot change: {instead.format(name=name)}")
            if type(self) is cls:
                raise error(unknown(said, name, known, {}))
            object.__setattr__(self, name, value)  # a subclass's own

        def set_state(self, state: dict) -> None:
            self.__dict__.update(state)
            for value in state.values():
                if isinstance(value, np.ndarray):
                    value.setflags(write=False)

        cls.__setattr__, cls.__delattr__, cls.__setstate__ = refuse, refuse, set_state
        return cls

    return guard


def unknown(what: str, name: str, known: set[str], instead: dict[str, str]) -> str:
    """The sentence about an attribute that does not exist, with what to do instead or the nearest name that does."""
    if name in instead:
        return f"{what} has no attribute {name!r}: {instead[name]}"
    near = difflib.get_close_matches(name, sorted(known | set(instead)), n=1)
    if not near:
        return f"{what} has no attribute {name!r}"
    hint = f" ({instead[near[0]]})" if near[0] in instead else ""
    return f"{what} has no attribute {name!r}; did you mean {near[0]!r}?{hint}"


class GuardedList(list):
    """A list that only its owner adds to; items may be taken out of it. Copies and pickles are plain lists."""

    _refusal: Exception

    def __reduce_ex__(self, _protocol):
        return list, (list(self),)


class FrozenList(GuardedList):
    """A list of a frozen object, which nobody changes."""


class FrozenDict(dict):
    """A dict of a frozen object. Copies and pickles are plain dicts."""

    _refusal: Exception

    def __reduce_ex__(self, _protocol):
        return dict, (dict(self),)


def _refuse(self, *_, **__) -> None:
    raise type(self._refusal)(*self._refusal.args)


for _name in ("__setitem__", "__iadd__", "__imul__", "append", "extend", "insert"):
    setattr(GuardedList, _name, _refuse)
for _name in ("__delitem__", "clear", "pop", "remove", "reverse", "sort"):
    setattr(FrozenList, _name, _refuse)
for _name in ("__setitem__", "__delitem__", "__ior__", "clear", "pop", "popitem", "setdefault", "update"):
    setattr(FrozenDict, _name, _refuse)


def _own(value):
    """A list, dict or array of the same content that can change; anything else as it is."""
    if isinstance(value, list):
        return list(value)
    if isinstance(value, dict):
        return dict(value)
    return value.copy() if isinstance(value, np.ndarray) else value


def _declared(cls: type, name: str):
    """What a class or its bases hold under a name; _NOTHING where they do not."""
    return getattr(cls, name) if any(name in base.__dict__ for base in cls.__mro__) else _NOTHING


def _public(one) -> set[str]:
    """Names of the public attributes of an object and of its class."""
    return {name for name in (*dir(type(one)), *one.__dict__) if not name.startswith("_")}
