"""Read Gmsh's files of versions 2 (text) and 4.1 (text and binary), with the physical groups of elements.

meshio refuses parametric nodes and big-endian numbers, makes a mesh of some files that are cut off inside a node's number, and
names no line. Here every count is checked against the file's content before memory is allocated, and errors name their line.
Source: the Gmsh reference manual, "File formats".
Weak: text is read as float64, so tags above 2^53 are refused. Of the groups of a volume in several, only the first is used.
"""

import re

import numpy as np
from meshio._common import num_nodes_per_cell
from meshio.gmsh import gmsh_to_meshio_type

from taisoft.errors import MeshError
from taisoft.mesh.safe_reading import MAX_EXACT_INT, Blocks, FileContent

PHYSICAL = "gmsh:physical"  # meshio's name of the elements' physical groups; 0 is none


class _Text:
    """Sequential reader of the numbers in a text section."""

    def __init__(self, name: str, data: bytes, start: int, section: str):
        """start: the first byte after the section's opening line."""
        self.name, self.section, self.at, self.first_line = name, section, 0, data.count(b"\n", 0, start) + 1
        end = re.compile(rb"^[ \t]*\$End%b\b" % section.encode(), re.MULTILINE).search(data, start)
        if end is None:
            raise _truncated(name, data, section)
        self.text, self.end = data[start : end.start()], end.end()
        words = self.text.split()
        try:
            self.numbers = np.array(words, dtype=np.float64)
        except ValueError:
            bad = next(i for i, word in enumerate(words) if not _is_number(word))
            raise self.error(f"{words[bad][:40]!r} is not a number", bad) from None

    def error(self, text: str, index: int | None = None) -> MeshError:
        """Return the error at number `index` of the section, by default the last one read."""
        starts = [0, *(word.start() for word in re.finditer(rb"\S+", self.text))]
        index = self.at - 1 if index is None else index
        line = self.first_line + self.text.count(b"\n", 0, starts[min(max(index + 1, 0), len(starts) - 1)])
        return MeshError(f"{self.name}: line {line} (${self.section}): {text}")

    def floats(self, n: int) -> np.ndarray:
        left = len(self.numbers) - self.at
        if n > left:
            raise self.error(f"{n} numbers should follow here or before, but only {left} do", len(self.numbers) - 1)
        self.at += n
        return self.numbers[self.at - n : self.at]

    def ints(self, n: int, kind: str = "size") -> np.ndarray:
        return self.as_ints(self.floats(n), self.at - n)

    def as_ints(self, values: np.ndarray, first: int, stride: int = 1) -> np.ndarray:
        """Return values as integers; they are the section's numbers first, first + stride, ..."""
        whole = (np.floor(values) == values) & (np.abs(values) <= MAX_EXACT_INT)
        if not whole.all():
            k = int(np.argmin(whole))
            raise self.error(f"{values[k]:g} is not a whole number", first + k * stride)
        return values.astype(np.int64)

    def close(self) -> int:
        """Return the offset of the byte after the section; all its numbers must have been read."""
        if self.at != len(self.numbers):
            raise self.error(f"{len(self.numbers) - self.at} numbers are left over", self.at)
        return self.end


class _Binary:
    """Sequential reader of the numbers in a binary section, version 4.1."""

    def __init__(self, name: str, data: bytes, start: int, section: str, order: str, size: int):
        """order: "<" or ">". size: bytes of a size_t."""
        self.name, self.data, self.at, self.section = name, data, start, section
        self.types = {kind: np.dtype(order + code) for kind, code in (("int", "i4"), ("size", f"u{size}"), ("float", "f8"))}

    def error(self, text: str) -> MeshError:
        return MeshError(f"{self.name}: byte {self.at} (${self.section}): {text}")

    def _read(self, n: int, kind: str) -> np.ndarray:
        dtype = self.types[kind]
        left = (len(self.data) - self.at) // dtype.itemsize
        if n > left:
            raise self.error(f"{n} numbers should follow, but the file ends after {left}")
        values = np.frombuffer(self.data, dtype, n, self.at)
        self.at += n * dtype.itemsize
        return values

    def floats(self, n: int) -> np.ndarray:
        return self._read(n, "float").astype(np.float64)

    def ints(self, n: int, kind: str = "size") -> np.ndarray:
        return self._read(n, kind).astype(np.int64)

    def close(self) -> int:
        end = re.compile(rb"\s*\$End%b\b" % self.section.encode()).match(self.data, self.at)
        if end is None:
            raise self.error(f"$End{self.section} should follow")
        return end.end()


