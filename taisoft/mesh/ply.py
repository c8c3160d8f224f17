"""Read .ply files, text and binary of either byte order, with any elements and properties.

meshio expects the faces' list under one of its two names, before other properties, and no other elements. Here the
rows whose lists have equal lengths are read as one array.
Source: Turk 1994, The PLY Polygon File Format, which calls the list `vertex_index`; most programs write `vertex_indices`.
"""

import re
import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.words import MAX_EXACT_INT, Words, to_int

LISTS = ("vertex_indices", "vertex_index")
UVS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))  # names of texture coordinates of vertices
STRUCT_TYPES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q", "f8": "d"}
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


def read_ply(name: str, data: bytes) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray] | None, dict]:
    """Return positions (n,3), polygons, arrays (k,corners), their UVs, (k,corners,2), or None, and no subsets.

    name: the file's, for messages. Raises MeshError.
    """
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
    points, polygons, uvs = np.empty((0, 3)), [], None
    for element in elements:
        lists, numbers = ({p.name: k for k, p in enumerate(element.properties) if bool(p.count) == own} for own in (True, False))
        corners = next((lists[one] for one in LISTS if one in lists), None)
        if element.name == "tristrips" or (element.name == "face" and corners is None):
            raise _unfit(name, element, f"faces with a list called {' or '.join(LISTS)}")
        if element.name == "vertex" and not numbers.keys() >= set("xyz"):
            raise _unfit(name, element, "vertices with numbers x, y and z")
        for first, values in rows.groups(element):
            if element.name == "vertex":
                points = np.column_stack([values[numbers[axis]] for axis in "xyz"])
                pair = next((pair for pair in UVS if numbers.keys() >= set(pair)), None)
                uvs = None if pair is None else np.column_stack([values[numbers[axis]] for axis in pair])
            elif element.name == "face":
                nodes = values[corners]
                if nodes.shape[1] < 3:
                    raise rows.error(f"expected a face of at least 3 corners, not {nodes.shape[1]}", int(first[0]))
                n_points = len(points) or MAX_EXACT_INT  # faces may come first
                bad = ~((nodes >= 0) & (nodes < n_points) & (np.floor(nodes) == nodes)).all(axis=1)
                if bad.any():
                    raise rows.error(f"expected whole numbers of vertices below {n_points:.0f}", int(first[bad.argmax()]))
                polygons.append(nodes.astype(np.int64))
    rows.end()
    return points, polygons, None if uvs is None else [uvs[nodes] for nodes in polygons], {}


def _unfit(name: str, element: Element, rule: str) -> MeshError:
    found = ", ".join(f"{'list ' if one.count else ''}{one.name}" for one in element.properties) or "nothing"
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
                case ["element", called, n] if order is not None and n[0] != "-" and all(one.name != called for one in elements):
                    elements.append(Element(called, to_int(n), [], line))
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
    """The rows after the header, as bytes, of which those before byte `at` were read."""

    def __init__(self, data: bytes, order: str, error: Callable[[str, int], MeshError]):
        """order: of bytes; error: returns the error at a byte of data."""
        self.data, self.at, self.error, self._order = data, 0, error, order

    def end(self) -> None:
        """Check that only blank space is left."""
        if self.data[self.at :].strip():
            raise self.error("expected the file's end after the last row that the header declares", self.at)

    def groups(self, element: Element) -> Iterator[tuple[np.ndarray, list[np.ndarray]]]:
        """Yield rows whose lists have equal lengths: first bytes (k,), and of each property the values (k,) or (k,length)."""
        for lengths, first in self._starts(element).items():
            fields, left = [], list(lengths)
            for k, one in enumerate(element.properties):
                fields += [(f"n{k}", self._order + one.count)] if one.count else []
                fields.append((f"{k}", self._order + one.type, (left.pop(0),)) if one.count else (f"{k}", self._order + one.type))
            kind = np.dtype(fields)
            if first[-1] - first[0] == (len(first) - 1) * kind.itemsize:  # without others between them
                values = np.frombuffer(self.data, kind, len(first), first[0])
            else:
                values = np.frombuffer(self.data, np.uint8)[first[:, None] + np.arange(kind.itemsize)].view(kind)[:, 0]
            yield first, [values[f"{k}"] for k in range(len(element.properties))]

    def _starts(self, element: Element) -> dict[tuple[int, ...], np.ndarray]:
        """Return the first bytes of all rows, by the lengths of their lists, and go on to the end of the last one."""
        sizes = [np.dtype(one.type).itemsize for one in element.properties]
        counts = [struct.Struct(self._order + STRUCT_TYPES[one.count]) if one.count else None for one in element.properties]
        end, n = len(self.data), element.n_rows
        if not n or not sizes:
            return {}
        if not any(counts) and n * sum(sizes) <= end - self.at:
            first, self.at = self.at, self.at + n * sum(sizes)
            return {(): np.arange(first, self.at, sum(sizes))}
        found: dict[tuple[int, ...], list[int]] = {}
        for _ in range(n):
            first, lengths = self.at, ()
            for count, size in zip(counts, sizes):
                if count is None:
                    self.at += size
                    continue
                (length,) = count.unpack_from(self.data, self.at) if self.at + count.size <= end else (-1,)
                if not 0 <= length <= end or length != int(length):
                    raise self.error("expected the length of a list in this row", min(self.at, end))
                lengths = (*lengths, int(length))
                self.at += count.size + int(length) * size
            if self.at > end:
                raise self.error("expected a whole row, but the file ends", end)
            found.setdefault(lengths, []).append(first)
        return {lengths: np.array(starts) for lengths, starts in found.items()}
