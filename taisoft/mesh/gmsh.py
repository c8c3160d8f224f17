"""Read Gmsh .msh files, versions 2 (text) and 4.1 (text and binary), and report the place of an error.

Source: the Gmsh reference manual, "File formats". Only $Nodes and $Elements are read; other sections are skipped.
Every count is checked against the file's content before memory is allocated. Weak: text is read as float64, so tags
above 2^53 are refused.
"""

import re

import numpy as np

from taisoft.errors import MeshError

# Gmsh element type -> (name, number of nodes)
ELEMENTS = {
    1: ("line", 2),
    2: ("triangle", 3),
    3: ("quad", 4),
    4: ("tetra", 4),
    5: ("hexahedron", 8),
    6: ("wedge", 6),
    7: ("pyramid", 5),
    8: ("line3", 3),
    9: ("triangle6", 6),
    10: ("quad9", 9),
    11: ("tetra10", 10),
    12: ("hexahedron27", 27),
    13: ("wedge18", 18),
    14: ("pyramid14", 14),
    15: ("vertex", 1),
    16: ("quad8", 8),
    17: ("hexahedron20", 20),
    18: ("wedge15", 15),
    19: ("pyramid13", 13),
    21: ("triangle10", 10),
    26: ("line4", 4),
    29: ("tetra20", 20),
}

_MAX_EXACT_INT = 2.0**53  # float64 holds every integer up to here exactly


_HEAD = re.compile(rb"\s*(?:\$Comments.*?\$EndComments\s*)?\$MeshFormat\s+(\S+)\s+([01])\s+(\d{1,2})[ \t\r]*\n", re.DOTALL)


class _Text:
    """Sequential reader of the numbers in a text section."""

    def __init__(self, name: str, data: bytes, start: int, section: str):
        """start: the first byte after the section's opening line."""
        self.name, self.data, self.start, self.section = name, data, start, section
        end = re.compile(rb"^[ \t]*\$End" + section.encode() + rb"\b", re.MULTILINE).search(data, start)
        if end is None:
            raise _truncated(name, data, section)
        self.end = end.end()
        words = data[start : end.start()].split()
        try:
            self.numbers = np.array(words, dtype=np.float64)
        except ValueError:
            bad = next(i for i, word in enumerate(words) if not _is_number(word))
            raise self.error(bad, f"{words[bad][:40]!r} is not a number") from None
        self.at = 0

    def line(self, index: int) -> int:
        """Return the line of the file, counted from 1, that holds number `index` of the section."""
        line = self.data.count(b"\n", 0, self.start) + 1
        for text in self.data[self.start : self.end].split(b"\n"):
            index -= len(text.split())
            if index < 0:
                break
            line += 1
        return line

    def error(self, index: int, text: str) -> MeshError:
        return MeshError(f"{self.name}: line {self.line(index)} (${self.section}): {text}")

    def floats(self, n: int) -> np.ndarray:
        """Return the next n numbers."""
        left = len(self.numbers) - self.at
        if n > left:
            raise self.error(len(self.numbers) - 1, f"{n} numbers should follow here or before, but only {left} do")
        self.at += n
        return self.numbers[self.at - n : self.at]

    def ints(self, n: int, size: bool = False) -> np.ndarray:
        """Return the next n numbers, which must be integers, and not negative if size is True."""
        values = self.floats(n)
        bad = ~((np.floor(values) == values) & (np.abs(values) <= _MAX_EXACT_INT))
        if size:
            bad |= ~(values >= 0)
        if bad.any():
            k = int(np.argmax(bad))
            kind = "a count or a tag" if size else "a whole number"
            raise self.error(self.at - n + k, f"{values[k]:g} is not {kind}")
        return values.astype(np.int64)

    def close(self) -> int:
        """Return the offset of the byte after the section; all its numbers must have been read."""
        if self.at != len(self.numbers):
            raise self.error(self.at, f"{len(self.numbers) - self.at} numbers are left over")
        return self.end


