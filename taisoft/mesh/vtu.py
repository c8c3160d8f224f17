"""Read .vtu files, VTK's XML files of unstructured grids: all pieces, numbers in any of the format's encodings.

Of several pieces meshio keeps the cells of the last; it drops cells of types that it does not know, and refuses versions above 1.
Here data of cells are decoded when they are asked for. Cells that `vtkGhostType` marks belong to another piece and are left out.
Sources: VTK documentation, "VTK XML formats"; vtkCellType.h, whose numbers meshio holds.
Weak: LZ4 needs a package that is not part of Python, and is refused.
"""

import base64
import binascii
import lzma
import re
import zlib
from functools import partial
from typing import NamedTuple
from xml.parsers import expat

import numpy as np
from meshio._common import num_nodes_per_cell
from meshio._vtk_common import vtk_to_meshio_type

from taisoft.errors import MeshError
from taisoft.mesh.regions import FIBRES
from taisoft.mesh.safe_reading import MAX_ENTRIES_PER_BYTE, Blocks, FileContent
from taisoft.mesh.words import Words

_TYPES = {f"{kind}Int{8 * n}": f"{kind[:1].lower() or 'i'}{n}" for kind in ("", "U") for n in (1, 2, 4, 8)}
_TYPES |= {"Float32": "f4", "Float64": "f8"}
_ORDERS = {"LittleEndian": "<", "BigEndian": ">"}
_DECOMPRESSORS = {"vtkZLibDataCompressor": zlib.decompressobj, "vtkLZMADataCompressor": lzma.LZMADecompressor}
_GHOSTS = "vtkGhostType"
_APPENDED = re.compile(rb"<AppendedData\b[^>]*>\s*_")


class _Array(NamedTuple):
    """A DataArray. line: of its text."""

    line: int
    attributes: dict[str, str]
    text: list[str]


class _Piece(NamedTuple):
    line: int
    attributes: dict[str, str]
    arrays: dict[str, dict[str, _Array]]  # by section and name


def read_vtu(name: str, data: bytes) -> FileContent:
    """Return points, cells and data of cells of all pieces. name: the file's, for messages. Raises MeshError."""
    return _Reader(name, data).content()