_GMSH_HEAD = re.compile(rb"\s*(?:\$Comments.*?\$EndComments\s*)?\$MeshFormat\s+(\S+)\s+([01])\s+(\d{1,2})[ \t\r]*\n", re.DOTALL)
_NAMES = re.compile(rb"^[ \t]*\$PhysicalNames\b.*?^[ \t]*\$EndPhysicalNames\b[^\n]*\n?", re.MULTILINE | re.DOTALL)
_VOLUME_NAME = re.compile(rb'^[ \t]*3[ \t]+(-?\d{1,10})[ \t]+"([^"\n]*)"', re.MULTILINE)
_OPENING = re.compile(rb"^[ \t]*\$(?!End)(\w+)[ \t\r]*\n", re.MULTILINE)


def read_gmsh(name: str, data: bytes) -> FileContent | None:
    """Return the content of a .msh file, with the physical groups PHYSICAL; None for other versions than 2 (text) and 4.1.

    name: the file's name for messages. data: its content. Raises MeshError.
    """
    found = _GMSH_HEAD.match(data)
    if found is None:
        raise MeshError(f"{name}: not a supported mesh: a Gmsh file must start with $MeshFormat and its version")
    version, binary, size = found[1].decode("ascii", "replace"), found[2] == b"1", int(found[3])
    major = version.split(".")[0]
    if (version not in ("4", "4.1") and major != "2") or (major == "2" and binary):
        return None
    at, order = found.end(), ""
    if binary:
        order = {b"\x01\0\0\0": "<", b"\0\0\0\x01": ">"}.get(data[at : at + 4], "")
        if not order or size not in (4, 8):
            raise MeshError(f"{name}: line 3 ($MeshFormat): the byte order or the size {size} of a number is not known")
    needed = {"Nodes": _nodes_2, "Elements": _elements_2} if major == "2" else {"Nodes": _nodes_4, "Elements": _elements_4}
    readers = needed if major == "2" else needed | {"Entities": _entities_4}
    sections = {}
    while opening := _OPENING.search(data, at):
        section, at = opening[1].decode("ascii", "replace"), opening.end()
        if section not in readers:
            at = data.find(b"$End" + opening[1], at)
            if at < 0:
                raise _truncated(name, data, section)
            continue
        if section in sections:
            line = data.count(b"\n", 0, at)
            raise MeshError(f"{name}: line {line}: a second ${section} section")
        numbers = _Binary(name, data, at, section, order, size) if binary else _Text(name, data, at, section)
        sections[section] = readers[section](numbers)
        at = numbers.close()
    for section in needed:
        if section not in sections:
            raise MeshError(f"{name}: there is no ${section} section")
    tags, points = sections["Nodes"]
    blocks, groups = sections["Elements"]
    if major == "4":  # of an entity, whose elements are one block or several
        physical = sections.get("Entities", {})
        groups = [np.full(len(block[1]), physical.get(entity, 0)) for block, entity in zip(blocks, groups)]
    return FileContent(points, _tags_to_indices(name, tags, blocks), {PHYSICAL: groups}, split_names(data)[0])


def split_names(data: bytes) -> tuple[dict[int, str], bytes]:
    """Return the names of the physical groups of volumes, and the file without them: meshio fails on some of them.

    Bytes that are not UTF-8 become single surrogates.
    """
    found = _NAMES.search(data, 0, max(data.find(b"$Nodes"), 0))
    if found is None:
        return {}, data
    names = {int(tag): text.decode("utf-8", "surrogateescape") for tag, text in _VOLUME_NAME.findall(found[0])}
    return names, data[: found.start()] + data[found.end() :]


def _truncated(name: str, data: bytes, section: str) -> MeshError:
    last = data.rstrip().count(b"\n") + 1
    return MeshError(f"{name}: line {last}: the file ends inside ${section}, before $End{section}")


def _is_number(word: bytes) -> bool:
    try:
        return bool(np.array([word], dtype=np.float64).size)
    except ValueError:
        return False


def _count(numbers) -> int:
    n = int(numbers.ints(1)[0])
    if n < 0:
        raise numbers.error(f"{n} is not a count")
    return n


def _nodes_4(numbers) -> tuple[np.ndarray, np.ndarray]:
    """Read tags (n,) and points (n,3), version 4.1: one block per entity, tags first, then coordinates."""
    n_blocks, total = numbers.ints(4)[:2]
    tags, points = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
    for _ in range(n_blocks):
        dim, _, parametric = numbers.ints(3, "int").tolist()
        n = _count(numbers)
        columns = 3 + (min(max(dim, 0), 3) if parametric else 0)  # parametric nodes have dim extra parameters
        tags.append(numbers.ints(n))
        points.append(numbers.floats(columns * n).reshape(n, columns)[:, :3])
    _check_total(numbers, total, sum(map(len, tags)), "nodes")
    return np.concatenate(tags), np.concatenate(points)


