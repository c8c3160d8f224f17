"""Guards against assigning to attributes that are unknown, read-only or frozen.

`Guarded` is the base of objects that are built step by step and then used. It refuses an unknown attribute and suggests the
nearest known one, refuses a read-only attribute and names the call to use instead, and refuses every change once the object is
frozen. `guarded_record` gives a frozen dataclass the same messages. Reading (getattr, hasattr, dir) is not changed.
"""

import dataclasses
import difflib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import ClassVar, dataclass_transform

import numpy as np

from taisoft.display import short_repr
from taisoft.errors import MeshError, SceneError, SimulationError, value_text

_NOTHING = object()


class SceneAttributeError(SceneError, AttributeError):
    """An attribute of a scene, or of one of its parts, does not exist or cannot be changed."""


class MeshAttributeError(MeshError, AttributeError):
    """An attribute of a mesh does not exist or cannot be changed."""


class SimulationAttributeError(SimulationError, AttributeError):
    """An attribute of a simulator does not exist or cannot be assigned to."""


class Guarded:
    """Base of classes whose attributes are those set by `__init__` before it calls `_seal`.

    Class attributes say, by attribute name, what to do instead of an assignment: `_instead` at any time, also for names that are
    no attributes, and `_instead_frozen` once the object is frozen, also for calls.
    """

    _error: ClassVar[type[Exception]] = SceneAttributeError
    _instead: ClassVar[dict[str, str]] = {}
    _instead_frozen: ClassVar[dict[str, str]] = {}
    _default_frozen: ClassVar[str] = ""  # for names that _instead_frozen leaves out
    _read_only: ClassVar[frozenset[str]] = frozenset()  # attributes that only the class itself sets
    _contents: ClassVar[dict[str, str]] = {}  # tuples and dicts that only calls fill -> the call
    _sealed = False
    _frozen = False

    def _label(self) -> str:
        """Return the object's name in messages."""
        return type(self).__name__.lower()

    def _seal(self, init: Callable) -> None:
        """Refuse new attributes from now on. init: the calling `__init__`; a subclass with its own may add more after it."""
        self._guard_contents()
        if type(self).__init__ is init:
            self.__dict__["_sealed"] = True

    def _guard_contents(self) -> None:
        for name in self._contents:
            self._hold(name, self.__dict__[name])

    def _held(self, name: str, items) -> "Contents | FrozenDict":
        """Return a copy of items that refuses changes by hand. name: the attribute that has them."""
        held = FrozenDict(items) if isinstance(items, dict) else Contents(items)
        if self._frozen:
            held._refusal = self._frozen_error(name)
        else:
            held._refusal = self._error(f"{self._label()}: {name} cannot be changed by hand: {self._rule(name)}")
        return held

    def _hold(self, name: str, items) -> None:
        """Store items as contents of the object, also of a frozen one."""
        self.__dict__[name] = self._held(name, items)

    def _freeze(self) -> None:
        """Refuse all changes from now on, also in lists, dicts and arrays."""
        self.__dict__["_frozen"] = True
        for name, value in self.__dict__.items():
            if isinstance(value, (list, Contents, dict)):
                self._hold(name, value)
            elif isinstance(value, np.ndarray):
                value.setflags(write=False)

    def _check_open(self, call: str) -> str:
        """Return the start of messages of a call that changes the object. Raises the error of the call if it is frozen."""
        if self._frozen:
            raise self._frozen_error(call)
        return f"{self._label()}: {call}"

    def _add(self, name: str, one):
        """Append one to the object's contents of that name, and return it."""
        self._hold(name, (*self.__dict__[name], one))
        return one

    def _replace(self, name: str, index: int, one) -> None:
        """Replace one of the object's contents of that name, also during a run."""
        items = list(self.__dict__[name])
        items[index] = one
        self._hold(name, items)

    def _remove(self, *gone) -> None:
        """Remove some of the object's contents. Raises the object's error if it is frozen or one is none of them."""
        self._check_open("remove")
        contents = {name: self.__dict__[name] for name in self._contents if isinstance(self.__dict__[name], tuple)}
        for one in gone:
            if not any(one is item for items in contents.values() for item in items):
                each = ": pass them one by one, as in remove(*items)" if isinstance(one, (list, tuple)) else ""
                raise self._error(f"{self._label()}: remove: {value_text(one)} is none of its {', '.join(contents)}{each}")
        for name, items in contents.items():
            self._hold(name, [item for item in items if not any(item is one for one in gone)])

    def _frozen_error(self, name: str) -> Exception:
        call = callable(_declared(type(self), name))
        instead = self._instead_frozen.get(name, self._default_frozen)
        return self._error(
            f"{self._label()}: {name} {'cannot be called' if call else 'cannot change'} any more, since a Simulator has taken "
            f"the scene: {instead}"
        )

    def __getstate__(self) -> dict:
        """Return the state for copies and pickles, with their own lists, dicts and arrays; copies are not frozen."""
        return {name: _mutable_copy(value) for name, value in self.__dict__.items() if name != "_frozen"}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        self._guard_contents()

    def __setattr__(self, name: str, value) -> None:
        if self._frozen and not name.startswith("_") and name in _public(self):
            raise self._frozen_error(name)
        if self._sealed:
            self._check(name, value)
        object.__setattr__(self, name, value)

    def __delattr__(self, name: str) -> None:
        if self._frozen:
            raise self._frozen_error(name)
        if self._sealed and name in _public(self) and _declared(type(self), name) is _NOTHING:  # an overridden method may go
            raise self._error(f"{self._label()}: {name} cannot be deleted: {self._rule(name)}")
        object.__delattr__(self, name)

    def _check(self, name: str, value) -> None:
        """Raise the error of assigning to an attribute that is unknown or cannot be set."""
        declared = _declared(type(self), name)
        if declared is _NOTHING and name not in self.__dict__:
            raise self._error(unknown(self._label(), name, _public(self), self._instead))
        kept = self._read_only | self._contents.keys()
        settable = declared.fset is not None if isinstance(declared, property) else name not in kept
        if not settable:
            raise self._error(f"{self._label()}: {name} cannot be set: {self._rule(name)}")
        if callable(declared) and not callable(value):
            hint = f": {self._instead[name]}" if name in self._instead else ""
            raise self._error(f"{self._label()}: {name} is a method and cannot be set{hint}")

    def _rule(self, name: str) -> str:
        """Return what to do instead of setting an attribute that exists but cannot be set."""
        return self._instead.get(name) or self._contents.get(name, "it is read-only")


