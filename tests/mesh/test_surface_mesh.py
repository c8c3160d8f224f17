"""Surface meshes and tetrahedralization (other formats, encodings: test_mesh_files.py): polygons, welding, faults and invalid
files; those of other libraries; tets of a ball at any place and scale; the mesher's failure and absence are reported.
"""

import re
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import MeshError
from taisoft.mesh import surface_mesh
from taisoft.mesh.surface_mesh import read_surface

BALL = ts.ball_mesh(0.5, 4)
USED, CORNERS = np.unique(BALL.surface, return_inverse=True)
X, T = BALL.vertices[USED], CORNERS.reshape(-1, 3)
VOLUME = float(BALL.volumes.sum())
CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def check_unit_cube(surface) -> None:
    assert len(surface.vertices) == 8 and len(surface.triangles) == 12 and not surface.faults() and not surface.warnings
    assert surface.volume == pytest.approx(1.0) and surface.area == pytest.approx(6.0) and surface.closed


def test_obj(tmp_path):
    """Quads, texture and normals per corner, negative indices, comments."""
    path = tmp_path / "cube.obj"
    lines = ["# a cube", *(f"v {x} {y} {z} 1.0" for x, y, z in CUBE), "vt 0 0", "vn 0 1 0", "usemtl none"]
    lines += [f"f {' '.join(f'{k + 1}/1/1' for k in quad)}  # side" for quad in QUADS[:-1]]
    lines += ["f " + " ".join(f"{k - 8}/-1/1" for k in QUADS[-1])]
    path.write_text("\n".join(lines))
    check_unit_cube(read_surface(path))


def test_off(tmp_path):
    """Quads, a polygon, colours, comments, and the headers of various programs."""
    path = tmp_path / "cube.off"
    lines = [f"{x} {y} {z} 255 0 0 255 # corner" for x, y, z in CUBE]
    lines += [f"4  {' '.join(map(str, quad))} 0.5 0.5 0.5" for quad in QUADS]
    headers = ["OFF\n8 6 12\n", "OFF # a cube\n\n# counts\n8 6\n", "COFF 8 6 12\n", "OFF8 6 0\n", "\n#\nSTCNOFF\n8 6 0\n"]
    for header in headers:
        path.write_text(header + "\n\n".join(lines))
        check_unit_cube(read_surface(path))
    path.write_text("OFF 5 1 0\n0 0 0\n2 0 0\n2 1 0\n1 2 0\n0 1 0\n5 0 1 2 3 4")
    surface = read_surface(path)
    assert surface.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]] and surface.area == pytest.approx(3.0)


POINTS = "0 0 0\n1 0 0\n0 1 0\n"
V = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("a.off", "# comment\n", "the file is empty"),
        ("a.off", "3 1 0\n" + POINTS, "line 1: not a supported surface: expected OFF, not '3'"),
        ("a.off", "OFF 3 1000000000 0\n" + POINTS, "line 1 declares 3 vertices and 1000000000 faces, but 3 lines follow"),
        ("a.off", "OFF 3 1 0\n0 0 0\n# x\n1 0\n0 1 0\n3 0 1 2\n", "line 4: expected three coordinates, not '1 0'"),
        ("a.off", "OFF 3 1 0\n" + POINTS + "2 0 1\n", "line 5: expected a number of at least 3 corners and as many"),
        ("a.off", "OFF 3 1 0\n" + POINTS + "3 0 1 3\n", r"line 5: vertex 3 does not exist \(3 vertices\)"),
        ("a.off", "OFF 3 1 0\n" + POINTS + "3 0 1 0_2\n", "line 5: expected a number of at least 3"),
        ("a.off", "OFF 3 0 0\n" + POINTS, "no triangles found"),
        ("a.obj", "v 0 0\n", "line 1: expected v and three coordinates, not 'v 0 0'"),
        ("a.obj", V.replace("1 0\n", "nan 0\n") + "f 1 2 3\n", "vertex 2 coordinate 1 is not finite"),
        ("a.obj", V + "f 1 2 4\n", r"triangle 0: vertex 3 does not exist \(3 vertices, counted from 0\)"),
        ("a.obj", V + "f 1 0 1\n", "line 4: expected f and at least 3 corners"),
        ("a.obj", V + "vt x\n", "line 4: expected vt and one or two numbers, not 'vt x'"),
        ("a.obj", V + "vt 0 0\nf 1/1 2 3/1\n", "line 5: expected f and at least 3 corners, all or none of them with a vt"),
        ("a.obj", V + "vt 0 0\nf /1 /1 /1\n", "line 5: expected f and at least 3 corners"),
        ("a.obj", V + "vt 0 0\nf 1/1 2/1 3/2\n", r"line 5: vt 2 does not exist \(1 are given\)"),
        ("a.obj", V + "f 1/-2 2/-1 3/-1\nvt 0 0\n", r"line 4: vt -2 does not exist \(1 are given\)"),
        ("a.ply", "passphrase", "line 1: not a supported surface: expected ply$"),
        ("a.msh", "x", "a surface is read from .obj, .stl, .ply, .off, not from .msh"),
    ],
)
def test_invalid_files_are_rejected(name, text, message, tmp_path):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(MeshError, match=f": {message}") as error:
        read_surface(path)
    assert str(error.value).startswith(str(path)) and len(str(error.value)) < 400


