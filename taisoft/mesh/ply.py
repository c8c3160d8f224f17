"""Read .ply files, text and binary of either byte order, with any elements and properties.

meshio expects the faces' list under one of its two names, before other properties, and no other elements. Here elements are
read in runs of rows whose lists have equal lengths, each as one array.
Source: Turk 1994, The PLY Polygon File Format, which calls the list `vertex_index`; most programs write `vertex_indices`.
"""

import re
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.words import MAX_EXACT_INT, Words

LISTS = ("vertex_indices", "vertex_index")
GROWTH = 8  # of the number of rows that are tried, after rows of equal lists
_SIZES = {"char": "i1", "short": "i2", "int": "i4", "float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
TYPES = _SIZES | {f"u{name}": f"u{_SIZES[name][1]}" for name in ("char", "short", "int")}
TYPES |= {f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)}
_HEAD = re.compile(rb"ply[ \t]*\r?\n(.*?)^end_header[ \t]*\r?\n", re.DOTALL | re.MULTILINE)
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class Property(NamedTuple):
    """A number of each row, or with `count`, NumPy's type of the length, a list."""

    name: str
    type: str
    count: str | None


class Element(NamedTuple):
    """What the header says of an element; its first line is number `line`."""

    name: str
    n_rows: int
    properties: list[Property]
    line: int


def read_ply(name: str, data: bytes) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return positions (n,3) and polygons, arrays (k,corners). name: the file's, for messages. Raises MeshError."""
    head = _HEAD.match(data)
    if head is None:
        lines = data.split(b"\n", 1000)
        wrong, rule = (1, "ply") if lines[0].strip() != b"ply" else (len(lines), "end_header")
        raise MeshError(f"{name}: line {wrong}: not a supported surface: expected {rule}")
    order, elements = _read_header(name, head[1].decode("utf-8", "replace"))
    if order:
        rows = _Rows(data[head.end() :], order, lambda text, at: MeshError(f"{name}: byte {head.end() + at}: {text}"))
    else:  # as bytes of float64
        words = Words(name, data[head.end() :], data.count(b"\n", 0, head.end()) + 1)
        rows = _Rows(words.floats(words.left()).tobytes(), "=", lambda text, at: words.error(text, at // 8))
        for element in elements:
            element.properties[:] = [one._replace(type="f8", count=one.count and "f8") for one in element.properties]
    points, polygons = [np.empty((0, 3))], []
    for element in elements:
        lists, numbers = ({p.name: k for k, p in enumerate(element.properties) if bool(p.count) == own} for own in (True, False))
        corners = next((lists[one] for one in LISTS if one in lists), None)
        if element.name == "tristrips" or (element.name == "face" and corners is None):
            raise _unfit(name, element, f"faces with a list called {' or '.join(LISTS)}")
        if element.name == "vertex" and not numbers.keys() >= set("xyz"):
            raise _unfit(name, element, "vertices with x, y and z")
        for run in rows.runs(element):
            if element.name == "vertex":
                points.append(np.column_stack([run[numbers[axis]] for axis in "xyz"]))
            elif element.name == "face":
                if run[corners].shape[1] < 3:
                    raise rows.error(f"expected a face of at least 3 corners, not {run[corners].shape[1]}")
                n_points = sum(map(len, points)) or MAX_EXACT_INT  # faces may come first
                fitting = (run[corners] >= 0) & (run[corners] < n_points) & (np.floor(run[corners]) == run[corners])
                bad = np.flatnonzero(~fitting.all(axis=1))
                if len(bad):
                    raise rows.error(f"expected whole numbers of vertices below {n_points:.0f}", int(bad[0]))
                polygons.append(run[corners].astype(np.int64))
    rows.end()
    return np.concatenate(points), polygons


def _unfit(name: str, element: Element, rule: str) -> MeshError:
    found = ", ".join(one.name for one in element.properties) or "nothing"
    return MeshError(f"{name}: line {element.line}: expected {rule}, not {element.name!r} with {found}")


def _read_header(name: str, text: str) -> tuple[str, list[Element]]:
    """Return the byte order, "" of text, and the elements."""
    order, elements = None, []
    for line, words in enumerate(map(str.split, text.split("\n")), 2):
        try:
            match words:
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", kind, "1.0"] if order is None:
                    order = _FORMATS[kind]
                case ["element", called, n] if order is not None and int(n) >= 0 and called not in {one.name for one in elements}:
                    elements.append(Element(called, int(n), [], line))
                case ["property", "list", count, kind, called] if TYPES[count][0] in "iu":
                    elements[-1].properties.append(Property(called, TYPES[kind], TYPES[count]))
                case ["property", kind, called]:
                    elements[-1].properties.append(Property(called, TYPES[kind], None))
                case _:
                    raise ValueError
        except (ValueError, LookupError):
            rule = "format, element or property and their words" if order is not None else "format ascii or binary 1.0"
            raise MeshError(f"{name}: line {line}: expected {rule}, not {' '.join(words)[:80]!r}") from None
    if order is None:
        raise MeshError(f"{name}: line 2: expected format ascii or binary 1.0")
    return order, elements


class _Rows:
    """The rows after the header, as bytes. size: of the present row, which begins at byte `at`."""

    def __init__(self, data: bytes, order: str, error: Callable[[str, int], MeshError]):
        """order: of bytes; error: returns the error at a byte of data."""
        self.data, self.at, self.size, self._order, self._error = data, 0, 0, order, error

    def error(self, text: str, row: int = 0) -> MeshError:
        """Return the error at a row from the present one on."""
        return self._error(text, self.at + row * self.size)

    def end(self) -> None:
        """Check that only blank space is left."""
        if self.data[self.at :].strip():
            raise self._error("expected the file's end after the last row that the header declares", self.at)

    def runs(self, element: Element) -> Iterator[list[np.ndarray]]:
        """Yield, for each run of rows with lists of equal lengths, the values (k,) or (k,length) of each property."""
        left, tried = element.n_rows, 1 if any(one.count for one in element.properties) else element.n_rows
        while left and element.properties:
            lengths, row = self._first_row(element)
            n = min(left, tried, (len(self.data) - self.at) // self.size)
            values = np.frombuffer(self.data, row, n, self.at)
            equal = np.ones(n, dtype=bool)
            for k, length in lengths.items():
                equal &= values[f"n{k}"] == length
            n = n if equal.all() else int(np.argmin(equal))
            yield [values[f"{k}"][:n] for k in range(len(element.properties))]
            self.at += n * self.size
            left, tried = left - n, GROWTH * n

    def _first_row(self, element: Element) -> tuple[dict[int, int], np.dtype]:
        """Return the lengths of the lists in the present row by the number of the property, and the row's type."""
        end, lengths, fields = self.at, {}, []
        for k, one in enumerate(element.properties):
            if one.count:
                count = np.dtype(self._order + one.count)
                found = np.frombuffer(self.data[end : end + count.itemsize].ljust(count.itemsize, b"\xff"), count)[0]
                if not (0 <= found <= len(self.data) and found == int(found)):
                    raise self._error(f"expected the length of the list {one.name} of {element.name!r}", end)
                lengths[k] = int(found)
                fields.append((f"n{k}", count))
                end += count.itemsize
            kind = np.dtype(self._order + one.type)
            fields.append((f"{k}", kind, (lengths[k],)) if one.count else (f"{k}", kind))
            end += kind.itemsize * lengths.get(k, 1)
        if end > len(self.data):
            raise self._error(f"expected a whole row of {element.name!r}, but the file ends", len(self.data))
        self.size = end - self.at
        return lengths, np.dtype(fields)
