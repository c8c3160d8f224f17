"""Read files that may be broken: their bytes and lines, and any format by meshio in a child process.

On a broken file meshio may end the program, print, raise any exception, loop forever, or allocate far more memory than the file
can fill; the mesher fTetWild prints a lot and may end its process. So both run in a child (`taisoft.processes`), meshio with
bounded time and memory. It imports neither Taichi nor SciPy and starts in about 0.2 s.
"""

import builtins
import contextlib
import io
import re
import tempfile
from codecs import BOM_UTF8
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taisoft.errors import MeshError, one_line
from taisoft.mesh.regions import FIBRES
from taisoft.processes import call, serve

UTF16 = "the file is UTF-16 text; save it as UTF-8"
HEAD = 64  # characters inspected to detect UTF-16 text
SECONDS, SECONDS_PER_BYTE = 15.0, 1e-5  # processor time limit of a reader; the slowest reads 1 MB/s
WALL_FACTOR = 4.0  # times that: its wall time limit, on a machine with other work
MEMORY, MEMORY_PER_BYTE = 2 << 30, 200  # limit of a reader's address space [bytes]; text becomes Python objects
MAX_ENTRIES_PER_BYTE = 16  # of a file, in the arrays read from it: more can only come from counts that it declares
MAX_READS_PAST_END = 100  # allowed reads past the end of a file, where some of meshio's readers loop forever
QUALITY = 10.0  # fTetWild's target upper bound of the tets' AMIPS energy: 3 for a regular tet
MAX_ITERATIONS = 80  # its maximum number of optimisation iterations

_open = open  # the child replaces the built-in one

Blocks = list[tuple[str, np.ndarray]]  # element blocks: meshio's type name, (k,nodes) indices from 0


class FileContent(NamedTuple):
    """What a mesh file holds."""

    points: np.ndarray  # (n,3)
    cells: Blocks
    # by name, the numbers (k,) of each block's elements, or a function that returns them, or none if some elements have none
    cell_data: dict[str, list[np.ndarray] | Callable[[], list[np.ndarray]]] = {}
    region_names: dict[int, str] = {}
    notes: list[str] = []  # what was left out
    fibres: list[np.ndarray] | None = None  # (k,3) of each block's elements, 0 of those without


