"""Read tables of a scene file strictly: unknown, missing or mistyped keys are refused with file and key path.

Values are validated by the functions that take them: `Table.make` calls a function with the table's keys as arguments, and
prefixes its errors with the file and key path, such as bodies.beam.material.young.
"""

import datetime
import inspect
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from taisoft.errors import MeshError, SceneError
from taisoft.scene import checks

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")  # keys that TOML allows without quotes
INT_LIMIT = 2**63  # upper bound of TOML integers
SURROGATES = {chr(code) for code in range(0xD800, 0xE000)}  # no valid characters, and TOML has no escape for them
MAX_ERROR_LENGTH = 400  # maximum number of characters of an error, which may repeat a whole list, without the file's folder
MAX_VALUE_LENGTH = 40  # maximum number of characters of a value in a message


def value_text(value) -> str:
    """Return a value as short text for a message."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= MAX_VALUE_LENGTH else text[: MAX_VALUE_LENGTH - 3] + "..."


def quote(text: str) -> str:
    """Return text as a quoted and escaped TOML string."""
    escapes = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r"}
    escaped = "".join(escapes.get(c) or (c if c.isprintable() or c in SURROGATES else f"\\U{ord(c):08X}") for c in text)
    return f'"{escaped}"'


def key_text(key: str) -> str:
    """Return a key as TOML writes it, quoted if needed."""
    return key if BARE_KEY.fullmatch(key) else quote(key)


def key_path(place: str, key: str) -> str:
    """Return the path of a key in the table at path `place`; "" is the file's top level."""
    return f"{place}.{key_text(key)}" if place else key_text(key)


def arguments_of(function: Callable, *excluded: str) -> tuple[list[str], list[str]]:
    """Return the names of a function's arguments, and of those without a default, except `excluded`."""
    parameters = [p for p in inspect.signature(function).parameters.values() if p.name not in ("self", *excluded)]
    return [p.name for p in parameters], [p.name for p in parameters if p.default is inspect.Parameter.empty]


def check_values(file: Path, values, place: str = "") -> None:
    """Raise SceneError if values contain, at any depth, non-finite numbers, integers beyond 64 bits, dates or times."""
    if isinstance(values, dict):
        for key, value in values.items():
            check_values(file, value, key_path(place, key))
    elif isinstance(values, list):
        for i, value in enumerate(values):
            check_values(file, value, f"{place}[{i}]")
    elif isinstance(values, float) and not math.isfinite(values):
        raise SceneError(f"{file}: {place} must be finite, not {values}")
    elif isinstance(values, int) and not -INT_LIMIT <= values < INT_LIMIT:
        raise SceneError(f"{file}: {place} is a whole number of more than 64 bits")
    elif isinstance(values, (datetime.date, datetime.time)):
        raise SceneError(f"{file}: {place} is a date or a time, which scenes do not use")


class Table:
    """One table of a file. values: key -> value. known: allowed keys; required: keys that must exist. Raises SceneError."""

    def __init__(self, file: Path, place: str, values, known: list[str], required: list[str] | tuple = ()):
        self.file, self.place, self.known = file, place, known
        if not isinstance(values, dict):
            raise self.error("", f"must be a table, not {value_text(values)}")
        self.values, allowed = values, set(known)  # a set, since a file may have thousands of names
        for key in values:
            if key not in allowed:
                raise self.error(key, f"is not known{checks.nearest(key, known)}; there are {', '.join(known)}")
        for key in required:
            if key not in values:
                raise self.error(key, "is missing")

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def error(self, key: str, text: str) -> SceneError:
        """Return an error about a key of this table, or about the table itself for ""."""
        return SceneError(f"{self.file}: {key_path(self.place, key) if key else self.place} {text}")

    def table(self, key: str, known: list[str], required: list[str] | tuple = ()) -> "Table":
        """Return the table under a key."""
        return Table(self.file, key_path(self.place, key), self.values[key], known, required)

    def named(self, key: str) -> "Table":
        """Return the table under a key that holds tables with names of their own; it is empty if the key is missing."""
        values, place = self.values.get(key, {}), key_path(self.place, key)
        if not isinstance(values, dict):
            raise self.error(key, f"must be tables [{place}.NAME], not {value_text(values)}")
        return Table(self.file, place, values, list(values))

    def listed(self, key: str, known: list[str], required: list[str] | tuple = ()) -> "list[Table]":
        """Return the tables of the list under a key; empty if the key is missing."""
        values, place = self.values.get(key, []), key_path(self.place, key)
        if not isinstance(values, list):
            raise self.error(key, f"must be a list of tables [[{place}]], not {value_text(values)}")
        return [Table(self.file, f"{place}[{i}]", value, known, required) for i, value in enumerate(values)]

    def checked(self, key: str):
        """Return the value of a key. Raises SceneError if a list holds, at any depth, anything but int and float numbers."""

        def check(value, place: str) -> None:
            for i, entry in enumerate(value if isinstance(value, list) else ()):
                if isinstance(entry, list):
                    check(entry, f"{place}[{i}]")
                elif isinstance(entry, bool) or not isinstance(entry, (int, float)):
                    raise SceneError(f"{self.file}: {place}[{i}] must be a number, not {value_text(entry)}")

        check(self.values[key], key_path(self.place, key))
        return self.values[key]

    def make(self, function: Callable, *prefixes: str, keys: list[str] | None = None, **others):
        """Call function(**others) with the values of `keys`, by default all, as further arguments; its errors are located."""
        given = {key: self.checked(key) for key in (self.known if keys is None else keys) if key in self.values}
        with self.located_errors(*prefixes):
            return function(**given, **others)

    def made(self, key: str, function: Callable, *prefixes: str):
        """Return what a function makes of the table under a key, whose keys are the function's arguments."""
        return self.table(key, *arguments_of(function)).make(function, *prefixes)

    @contextmanager
    def located_errors(self, *prefixes: str) -> Iterator[None]:
        """Prefix errors raised inside with the file and this table's path. prefixes: starts of their text to remove."""
        try:
            yield
        except (SceneError, MeshError) as error:
            text = str(error)
            for start in prefixes:
                text = text.removeprefix(start)
            limit = MAX_ERROR_LENGTH + len(str(self.file.parent))
            text = text if len(text) <= limit else f"{text[:limit]}..."
            key = re.match(r"\w+", text)
            if key and key[0] in self.known:
                place = key_path(self.place, key[0]) + text[key.end() :]
            else:
                place = f"{self.place}: {text}" if self.place else text
            raise type(error)(f"{self.file}: {place}") from error
