"""Broken and unsupported mesh files give one MeshError, which:

* starts with the file's exact name, however long, and ends with the reader's cause, without the file's content;
* names the line or byte and the count of Gmsh's and TetGen's files, whatever is cut off; no part of a mesh is read;
* comes quickly, even if the file declares absurd counts or more data than it can hold.
"""

import os
import re
import threading

import meshio
import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import MeshError
from taisoft.mesh.files import read_mesh
from tests.mesh.test_mesh_files import GMSH2, MARK, MESH, TEXT, same, write_by_meshio

TETS = [("tetra", MESH.tets)]
OFF = "OFF 3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 2\n"
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1/1 3/2 2/3\n"


def refusal(read, path) -> str:
    """The message of the error, without the file's name at its start."""
    with pytest.raises(MeshError) as caught:
        read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and "\n" not in text and text.count(str(path)) == 1
    return text.removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    "name, content, message",
    [
        ("absent.msh", None, "there is no such file"),
        ("a.msh", b"\n \n", "the file is empty"),
        ("a.msh", MARK + b"\r\n", "the file is empty"),
        ("a.txt", b"hello", "not a supported mesh: the ending '.txt' is not known"),
        ("a.obj", OBJ.encode(), "no tetrahedra; 2 triangles found; make a volume mesh first"),
        ("a.off", OFF.encode(), "no tetrahedra; 2 faces found"),
    ],
)
def test_files_without_a_mesh_are_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert refusal(read_mesh, tmp_path / name).startswith(message)


def test_surfaces_and_other_things_in_place_of_a_mesh(tmp_path):
    triangles, n = [("triangle", MESH.surface)], len(MESH.surface)
    for name, options in (("a.stl", TEXT), ("b.stl", {"binary": True}), ("a.ply", {"binary": True}), ("a.msh", GMSH2)):
        path = write_by_meshio(tmp_path / name, triangles, **options)
        assert re.match(f"no tetrahedra; {n} (triangles|faces) found; make a volume mesh", refusal(read_mesh, path))
    for path, message in ((tmp_path, "this is not a file"), (tmp_path / "\0.msh", "."), (3, "must be a file's name")):
        with pytest.raises(MeshError, match=message):
            read_mesh(path)


@pytest.mark.parametrize(
    "name, message",
    [
        ("a b.vtk", "not a supported mesh (Illegal VTK header)"),
        (":smile: [red]a[/blue].vtu", "not a supported mesh (its structure is broken)"),
        ("a.svg", "not a supported mesh (such files can only be written: svg)"),
    ],
)
def test_messages_give_the_exact_name_and_one_cause(tmp_path, monkeypatch, name, message):
    """In a narrow terminal, with a folder name longer than its line; brackets are markup of a library."""
    monkeypatch.setenv("COLUMNS", "20")
    path = tmp_path / ("a folder with a [bold]long[/bold] name " * 5) / name
    path.parent.mkdir(parents=True)
    path.write_text("passphrase\nof three lines\n\n")
    assert refusal(read_mesh, path) == message
    if name == "a b.vtk":
        scene = path.with_name("scene.toml")
        scene.write_text("[bodies.a]\nmaterial = {}\nmesh = { file = 'a b.vtk' }\n")
        with pytest.raises(MeshError) as caught:
            ts.read_scene(scene)
        assert str(caught.value) == f"{scene}: bodies.a.mesh: {path}: {message}"


def test_markup_in_the_output_of_a_reader_is_no_error(tmp_path, capfd):
    path = write_by_meshio(tmp_path / "part.su2", TETS)
    path.write_text(path.read_text() + "[/red] :smile:\n")
    capfd.readouterr()
    assert same(read_mesh(path)) and capfd.readouterr() == ("", "")


def test_inverted_tets_are_refused_or_fixed(tmp_path):
    tets = MESH.tets.copy()
    tets[3] = tets[3, [1, 0, 2, 3]]
    path = write_by_meshio(tmp_path / "part.msh", [("tetra", tets)], **GMSH2)
    assert refusal(read_mesh, path).startswith("1 of 10 tets are inverted, the first is tet 3")
    with pytest.warns(UserWarning, match="flipped: 3"):
        assert read_mesh(path, fix_orientation=True).flipped.tolist() == [3]


# --- Gmsh and TetGen --------------------------------------------------------------------------------------------------