class _Binary:
    """Sequential reader of the numbers in a binary section, version 4.1."""

    def __init__(self, name: str, data: bytes, start: int, section: str, order: str, size: int):
        """start: the first byte after the section's opening line. order: "<" or ">". size: bytes of a size_t."""
        self.name, self.data, self.at, self.section = name, data, start, section
        kinds = {"int": "i4", "size": f"u{size}", "float": "f8"}
        self.types = {kind: np.dtype(order + code) for kind, code in kinds.items()}

    def error(self, text: str) -> MeshError:
        return MeshError(f"{self.name}: byte {self.at} (${self.section}): {text}")

    def _take(self, n: int, kind: str) -> np.ndarray:
        dtype = self.types[kind]
        left = (len(self.data) - self.at) // dtype.itemsize
        if n > left:
            raise self.error(f"{n} numbers should follow, but the file ends after {left}")
        values = np.frombuffer(self.data, dtype, n, self.at)
        self.at += n * dtype.itemsize
        return values

    def floats(self, n: int) -> np.ndarray:
        return self._take(n, "float").astype(np.float64)

    def ints(self, n: int, size: bool = False) -> np.ndarray:
        values = self._take(n, "size" if size else "int")
        if size and n and values.max() > _MAX_EXACT_INT:
            raise self.error(f"{values.max()} is not a count or a tag")
        return values.astype(np.int64)

    def close(self) -> int:
        end = re.compile(rb"\s*\$End" + self.section.encode() + rb"\b").match(self.data, self.at)
        if end is None:
            raise self.error(f"$End{self.section} should follow")
        return end.end()


def read_gmsh(name: str, data: bytes) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]] | None:
    """Return points (n,3) and element blocks (type name, (k,nodes) indices from 0); None for unsupported versions.

    name: the file's name for messages. data: its content. Raises MeshError.
    """
    found = _HEAD.match(data)
    if found is None:
        raise MeshError(f"{name}: not a supported mesh: a Gmsh file must start with $MeshFormat and its version")
    version, binary, size = found[1].decode("ascii", "replace"), found[2] == b"1", int(found[3])
    major = version.split(".")[0]
    if (version not in ("4", "4.1") and major != "2") or (major == "2" and binary):
        return None
    order = "<"
    if binary:
        order = {b"\x01\0\0\0": "<", b"\0\0\0\x01": ">"}.get(data[found.end() : found.end() + 4], "")
        if not order or size not in (4, 8):
            raise MeshError(f"{name}: line 3 ($MeshFormat): the byte order or the size {size} of a number is not known")
    sections = {}
    at = found.end()
    while opening := re.compile(rb"^[ \t]*\$(?!End)(\w+)[ \t\r]*\n", re.MULTILINE).search(data, at):
        section, at = opening[1].decode("ascii", "replace"), opening.end()
        if section not in ("Nodes", "Elements"):
            end = data.find(b"$End" + opening[1], at)
            if end < 0:
                raise _truncated(name, data, section)
            at = end
            continue
        if section in sections:
            line = data.count(b"\n", 0, at)
            raise MeshError(f"{name}: line {line}: a second ${section} section")
        numbers = _Binary(name, data, at, section, order, size) if binary else _Text(name, data, at, section)
        sections[section] = _READERS[major, section](numbers)
        at = numbers.close()
    for section in ("Nodes", "Elements"):
        if section not in sections:
            raise MeshError(f"{name}: there is no ${section} section")
    tags, points = sections["Nodes"]
    return points, _to_indices(name, tags, sections["Elements"])


def _nodes_4(numbers) -> tuple[np.ndarray, np.ndarray]:
    """Read tags (n,) and points (n,3) of $Nodes, version 4.1: one block per entity, tags first, then coordinates."""
    blocks, total = numbers.ints(4, size=True)[:2]
    tags, points = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
    for _ in range(blocks):
        dim, _, parametric = numbers.ints(3)
        count = int(numbers.ints(1, size=True)[0])
        columns = 3 + (min(max(int(dim), 0), 3) if parametric else 0)  # parametric nodes have dim extra parameters
        tags.append(numbers.ints(count, size=True))
        points.append(numbers.floats(columns * count).reshape(count, columns)[:, :3])
    return _check_total(numbers, total, np.concatenate(tags), "nodes"), np.concatenate(points)


def _elements_4(numbers) -> list[tuple[str, np.ndarray]]:
    """Read type names and node tags (k,nodes) of $Elements, version 4.1."""
    blocks, total = numbers.ints(4, size=True)[:2]
    found = []
    for _ in range(blocks):
        kind, nodes = _kind(numbers, int(numbers.ints(3)[2]))
        count = int(numbers.ints(1, size=True)[0])
        found.append((kind, numbers.ints(count * (1 + nodes), size=True).reshape(count, 1 + nodes)[:, 1:]))
    _check_total(numbers, total, range(sum(len(tags) for _, tags in found)), "elements")
    return found


