"""Tables of a scene file, read strictly: what is unknown, missing or of another kind is refused, with file and place.

Rules about values are left to what is made from them: `Table.make` calls it with the table's keys as arguments, and puts
file and place, such as bodies.beam.material.young, in front of what it refuses.
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

BARE = re.compile(r"[A-Za-z0-9_-]+")  # keys that TOML takes without quotes
LARGEST = 2**63  # whole numbers of TOML are below
SURROGATES = {chr(code) for code in range(0xD800, 0xE000)}  # no characters, and no escape can stand for them
LONGEST = 400  # characters of an error's text, which may repeat a whole list, besides those of the file's folder
SHOWN = 40  # characters of a value in a message


def shown(value) -> str:
    """A value in a message, short."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."


def quoted(text: str) -> str:
    """A text in the quotes of TOML, escaped where it must be."""
    short = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r"}
    plain = "".join(short.get(c) or (c if c.isprintable() or c in SURROGATES else f"\\U{ord(c):08X}") for c in text)
    return f'"{plain}"'


def bare_or_quoted(key: str) -> str:
    """A key as TOML writes it."""
    return key if BARE.fullmatch(key) else quoted(key)


def joined(place: str, key: str) -> str:
    """The place of a key in the table at `place`; "" is the file's top."""
    return f"{place}.{bare_or_quoted(key)}" if place else bare_or_quoted(key)


def arguments_of(function: Callable, *left_out: str) -> tuple[list[str], list[str]]:
    """Names of a function's arguments, and of those without a default, apart from those left out."""
    parameters = [p for p in inspect.signature(function).parameters.values() if p.name not in ("self", *left_out)]
    return [p.name for p in parameters], [p.name for p in parameters if p.default is inspect.Parameter.empty]


def check_values(file: Path, values, place: str = "") -> None:
    """Refuse, anywhere in a file, numbers that are not finite or too large for 64 bits, and dates and times."""
    if isinstance(values, dict):
        for key, value in values.items():
            check_values(file, value, joined(place, key))
    elif isinstance(values, list):
        for i, value in enumerate(values):
            check_values(file, value, f"{place}[{i}]")
    elif isinstance(values, float) and not math.isfinite(values):
        raise SceneError(f"{file}: {place} must be finite, not {values}")
    elif isinstance(values, int) and not -LARGEST <= values < LARGEST:
        raise SceneError(f"{file}: {place} is a whole number of more than 64 bits")
    elif isinstance(values, (datetime.date, datetime.time)):
        raise SceneError(f"{file}: {place} is a date or a time, which a scene has no use for")


class Table:
    """One table of a file. values: key -> value. known: all keys it may have; needed: those it must have. Raises SceneError."""

    def __init__(self, file: Path, place: str, values, known: list[str], needed: list[str] | tuple = ()):
        self.file, self.place, self.known = file, place, known
        if not isinstance(values, dict):
            raise self.error("", f"must be a table, not {shown(values)}")
        self.values, among = values, set(known)  # names are known by the thousand
        for key in values:
            if key not in among:
                raise self.error(key, f"is not known{checks.nearest(key, known)}; there are {', '.join(known)}")
        for key in needed:
            if key not in values:
                raise self.error(key, "is missing")

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def error(self, key: str, text: str) -> SceneError:
        """The error about a key of this table, or about the table for ""."""
        return SceneError(f"{self.file}: {joined(self.place, key) if key else self.place} {text}")

    def table(self, key: str, known: list[str], needed: list[str] | tuple = ()) -> "Table":
        """The table under a key."""
        return Table(self.file, joined(self.place, key), self.values[key], known, needed)

    def named(self, key: str) -> list[str]:
        """The names of the tables under a key, in their order; none where the key is missing."""
        values = self.values.get(key, {})
        if not isinstance(values, dict):
            raise self.error(key, f"must be tables [{joined(self.place, key)}.NAME], not {shown(values)}")
        return list(values)

    def listed(self, key: str, known: list[str], needed: list[str] | tuple = ()) -> "list[Table]":
        """The tables of the list under a key; none where the key is missing."""
        values, place = self.values.get(key, []), joined(self.place, key)
        if not isinstance(values, list):
            raise self.error(key, f"must be a list of tables [[{place}]], not {shown(values)}")
        return [Table(self.file, f"{place}[{i}]", value, known, needed) for i, value in enumerate(values)]

    def checked(self, key: str):
        """The value of a key; in lists, at any depth, only numbers that are not true or false."""
        self._check_numbers(self.values[key], joined(self.place, key))
        return self.values[key]

    def _check_numbers(self, value, place: str) -> None:
        for i, entry in enumerate(value if isinstance(value, list) else ()):
            if isinstance(entry, list):
                self._check_numbers(entry, f"{place}[{i}]")
            elif isinstance(entry, bool) or not isinstance(entry, (int, float)):
                raise SceneError(f"{self.file}: {place}[{i}] must be a number, not {shown(entry)}")

    def make(self, function: Callable, *said: str, keys: list[str] | None = None, **more):
        """function(**more) with the values of `keys`, all by default, as further arguments; what it refuses is `placed`."""
        given = {key: self.checked(key) for key in (self.known if keys is None else keys) if key in self.values}
        with self.placed(*said):
            return function(**given, **more)

    @contextmanager
    def placed(self, *said: str) -> Iterator[None]:
        """Errors raised inside get the file and this table's place in front. said: starts of their text to leave out."""
        try:
            yield
        except (SceneError, MeshError) as error:
            text = str(error)
            for start in said:
                text = text.removeprefix(start)
            most = LONGEST + len(str(self.file.parent))
            text = text if len(text) <= most else f"{text[:most]}..."
            key = re.match(r"\w+", text)
            if key and key[0] in self.known:
                place = joined(self.place, key[0]) + text[key.end() :]
            else:
                place = f"{self.place}: {text}" if self.place else text
            raise type(error)(f"{self.file}: {place}") from error
