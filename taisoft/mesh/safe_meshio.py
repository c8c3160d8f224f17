"""meshio behind a fence.

On a broken file meshio may end the program, print, raise anything, wait for ever, or ask for memory that the file cannot fill;
here that becomes one MeshError.
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

PATIENCE = 100  # times that a reader may ask past the end of a file
PER_BYTE = 16  # numbers that a reader may make room for, for each byte of a file

# Readers that would wait for ever at the end of a broken file, by ending.
_WAITING = {
    ".mdpa": "mdpa", ".ply": "ply", ".dat": "tecplot", ".tec": "tecplot", ".nas": "nastran", ".bdf": "nastran", ".fem": "nastran",
}  # fmt: skip
_OF_TEXT = ("tecplot", "nastran")

_most: ContextVar[float] = ContextVar("most numbers in an array", default=math.inf)


class _Ending(io.BufferedReader):
    """A file that raises where a reader asks again and again past its end; some of meshio's readers would for ever."""

    asked = 0

    def _told(self, found: bytes) -> bytes:
        self.asked = 0 if found else self.asked + 1
        if self.asked > PATIENCE:
            raise EOFError("the file ends too early")
        return found

    def readline(self, size: int | None = -1, /) -> bytes:
        return self._told(super().readline(size))

    def read(self, size: int | None = -1, /) -> bytes:
        return self._told(super().read(size))


class _EndingText(io.TextIOWrapper):
    """The same for text."""

    asked = 0

    def readline(self, size: int = -1, /) -> str:
        line = super().readline(size)
        self.asked = 0 if line else self.asked + 1
        if self.asked > PATIENCE:
            raise EOFError("the file ends too early")
        return line


def _counted(make):
    """As a method of `_CountingNumpy`: a function of NumPy that makes an array of a shape."""

    def method(self, shape, *more, **named):
        self._check(math.prod(np.atleast_1d(shape).tolist()))
        return make(shape, *more, **named)

    return method


class _CountingNumpy:
    """NumPy as meshio sees it: arrays whose size a file announces are refused before room is made for what it cannot fill."""

    def __getattr__(self, name: str):
        return getattr(np, name)

    @staticmethod
    def _check(n: float) -> None:
        if n > _most.get():
            raise MemoryError

    def fromfile(self, file, dtype=float, count=-1, sep="", **more):
        self._check(count)
        return np.fromfile(file, dtype, count, sep, **more)

    def arange(self, *bounds, **more):
        low, high, step = (*bounds, 1)[:3] if len(bounds) > 1 else (0, *bounds, 1)
        self._check((high - low) / step if step else 0)
        return np.arange(*bounds, **more)

    empty, zeros, ones, full = map(_counted, (np.empty, np.zeros, np.ones, np.full))


for _name, _module in list(sys.modules.items()):
    if _name.startswith("meshio.") and getattr(_module, "np", None) is np:
        _module.np = _CountingNumpy()


class _Console(meshio_messages.Console):
    """Where meshio prints: nowhere inside the fence. It takes what a file holds for markup, which may be an error."""

    def print(self, *objects, **options) -> None:
        if _most.get() == math.inf:
            super().print(*objects, **options)


meshio_messages.Console = _Console


def read_safely(file: Path, name: str, data: bytes, kind: str = "mesh") -> meshio.Mesh:
    """What meshio reads from a file. name: the file, for messages; data: its content; kind: "mesh" or "surface".

    Raises MeshError, whatever meshio does.
    """
    printed, bound = io.StringIO(), _most.set(PER_BYTE * len(data) + 4096)
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), np.errstate(all="ignore"):
            with _unmarked(file, data) as plain:
                return _call(plain, file.suffix.lower(), data)
    except ImportError as error:
        raise MeshError(f"{name}: files {file.suffix!r} need the Python package {error.name or error}") from error
    except MemoryError as error:
        raise MeshError(f"{name}: not a supported {kind}: it asks for more memory than it can fill") from error
    except (Exception, SystemExit) as error:
        raise MeshError(f"{name}: not a supported {kind} ({_cause(error, data)})") from error
    finally:
        _most.reset(bound)


@contextlib.contextmanager
def _unmarked(file: Path, data: bytes) -> Iterator[Path]:
    """The file, or where its content is data after a byte-order mark, which only XML readers know, a copy of data."""
    if data.startswith(b"<") or file.stat().st_size == len(data):
        yield file
        return
    with tempfile.TemporaryDirectory(prefix="taisoft-") as folder:
        copy = Path(folder) / file.name
        copy.write_bytes(data)
        yield copy


def _cause(error: BaseException, data: bytes) -> str:
    """What a reader says of a file, in one line, without the file's name, which messages start with."""
    text = str(error) if isinstance(error, meshio.ReadError) else f"{type(error).__name__}: {error}"
    return one_line(_without_content(text, data)) or "its structure is broken"


def _without_content(said: str, data: bytes) -> str:
    """A message without what the file holds: it may be a file that others must not read."""
    content = data.lower()
    plain = re.sub(r"(['\"`]).*?\1", "...", said, flags=re.DOTALL)
    return " ".join("..." if len(word) > 3 and word.lower().encode() in content else word for word in plain.split())


def _call(file: Path, ending: str, data: bytes) -> meshio.Mesh:
    """meshio's mesh; readers that would wait for ever get a file that stops them."""
    file_format = _WAITING.get(ending)
    if ending == ".msh":
        if data.lstrip()[:1] != b"(":
            return _read(file, ["gmsh"])
        file_format = "ansys"
    if file_format is None:
        return _read(file, _filetypes_from_path(file))
    with _Ending(io.FileIO(file)) as stream:
        if file_format in _OF_TEXT:
            with _EndingText(stream, encoding="utf-8") as text:
                return meshio.read(text, file_format=file_format)
        return meshio.read(stream, file_format=file_format)


def _read(file: Path, formats: list[str]) -> meshio.Mesh:
    """The mesh in the first of the formats that fits. Raises what the last reader does.

    As `meshio.read`, which would print the readers' reasons, broken at a terminal's width, and end the program.
    """
    readers = [reader_map[name] for name in formats if name in reader_map]
    if not readers:
        raise meshio.ReadError(f"such files can only be written: {', '.join(formats)}")
    for reader in readers[:-1]:
        with contextlib.suppress(meshio.ReadError):
            return reader(str(file))
    return readers[-1](str(file))
