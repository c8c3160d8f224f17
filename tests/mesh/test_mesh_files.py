"""Reading and writing of meshes (test_fuzz.py: random and mutated files):

* written meshes are read back bitwise; a failed write leaves no file;
* Gmsh's versions, TetGen's pairs and meshio's formats give the same mesh;
* a truncated, inconsistent, empty or unsupported file gives a MeshError that starts with its name and gives the line if known;
* other elements are refused by name and number; boundary elements and unused vertices cause warnings; welding merges vertices.
"""

import contextlib
import io
import os
import re
import threading
from pathlib import Path

import meshio
import numpy as np
import pytest

from taisoft.errors import MeshError, OutputError
from taisoft.mesh.files import WRITERS, read_mesh, write_mesh
from taisoft.mesh.shapes import ball_mesh, box_mesh
from taisoft.mesh.tet_mesh import TetMesh

MESH = box_mesh((2, 1, 1), (0.3, 0.1, 1.0 / 3.0), center=(0.1, 0.2, 0.3))

# endings that need no further packages
FORMATS = ".msh .vtk .vtu .mesh .meshb .inp .avs .xml .vol .su2 .dat .mdpa .f3grid .post .ele".split()


def write_by_meshio(path: Path, cells, points=MESH.vertices, **options) -> Path:
    """A file written by meshio. cells: list of (type, (k,nodes) indices)."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        meshio.write(path, meshio.Mesh(points, cells), **options)
    return path


def gmsh_text(tmp_path: Path, mesh: TetMesh = MESH) -> tuple[Path, str]:
    """A valid text file, and its content."""
    path = tmp_path / "part.msh"
    write_mesh(path, mesh)
    return path, path.read_text()


def same(mesh: TetMesh) -> bool:
    return np.array_equal(mesh.vertices, MESH.vertices) and np.array_equal(mesh.tets, MESH.tets)


@pytest.mark.parametrize("ending", sorted(WRITERS))
def test_written_meshes_are_read_back_bitwise(tmp_path, ending):
    path = tmp_path / f"part{ending}"
    write_mesh(path, ball_mesh(1.0, 2))  # replaced below
    write_mesh(str(path), MESH)
    mesh = read_mesh(path)
    assert same(mesh) and mesh.warnings == [] and mesh.source == str(path)
    assert os.listdir(tmp_path) == [path.name]


def test_a_failed_write_leaves_no_file(tmp_path, monkeypatch):
    with pytest.raises(OutputError, match="cannot write .*absent/part.msh: No such file"):
        write_mesh(tmp_path / "absent" / "part.msh", MESH)

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(meshio, "write", full)
    with pytest.raises(OutputError, match="No space left on device"):
        write_mesh(tmp_path / "part.msh", MESH)
    assert os.listdir(tmp_path) == []


def test_writing_refuses_unknown_endings_and_objects(tmp_path):
    with pytest.raises(MeshError, match="can be written as .msh, .vtk, .vtu, .mesh, not with the ending '.stl'"):
        write_mesh(tmp_path / "part.stl", MESH)
    with pytest.raises(MeshError, match="needs a TetMesh, not tuple"):
        write_mesh(tmp_path / "part.msh", (MESH.vertices, MESH.tets))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("ending", sorted(FORMATS))
def test_formats_give_the_same_mesh(tmp_path, ending, capfd):
    options = {"file_format": "gmsh"} if ending == ".msh" else {}
    path = write_by_meshio(tmp_path / f"part{ending}", [("tetra", MESH.tets)], **options)
    capfd.readouterr()
    assert same(read_mesh(path))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("version", ["gmsh22", "gmsh", "ansys"])
@pytest.mark.parametrize("binary", [False, True])
def test_msh_versions_give_the_same_mesh(tmp_path, version, binary):
    path = write_by_meshio(tmp_path / "part.msh", [("tetra", MESH.tets)], file_format=version, binary=binary)
    assert same(read_mesh(path))


def test_gmsh_blocks_parametric_nodes_and_sparse_tags(tmp_path):
    path = tmp_path / "part.msh"
    path.write_text(
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Comments\nanything 1 2\n$EndComments\n"
        "$Entities\n0 0 0 1\n1 0 0 0 1 1 1 0 0\n$EndEntities\n"
        "$Nodes\n2 4 7 90\n2 1 1 2\n7\n90\n0 0 0 0.1 0.2\n1 0 0 0.3 0.4\n3 1 0 2\n8\n20\n0 1 0\n0 0 1\n$EndNodes\n"
        "$Elements\n2 2 1 2\n2 1 2 1\n1 7 90 8\n3 1 4 1\n2 7 90 8 20\n$EndElements\n"
    )
    with pytest.warns(UserWarning, match="1 triangle next to the tets are not used"):
        mesh = read_mesh(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]] and mesh.tets.tolist() == [[0, 1, 2, 3]]


def test_big_endian_binary(tmp_path):
    path = write_by_meshio(tmp_path / "part.msh", [("tetra", MESH.tets)], file_format="gmsh", binary=True)
    head = b"$MeshFormat\n4.1 1 8\n" + (1).to_bytes(4, "big") + b"\n$EndMeshFormat\n"
    n, m = MESH.n_verts, MESH.n_tets
    nodes = [np.array([1, n, 1, n], ">u8"), np.array([3, 1, 0], ">i4"), np.array([n], ">u8"), np.arange(1, n + 1).astype(">u8")]
    nodes.append(MESH.vertices.astype(">f8"))
    rows = np.column_stack([np.arange(m), MESH.tets + 1]).astype(">u8")
    cells = [np.array([1, m, 1, m], ">u8"), np.array([3, 1, 4], ">i4"), np.array([m], ">u8"), rows]
    text = head + b"$Nodes\n" + b"".join(a.tobytes() for a in nodes) + b"\n$EndNodes\n"
    path.write_bytes(text + b"$Elements\n" + b"".join(a.tobytes() for a in cells) + b"\n$EndElements\n")
    assert same(read_mesh(path))


def test_tetgen_files_count_from_one_and_must_be_consistent(tmp_path):
    (tmp_path / "t.node").write_text("# comment\n4 3 1 0 # head\n\n1 0 0 0 9\n2 1 0 0 9\n3 0 1 0 9 # third\n4 0 0 1 9\n")
    (tmp_path / "t.ele").write_text("1 4 0\n1 1 2 3 4\n")
    assert read_mesh(tmp_path / "t.node").tets.tolist() == [[0, 1, 2, 3]]
    (tmp_path / "t.ele").write_text("1 4 0\n1 1 2 3\n")
    with pytest.raises(MeshError, match="t.ele: line 2: expected 5 numbers"):
        read_mesh(tmp_path / "t.ele")
    (tmp_path / "t.ele").write_text("2 4 0\n1 1 2 3 4\n")
    with pytest.raises(MeshError, match="t.ele: line 2: 2 tets were declared, but the file ends after 1"):
        read_mesh(tmp_path / "t.node")
    (tmp_path / "t.ele").unlink()
    with pytest.raises(MeshError, match="t.ele: there is no such file; TetGen's files come in pairs"):
        read_mesh(tmp_path / "t.node")


@pytest.mark.parametrize("ending, other", [(".node", ".ele"), (".ele", ".node")])
def test_a_pipe_in_place_of_tetgens_other_file_is_refused(tmp_path, ending, other):
    """Nothing writes to the pipe, so that opening it would block."""
    pipe = tmp_path / f"t{other}"
    os.mkfifo(pipe)
    (tmp_path / f"t{ending}").write_text("4 3\n0 0 0 0\n1 1 0 0\n2 0 1 0\n3 0 0 1\n" if ending == ".node" else "1 4\n0 0 1 2 3\n")
    unblock = threading.Timer(5.0, lambda: os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)))
    unblock.start()
    try:
        with pytest.raises(MeshError, match=f"t{other}: this is not a file; TetGen's files come in pairs"):
            read_mesh(tmp_path / f"t{ending}")
    finally:
        unblock.cancel()


# invalid files


def test_surfaces_without_tets_are_refused_with_their_triangle_count(tmp_path):
    """Text formats of surfaces: test_mesh_content.py."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1/1 3/2 2/3\n")
    with pytest.raises(MeshError, match="a.obj: no tetrahedra; 2 triangles found; make a volume mesh first"):
        read_mesh(tmp_path / "a.obj")
    for ending in (".stl", ".ply", ".vtk", ".vtu", ".mesh", ".inp"):
        options = {"binary": True} if ending in (".stl", ".ply") else {}
        path = write_by_meshio(tmp_path / f"a{ending}", [("triangle", MESH.surface)], **options)
        with pytest.raises(MeshError, match=f"no tetrahedra; {len(MESH.surface)} (triangles|faces) found; make a volume mesh"):
            read_mesh(path)