class _Reader:
    """The tree of one file, as far as it is needed, and the decoding of its numbers."""

    def __init__(self, name: str, data: bytes):
        self.name, self._size, self._pieces, self._root = name, len(data), [], {}
        self._section, self._array, self._tags = "", None, []
        encoding = "utf-8" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else None
        data = data.decode("utf-16", "replace").encode() if encoding else data
        appended = _APPENDED.search(data)
        self._appended, self._first = b"", 0
        if appended:  # raw bytes are no XML
            end = max(data.rfind(b"</AppendedData"), appended.end())
            self._appended, self._first = data[appended.end() : end], appended.end()
            data = data[: appended.end()] + data[end:]
        self._raw = bool(appended) and b"base64" not in appended[0]
        self._parser = parser = expat.ParserCreate(encoding)
        parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = self._start, self._end, self._text
        parser.StartDoctypeDeclHandler = self._refuse_declaration
        try:
            parser.Parse(data, True)
        except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two for unknown encodings
            reason = expat.ErrorString(error.code) if isinstance(error, expat.ExpatError) else "unknown encoding"
            raise self._error(f"not a supported mesh: expected XML ({reason})", parser.ErrorLineNumber) from None

    def _error(self, text: str, line: int | None = None) -> MeshError:
        return MeshError(f"{self.name}: line {self._parser.CurrentLineNumber if line is None else line}: {text}")

    def _refuse_declaration(self, *_) -> None:
        raise self._error("expected no document type declaration")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._tags.append(tag)
        if not self._root:
            if tag != "VTKFile" or attributes.get("type") != "UnstructuredGrid":
                raise self._error('not a supported mesh: expected <VTKFile type="UnstructuredGrid">')
            self._root = attributes
            self._order = self._chosen(_ORDERS, attributes.get("byte_order", "LittleEndian"), "byte_order")
            self._header = np.dtype(self._order + self._chosen(_TYPES, attributes.get("header_type", "UInt32"), "header_type"))
            compressor = attributes.get("compressor")
            self._decompressor = self._chosen(_DECOMPRESSORS, compressor, "compressor") if compressor else None
        elif tag == "Piece":
            self._pieces.append(_Piece(self._parser.CurrentLineNumber, attributes, {}))
        elif tag in ("Points", "Cells", "CellData", "PointData", "FieldData"):
            self._section = tag
        elif tag == "DataArray" and self._pieces and self._section in ("Points", "Cells", "CellData"):
            self._array = _Array(self._parser.CurrentLineNumber, attributes, [])
            key = "" if self._section == "Points" else attributes.get("Name", "")
            self._pieces[-1].arrays.setdefault(self._section, {})[key] = self._array

    def _end(self, tag: str) -> None:
        self._array = None if self._tags.pop() == "DataArray" else self._array

    def _text(self, text: str) -> None:
        if self._array is not None and self._tags[-1] == "DataArray":  # not InformationKey in it
            self._array.text.append(text)

    def _chosen(self, table: dict, key: str, what: str, line: int | None = None):
        if key not in table:
            raise self._error(f"expected {what} {', '.join(table)}, not {key[:40]!r}", line)
        return table[key]

    def content(self) -> FileContent:
        points, blocks, total, n_ghosts = [np.empty((0, 3))], Blocks(), 0, 0
        pieces: list[tuple[_Piece, np.ndarray, np.ndarray]] = []  # with cells: the first of each block, which are kept
        for piece in self._pieces:
            n_points, n_cells = (self._count(piece, what) for what in ("NumberOfPoints", "NumberOfCells"))
            if n_cells == 0:
                continue
            points.append(self._numbers(piece, "Points", "", 3 * n_points).reshape(-1, 3))
            offsets, types = (self._numbers(piece, "Cells", what, n_cells).astype(np.int64) for what in ("offsets", "types"))
            cells = piece.arrays["Cells"]
            sizes = np.diff(offsets, prepend=0)
            if (sizes < 0).any():
                raise self._error("expected offsets that do not decrease", cells["offsets"].line)
            nodes = self._numbers(piece, "Cells", "connectivity", int(offsets[-1])).astype(np.int64)
            bad = np.flatnonzero((nodes < 0) | (nodes >= n_points))
            if len(bad):
                cell = np.searchsorted(offsets, bad[0], "right")
                text = f"cell {cell}: node {nodes[bad[0]]} does not exist ({n_points} points)"
                raise self._error(text, cells["connectivity"].line)
            first = np.flatnonzero(np.diff(types, prepend=-1))
            has_ghosts = _GHOSTS in piece.arrays.get("CellData", {})
            kept = self._numbers(piece, "CellData", _GHOSTS, n_cells) == 0 if has_ghosts else np.ones(n_cells, dtype=bool)
            for begin, end in zip(first.tolist(), [*first[1:].tolist(), n_cells]):
                kind, own = self._block(cells["types"].line, types[begin], sizes[begin:end], begin, nodes, offsets, total)
                blocks.append((kind, own[kept[begin:end]]))
            pieces.append((piece, first, kept))
            total, n_ghosts = total + n_points, n_ghosts + n_cells - int(kept.sum())
        keys = {key: None for piece, _, _ in pieces for key in piece.arrays.get("CellData", {}) if _components(piece, key) == 1}
        notes = [f"{n_ghosts} cells that {_GHOSTS} marks are left out"] if n_ghosts else []
        by_name = {key: partial(self._of_cells, key, pieces) for key in keys if key != _GHOSTS}
        vectors = [key for key in FIBRES if pieces and all(_components(piece, key) == 3 for piece, _, _ in pieces)]
        fibres = self._of_cells(vectors[0], pieces) if vectors else None
        return FileContent(np.concatenate(points), blocks, by_name, notes=notes, fibres=fibres)

    def _of_cells(self, key: str, pieces: list[tuple[_Piece, np.ndarray, np.ndarray]]) -> list[np.ndarray]:
        """Return data of cells by blocks; none if pieces lack them."""
        width = _components(pieces[0][0], key)
        if not all(_components(piece, key) == width for piece, _, _ in pieces):
            return []
        found = []
        for piece, first, kept in pieces:
            values = self._numbers(piece, "CellData", key, width * len(kept))
            values = values if width == 1 else values.reshape(-1, width)
            found += [one[own] for one, own in zip(np.split(values, first[1:]), np.split(kept, first[1:]))]
        return found

    def _block(self, line, code, sizes, begin, nodes, offsets, shift) -> tuple[str, np.ndarray]:
        """Return the cells from number `begin` on, all of the same type. shift: added to the numbers of nodes."""
        kind = vtk_to_meshio_type.get(int(code), f"VTK type {code}")
        expected = num_nodes_per_cell.get(kind)
        if expected is None:  # refused later, by its name
            return kind, np.empty((len(sizes), 0), dtype=np.int64)
        bad = np.flatnonzero(sizes != expected)
        if len(bad):
            raise self._error(f"cell {begin + bad[0]} of type {code}: expected {expected} nodes, not {sizes[bad[0]]}", line)
        end = offsets[begin + len(sizes) - 1]
        return kind, shift + nodes[end - expected * len(sizes) : end].reshape(-1, expected)

    def _count(self, piece: _Piece, what: str) -> int:
        text = piece.attributes.get(what, "")
        if not re.fullmatch(r"\s*\d{1,15}\s*", text, re.ASCII):
            raise self._error(f"expected {what} of the piece, a whole number, not {text[:40]!r}", piece.line)
        return int(text)

    def _numbers(self, piece: _Piece, section: str, key: str, n: int) -> np.ndarray:
        """Return the n numbers of an array of a piece."""
        array = piece.arrays.get(section, {}).get(key)
        if array is None:
            raise self._error(f"expected a DataArray {key or section} in this piece", piece.line)
        kind = np.dtype(self._order + self._chosen(_TYPES, array.attributes.get("type", ""), "type", array.line))
        if n > MAX_ENTRIES_PER_BYTE * self._size:
            raise self._error(f"it declares more data than it can hold: {n} numbers of {key or section}", array.line)
        encoding = array.attributes.get("format", "ascii")
        if encoding == "ascii":
            words = Words(self.name, "".join(array.text).encode(), array.line)
            found = words.floats(words.left())
            found = words.as_ints(found, 0) if kind.kind in "iu" else found
        elif encoding == "binary":
            text = "".join("".join(array.text).split()).encode()
            found = self._decoded(_Stream(text, True, lambda text: self._error(text, array.line)), kind, n)
        else:
            offset = array.attributes.get("offset", "").strip()
            if encoding != "appended" or not re.fullmatch(r"\d{1,15}", offset, re.ASCII):
                raise self._error("expected format ascii, binary, or appended and an offset", array.line)
            place = f"{self.name}: byte {self._first + int(offset)} ({key or section})"
            stream = _Stream(self._appended[int(offset) :], not self._raw, lambda text: MeshError(f"{place}: {text}"))
            found = self._decoded(stream, kind, n)
        if len(found) != n:
            raise self._error(f"expected {n} numbers of {key or section}, not {len(found)}", array.line)
        return found

    def _decoded(self, stream: "_Stream", kind: np.dtype, n: int) -> np.ndarray:
        """Return an array that begins with its length, or with the lengths of its compressed blocks. n: numbers expected."""
        first = int(np.frombuffer(stream.peek(self._header.itemsize), self._header)[0])
        if self._decompressor is None:
            data = stream.after(self._header.itemsize, first)
        elif first == 0:
            data = b""
        else:
            if first > self._size:
                raise stream.error(f"expected a number of blocks, not {first}")
            head = stream.read((3 + first) * self._header.itemsize)
            _, size, _, *lengths = np.frombuffer(head, self._header).tolist()
            parts, left = [], n * kind.itemsize + 1
            for k, block in enumerate(stream.split(lengths)):
                try:
                    parts.append(self._decompressor().decompress(block, max(min(size, left), 1)))
                    left -= len(parts[-1])
                except (zlib.error, lzma.LZMAError, EOFError, OverflowError):
                    raise stream.error(f"expected compressed data in block {k}") from None
            data = b"".join(parts)
        if len(data) % kind.itemsize:
            raise stream.error(f"expected numbers of {kind.itemsize} bytes, not {len(data)} bytes")
        return np.frombuffer(data, kind)