@contextmanager
def thawed(*items: Guarded) -> Iterator[None]:
    """Allow setting frozen and read-only attributes within the block.

    For a simulator, which changes the numbers of its own copy of the scene, and for assembling copies.
    """
    before = [(one, one._sealed, one._frozen) for one in items]
    for one in items:
        one.__dict__.update(_sealed=False, _frozen=False)
    try:
        yield
    finally:
        for one, sealed, frozen in before:
            one.__dict__["_sealed"] = sealed
            one._guard_contents()
            if frozen:
                one._freeze()


@dataclass_transform(eq_default=False, frozen_default=True, field_specifiers=(dataclasses.field,))
def guarded_record(
    what: str, instead: str, error: type[Exception] = SceneAttributeError, eq: bool = False
) -> Callable[[type], type]:
    """Return a decorator that makes a class a frozen dataclass with the messages of `Guarded`, `checked` fields, and read-only
    arrays.

    what: its label in messages, followed by its name if it has one; instead: what to do instead of changing an attribute, with
    {name} for the attribute; eq: whether records are compared by value. Those that are not have the repr `short_repr`.
    """

    def guard(cls: type) -> type:
        check = getattr(cls, "__post_init__", None)

        def make_read_only(self) -> None:
            for value in vars(self).values():
                if isinstance(value, np.ndarray):
                    value.setflags(write=False)

        def label(self) -> str:
            own_name = getattr(self, "name", None)
            return what if own_name is None else f"{what} {own_name!r}"

        def check_and_protect(self) -> None:
            for field in dataclasses.fields(self):
                value = getattr(self, field.name)
                if "check" in field.metadata and not (value is None is field.default):
                    object.__setattr__(self, field.name, field.metadata["check"](value, f"{label(self)}: {field.name}"))
            if check is not None:
                check(self)
            make_read_only(self)

        def refuse(self, name: str, value=None) -> None:
            known = _public(self)
            if name in known:
                raise error(f"{label(self)}: {name} cannot change: {instead.format(name=name)}")
            if type(self) is cls:
                raise error(unknown(label(self), name, known, {}))
            object.__setattr__(self, name, value)  # an attribute of a subclass

        def set_state(self, state: dict) -> None:
            self.__dict__.update(state)
            make_read_only(self)

        cls.__post_init__ = check_and_protect
        if not eq and "__repr__" not in vars(cls):
            cls.__repr__ = short_repr
        cls = dataclasses.dataclass(frozen=True, eq=eq)(cls)
        cls.__setattr__, cls.__delattr__, cls.__setstate__ = refuse, refuse, set_state
        return cls

    return guard


