"""Reading and writing of mesh files (random and mutated ones: faults/test_fuzz.py): written meshes are read back bitwise; every
format and encoding gives the same mesh; second-order tets with straight edges give their corners; welding merges
vertices. Broken files give one MeshError, which starts with the name and gives the line or node of Gmsh's and TetGen's files.
"""

import contextlib
import io
import os
import re
from pathlib import Path

import meshio
import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import MeshError, OutputError
from taisoft.mesh.files import WRITERS, read_mesh, write_mesh
from taisoft.mesh.nodes import make_nodes
from taisoft.mesh.shapes import ball_mesh, box_mesh
from taisoft.mesh.tet_mesh import TetMesh

MESH = box_mesh((2, 1, 1), (0.3, 0.1, 1.0 / 3.0), center=(0.1, 0.2, 0.3))
MARK = b"\xef\xbb\xbf"
TEXT = {"binary": False}
GMSH2 = {"file_format": "gmsh22", **TEXT}  # read without a child process
FORMATS = {  # ending, and options of meshio's writer
    "gmsh 4": (".msh", {"file_format": "gmsh", **TEXT}),
    "gmsh 4 binary": (".msh", {"file_format": "gmsh", "binary": True}),
    "ansys": (".msh", {"file_format": "ansys", **TEXT}),
    "vtk": (".vtk", TEXT),
    "tetgen": (".ele", {}),
    "obj": (".obj", {}),
    "stl": (".stl", TEXT),
}


def write_by_meshio(path: Path, cells, points=MESH.vertices, **options) -> Path:
    """A file written by meshio. cells: list of (type, (k,nodes) indices)."""
    cell_data = options.pop("cell_data", None)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        meshio.write(path, meshio.Mesh(points, cells, cell_data=cell_data), **options)
    return path


def same(mesh: TetMesh, rounding: float = 0.0) -> bool:
    """rounding: of the coordinates in the file [m]."""
    return np.abs(mesh.vertices - MESH.vertices).max() <= rounding and np.array_equal(mesh.tets, MESH.tets)


@pytest.mark.parametrize("ending", sorted(WRITERS))
def test_written_meshes_are_read_back_bitwise(tmp_path, ending):
    path = tmp_path / f"part{ending}"
    write_mesh(path, ball_mesh(1.0, 2))  # replaced below
    write_mesh(str(path), MESH)
    mesh = read_mesh(path)
    assert same(mesh) and mesh.warnings == () and mesh.source == str(path) and mesh.regions is None
    assert os.listdir(tmp_path) == [path.name]


def test_a_failed_write_leaves_no_file(tmp_path, monkeypatch):
    with pytest.raises(MeshError, match="can be written as .msh, .vtk, .vtu, .mesh, not with the ending '.stl'"):
        write_mesh(tmp_path / "part.stl", MESH)
    with pytest.raises(MeshError, match="mesh must be a TetMesh, not tuple"):
        write_mesh(tmp_path / "part.msh", (MESH.vertices, MESH.tets))
    with pytest.raises(OutputError, match="cannot write .*absent/part.msh: No such file"):
        write_mesh(tmp_path / "absent" / "part.msh", MESH)

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(meshio, "write", full)
    with pytest.raises(OutputError, match="No space left on device"):
        write_mesh(tmp_path / "part.msh", MESH)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("ending, options", FORMATS.values())