def test_errors_of_gmsh_files_give_the_line_and_the_node(tmp_path):
    path = tmp_path / "part.msh"
    ts.write_mesh(path, MESH)
    lines = path.read_text().splitlines(keepends=True)
    inside, first, nodes = lines.index("$Elements\n") + 5, lines.index("$Elements\n") + 3, lines.index("$Nodes\n") + 3
    number, *corners = lines[first + 2].split()
    for changed, message in (
        (lines[:inside], rf"line {inside}: the file ends inside \$Elements, before \$EndElements"),
        (lines[: inside - 1] + lines[inside:], r"line \d+ \(\$Elements\): 50 numbers should follow"),
        ([*lines[:inside], "11 1 x 3 4\n", *lines[inside + 1 :]], rf"line {inside + 1} \(\$Elements\): b'x' is not a number"),
        ([*lines[: inside - 4], "7 7 ", *lines[inside - 4 :]], r"line \d+ \(\$Elements\): 42 numbers should follow"),
        ([*lines[: first + 2], f"{number} 99 {' '.join(corners[1:])}\n", *lines[first + 3 :]], r"tet 2: node 99 .* \(12 nodes\)"),
        ([*lines[:nodes], lines[nodes + 1], *lines[nodes + 1 :]], "node 2 is given twice"),
        ([*lines[:-1], "7\n", lines[-1]], r"line \d+ \(\$Elements\): 1 numbers are left over"),
    ):
        path.write_text("".join(changed))
        assert re.match(message, refusal(read_mesh, path))


@pytest.mark.parametrize("version, binary", [("gmsh", False), ("gmsh", True), ("gmsh22", False)])
def test_cut_or_random_gmsh_files_never_give_a_partial_mesh(tmp_path, version, binary):
    path, rng = write_by_meshio(tmp_path / "part.msh", TETS, file_format=version, binary=binary), np.random.default_rng(4)
    data = path.read_bytes().rstrip()
    for length in range(40, len(data) - 1, max(1, len(data) // 100)):  # shorter ones are for meshio
        path.write_bytes(data[:length])
        refusal(read_mesh, path)
    if binary:
        for _ in range(30):
            path.write_bytes(data[: data.index(b"$Nodes") + 7] + rng.bytes(rng.integers(1, 400)))
            refusal(read_mesh, path)


def test_tetgen_files_count_from_one_and_must_be_consistent(tmp_path):
    node, ele = tmp_path / "t.node", tmp_path / "t.ele"
    node.write_text("# comment\n4 3 1 0 # head\n\n1 0 0 0 9\n2 1 0 0 9\n3 0 1 0 9 # third\n4 0 0 1 9\n")
    ele.write_text("1 4 0\n1 1 2 3 4\n")
    assert read_mesh(node).tets.tolist() == [[0, 1, 2, 3]]
    for text, message in (
        ("1 4 0\n1 1 2 3\n", "line 2: expected 5 numbers"),
        ("2 4 0\n1 1 2 3 4\n", "line 2: 2 tets were declared, but the file ends after 1"),
        ("1 5 0\n1 1 2 3 4 5\n", "tets must have 4 or 10 nodes, not 5"),
    ):
        ele.write_text(text)
        assert refusal(read_mesh, ele).startswith(message)
    ele.unlink()
    with pytest.raises(MeshError, match="t.ele: there is no such file; TetGen's files come in pairs"):
        read_mesh(node)


def test_a_pipe_in_place_of_tetgens_other_file_is_refused(tmp_path):
    """Nothing writes to the pipe, so that opening it would block."""
    pipe = tmp_path / "t.ele"
    os.mkfifo(pipe)
    (tmp_path / "t.node").write_text("4 3\n0 0 0 0\n1 1 0 0\n2 0 1 0\n3 0 0 1\n")
    unblock = threading.Timer(5.0, lambda: os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)))
    unblock.start()
    try:
        with pytest.raises(MeshError, match="t.ele: this is not a file; TetGen's files come in pairs"):
            read_mesh(tmp_path / "t.node")
    finally:
        unblock.cancel()


# --- limits -----------------------------------------------------------------------------------------------------------


def processor_seconds() -> float:
    """Processor time of this process and of the readers that have ended [s]: independent of other work on the machine."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@pytest.mark.parametrize("ending, count", [(".msh", 10**15), (".ele", 10**30), (".vtk", 10**9), (".mesh", 10**15)])
def test_absurd_counts_are_refused_quickly(tmp_path, ending, count):
    options = {"file_format": "gmsh", "binary": False} if ending == ".msh" else {}
    path = write_by_meshio(tmp_path / f"part{ending}", TETS, **options)
    data = path.read_bytes()
    assert re.search(rb"\b1[02]\b", data)  # 12 vertices, 10 tets
    path.write_bytes(re.sub(rb"\b1[02]\b", str(count).encode(), data, count=2))
    start = processor_seconds()
    refusal(read_mesh, path)
    assert processor_seconds() - start < 5.0


def test_more_data_than_the_file_can_hold(tmp_path):
    """A small compressed file that would fill the memory of its reader."""
    path = tmp_path / "zeros.vtu"
    meshio.write(path, meshio.Mesh(np.zeros((500_000, 3)), [("tetra", np.array([[0, 1, 2, 3]]))]), compression="zlib")
    assert path.stat().st_size < 1e5
    assert "it declares more data than it can hold" in refusal(read_mesh, path)