def _entities_4(numbers) -> dict[tuple[int, int], int]:
    """Read the first physical group of each entity that is in one, by (dimension, tag), version 4.1."""
    found = {}
    counts = numbers.ints(4).tolist()
    for dim, n in enumerate(counts):
        for _ in range(n):
            tag = int(numbers.ints(1, "int")[0])
            numbers.floats(6 if dim else 3)  # a point's place, or a bounding box
            groups = numbers.ints(_count(numbers), "int")
            if dim:
                numbers.ints(_count(numbers), "int")  # the entities of its boundary
            if len(groups):
                found[dim, tag] = abs(int(groups[0]))  # negative: of reversed orientation
    return found


def _elements_4(numbers) -> tuple[Blocks, list[tuple[int, int]]]:
    """Read type names and node tags (k,nodes), and the entity (dimension, tag) of each block, version 4.1."""
    n_blocks, total = numbers.ints(4)[:2]
    blocks, entities = [], []
    for _ in range(n_blocks):
        dim, entity, code = numbers.ints(3, "int").tolist()
        kind, n_nodes = _element_type(numbers, code)
        entities.append((dim, entity))
        n = _count(numbers)
        blocks.append((kind, numbers.ints(n * (1 + n_nodes)).reshape(n, 1 + n_nodes)[:, 1:]))
    _check_total(numbers, total, sum(len(tags) for _, tags in blocks), "elements")
    return blocks, entities


def _check_total(numbers, total: int, found: int, what: str) -> None:
    if found != total:
        raise numbers.error(f"{total} {what} were declared, but the blocks hold {found}")


def _element_type(numbers, code: int) -> tuple[str, int]:
    """Return name and number of nodes of a Gmsh element type."""
    if code not in gmsh_to_meshio_type:
        raise numbers.error(f"Gmsh's element type {code} is not known here")
    return gmsh_to_meshio_type[code], num_nodes_per_cell[gmsh_to_meshio_type[code]]


def _nodes_2(numbers: _Text) -> tuple[np.ndarray, np.ndarray]:
    """Read tags (n,) and points (n,3), version 2: a count, then rows of tag x y z."""
    rows = numbers.floats(4 * _count(numbers)).reshape(-1, 4)
    return numbers.as_ints(rows[:, 0], 1, stride=4), rows[:, 1:]


def _elements_2(numbers: _Text) -> tuple[Blocks, list[np.ndarray]]:
    """Read type names and node tags (k,nodes), and the physical group of each element (k,) of each block, version 2.

    A count, then rows of tag, type, number of labels, labels, nodes; the first label is the group.
    """
    n, start = _count(numbers), numbers.at
    values = numbers.ints(len(numbers.numbers) - start).tolist()
    found: dict[tuple[str, int], tuple[list[int], list[int]]] = {}
    at = 0
    for _ in range(n):
        numbers.at = start + at + 2  # the place of an error
        code, n_labels = (values[at + 1 : at + 3] + [0, -1])[:2]
        kind = _element_type(numbers, code) if n_labels >= 0 else ("", 0)
        first = at + 3 + n_labels
        at = first + kind[1]
        if n_labels < 0 or at > len(values):
            raise numbers.error("this element is not complete")
        tags, groups = found.setdefault(kind, ([], []))
        tags.extend(values[first:at])
        groups.append(values[first - n_labels] if n_labels else 0)
    numbers.at = start + at
    blocks = [(name, np.array(tags, dtype=np.int64).reshape(-1, n)) for (name, n), (tags, _) in found.items()]
    return blocks, [np.array(groups, dtype=np.int64) for _, groups in found.values()]


def _tags_to_indices(name: str, tags: np.ndarray, blocks: Blocks) -> Blocks:
    """Replace node tags by indices, counted from 0 in file order."""
    order = np.argsort(tags, kind="stable")
    ordered = tags[order]
    repeated = np.flatnonzero(ordered[1:] == ordered[:-1])
    if len(repeated):
        raise MeshError(f"{name}: node {ordered[repeated[0]]} is given twice")
    result = []
    for kind, nodes in blocks:
        if nodes.size and not len(tags):
            raise MeshError(f"{name}: the mesh has no vertices")
        at = np.minimum(np.searchsorted(ordered, nodes), len(ordered) - 1)
        unknown = np.argwhere(ordered[at] != nodes)
        if len(unknown):
            e, label = unknown[0, 0], "tet" if kind in ("tetra", "tetra10") else kind
            raise MeshError(f"{name}: {label} {e}: node {nodes[tuple(unknown[0])]} does not exist ({len(tags)} nodes)")
        result.append((kind, order[at]))
    return result