def test_welding(tmp_path):
    """Each triangle has its own vertices, as in .stl files, equal or slightly apart."""
    path = tmp_path / "ball.obj"
    corners = X[T].reshape(-1, 3)
    for apart, weld in ((0.0, 0.0), (1e-4, 1e-3)):
        moved = corners + apart * np.random.default_rng(1).uniform(-1, 1, corners.shape) / 2
        lines = ["v {:.17g} {:.17g} {:.17g}".format(*x) for x in moved]
        path.write_text("\n".join([*lines, *(f"f {k} {k + 1} {k + 2}" for k in range(1, len(moved), 3))]))
        with pytest.warns(UserWarning, match=f"{len(corners) - len(X)} of {len(corners)} vertices were welded"):
            surface = read_surface(path, weld=weld)
        assert len(surface.vertices) == len(X) and not surface.faults()
        if apart:
            width = float(re.search(r"sides of cracks at most (\S+) m wide, which weld", read_surface(path).faults()[0])[1])
            assert 0.0 < width <= 2e-4 and not read_surface(path, weld=width).faults()
    with pytest.raises(MeshError, match="ball.obj: weld must be at least 0 m, not"):
        read_surface(path, weld=-1.0)


def test_dropped_triangles_cause_warnings(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nv 9 9 9\nf 1 2 3\nf 1 2 4\nf 3 1 2\n")
    with pytest.warns(UserWarning):
        surface = read_surface(path)
    assert surface.warnings == [
        "1 triangles without area are left out, the first is triangle 1",
        "1 triangles given twice are left out, the first is triangle 2",
    ]
    assert len(surface.vertices) == 3 and len(surface.triangles) == 1


def test_invalid_arrays_are_rejected():
    for vertices, triangles, message in (
        (np.where(np.arange(3) == 1, np.nan, X), T, "vertex 0 coordinate 1 is not finite"),
        (X, T.astype(float), "triangles must be integers, not float64"),
        (X, [*T, (0, 1, len(X))], f"triangle {len(T)}: vertex {len(X)} does not exist \\({len(X)} vertices, counted from 0\\)$"),
    ):
        with pytest.raises(MeshError, match=f"^here: {message}"):
            ts.SurfaceMesh(vertices, triangles, "here")


def test_faults():
    assert not ts.SurfaceMesh(X, T).faults()
    hole = ts.SurfaceMesh(X, T[1:]).faults()[0]
    assert hole.startswith("1 hole: 3 edges belong to one triangle") and "crack" not in hole
    open_twice = ts.SurfaceMesh(X, np.delete(T, [0, len(T) - 1], axis=0))
    assert open_twice.faults()[0].startswith("2 holes: 6 edges") and not open_twice.closed
    flipped = T.copy()
    flipped[3] = flipped[3, ::-1]
    assert ts.SurfaceMesh(X, flipped).faults()[0].startswith("3 edges have two triangles of opposite orientation")
    assert ts.SurfaceMesh(X, T[:, ::-1]).faults() == ["all normals point inward; flip them"]
    wall = np.vstack([X, X.mean(axis=0)]), np.vstack([T, [*T[0, :2], len(X)]])
    assert any("belong to more than two triangles" in text for text in ts.SurfaceMesh(*wall).faults())
    two = ts.SurfaceMesh(np.vstack([X, X + 3.0]), np.vstack([T, T + len(X)]))
    assert two.n_pieces == 2 and two.volume == pytest.approx(2 * VOLUME) and not two.faults()


@pytest.mark.filterwarnings("ignore:SimpleNamespace")
def test_surfaces_of_other_libraries_are_read():
    """By their vertices and faces, wherever a surface is expected; the copy of a vertex is welded."""
    trimesh = SimpleNamespace(vertices=np.vstack([X, X[:1]]), faces=np.where((T == 0) & (np.arange(3) == 1), len(X), T))
    with pytest.warns(UserWarning, match=f"SimpleNamespace: 1 of {len(X) + 1} vertices were welded"):
        surface = ts.read_surface(trimesh)
    assert len(surface.vertices) == len(X) and surface.volume == pytest.approx(VOLUME) and not surface.faults()
    scene = ts.Scene()
    for given in (surface, trimesh):
        for mesh in (given, ts.place(given, scale=2.0)):
            scene.add_rigid_body(mesh)
        scene.add_body(BALL, ts.Material()).embed(given, contact=True)
    masses = [body.mass for body in scene.bodies]
    assert masses[:3] == masses[3:] and np.array_equal(scene.bodies[2].nodes.surface, scene.bodies[5].nodes.surface)
    for wrong, message in (
        (3, "must be a file's name or have vertices"),
        (SimpleNamespace(vertices=X, faces=QUADS), "triangles must"),
    ):
        with pytest.raises(MeshError, match=message):
            ts.read_surface(wrong)


def test_tets_fill_a_ball_that_is_inside_out():
    """Small, and far from the origin."""
    pytest.importorskip("wildmeshing")
    scale, shift = 1e-3, 50.0
    with pytest.warns(UserWarning, match="point inward"):
        mesh = ts.tetrahedralize(ts.SurfaceMesh(scale * X + shift, T[:, ::-1], "ball"), edge_length=0.4 * scale)
    assert mesh.volumes.sum() == pytest.approx(VOLUME * scale**3, rel=0.05) and mesh.volumes.min() > 0 and mesh.n_components == 1
    assert 40 < mesh.n_tets < 2000
    assert np.linalg.norm(mesh.vertices - shift, axis=1).max() < 0.53 * scale


def test_bad_arguments_and_absence_and_failure_of_the_mesher_are_reported(monkeypatch, tmp_path):
    surface = ts.SurfaceMesh(X, T, "ball.obj")
    limits = "greater than 0 and below .* m, the surface's diagonal"
    for edge_length, rule in ((0.0, limits), (9.0, limits), (np.nan, "finite"), ("x", "a number"), (True, "a number")):
        with pytest.raises(MeshError, match=f"ball.obj: edge_length must be {rule}, not"):
            ts.tetrahedralize(surface, edge_length=edge_length)
    with pytest.raises(MeshError, match="surface .see read_surface. must be a SurfaceMesh, not TetMesh"):
        ts.tetrahedralize(BALL)
    monkeypatch.setattr(surface_mesh, "find_spec", lambda name: None)
    with pytest.raises(MeshError, match=r"ball.obj: .* needs the package wildmeshing: pip install 'taisoft\[mesh\]'"):
        ts.tetrahedralize(surface)
    monkeypatch.setattr(surface_mesh, "find_spec", lambda name: True)
    (tmp_path / "wildmeshing.py").write_text("import os\nos.write(2, b'terminate called\\nno memory\\n')\nos.abort()\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(MeshError, match="ball.obj: the mesher failed: its process ended by signal SIGABRT: no memory"):
        ts.tetrahedralize(surface)