@pytest.mark.parametrize(
    "kind, nodes, named", [("quad", 4, "2 quads"), ("hexahedron", 8, "2 hexahedra"), ("pyramid", 5, "2 pyramid elements")]
)
@pytest.mark.parametrize("ending", [".vtk", ".msh"])
def test_other_elements_are_refused_by_name_and_number(tmp_path, kind, nodes, named, ending):
    cells = [(kind, np.arange(2 * nodes).reshape(2, nodes) % 12), ("tetra", MESH.tets)]
    options = {"file_format": "gmsh22", "binary": False} if ending == ".msh" else {}
    path = write_by_meshio(tmp_path / f"part{ending}", cells, **options)
    with pytest.raises(MeshError, match=f"only tetrahedra with four or ten nodes can be used, but the file holds {named}$"):
        read_mesh(path)


def test_boundary_elements_and_unused_vertices_cause_warnings(tmp_path):
    points = np.vstack([[(9.0, 9, 9)], MESH.vertices, [(8.0, 8, 8)]])
    cells = [("line", [[1, 2], [2, 3]]), ("triangle", MESH.surface + 1), ("tetra", MESH.tets + 1)]
    path = write_by_meshio(tmp_path / "part.vtk", cells, points)
    with pytest.warns(UserWarning):
        mesh = read_mesh(path)
    assert same(mesh)
    assert mesh.warnings == [
        "2 lines, 20 triangles next to the tets are not used",
        "2 vertices of no tet are left out, the first is vertex 0 of the file",
    ]


