"""Read Gmsh's files of versions 2 (text), 4.0 and 4.1 (text and binary), with the physical groups of elements.

meshio refuses parametric nodes and big-endian numbers, makes a mesh of some files that are cut off inside a node's number, and
names no line. Here every count is checked against the file's content before memory is allocated, and errors name their line.
Source: the Gmsh reference manual, "File formats".
Weak: text is read as float64, so tags above 2^53 are refused. Of the groups of a volume in several, only the first is used.
"""

import re
from collections.abc import Callable
from functools import partial

import numpy as np
from meshio._common import num_nodes_per_cell
from meshio.gmsh import gmsh_to_meshio_type

from taisoft.errors import MeshError
from taisoft.mesh.regions import FIBRES
from taisoft.mesh.safe_reading import Blocks, FileContent
from taisoft.mesh.words import Words, last_line

PHYSICAL = "gmsh:physical"  # meshio's name of the elements' physical groups; 0 is none


class _Text(Words):
    """Sequential reader of the numbers in a text section."""

    def __init__(self, name: str, data: bytes, start: int, section: str):
        """start: the first byte after the section's opening line."""
        end = re.compile(rb"^[ \t]*\$End%b\b" % section.encode(), re.MULTILINE).search(data, start)
        if end is None:
            raise _truncated(name, data, section)
        super().__init__(name, data[start : end.start()], data.count(b"\n", 0, start) + 1, f"${section}")
        self._after = end.end()

    def rows(self, n: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return tags (n,) and the numbers (n,columns) that follow each."""
        first, values = self.at, self.floats(n * (1 + columns)).reshape(n, 1 + columns)
        return self.as_ints(values[:, 0], first, stride=1 + columns), values[:, 1:]

    def close(self) -> int:
        """Return the offset of the byte after the section; all its numbers must have been read."""
        self.end()
        return self._after


class _Binary:
    """Sequential reader of the numbers in a binary section, version 4."""

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

    def count(self, kind: str = "size") -> int:
        n = int(self.ints(1, kind)[0])
        if n < 0:
            raise self.error("expected a number from 0 to 2^63 - 1")
        return n

    def rows(self, n: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
        self.types["row"] = np.dtype([("tag", self.types["int"]), ("values", self.types["float"], (columns,))])
        values = self._read(n, "row")
        return values["tag"].astype(np.int64), values["values"].astype(np.float64)

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
_FIBRES = re.compile(rb'\s*\d+\s+"(?:%s)"[ \t\r]*\n(?:[ \t]*"[^"\n]*"[ \t\r]*\n)*' % "|".join(FIBRES).encode())
# of such a section: real numbers, then a step, three components, the number of rows, and perhaps the part
_TAGS = re.compile(rb"\s*(?:0|1\s+\S+)\s+(?:3\s+\d+\s+3\s+(\d{1,15})|4\s+\d+\s+3\s+(\d{1,15})\s+\d+)[ \t\r]*\n")
_OPENING = re.compile(rb"^[ \t]*\$(?!End)(\w+)[ \t\r]*\n", re.MULTILINE)


def read_gmsh(name: str, data: bytes) -> FileContent | None:
    """Return the content of a .msh file, with the physical groups PHYSICAL; None for version 2 in binary.

    name: the file's name for messages. data: its content. Raises MeshError.
    """
    found = _GMSH_HEAD.match(data)
    if found is None:
        raise MeshError(f"{name}: line 1: not a supported mesh: expected $MeshFormat, then version, file type and data size")
    version, binary, size = found[1].decode("ascii", "replace"), found[2] == b"1", int(found[3])
    line = data.count(b"\n", 0, found.end())
    major = version.split(".")[0]
    if version not in ("4", "4.0", "4.1") and major != "2":
        raise MeshError(f"{name}: line {line} ($MeshFormat): expected version 2, 4.0 or 4.1, not {version[:40]!r}")
    if major != "4" and binary:
        return None
    at, order = found.end(), ""
    if binary:
        order = {b"\x01\0\0\0": "<", b"\0\0\0\x01": ">"}.get(data[at : at + 4], "")
        if not order or size not in (4, 8):
            rule = "expected numbers of 4 or 8 bytes, then the number 1 in binary"
            raise MeshError(f"{name}: line {line} ($MeshFormat): {rule}")
    readers: dict[str, Callable] = {"Nodes": _nodes_2, "Elements": _elements_2}
    if major == "4":
        parts = partial(_entities_4, parted=True)
        readers = {"Nodes": _nodes_4, "Elements": _elements_4, "Entities": _entities_4, "PartitionedEntities": parts}
        readers = {section: partial(reader, old=version != "4.1") for section, reader in readers.items()}
    sections, fibres, opened = {}, None, partial(_Binary, order=order, size=size) if binary else _Text
    while opening := _OPENING.search(data, at):
        section, at = opening[1].decode("ascii", "replace"), opening.end()
        if section == "ElementData" and (start := _FIBRES.match(data, at)):
            if (found := _TAGS.match(data, start.end())) is None:
                line = data.count(b"\n", 0, start.end()) + 1
                raise MeshError(f"{name}: line {line} (${section}): expected numbers of tags, three components and a count")
            numbers = opened(name, data, found.end(), section)
            fibres, at = numbers.rows(int(found[1] or found[2]), 3), numbers.close()
            continue
        if section not in readers:
            line, at = data.count(b"\n", 0, at), data.find(b"$End" + opening[1], at)
            if at < 0:
                raise MeshError(f"{name}: line {line}: expected the end of this section, not the file's")
            continue
        if section in sections:
            line = data.count(b"\n", 0, at)
            raise MeshError(f"{name}: line {line}: expected only one ${section} section")
        numbers = opened(name, data, at, section)
        sections[section] = readers[section](numbers)
        at = numbers.close()
    for section in ("Nodes", "Elements"):
        if section not in sections:
            raise MeshError(f"{name}: line {last_line(data)}: expected a ${section} section before the file's end")
    tags, points = sections["Nodes"]
    blocks, groups, tags_of = sections["Elements"]
    if major == "4":  # of an entity, whose elements are one block or several
        of_wholes, (of_parts, wholes) = (sections.get(key, ({}, {})) for key in ("Entities", "PartitionedEntities"))
        of_wholes = of_wholes[0]  # Gmsh may add groups of its own to parts
        physical = of_wholes | of_parts | {part: of_wholes[whole] for part, whole in wholes.items() if whole in of_wholes}
        groups = [np.full(len(block[1]), physical.get(entity, 0)) for block, entity in zip(blocks, groups)]
    by_block = None if fibres is None else [_of_elements(own, *fibres) for own in tags_of]
    return FileContent(points, _tags_to_indices(name, tags, blocks), {PHYSICAL: groups}, split_names(data)[0], fibres=by_block)


def _of_elements(tags: np.ndarray, given: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (k,3) of elements with these tags (k,), 0 where none are given. given: tags (n,) of values (n,3)."""
    found, order = np.zeros((len(tags), 3)), np.argsort(given)
    if len(given):
        at = order[np.minimum(np.searchsorted(given[order], tags), len(given) - 1)]
        found[given[at] == tags] = values[at[given[at] == tags]]
    return found


def element_data(name: str, values: np.ndarray) -> bytes:
    """Return the section of a file that holds vectors (m,3) of elements with the tags 1 to m, as text."""
    rows = "".join(f"{k} {x!r} {y!r} {z!r}\n" for k, (x, y, z) in enumerate(values.tolist(), 1))
    return f'$ElementData\n1\n"{name}"\n1\n0.0\n3\n0\n3\n{len(values)}\n{rows}$EndElementData\n'.encode()


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
    return MeshError(f"{name}: line {last_line(data)}: the file ends inside ${section}, before $End{section}")


def _nodes_4(numbers, old: bool) -> tuple[np.ndarray, np.ndarray]:
    """Read tags (n,) and points (n,3): one block per entity. old: version 4.0, whose rows hold a tag and its coordinates."""
    n_blocks, total = numbers.ints(2 if old else 4)[:2]
    tags, points = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
    for _ in range(n_blocks):
        dim, parametric = numbers.ints(3, "int")[[1, 2] if old else [0, 2]].tolist()
        n = numbers.count()
        columns = 3 + (min(max(dim, 0), 3) if parametric else 0)  # parametric nodes have dim extra parameters
        own, rows = numbers.rows(n, columns) if old else (numbers.ints(n), numbers.floats(columns * n).reshape(n, columns))
        tags.append(own)
        points.append(rows[:, :3])
    _check_total(numbers, total, sum(map(len, tags)), "nodes")
    return np.concatenate(tags), np.concatenate(points)


def _entities_4(numbers, old: bool, parted: bool = False) -> tuple[dict, dict]:
    """Read the first physical group of each entity that is in one, and of each part the whole, by (dimension, tag).

    old: version 4.0. parted: whether the entities are parts.
    """
    found, wholes, size = {}, {}, "int" if old else "size"
    if parted:
        numbers.ints(1, size)  # the number of parts
        numbers.ints(2 * numbers.count(size), "int")  # ghost entities
    counts = numbers.ints(4).tolist()
    for dim, n in enumerate(counts):
        for _ in range(n):
            tag = int(numbers.ints(1, "int")[0])
            if parted:
                wholes[dim, tag] = tuple(numbers.ints(2, "int").tolist())
                numbers.ints(numbers.count(size), "int")  # numbers of the parts
            numbers.floats(6 if dim or old else 3)  # a point's place, or a bounding box
            groups = numbers.ints(numbers.count(), "int")
            if dim:
                numbers.ints(numbers.count(), "int")  # the entities of its boundary
            if len(groups):
                found[dim, tag] = abs(int(groups[0]))  # negative: of reversed orientation
    return found, wholes


def _elements_4(numbers, old: bool) -> tuple[Blocks, list[tuple[int, int]], list[np.ndarray]]:
    """Read type names and node tags (k,nodes), the entity (dimension, tag) and the elements' tags of each block.

    old: version 4.0.
    """
    n_blocks, total = numbers.ints(2 if old else 4)[:2]
    blocks, entities, tags = [], [], []
    for _ in range(n_blocks):
        dim, entity, code = numbers.ints(3, "int")[[1, 0, 2] if old else [0, 1, 2]].tolist()
        kind, n_nodes = _element_type(numbers, code)
        entities.append((dim, entity))
        n = numbers.count()
        rows = numbers.ints(n * (1 + n_nodes), "int" if old else "size").reshape(n, 1 + n_nodes)
        blocks.append((kind, rows[:, 1:]))
        tags.append(rows[:, 0])
    _check_total(numbers, total, sum(len(tags) for _, tags in blocks), "elements")
    return blocks, entities, tags


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
    return numbers.rows(numbers.count(), 3)


def _elements_2(numbers: _Text) -> tuple[Blocks, list[np.ndarray], list[np.ndarray]]:
    """Read type names and node tags (k,nodes), and physical groups and tags (k,) of the elements of each block, version 2.

    A count, then rows of tag, type, number of labels, labels, nodes; the first label is the group.
    """
    n, start = numbers.count(), numbers.at
    values = numbers.ints(numbers.left()).tolist()
    found: dict[tuple[str, int], tuple[list[int], list[int], list[int]]] = {}
    at = 0
    for _ in range(n):
        numbers.at = start + at + 2  # the place of an error
        code, n_labels = (values[at + 1 : at + 3] + [0, -1])[:2]
        kind = _element_type(numbers, code) if n_labels >= 0 else ("", 0)
        begin, first = at, at + 3 + n_labels
        at = first + kind[1]
        if n_labels < 0 or at > len(values):
            raise numbers.error("this element is not complete")
        nodes, groups, tags = found.setdefault(kind, ([], [], []))
        nodes.extend(values[first:at])
        tags.append(values[begin])
        groups.append(values[first - n_labels] if n_labels else 0)
    numbers.at = start + at
    blocks = [(name, np.array(nodes, dtype=np.int64).reshape(-1, n)) for (name, n), (nodes, _, _) in found.items()]
    return blocks, *([np.array(own[k], dtype=np.int64) for own in found.values()] for k in (1, 2))


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