def _components(piece: _Piece, key: str) -> int:
    """Return how many numbers the data of a piece's cells have each; 0 if there are none, or no numbers."""
    array = piece.arrays.get("CellData", {}).get(key)
    attributes = array.attributes if array else {}
    width = attributes.get("NumberOfComponents") or "1"
    return int(width) if attributes.get("type") in _TYPES and width in ("1", "3") else 0


class _Stream:
    """Bytes, or text that codes them in base64, read from their beginning on."""

    def __init__(self, data: bytes, coded: bool, error):
        self._data, self._coded, self._at, self.error = data, coded, 0, error

    def peek(self, n: int) -> bytes:
        """Return the next n bytes and stay before them."""
        at = self._at
        found, self._at = self.read(n), at
        return found

    def read(self, n: int) -> bytes:
        size = -(-n // 3) * 4 if self._coded else n
        found = self._data[self._at : self._at + size]
        if len(found) == size and self._coded:
            try:
                found = base64.b64decode(found, validate=True)
            except (binascii.Error, ValueError):
                raise self.error("expected base64 text") from None
        if len(found) < n:
            raise self.error(f"expected {n} bytes here, but the data end")
        self._at += size
        return found[:n]

    def after(self, header: int, n: int) -> bytes:
        """Return n bytes after a header, which is coded in base64 on its own or together with them."""
        size = -(-header // 3) * 4
        if self._coded and self._data[size - 1 : size] != b"=":
            return self.read(header + n)[header:]
        self.read(header)
        return self.read(n)

    def split(self, lengths: list[int]) -> list[bytes]:
        data, ends = self.read(sum(lengths)), np.cumsum(lengths).tolist()
        return [data[end - length : end] for end, length in zip(ends, lengths)]