def test_welding_merges_close_vertices(tmp_path):
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six")
    gap = 1e-4
    points = np.vstack([box.vertices, box.vertices + (1.0 + gap, 0, 0)])
    path = write_by_meshio(tmp_path / "part.vtk", [("tetra", np.vstack([box.tets, box.tets + 8]))], points)
    assert read_mesh(path).n_components == 2
    mesh = read_mesh(path, weld=gap / 2)
    assert mesh.n_components == 2 and mesh.warnings == []
    with pytest.warns(UserWarning, match="4 vertices were welded"):
        mesh = read_mesh(path, weld=2 * gap)
    assert mesh.n_components == 1 and mesh.n_verts == 12 and len(mesh.surface) == 20
    for weld in (1.5, -1.0, np.nan, "1e-3", True):
        with pytest.raises(MeshError, match="part.vtk: weld"):
            read_mesh(path, weld=weld)


def test_inverted_tets_are_refused_or_fixed(tmp_path):
    tets = MESH.tets.copy()
    tets[3] = tets[3, [1, 0, 2, 3]]
    path = write_by_meshio(tmp_path / "part.vtk", [("tetra", tets)])
    with pytest.raises(MeshError, match=r"part.vtk: 1 of 10 tets are inverted, the first is tet 3"):
        read_mesh(path)
    with pytest.warns(UserWarning, match="flipped: 3"):
        assert read_mesh(path, fix_orientation=True).flipped.tolist() == [3]


def test_errors_of_the_mesh_name_the_file(tmp_path):
    points = MESH.vertices.copy()
    points[7, 2] = np.nan
    path = write_by_meshio(tmp_path / "part.vtk", [("tetra", MESH.tets)], points)
    with pytest.raises(MeshError, match=rf"^{re.escape(str(path))}: vertex 7 coordinate 2 is not finite"):
        read_mesh(path)
    path = write_by_meshio(tmp_path / "part.vtk", [("tetra", MESH.tets + 1)])
    with pytest.raises(MeshError, match="vertex 12 does not exist .* count from 1"):
        read_mesh(path)


def test_files_that_cannot_be_read(tmp_path):
    for path, message in (
        (tmp_path / "absent.msh", "there is no such file"),
        (tmp_path, "this is not a file"),
        (tmp_path / "\0.msh", "."),
        (3, "must be a file's name"),
    ):
        with pytest.raises(MeshError, match=message):
            read_mesh(path)
    for content in (b"", b"\n \n"):
        (tmp_path / "empty.msh").write_bytes(content)
        with pytest.raises(MeshError, match="empty.msh: the file is empty"):
            read_mesh(tmp_path / "empty.msh")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(MeshError, match="notes.txt: not a supported mesh: the ending '.txt' is not known"):
        read_mesh(tmp_path / "notes.txt")