def read_content(file: Path) -> bytes:
    """Return the file's bytes without a UTF-8 byte-order mark. Raises MeshError if unreadable, blank or UTF-16 (XML excepted)."""
    try:
        if not file.exists():
            raise MeshError(f"{file}: there is no such file")
        if not file.is_file():
            raise MeshError(f"{file}: this is not a file")
        data = file.read_bytes()
    except (OSError, ValueError) as error:
        raise MeshError(f"{str(file)!r}: the file cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if data.startswith(BOM_UTF8) and b"\0" not in data:  # a binary .stl header may start with the same bytes
        data = data[len(BOM_UTF8) :]
    if not data.strip():
        raise MeshError(f"{file}: the file is empty")
    if (head := utf16_head(data)) and not head.startswith("<"):  # XML readers decode UTF-16
        raise MeshError(f"{file}: {UTF16}")
    return data


def utf16_head(data: bytes) -> str:
    """Return the first characters of UTF-16 text, with or without a byte-order mark; "" if data is not UTF-16 text."""
    for codec, mark in (("utf-16-le", b"\xff\xfe"), ("utf-16-be", b"\xfe\xff")):
        text = data.removeprefix(mark)[:HEAD].decode(codec, "ignore").strip()
        if all(c.isprintable() or c.isspace() for c in text) and (data.startswith(mark) or text.isascii()):
            return text
    return ""


def content_lines(name: str, data: bytes) -> list[tuple[int, list[str]]]:
    """Return number and words of each line that is not empty; # begins a comment."""
    text = data.decode("utf-8", "replace").splitlines()
    lines = [(number, words) for number, line in enumerate(text, 1) if (words := line.split("#", 1)[0].split())]
    if not lines:
        raise MeshError(f"{name}: the file is empty")
    return lines


def read_by_meshio(file: Path, data: bytes) -> FileContent:
    """Return what a file holds. data: its bytes. Raises MeshError for every failure of meshio."""
    with tempfile.TemporaryDirectory(prefix="taisoft-") as folder:
        source = file
        if not data.startswith(b"<") and file.stat().st_size != len(data):  # only XML readers accept a byte-order mark
            source = Path(folder, file.name)
            source.write_bytes(data)
        try:
            found = read_in_child("meshio", source)
        except MeshError as error:
            place, text = re.match(r"((?:line|byte) \d+: )?(.*)", str(error)).groups()
            raise MeshError(f"{file}: {place or ''}not a supported mesh ({text})") from None
    cells = [(kind, nodes) for kind, nodes in found["cells"]]
    names = dict(found["region_names"])
    return FileContent(found["points"], cells, found["cell_data"], names, found["notes"], found["fibres"])


def content_of(mesh) -> FileContent:
    """Return what a meshio.Mesh holds, with its cell data that are numbers, and the names of its groups of solids."""
    rows = [
        one.data if isinstance(one.data, np.ndarray) else np.empty((len(one.data), 0), int) for one in mesh.cells
    ]  # polyhedra
    cells = [(one.type, nodes) for one, nodes in zip(mesh.cells, rows)]
    of_cells = {name: list(map(np.asarray, of_blocks)) for name, of_blocks in mesh.cell_data.items()}
    numbers = {name: of for name, of in of_cells.items() if all(one.ndim == 1 and one.dtype.kind in "iuf" for one in of)}
    fields = {name: np.asarray(value) for name, value in mesh.field_data.items()}  # of any kind, such as a time
    pairs = {name: value for name, value in fields.items() if value.shape == (2,) and value.dtype.kind in "iu"}
    names = {int(tag): name for name, (tag, dim) in pairs.items() if dim == 3}
    vectors = [of_cells[name] for name in FIBRES if name in of_cells]
    fibres = next((of for of in vectors if all(one.shape[1:] == (3,) and one.dtype.kind in "iuf" for one in of)), None)
    return FileContent(np.asarray(mesh.points), cells, numbers, names, fibres=fibres)


def read_in_child(task: str, file: Path, **given) -> dict:
    """Return what a task of `TASKS` reads from a file, with bounded time and memory. Raises MeshError."""
    size = file.stat().st_size
    seconds = SECONDS + SECONDS_PER_BYTE * size
    limits = {"memory": MEMORY + MEMORY_PER_BYTE * size, "seconds": int(seconds) + 1}
    return run_child(task, WALL_FACTOR * seconds, path=str(file.absolute()), limits=limits, **given)


def run_child(task: str, seconds: float | None = None, **given) -> dict:
    """Return what a task of `TASKS` returns in a child process. Raises MeshError, also if it takes more than `seconds`."""
    request, environment = {"task": task, "given": given}, {"OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory(prefix="taisoft-") as folder:  # the mesher writes files where it runs
        answer = call(("-P", "-m", __name__), request, seconds, environment=environment, cwd=folder)
    if "answer" not in answer:
        raise MeshError(answer.get("error") or one_line(answer["crash"]))
    return answer["answer"]


def answer(request: dict) -> dict:
    """Carry out a task in the child."""
    try:
        return {"answer": TASKS[request["task"]](**request["given"])}
    except MeshError as error:
        return {"error": str(error)}


def _read_usd(path: str, limits: dict, alone: bool) -> dict:
    from taisoft.mesh.usd_content import read_stage

    _limit_resources(**limits)
    return read_stage(path, alone)


def _fill(vertices: np.ndarray, triangles: np.ndarray, edge_length: float, envelope: float) -> dict[str, np.ndarray]:
    import wildmeshing

    mesher = wildmeshing.Tetrahedralizer(
        stop_quality=QUALITY, max_its=MAX_ITERATIONS, edge_length_r=edge_length, epsilon=envelope
    )
    mesher.set_log_level(6)
    mesher.set_mesh(vertices, triangles.astype(np.int32))
    mesher.tetrahedralize()
    points, tets, _ = mesher.get_tet_mesh()
    return {"vertices": np.asarray(points, dtype=np.float64), "tets": np.asarray(tets, dtype=np.int64)}


def _read(path: str, limits: dict) -> dict:
    """Read a file by meshio. Raises MeshError, which says why without repeating the file: it may be confidential."""
    import meshio

    data = Path(path).read_bytes()
    _limit_resources(**limits)
    builtins.open = _open_bounded
    printed: list[str] = []  # the printer would parse file content as markup, which may fail
    meshio._common.Console.print = lambda _, text, **__: printed.append(re.sub(r"\[/?\w+\]|Warning: ", "", str(text)))
    try:
        with np.errstate(all="ignore"):
            mesh = _first_fitting(path, data)
            content = content_of(mesh)
        arrays = [content.points, *(nodes for _, nodes in content.cells)]
        if any(array.dtype.hasobject for array in arrays):
            raise meshio.ReadError("rows of different lengths")
        of_cells = [np.asarray(one) for of_blocks in mesh.cell_data.values() for one in of_blocks]
        if sum(array.size for array in (*arrays, *of_cells)) > MAX_ENTRIES_PER_BYTE * len(data):
            raise MemoryError
    except ImportError as error:
        raise MeshError(f"its format needs the Python package {error.name or error}") from None
    except MemoryError:
        raise MeshError("it declares more data than it can hold") from None
    except (Exception, SystemExit) as error:
        text = _without_content(str(error), data.lower()) if isinstance(error, (meshio.ReadError, EOFError)) else ""
        text = text if text and "..." not in text else f"the reader of {Path(path).suffix} files stopped here"
        raise MeshError(_place(error, data) + text) from None
    if skipped := next((text for text in printed if "cannot handle" in text), None):
        raise MeshError(f"cells of {skipped[skipped.rfind('(') + 1 :].rstrip(').')} of VTK are not known here")
    notes = [_without_content(text, data.lower()) for text in printed]
    found = {"points": content.points, "cells": content.cells, "cell_data": content.cell_data, "fibres": content.fibres}
    return found | {"region_names": list(content.region_names.items()), "notes": notes}


def _limit_resources(memory: int, seconds: int) -> None:
    with contextlib.suppress(ImportError):  # other systems than Linux lack the module
        import resource

        for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds)):  # the latter ends an orphan too
            hard = resource.getrlimit(kind)[1]
            limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
            with contextlib.suppress(ValueError, OSError):  # or refuse the limit
                resource.setrlimit(kind, (limit, limit))


