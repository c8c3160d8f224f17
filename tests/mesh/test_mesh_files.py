"""Reading and writing of mesh files (broken ones: test_broken_files.py; random and mutated ones: faults/test_fuzz.py):

* written meshes are read back bitwise; a failed write leaves no file;
* every format, text or binary, gives the same mesh; a byte-order mark and Windows line ends change nothing, and UTF-16 text is
  refused with advice, except XML;
* the corners of second-order tets make the mesh, for any order of the edges; curved edges are counted in a warning with the
  largest deviation, and nodes off the edges are rejected;
* other elements are refused by name and number; boundary elements and unused vertices cause warnings; welding merges vertices.
"""

import contextlib
import io
import os
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
    "gmsh 2": (".msh", GMSH2),
    "gmsh 4": (".msh", {"file_format": "gmsh", **TEXT}),
    "gmsh 4 binary": (".msh", {"file_format": "gmsh", "binary": True}),
    "gmsh 2 binary": (".msh", {"file_format": "gmsh22", "binary": True}),
    "ansys": (".msh", {"file_format": "ansys", **TEXT}),
    "vtk": (".vtk", TEXT),
    "vtu": (".vtu", TEXT),
    "tetgen": (".ele", {}),
    "obj": (".obj", {}),
    "stl": (".stl", TEXT),
}
RARE = {ending: (ending, {}) for ending in ".inp .meshb .mesh .avs .xml .vol .su2 .dat .mdpa .post .off".split()}
RARE |= {"ansys binary": (".msh", {"file_format": "ansys"}), "vtk 4.2": (".vtk", {"file_format": "vtk42", **TEXT})}
RARE |= {"f3grid": (".f3grid", TEXT), "ply": (".ply", TEXT)}


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
    assert same(mesh) and mesh.warnings == [] and mesh.source == str(path) and mesh.regions is None
    assert os.listdir(tmp_path) == [path.name]


def test_a_failed_write_leaves_no_file(tmp_path, monkeypatch):
    with pytest.raises(MeshError, match="can be written as .msh, .vtk, .vtu, .mesh, not with the ending '.stl'"):
        write_mesh(tmp_path / "part.stl", MESH)
    with pytest.raises(MeshError, match="needs a TetMesh, not tuple"):
        write_mesh(tmp_path / "part.msh", (MESH.vertices, MESH.tets))
    with pytest.raises(OutputError, match="cannot write .*absent/part.msh: No such file"):
        write_mesh(tmp_path / "absent" / "part.msh", MESH)

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(meshio, "write", full)
    with pytest.raises(OutputError, match="No space left on device"):
        write_mesh(tmp_path / "part.msh", MESH)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "ending, options", [*FORMATS.values(), *(pytest.param(*one, marks=pytest.mark.long) for one in RARE.values())]
)
def test_every_format_with_a_byte_order_mark_and_windows_line_ends(tmp_path, capfd, ending, options):
    """Binary files are left as they are."""
    surface = ending in (".obj", ".off", ".stl", ".ply")
    path = write_by_meshio(
        tmp_path / f"part{ending}", [("triangle", MESH.surface) if surface else ("tetra", MESH.tets)], **options
    )
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
        assert same(mesh, 1e-12 if ending == ".vtu" else 0.0) and mesh.warnings == []
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


def test_byte_order_marks_in_binary_data_are_data(tmp_path):
    path = write_by_meshio(tmp_path / "a.stl", [("triangle", MESH.surface)], binary=True)
    path.write_bytes(MARK + path.read_bytes()[len(MARK) :])
    assert ts.read_surface(path).volume == pytest.approx(MESH.volumes.sum(), rel=1e-6)


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
        with pytest.raises(MeshError, match=f"only tetrahedra with four or ten nodes can be used, but the file holds {named}$"):
            read_mesh(path)


def test_boundary_elements_and_unused_vertices_cause_warnings(tmp_path):
    points = np.vstack([[(9.0, 9, 9)], MESH.vertices, [(8.0, 8, 8)]])
    cells = [("line", [[1, 2], [2, 3]]), ("triangle", MESH.surface + 1), ("tetra", MESH.tets + 1)]
    path = write_by_meshio(tmp_path / "part.msh", cells, points, **GMSH2)
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
    path = write_by_meshio(tmp_path / "part.msh", [("tetra", np.vstack([box.tets, box.tets + 8]))], points, **GMSH2)
    assert read_mesh(path).n_components == 2
    mesh = read_mesh(path, weld=gap / 2)
    assert mesh.n_components == 2 and mesh.warnings == []
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
        assert (mesh.n_verts, mesh.n_tets) == expected and mesh.n_components == 1 and mesh.warnings == []