def checked(check: Callable, default=dataclasses.MISSING, **limits):
    """Return a field of a `guarded_record` that holds check(value, "LABEL: NAME", **limits); None, where it is the default."""
    return dataclasses.field(default=default, metadata={"check": partial(check, **limits)})


def unknown(what: str, name: str, known: set[str], instead: dict[str, str]) -> str:
    """Return the message about an attribute that does not exist, with what to do instead or the nearest existing name."""
    if name in instead:
        return f"{what} has no attribute {name!r}: {instead[name]}"
    near = difflib.get_close_matches(name, sorted(known | set(instead)), n=1)
    if not near:
        return f"{what} has no attribute {name!r}"
    hint = f" ({instead[near[0]]})" if near[0] in instead else ""
    return f"{what} has no attribute {name!r}; did you mean {near[0]!r}?{hint}"


class Contents(tuple):
    """Items of an object, which only its own calls add and remove. Copies and pickles are plain tuples."""

    _refusal: Exception

    def __reduce_ex__(self, _protocol):
        return tuple, (tuple(self),)


class FrozenDict(dict):
    """An immutable dict of a frozen object. Copies and pickles are plain dicts."""

    _refusal: Exception

    def __reduce_ex__(self, _protocol):
        return dict, (dict(self),)


def _refuse(self, *_, **__) -> None:
    raise type(self._refusal)(*self._refusal.args)


for _name in ("append", "clear", "extend", "insert", "pop", "remove", "reverse", "sort"):
    setattr(Contents, _name, _refuse)
for _name in ("__setitem__", "__delitem__", "__iadd__", "__imul__"):
    setattr(Contents, _name, _refuse)
for _name in ("__setitem__", "__delitem__", "__ior__", "clear", "pop", "popitem", "setdefault", "update"):
    setattr(FrozenDict, _name, _refuse)


def _mutable_copy(value):
    """Return a mutable copy of a dict or array; anything else unchanged."""
    if isinstance(value, dict):
        return dict(value)
    return value.copy() if isinstance(value, np.ndarray) else value


def _declared(cls: type, name: str):
    """Return the attribute that a class or one of its bases defines under a name, or _NOTHING."""
    return getattr(cls, name) if any(name in base.__dict__ for base in cls.__mro__) else _NOTHING


def _public(one) -> set[str]:
    """Return the names of the public attributes of an object and its class."""
    return {name for name in (*dir(type(one)), *one.__dict__) if not name.startswith("_")}