def _nodes_2(numbers: _Text) -> tuple[np.ndarray, np.ndarray]:
    """Read tags (n,) and points (n,3) of $Nodes, version 2: a count, then rows of tag x y z."""
    count = int(numbers.ints(1, size=True)[0])
    rows = numbers.floats(4 * count).reshape(count, 4)
    bad = ~((np.floor(rows[:, 0]) == rows[:, 0]) & (np.abs(rows[:, 0]) <= _MAX_EXACT_INT))
    if bad.any():
        k = int(np.argmax(bad))
        raise numbers.error(1 + 4 * k, f"{rows[k, 0]:g} is not a node's tag")
    return rows[:, 0].astype(np.int64), rows[:, 1:]


def _elements_2(numbers: _Text) -> list[tuple[str, np.ndarray]]:
    """Read type names and node tags (k,nodes) of $Elements, version 2: a count, then rows of tag, type, labels, nodes."""
    count = int(numbers.ints(1, size=True)[0])
    start = numbers.at
    values = numbers.ints(len(numbers.numbers) - start).tolist()
    found: dict[int, list[int]] = {}
    at = 0
    for _ in range(count):
        if at + 3 > len(values):
            raise numbers.error(start + len(values) - 1, f"the section ends before its {count} elements are complete")
        code, labels = values[at + 1], values[at + 2]
        numbers.at = start + at + 1
        nodes = _kind(numbers, code)[1]
        first, at = at + 3 + labels, at + 3 + labels + nodes
        if labels < 0 or at > len(values):
            raise numbers.error(start + first - labels - 1, "this element is not complete")
        found.setdefault(code, []).extend(values[first:at])
    numbers.at = start + at
    return [(ELEMENTS[c][0], np.array(tags, dtype=np.int64).reshape(-1, ELEMENTS[c][1])) for c, tags in found.items()]


_READERS = {("4", "Nodes"): _nodes_4, ("4", "Elements"): _elements_4, ("2", "Nodes"): _nodes_2, ("2", "Elements"): _elements_2}


def _kind(numbers, code: int) -> tuple[str, int]:
    if code not in ELEMENTS:
        index = (numbers.at - 1,) if isinstance(numbers, _Text) else ()
        raise numbers.error(*index, f"Gmsh's element type {code} is not known here")
    return ELEMENTS[code]


def _check_total(numbers, total: int, items, what: str):
    """Return the items if their number equals the total declared by the section; raise MeshError otherwise."""
    if len(items) != total:
        index = (0,) if isinstance(numbers, _Text) else ()
        raise numbers.error(*index, f"{total} {what} were declared, but the blocks hold {len(items)}")
    return items


def _to_indices(name: str, tags: np.ndarray, blocks: list[tuple[str, np.ndarray]]) -> list[tuple[str, np.ndarray]]:
    """Replace node tags by indices, counted from 0 in file order."""
    order = np.argsort(tags, kind="stable")
    ordered = tags[order]
    repeated = np.flatnonzero(ordered[1:] == ordered[:-1])
    if len(repeated):
        raise MeshError(f"{name}: node {ordered[repeated[0]]} is given twice")
    result = []
    for kind, nodes in blocks:
        if not nodes.size:
            continue
        if not len(tags):
            raise MeshError(f"{name}: the mesh has no vertices")
        at = np.minimum(np.searchsorted(ordered, nodes), len(ordered) - 1)
        unknown = np.argwhere(ordered[at] != nodes)
        if len(unknown):
            e = int(unknown[0, 0])
            label = "tet" if kind in ("tetra", "tetra10") else kind
            raise MeshError(f"{name}: {label} {e}: node {nodes[tuple(unknown[0])]} does not exist ({len(tags)} nodes)")
        result.append((kind, order[at]))
    return result


def _truncated(name: str, data: bytes, section: str) -> MeshError:
    last = data.rstrip().count(b"\n") + 1
    return MeshError(f"{name}: line {last}: the file ends inside ${section}, before $End{section}")


def _is_number(word: bytes) -> bool:
    try:
        np.array([word], dtype=np.float64)
    except ValueError:
        return False
    return True
