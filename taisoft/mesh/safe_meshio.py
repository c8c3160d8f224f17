"""Read files by meshio with every failure turned into one MeshError.

On a broken file meshio may end the program, print, raise any exception, loop forever, or allocate far more memory than the
file can fill.
"""

import contextlib
import io
import math
import re
import sys
import tempfile
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

import meshio
import numpy as np
from meshio import _common as meshio_messages
from meshio._helpers import _filetypes_from_path, reader_map

from taisoft.errors import MeshError
from taisoft.mesh.content import one_line

MAX_READS_PAST_END = 100  # allowed reads past the end of a file
MAX_ENTRIES_PER_BYTE = 16  # allowed array entries for each byte of a file

# Readers that loop forever at the end of a broken file, by extension.
_LOOPING_READERS = {
    ".mdpa": "mdpa",
    ".ply": "ply",
    ".dat": "tecplot",
    ".tec": "tecplot",
    ".nas": "nastran",
    ".bdf": "nastran",
    ".fem": "nastran",
}
_TEXT_FORMATS = ("tecplot", "nastran")

_max_entries: ContextVar[float] = ContextVar("largest number of array entries", default=math.inf)


class _BoundedFile(io.BufferedReader):
    """Binary file that raises EOFError after too many reads past its end, where some meshio readers loop forever."""

    empty_reads = 0

    def _check_end(self, found: bytes) -> bytes:
        self.empty_reads = 0 if found else self.empty_reads + 1
        if self.empty_reads > MAX_READS_PAST_END:
            raise EOFError("the file ends too early")
        return found

    def readline(self, size: int | None = -1, /) -> bytes:
        return self._check_end(super().readline(size))

    def read(self, size: int | None = -1, /) -> bytes:
        return self._check_end(super().read(size))


class _BoundedTextFile(io.TextIOWrapper):
    """Text file that raises EOFError after too many reads past its end."""

    empty_reads = 0

    def readline(self, size: int = -1, /) -> str:
        line = super().readline(size)
        self.empty_reads = 0 if line else self.empty_reads + 1
        if self.empty_reads > MAX_READS_PAST_END:
            raise EOFError("the file ends too early")
        return line


def _checked_size(make):
    """Wrap a NumPy function that allocates an array of a given shape as a size-checked method of `_CountingNumpy`."""

    def method(self, shape, *args, **kwargs):
        self._check(math.prod(np.atleast_1d(shape).tolist()))
        return make(shape, *args, **kwargs)

    return method


class _CountingNumpy:
    """Stand-in for NumPy in meshio: refuses arrays too large for the file to fill, before they are allocated."""

    def __getattr__(self, name: str):
        return getattr(np, name)

    @staticmethod
    def _check(n: float) -> None:
        if n > _max_entries.get():
            raise MemoryError

    def fromfile(self, file, dtype=float, count=-1, sep="", **kwargs):
        self._check(count)
        return np.fromfile(file, dtype, count, sep, **kwargs)

    def arange(self, *bounds, **kwargs):
        low, high, step = (*bounds, 1)[:3] if len(bounds) > 1 else (0, *bounds, 1)
        self._check((high - low) / step if step else 0)
        return np.arange(*bounds, **kwargs)

    empty, zeros, ones, full = map(_checked_size, (np.empty, np.zeros, np.ones, np.full))


for _name, _module in list(sys.modules.items()):
    if _name.startswith("meshio.") and getattr(_module, "np", None) is np:
        _module.np = _CountingNumpy()


class _Console(meshio_messages.Console):
    """meshio's console, silent inside `read_safely`: it parses file content as markup, which may fail."""

    def print(self, *objects, **options) -> None:
        if _max_entries.get() == math.inf:
            super().print(*objects, **options)


meshio_messages.Console = _Console


def read_safely(file: Path, name: str, data: bytes, kind: str = "mesh") -> meshio.Mesh:
    """Read a file by meshio. name: the file's name for messages; data: its content; kind: "mesh" or "surface".

    Raises MeshError for every failure of meshio.
    """
    printed, token = io.StringIO(), _max_entries.set(MAX_ENTRIES_PER_BYTE * len(data) + 4096)
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), np.errstate(all="ignore"):
            with _without_bom(file, data) as plain:
                return _call(plain, file.suffix.lower(), data)
    except ImportError as error:
        raise MeshError(f"{name}: files {file.suffix!r} need the Python package {error.name or error}") from error
    except MemoryError as error:
        raise MeshError(f"{name}: not a supported {kind}: it declares more data than it can hold") from error
    except (Exception, SystemExit) as error:
        raise MeshError(f"{name}: not a supported {kind} ({_cause(error, data)})") from error
    finally:
        _max_entries.reset(token)


@contextlib.contextmanager
def _without_bom(file: Path, data: bytes) -> Iterator[Path]:
    """Yield the file, or a copy without its byte-order mark, which only XML readers accept."""
    if data.startswith(b"<") or file.stat().st_size == len(data):
        yield file
        return
    with tempfile.TemporaryDirectory(prefix="taisoft-") as folder:
        copy = Path(folder) / file.name
        copy.write_bytes(data)
        yield copy


def _cause(error: BaseException, data: bytes) -> str:
    """Return a reader's error on one line; the caller puts the file's name in front."""
    text = str(error) if isinstance(error, meshio.ReadError) else f"{type(error).__name__}: {error}"
    return one_line(_without_content(text, data)) or "its structure is broken"


def _without_content(message: str, data: bytes) -> str:
    """Remove file content from a message: the file may be confidential."""
    content = data.lower()
    plain = re.sub(r"(['\"`]).*?\1", "...", message, flags=re.DOTALL)
    return " ".join("..." if len(word) > 3 and word.lower().encode() in content else word for word in plain.split())


def _call(file: Path, ending: str, data: bytes) -> meshio.Mesh:
    """Read by meshio; readers that could loop forever get a file that raises EOFError."""
    file_format = _LOOPING_READERS.get(ending)
    if ending == ".msh":
        if data.lstrip()[:1] != b"(":
            return _read(file, ["gmsh"])
        file_format = "ansys"
    if file_format is None:
        return _read(file, _filetypes_from_path(file))
    with _BoundedFile(io.FileIO(file)) as stream:
        if file_format in _TEXT_FORMATS:
            with _BoundedTextFile(stream, encoding="utf-8") as text:
                return meshio.read(text, file_format=file_format)
        return meshio.read(stream, file_format=file_format)


def _read(file: Path, formats: list[str]) -> meshio.Mesh:
    """Read the mesh in the first format that fits. Raises the error of the last reader.

    Replaces `meshio.read`, which prints the readers' errors, wrapped at the terminal's width, and ends the program.
    """
    readers = [reader_map[name] for name in formats if name in reader_map]
    if not readers:
        raise meshio.ReadError(f"such files can only be written: {', '.join(formats)}")
    for reader in readers[:-1]:
        with contextlib.suppress(meshio.ReadError):
            return reader(str(file))
    return readers[-1](str(file))
