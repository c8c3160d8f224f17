"""Random and randomly changed files, for every reader.

Each gives a result or a one-line TaisoftError that names the file and, where it is a mesh's, the line, byte or item, without a
word of Python; within seconds, printing nothing, and allocating at most an amount that is linear in the file's size.
"""

import contextlib
import io
import random
import re
import signal
import tracemalloc
import warnings

import meshio
import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt

import taisoft as ts
from taisoft.checkpoint import read_checkpoint, write_checkpoint
from taisoft.mesh.surface_mesh import FORMATS, read_surface
from tests.mesh.test_formats import EXPECTED, FORMS, vtu
from tests.scene.toml_scenes import TEXT
from tests.view.fake_simulator import beam_scene

MESH = ts.box_mesh((2, 1, 1), (2, 1, 1), pattern="six")
GMSH = {"part.msh": ("gmsh", True), "text.msh": ("gmsh", False), "old.msh": ("gmsh22", False), "ansys.msh": ("ansys", False)}
OTHERS = "vtk vtu mesh meshb xml bdf inp avs node".split()
TEXTS = (b"-1", b"9", b"nan", b"1e400", b" ", b"\n", b"$End", b"99999", b"3000000")
PIECES = (*TEXTS, b"\0", b"\xff\xfe", b"\xff\xff\xff\x7f", b"\0\0\0@")
SIZES = (0, -1, 10**5, 10**6, 10**7, 10**9, 2**31, 2**32 - 1, 2**63, 10**30)
BASE_MEMORY, MEMORY_PER_BYTE = 5_000_000, 400  # bytes that a reader may allocate: for any file, and per byte of the file
SECONDS = 20  # time limit of a reader
QUICK = re.compile(r"surface\.|(text|binary)\.[ps]|(part|text|old)\.msh|part\.(vtu|mesh|inp|bdf|node)$")  # without a child
N_QUICK, N_SMALL = 200, 40  # changed files of each of these, and of those of test_formats.py
PLACE = re.compile(
    r"\b(line|byte|row|node|vertex|vertices|tets?|triangle|edges?) \d|\bno \w+|is empty|the file holds|ten nodes are not|UTF-16"
)
PYTHON = re.compile(r"\w(Error|Exception)\b|\bNone|ndarray|dtype|int\(|literal|codec|out of range|unpack|Traceback|(?<!\S)b'")


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> dict[str, bytes]:
    """A valid file of each kind."""
    folder = tmp_path_factory.mktemp("samples")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        tets, triangles = (meshio.Mesh(MESH.vertices, [cells]) for cells in (("tetra", MESH.tets), ("triangle", MESH.surface)))
        for name, (kind, binary) in GMSH.items():
            meshio.write(folder / name, tets, file_format=kind, binary=binary)
        meshio.write(folder / "text.vtk", tets, binary=False)
        for ending in OTHERS:
            meshio.write(folder / f"part.{ending}", tets)
        for ending in FORMATS:
            meshio.write(folder / f"surface{ending}", triangles)
        meshio.write(folder / "text.ply", triangles, binary=False)
        meshio.write(folder / "binary.stl", triangles, binary=True)
    for ending in (".msh", ".vtu"):
        ts.write_mesh(folder / f"with_fibres{ending}", ts.TetMesh(MESH.vertices, MESH.tets, fibres=np.ones((MESH.n_tets, 3))))
    for ending in ("usda", "usdc"):
        stage = Usd.Stage.CreateNew(str(folder / f"stage.{ending}"))
        prim = UsdGeom.TetMesh.Define(stage, "/tets")
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(MESH.vertices.astype(np.float32)))
        prim.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(MESH.tets.astype(np.int32)))
        stage.Save()
    write_checkpoint(folder / "a.npz", {}, beam_scene(), {}, {"x": np.arange(300.0), "n": 3}, {"fps": 30.0})
    # without cell counts, since changed ones may describe a valid but huge mesh
    (folder / "scene.toml").write_text(TEXT[: TEXT.index("[bodies.beam]")] + "[bodies.beam]\nmesh = { file = 'part.vtk' }\n")
    small = {f"small{k}.{name[2:]}": text.encode() for k, (name, text, _) in enumerate(EXPECTED)}
    small |= {f"small_{form}.vtu": vtu(form) for form in FORMS}
    return small | {path.name: path.read_bytes() for path in folder.iterdir()}