def _first_fitting(path: str, data: bytes):
    """Return the mesh in the first format that fits. Raises the error of the last reader.

    Replaces `meshio.read`, which prints the readers' errors, wrapped at the terminal's width, and ends the program.
    """
    import meshio
    from meshio._helpers import _filetypes_from_path, reader_map

    formats = _filetypes_from_path(Path(path))
    if path.lower().endswith(".msh"):
        formats = ["ansys" if data.lstrip().startswith(b"(") else "gmsh"]
    readers = [reader_map[name] for name in formats if name in reader_map]
    if not readers:
        raise meshio.ReadError(f"such files can only be written: {', '.join(formats)}")
    for reader in readers[:-1]:
        with contextlib.suppress(meshio.ReadError):
            return reader(path)
    return readers[-1](path)


def _without_content(message: str, content: bytes) -> str:
    """Return a message on one line without quoted text and words of the file's content, given in lower case."""
    plain = re.sub(r"(['\"`]).*?\1", "...", message, flags=re.DOTALL)
    return " ".join("..." if len(word) > 3 and word.lower().encode() in content else word for word in plain.split())


def _place(error: BaseException, data: bytes) -> str:
    """Return the line or byte that was read last, as the beginning of a message; "" if no file was opened."""
    if line := getattr(error, "position", (0,))[0]:  # of XML
        return f"line {line}: "
    if not _BoundedFile.opened:
        return ""
    at = max(file.end if file.closed else file.tell() for file in _BoundedFile.opened)
    lines = _BoundedText.lines or data.count(b"\n", 0, max(at - 1, 0)) + 1
    return f"byte {at}: " if b"\0" in data else f"line {lines}: "


class _BoundedFile(io.BufferedReader):
    """File that raises EOFError after too many reads past its end."""

    _empty_reads = end = 0
    opened: list["_BoundedFile"] = []

    def close(self) -> None:
        self.end = self.end if self.closed else self.tell()
        super().close()

    def _checked(self, found: bytes) -> bytes:
        self._empty_reads = 0 if found else self._empty_reads + 1
        if self._empty_reads > MAX_READS_PAST_END:
            raise EOFError("the file ends too early")
        return found

    def read(self, *size) -> bytes:
        return self._checked(super().read(*size))

    def read1(self, *size) -> bytes:  # called by TextIOWrapper
        return self._checked(super().read1(*size))

    def readline(self, *size) -> bytes:
        return self._checked(super().readline(*size))


class _BoundedText(io.TextIOWrapper):
    """Text that counts the lines read."""

    lines = 0

    def readline(self, *size) -> str:
        _BoundedText.lines += 1
        return super().readline(*size)

    def __next__(self) -> str:
        _BoundedText.lines += 1
        return super().__next__()


def _open_bounded(file, mode: str = "r", buffering: int = -1, encoding: str | None = None, **options) -> io.IOBase:
    if not set(mode) <= set("rbt"):
        return _open(file, mode, buffering, encoding, **options)
    stream = _BoundedFile(io.FileIO(file))
    _BoundedFile.opened.append(stream)
    return stream if "b" in mode else _BoundedText(stream, encoding=encoding or "utf-8", **options)


TASKS = {"meshio": _read, "usd": _read_usd, "fill": _fill}

if __name__ == "__main__":
    serve(answer)