def test_every_format_with_a_byte_order_mark_and_windows_line_ends(tmp_path, capfd, ending, options):
    """Binary files are left as they are."""
    surface = ending in (".obj", ".stl")
    cells = [("triangle", MESH.surface) if surface else ("tetra", MESH.tets)]
    path = write_by_meshio(tmp_path / f"part{ending}", cells, **options)
    for file in tmp_path.iterdir():  # TetGen's are two
        data = file.read_bytes()
        if b"\0" not in data:
            file.write_bytes(MARK + data.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"))
    capfd.readouterr()
    if surface:
        mesh = ts.read_surface(path)
        assert len(mesh.triangles) == len(MESH.surface) and mesh.volume == pytest.approx(MESH.volumes.sum(), rel=1e-6)
    else:
        mesh = read_mesh(path)
        assert same(mesh) and mesh.warnings == ()
    assert capfd.readouterr() == ("", "")


def test_utf16_text_is_refused_with_advice_except_xml(tmp_path):
    cells = [("triangle", MESH.surface), ("tetra", MESH.tets)]
    for codec in ("utf-16", "utf-16-le", "utf-16-be"):
        for name, own, options in (("part.msh", cells[1:], GMSH2), ("part.vtk", cells[1:], TEXT), ("part.obj", cells[:1], {})):
            path = write_by_meshio(tmp_path / name, own, **options)
            path.write_bytes(path.read_bytes().decode("latin-1").encode(codec))
            with pytest.raises(MeshError, match=f"{name}: the file is UTF-16 text; save it as UTF-8$"):
                (ts.read_surface if name == "part.obj" else read_mesh)(path)
    path = write_by_meshio(tmp_path / "part.vtu", cells[1:], **TEXT)
    path.write_bytes(path.read_bytes().decode().encode("utf-16"))
    assert same(read_mesh(path), 1e-12)


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


def test_other_elements_are_refused_by_name_and_number(tmp_path):
    for kind, nodes, named in (("quad", 4, "2 quads"), ("pyramid", 5, "2 pyramid elements")):
        cells = [(kind, np.arange(2 * nodes).reshape(2, nodes) % 12), ("tetra", MESH.tets)]
        path = write_by_meshio(tmp_path / "part.msh", cells, **GMSH2)
        refusal = f"only tetrahedra with four or ten nodes can be used, but the file holds {named}$"
        for read, given in ((read_mesh, path), (TetMesh.from_meshio, meshio.Mesh(MESH.vertices, cells))):
            with pytest.raises(MeshError, match=refusal):
                read(given)
    with pytest.raises(MeshError, match="^from_meshio: mesh of meshio must be a Mesh, not str$"):
        TetMesh.from_meshio("part.msh")


def test_welding_merges_close_vertices(tmp_path):
    box, gap = box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six"), 1e-4
    points = np.vstack([box.vertices, box.vertices + (1.0 + gap, 0, 0)])
    path = write_by_meshio(tmp_path / "part.msh", [("tetra", np.vstack([box.tets, box.tets + 8]))], points, **GMSH2)
    assert read_mesh(path).n_components == 2
    mesh = read_mesh(path, weld=gap / 2)
    assert mesh.n_components == 2 and mesh.warnings == ()
    with pytest.warns(UserWarning, match="4 vertices were welded"):
        mesh = read_mesh(path, weld=2 * gap)
    assert mesh.n_components == 1 and mesh.n_verts == 12 and len(mesh.surface) == 20
    for weld in (1.5, -1.0, np.nan, "1e-3", True):
        with pytest.raises(MeshError, match="part.msh: weld"):
            read_mesh(path, weld=weld)


def test_meshes_from_other_programs_give_no_warning(shared):
    counts = {"bar-2523": (886, 2523), "bunny": (4670, 19379), "sphere1K": (1760, 6851), "mat20x20": (800, 2166)}
    for name, expected in counts.items():
        mesh = read_mesh(shared / "meshes" / f"{name}.msh")
        assert (mesh.n_verts, mesh.n_tets) == expected and mesh.n_components == 1 and mesh.warnings == ()


NODES = make_nodes(MESH, 2)
CELLS = NODES.elements[:, [0, 1, 2, 3, 4, 7, 5, 6, 8, 9]]  # VTK's order of the edges: 01, 12, 02, 03, 13, 23


def write_quadratic(path: Path, points=NODES.positions, cells=CELLS, others=(), **options) -> Path:
    """A file, by default of Gmsh, which is read without a child process."""
    return write_by_meshio(path, [*others, ("tetra10", cells)], points, **(options or GMSH2))


@pytest.mark.parametrize("options", [GMSH2, {"file_format": "gmsh", "binary": True}])
def test_corners_make_the_mesh_for_any_order_of_the_edges(tmp_path, options):
    for order in (np.arange(6), np.random.default_rng(1).permutation(6)):
        cells = np.hstack([CELLS[:, :4], CELLS[:, 4:][:, order]])
        mesh = read_mesh(write_quadratic(tmp_path / "part.msh", cells=cells, **options))
        assert same(mesh) and mesh.warnings == ()
    for name, rows in (("t.node", NODES.positions), ("t.ele", NODES.elements)):
        head = f"{len(rows)} {rows.shape[1]} 0 0"
        np.savetxt(tmp_path / name, np.column_stack([np.arange(len(rows)), rows]), "%.17g", header=head, comments="")
    assert same(read_mesh(tmp_path / "t.ele"))


def test_nodes_off_the_edges_and_unknown_ones_are_rejected(tmp_path):
    points = NODES.positions.copy()
    points[MESH.n_verts :] += 1.0
    mixed = CELLS[:, [0, 4, 1, 5, 2, 3, 6, 7, 8, 9]]
    for path in (write_quadratic(tmp_path / "a.msh", points), write_quadratic(tmp_path / "b.msh", cells=mixed)):
        with pytest.raises(MeshError, match=f"{path.name}: the tets' ten nodes are not four corners and then one on each"):
            read_mesh(path)
    cells = CELLS.copy()
    cells[3, 7] = 99
    with pytest.raises(MeshError, match="part.vtk: second-order tet 3: node 99 does not exist"):
        read_mesh(write_quadratic(tmp_path / "part.vtk", cells=cells, **TEXT))


def test_both_orders_with_boundary_elements_and_unused_vertices(tmp_path):
    points = np.vstack([[(9.0, 9, 9)], NODES.positions])
    others = [("line3", CELLS[:1, [0, 1, 4]] + 1), ("triangle6", CELLS[:2, [0, 1, 2, 4, 5, 6]] + 1), ("tetra", MESH.tets[:4] + 1)]
    with pytest.warns(UserWarning):
        mesh = read_mesh(write_quadratic(tmp_path / "part.msh", points, CELLS[4:] + 1, others))
    n_unused = 1 + len(np.setdiff1d(CELLS[:4], [*CELLS[4:].flat, *MESH.tets.flat]))  # midside nodes of no second-order tet
    assert same(mesh) and n_unused > 1
    assert list(mesh.warnings) == [
        "1 line3, 2 triangle6 elements next to the tets are not used",
        f"{n_unused} vertices of no tet are left out, the first is vertex 0 of the file",
    ]


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


def test_files_without_a_mesh_are_refused(tmp_path):
    for name, content, message in (
        ("absent.msh", None, "there is no such file"),
        ("a.msh", MARK + b"\r\n", "the file is empty"),
        ("a.svg", b"x", "not a supported mesh (such files can only be written: svg)"),
        ("a.txt", b"hello", "not a supported mesh: the ending '.txt' is not known"),
        ("a.obj", OBJ.encode(), "no tetrahedra; .obj holds surfaces; make a volume mesh first"),
        ("a.off", OFF.encode(), "no tetrahedra; .off holds surfaces"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        assert refusal(read_mesh, tmp_path / name).startswith(message)
    for name, options in (("a.stl", TEXT), ("a.ply", {"binary": True}), ("a.msh", GMSH2)):
        path = write_by_meshio(tmp_path / name, [("triangle", MESH.surface)], **options)
        found = f"no tetrahedra; ({path.suffix} holds surfaces|{len(MESH.surface)} triangles found); make a volume mesh first"
        assert re.match(found, refusal(read_mesh, path))
    for path, message in ((tmp_path, "this is not a file"), (tmp_path / "\0.msh", "."), (3, "must be a file's name")):
        with pytest.raises(MeshError, match=message):
            read_mesh(path)


def test_inverted_tets_are_refused_or_fixed(tmp_path):
    tets = MESH.tets.copy()
    tets[3] = tets[3, [1, 0, 2, 3]]
    path = write_by_meshio(tmp_path / "part.msh", [("tetra", tets)], **GMSH2)
    assert refusal(read_mesh, path).startswith("1 of 10 tets are inverted, the first is tet 3")
    with pytest.warns(UserWarning, match="flipped: 3"):
        assert read_mesh(path, fix_orientation=True).flipped.tolist() == [3]


def test_errors_of_gmsh_files_give_the_line_and_the_node(tmp_path):
    path = tmp_path / "part.msh"
    ts.write_mesh(path, MESH)
    lines = path.read_text().splitlines(keepends=True)
    inside, first, nodes = lines.index("$Elements\n") + 5, lines.index("$Elements\n") + 3, lines.index("$Nodes\n") + 3
    number, *corners = lines[first + 2].split()
    for changed, message in (
        (lines[:inside], rf"line {inside}: the file ends inside \$Elements, before \$EndElements"),
        (lines[: inside - 1] + lines[inside:], r"line \d+ \(\$Elements\): 50 numbers should follow"),
        ([*lines[:inside], "11 1 x 3 4\n", *lines[inside + 1 :]], rf"line {inside + 1} \(\$Elements\): expected a number, not"),
        ([*lines[: inside - 4], "7 7 ", *lines[inside - 4 :]], r"line \d+ \(\$Elements\): 42 numbers should follow"),
        ([*lines[: first + 2], f"{number} 99 {' '.join(corners[1:])}\n", *lines[first + 3 :]], r"tet 2: node 99 .* \(12 nodes\)"),
        ([*lines[: first - 2], "1 11 1 10\n", *lines[first - 1 :]], r"line \d+ \(\$Elements\): 11 elements were declared, but"),
        ([*lines[:nodes], lines[nodes + 1], *lines[nodes + 1 :]], "node 2 is given twice"),
        ([*lines[:-1], "7\n", lines[-1]], r"line \d+ \(\$Elements\): 1 numbers are left over"),
    ):
        path.write_text("".join(changed))
        assert re.match(message, refusal(read_mesh, path))


@pytest.mark.parametrize("version, binary", [("gmsh", False), ("gmsh", True), ("gmsh22", False)])
def test_cut_gmsh_files_never_give_a_partial_mesh(tmp_path, version, binary):
    path = write_by_meshio(tmp_path / "part.msh", TETS, file_format=version, binary=binary)
    data = path.read_bytes().rstrip()
    for length in range(40, len(data) - 1, max(1, len(data) // 50)):  # shorter ones are for meshio
        path.write_bytes(data[:length])
        refusal(read_mesh, path)


def test_tetgen_files_count_from_one_and_must_be_consistent(tmp_path):
    node, ele = tmp_path / "t.node", tmp_path / "t.ele"
    node.write_text("# comment\n4 3 1 0 # head\n\n1 0 0 0 9\n2 1 0 0 9\n3 0 1 0 9 # third\n4 0 0 1 9\n")
    ele.write_text("1 4 0\n1 1 2 3 4\n")
    assert read_mesh(node).tets.tolist() == [[0, 1, 2, 3]]
    for text, message in (
        ("1 4 0\n1 1 2 3\n", "line 2: expected 5 numbers"),
        ("2 4 0\n1 1 2 3 4\n", "line 2: 2 tets were declared, but the file ends after 1"),
        ("1 5 0\n1 1 2 3 4 5\n", "line 1: tets must have 4 or 10 nodes, not 5"),
    ):
        ele.write_text(text)
        assert refusal(read_mesh, ele).startswith(message)
    ele.unlink()
    with pytest.raises(MeshError, match="t.ele: there is no such file; TetGen's files come in pairs"):
        read_mesh(node)


def test_more_data_than_the_file_can_hold(tmp_path):
    """A small compressed file that would fill the memory of its reader."""
    path = tmp_path / "zeros.vtu"
    meshio.write(path, meshio.Mesh(np.zeros((500_000, 3)), [("tetra", np.array([[0, 1, 2, 3]]))]), compression="zlib")
    assert path.stat().st_size < 1e5
    assert "it declares more data than it can hold" in refusal(read_mesh, path)