def test_errors_of_gmsh_files_give_the_line(tmp_path):
    path, text = gmsh_text(tmp_path)
    lines = text.splitlines(keepends=True)
    inside = lines.index("$Elements\n") + 5
    path.write_text("".join(lines[:inside]))
    with pytest.raises(MeshError, match=rf"part.msh: line {inside}: the file ends inside \$Elements, before \$EndElements"):
        read_mesh(path)
    path.write_text("".join(lines[: inside - 1] + lines[inside:]))  # without one element
    with pytest.raises(MeshError, match=r"part.msh: line \d+ \(\$Elements\): 50 numbers should follow"):
        read_mesh(path)
    path.write_text("".join(lines[:inside] + ["11 1 x 3 4\n"] + lines[inside + 1 :]))
    with pytest.raises(MeshError, match=rf"line {inside + 1} \(\$Elements\): b'x' is not a number"):
        read_mesh(path)
    path.write_text(text.replace("$Elements\n", "$Elements\n7 7 "))
    with pytest.raises(MeshError, match=r"line \d+ \(\$Elements\)"):
        read_mesh(path)


def test_missing_or_repeated_gmsh_nodes_are_refused(tmp_path):
    path, text = gmsh_text(tmp_path)
    lines = text.splitlines(keepends=True)
    first = lines.index("$Elements\n") + 3
    number, *corners = lines[first + 2].split()
    path.write_text("".join([*lines[: first + 2], f"{number} 99 {' '.join(corners[1:])}\n", *lines[first + 3 :]]))
    with pytest.raises(MeshError, match=r"part.msh: tet 2: node 99 does not exist \(12 nodes\)"):
        read_mesh(path)
    nodes = lines.index("$Nodes\n") + 3
    path.write_text("".join([*lines[:nodes], *lines[nodes + 1 : nodes + 2], *lines[nodes + 1 :]]))
    with pytest.raises(MeshError, match="part.msh: node 2 is given twice"):
        read_mesh(path)


def processor_seconds() -> float:
    """Processor time of this process and of the readers that have ended [s]: independent of other work on the machine."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@pytest.mark.parametrize("count", [10**9, 10**15, 10**30])
@pytest.mark.parametrize("ending", [".msh", ".vtk", ".mesh", ".vol", ".su2", ".xml", ".ele", ".dat"])
def test_absurd_counts_are_refused_quickly(tmp_path, ending, count):
    options = {"file_format": "gmsh", "binary": False} if ending == ".msh" else {}
    path = write_by_meshio(tmp_path / f"part{ending}", [("tetra", MESH.tets)], **options)
    data = path.read_bytes()
    assert re.search(rb"\b1[02]\b", data)  # 12 vertices, 10 tets
    path.write_bytes(re.sub(rb"\b1[02]\b", str(count).encode(), data, count=2))
    start = processor_seconds()
    with pytest.raises(MeshError, match="^" + re.escape(str(path))):
        read_mesh(path)
    assert processor_seconds() - start < 5.0


@pytest.mark.parametrize("head", [b"", b"$MeshFormat\n4.1 1 8\n\1\0\0\0\n$EndMeshFormat\n$Nodes\n"])
def test_random_bytes_are_refused(tmp_path, head):
    path, rng = tmp_path / "mesh.msh", np.random.default_rng(4)
    for _ in range(50):
        path.write_bytes(head + rng.bytes(rng.integers(1, 400)))
        with pytest.raises(MeshError):
            read_mesh(path)


@pytest.mark.parametrize("version, binary", [("gmsh", False), ("gmsh", True), ("gmsh22", False)])
def test_truncated_gmsh_files_never_give_a_partial_mesh(tmp_path, version, binary):
    path = write_by_meshio(tmp_path / "part.msh", [("tetra", MESH.tets)], file_format=version, binary=binary)
    data = path.read_bytes().rstrip()
    for length in range(0, len(data) - 1, max(1, len(data) // 150)):
        path.write_bytes(data[:length])
        with pytest.raises(MeshError):
            read_mesh(path)


@pytest.mark.parametrize(
    "name, counts",
    [("bar-2523.msh", (886, 2523)), ("bunny.msh", (4670, 19379)), ("sphere1K.msh", (1760, 6851)), ("mat20x20.msh", (800, 2166))],
)
def test_meshes_from_other_programs(shared, name, counts):
    mesh = read_mesh(shared / "meshes" / name)
    assert (mesh.n_verts, mesh.n_tets) == counts and mesh.n_components == 1 and mesh.warnings == []
    x = mesh.vertices[mesh.surface]
    enclosed = np.einsum("ij,ij->", x[:, 0], np.cross(x[:, 1], x[:, 2])) / 6.0
    assert enclosed == pytest.approx(mesh.volumes.sum())
