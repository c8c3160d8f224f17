"""Encodings of mesh, surface and scene files:

* a byte-order mark and Windows line ends give the same mesh, surface and scene, with the same warnings;
* UTF-16 text is refused with advice, except XML, whose readers support it;
* bytes of a binary file that look like a byte-order mark are data.
"""

import warnings
from pathlib import Path

import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.safe_reading import utf16_head
from tests.mesh.test_mesh_files import MESH, write_by_meshio
from tests.scene.toml_scenes import MESH as SCENE

TEXT = {"binary": False}
MESHES = {
    ".msh": {"file_format": "gmsh", **TEXT},
    "2.msh": {"file_format": "gmsh22", **TEXT},
    "ansys.msh": {"file_format": "ansys", **TEXT},
    ".vtk": TEXT,
    "42.vtk": {"file_format": "vtk42", **TEXT},
    ".vtu": TEXT,
    ".mesh": {},
    ".ele": {},
    ".inp": {},
    ".avs": {},
    ".vol": {},
    ".su2": {},
    ".dat": {},
    ".mdpa": {},
    ".f3grid": TEXT,
    ".xml": {},
}
SURFACES = {".obj": {}, ".off": {}, ".stl": TEXT, ".ply": TEXT}
MARK = b"\xef\xbb\xbf"


def outcome(read, path) -> tuple:
    """The arrays or the error message of a reader, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            mesh = read(path)
        except ts.TaisoftError as error:
            result = str(error)
        else:
            result = (mesh.vertices.tolist(), mesh.tets.tolist() if read is ts.read_mesh else mesh.triangles.tolist())
    return result, [str(warning.message) for warning in caught]


def written(folder: Path, ending: str) -> Path:
    """A file as meshio writes it; some formats with surface triangles beside the tets."""
    if ending in SURFACES:
        return write_by_meshio(folder / f"part{ending}", [("triangle", MESH.surface)], **SURFACES[ending])
    both = [("triangle", MESH.surface)] if ending in (".vtk", "2.msh") else []
    return write_by_meshio(folder / f"part{ending}", [*both, ("tetra", MESH.tets)], **MESHES[ending])


@pytest.mark.parametrize("ending", [*MESHES, *SURFACES])
def test_byte_order_marks_and_line_ends_change_nothing(tmp_path, ending):
    path = written(tmp_path, ending)
    read = ts.read_surface if ending in SURFACES else ts.read_mesh
    files = {file: file.read_bytes().replace(b"\r\n", b"\n") for file in tmp_path.iterdir()}  # two files of TetGen
    for file, data in files.items():
        file.write_bytes(data)
    plain = outcome(read, path)
    assert not isinstance(plain[0], str) and len(plain[0][1]) == len(MESH.surface if ending in SURFACES else MESH.tets)
    for mark in (b"", MARK):
        for ends in (b"\r\n", b"\n"):
            for file, data in files.items():
                file.write_bytes(mark + data.replace(b"\n", ends))
            assert outcome(read, path) == plain
    if read is ts.read_surface:
        with pytest.raises(ts.MeshError, match=f"no tetrahedra; {len(MESH.surface)} (triangles|faces) found"):
            ts.read_mesh(path)


def test_a_byte_order_mark_does_not_change_errors(tmp_path):
    broken = {"a.vtk": b"nonsense", "a.msh": b"$MeshFormat\n4.1 0 8\n", "a.obj": b"v 0 0\n", "a.off": b"OFF\n1\n"}
    for name, content in broken.items():
        read = ts.read_surface if name in ("a.obj", "a.off") else ts.read_mesh
        (tmp_path / name).write_bytes(content)
        plain = outcome(read, tmp_path / name)
        (tmp_path / name).write_bytes(MARK + content)
        assert outcome(read, tmp_path / name) == plain and isinstance(plain[0], str)
    (tmp_path / "a.msh").write_bytes(MARK + b"\r\n")
    with pytest.raises(ts.MeshError, match="a.msh: the file is empty"):
        ts.read_mesh(tmp_path / "a.msh")


@pytest.mark.parametrize("codec", ["utf-16", "utf-16-le", "utf-16-be"])
def test_utf16_text_is_refused_with_advice(tmp_path, codec):
    message = "part.*: the file is UTF-16 text; save it as UTF-8$"
    for ending in (".msh", ".vtk", ".mesh", ".obj", ".stl", ".ply", ".off"):
        path = written(tmp_path, ending)
        path.write_bytes(path.read_bytes().decode("latin-1").encode(codec))
        with pytest.raises(ts.MeshError, match=message):
            (ts.read_surface if ending in SURFACES else ts.read_mesh)(path)
    for file in (tmp_path / "part.node", written(tmp_path, ".ele")):
        file.write_text(file.read_text(), encoding=codec)
        with pytest.raises(ts.MeshError, match=message):
            ts.read_mesh(tmp_path / "part.node")
    (tmp_path / "scene.toml").write_text(SCENE.format("a.msh"), encoding=codec)
    with pytest.raises(ts.SceneError, match="scene.toml: the file is UTF-16 text; save it as UTF-8$"):
        ts.read_scene(tmp_path / "scene.toml")


def test_utf16_xml_is_read(tmp_path):
    path = written(tmp_path, ".vtu")
    plain = outcome(ts.read_mesh, path)
    path.write_bytes(path.read_bytes().decode().encode("utf-16"))
    assert outcome(ts.read_mesh, path) == plain


def test_scene_files_may_have_byte_order_marks_and_windows_line_ends(tmp_path):
    text = '[bodies."µ"]\nmaterial = {}\nmesh = { file = "a.msh" }\n'
    ts.write_mesh(tmp_path / "a.msh", MESH)
    for data in (text.encode(), MARK + text.encode(), MARK + text.replace("\n", "\r\n").encode()):
        (tmp_path / "scene.toml").write_bytes(data)
        body = ts.read_scene(tmp_path / "scene.toml")[0].bodies[0]
        assert body.name == "µ" and np.array_equal(body.rest_positions, MESH.vertices)


def test_byte_order_marks_in_binary_data_are_data(tmp_path):
    path = write_by_meshio(tmp_path / "a.stl", [("triangle", MESH.surface)], binary=True)
    plain = outcome(ts.read_surface, path)
    for mark in (MARK, b"\xff\xfe"):
        path.write_bytes(mark + path.read_bytes()[len(mark) :])
        assert outcome(ts.read_surface, path) == plain
    binary = (b"\0\0\0\0\x01\0", b"\xff\xfe\0\0a\0\0\0", MESH.vertices.tobytes(), MESH.tets.tobytes())
    for data in (b"", b"\xff\xfe", b"ab", "plain text of one line, \u00e9 \u4e2d".encode(), *binary):
        assert utf16_head(data) == ""