def read(path) -> None:
    """Read a file; a mesh must be valid."""
    if path.suffix == ".toml":
        ts.read_scene(path)
    elif path.suffix == ".npz":
        read_checkpoint(path)
    elif path.suffix in (".usda", ".usdc"):
        ts.read_usd(path)
    elif path.suffix in FORMATS:
        read_surface(path)
    else:
        mesh = ts.read_mesh(path)
        assert (mesh.volumes > 0).all() and np.isfinite(mesh.vertices).all()


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Random bytes, or the data cut, with a bit flipped, a part repeated, one number replaced, or with pieces overwritten."""
    mutation, content = rng.random(), bytearray(data)
    if mutation < 0.1:
        return rng.randbytes(rng.randint(1, 400))
    if mutation < 0.25:
        return data[: rng.randint(0, len(data))]
    first, end = sorted(rng.randint(0, len(data) - 1) for _ in range(2))
    if mutation < 0.3:
        return data[:first] + bytes([data[first] ^ 1 << rng.randint(0, 7)]) + data[first + 1 :]
    if mutation < 0.4:
        return data[:end] + data[first:end] + data[end:]
    if mutation < 0.7:
        numbers = list(re.finditer(rb"\d+", data))
        at = rng.choice(numbers) if numbers else None
        return data[: at.start()] + str(rng.choice(SIZES)).encode() + data[at.end() :] if at else data
    for _ in range(rng.randint(1, 4)):
        at = rng.randint(0, len(content) - 1)
        content[at : at + rng.randint(0, 4)] = rng.choice(PIECES)
    return bytes(content)


def check_outcome(path) -> None:
    try:
        return read(path)
    except ts.TaisoftError as error:
        text = str(error)
    assert str(path.with_suffix("")) in text and "\n" not in text and len(text) < 1200 and not PYTHON.search(text), text
    assert PLACE.search(text) or path.suffix not in (*FORMATS, *(f".{ending}" for ending in OTHERS), ".msh"), text


def check_reader(path, data: bytes) -> None:
    path.write_bytes(data)
    printed = io.StringIO()
    tracemalloc.start()
    signal.alarm(SECONDS)
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            check_outcome(path)
    finally:
        signal.alarm(0)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert printed.getvalue() == ""
    assert peak < BASE_MEMORY + MEMORY_PER_BYTE * len(data), f"{peak} bytes for a file of {len(data)}"


class ReaderTimeoutError(BaseException):
    """A reader takes too long. Not an Exception, so that no reader catches it."""


def time_out(*_):
    raise ReaderTimeoutError(f"a reader took more than {SECONDS} s")


def test_readers_survive_mutated_files(tmp_path, samples):
    """After a failure tmp_path holds the file."""
    rng = random.Random(1)
    before = signal.signal(signal.SIGALRM, time_out)
    (tmp_path / "file.ele").write_bytes(samples["part.ele"])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)  # of NumPy
            for name, data in sorted(samples.items()):
                path = tmp_path / f"file.{name.rsplit('.', 1)[1]}"
                path.write_bytes(data)  # unchanged at first, so that imports and caches do not count as a file's memory
                with contextlib.suppress(ts.TaisoftError):  # meshio cannot read every file that it writes
                    read(path)
                check_reader(path, mutated(data, rng))
                for _ in range(N_SMALL if name.startswith(("small", "with_fibres")) else N_QUICK if QUICK.match(name) else 0):
                    path.write_bytes(mutated(data, rng))
                    check_outcome(path)
    finally:
        signal.signal(signal.SIGALRM, before)