# --- second-order tets -----------------------------------------------------------------------------------------------

NODES = make_nodes(MESH, 2)
CELLS = NODES.elements[:, [0, 1, 2, 3, 4, 7, 5, 6, 8, 9]]  # VTK's order of the edges: 01, 12, 02, 03, 13, 23


def write_quadratic(path: Path, points=NODES.positions, cells=CELLS, others=(), **options) -> Path:
    """A file, by default of Gmsh, which is read without a child process."""
    return write_by_meshio(path, [*others, ("tetra10", cells)], points, **(options or GMSH2))


@pytest.mark.parametrize("ending, options", [FORMATS["gmsh 2"], FORMATS["gmsh 4 binary"], FORMATS["vtk"]])
def test_corners_make_the_mesh_for_any_order_of_the_edges(tmp_path, ending, options):
    for order in (np.arange(6), np.random.default_rng(1).permutation(6)):
        cells = np.hstack([CELLS[:, :4], CELLS[:, 4:][:, order]])
        mesh = read_mesh(write_quadratic(tmp_path / f"part{ending}", cells=cells, **options))
        assert same(mesh) and mesh.warnings == []


def test_second_order_tetgen_files(tmp_path):
    rows = [f"{i} {x:.17g} {y:.17g} {z:.17g}" for i, (x, y, z) in enumerate(NODES.positions, 1)]
    (tmp_path / "t.node").write_text("\n".join([f"{len(rows)} 3 0 0", *rows]))
    rows = [" ".join(map(str, [i, *(nodes + 1)])) for i, nodes in enumerate(NODES.elements, 1)]
    (tmp_path / "t.ele").write_text("\n".join([f"{len(rows)} 10 0", *rows]))
    assert same(read_mesh(tmp_path / "t.ele"))


def test_curved_edges_are_straightened_with_a_warning(tmp_path):
    """A ball whose surface edges are bent onto the sphere."""
    ball = ball_mesh(1.0, 4)
    nodes = make_nodes(ball, 2)
    edges = np.unique(np.sort(ball.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    points, middles = nodes.positions.copy(), np.setdiff1d(nodes.surface, ball.surface)
    points[middles] /= np.linalg.norm(points[middles], axis=1, keepdims=True)
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    deviation = (1 - 0.5 * np.linalg.norm(a + b, axis=1)) / np.linalg.norm(a - b, axis=1)
    with pytest.warns(UserWarning, match="part.msh: .* curved"):
        mesh = read_mesh(write_quadratic(tmp_path / "part.msh", points, nodes.elements[:, [0, 1, 2, 3, 4, 7, 5, 6, 8, 9]]))
    assert np.array_equal(mesh.vertices, ball.vertices) and len(mesh.warnings) == 1
    message = mesh.warnings[0]
    assert message.startswith(f"{len(edges)} edges of second-order tets are curved")
    assert f"the largest deviation is {deviation.max():.2g} of the edge's length, between vertices " in message
    worst = [int(word) for word in message.split("between vertices ")[1].split(" of ")[0].split(" and ")]
    assert deviation[(edges == worst).all(axis=1)] == pytest.approx(deviation.max())


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
    assert mesh.warnings == [
        "1 line3, 2 triangle6 elements next to the tets are not used",
        f"{n_unused} vertices of no tet are left out, the first is vertex 0 of the file",
    ]


def test_welding_merges_corners_of_second_order_tets(tmp_path):
    one = make_nodes(box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six"), 2)
    points = np.vstack([one.positions, one.positions + (1.0, 0, 0)])
    path = write_quadratic(tmp_path / "part.msh", points, np.vstack([one.elements, one.elements + len(one.positions)]))
    with pytest.warns(UserWarning, match="4 vertices were welded"):
        mesh = read_mesh(path, weld=0.0)
    assert mesh.n_verts == 12 and mesh.n_components == 1 and len(mesh.warnings) == 1
