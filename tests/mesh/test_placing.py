"""Own meshes: `place`, and the options --up, --scale, --rotate and --at.

* the up axis turns to y by a rotation, exactly; scale, rotation and place follow in this order; regions and warnings stay;
* for any arguments shapes keep their angles, orientation and volume times scale^3;
* `taisoft tetrahedralize` and `taisoft scene` give what `place` gives; they refuse what is not a number, and a scene;
* closed holes are reported with the volume; `taisoft info` names the extent along each axis.
"""

import re
import shlex
import warnings

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.cli import main
from taisoft.errors import MeshError
from tests.cli.command import BEAM, run, write

TOWER = ts.box_mesh((1, 1, 3), (1, 2, 6), center=(10, 20, 30))  # 6 long along z


@pytest.mark.parametrize("up, point", [("y", (1, 2, 3)), ("z", (1, 3, -2)), ("x", (-2, 1, 3))])
def test_the_up_axis_turns_to_y(up, point):
    corner = ts.SurfaceMesh([(1, 2, 3), (0, 0, 0), (1, 0, 0)], [(0, 1, 2)])
    assert np.array_equal(ts.place(corner, up).vertices[0], point)


def test_the_order_of_operations():
    """z up: (1, 2, 3) -> (1, 3, -2); times 2: (2, 6, -4); a quarter turn about x: (2, 4, 6), then about y: (6, 4, -2)."""
    corner = ts.SurfaceMesh([(1, 2, 3), (0, 0, 0), (1, 0, 0)], [(0, 1, 2)], "corner", ["a note"])
    placed = ts.place(corner, "z", 2, (90, 90, 0))
    assert np.array_equal(placed.vertices[0], (6, 4, -2)) and (placed.source, placed.warnings) == ("corner", ["a note"])


def test_the_middle_of_the_underside_goes_to_its_place():
    placed = ts.place(TOWER, "z", 0.5, at=(1, 2, 3))
    assert np.array_equal(placed.vertices.min(axis=0), (0.75, 2, 2.5)) and np.array_equal(
        placed.vertices.max(axis=0), (1.25, 5, 3.5)
    )


def test_regions_stay_and_warnings_are_not_repeated():
    with pytest.warns(UserWarning, match="nearly flat"):
        flat = ts.box_mesh((1, 1, 1), (1, 1e-3, 1))
        flat = ts.TetMesh(flat.vertices, flat.tets, regions=[1, 1, 2, 2, 2], region_names={2: "bone"}, source="flat.msh")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        placed = ts.place(flat, scale=2.0)
    assert placed.regions.tolist() == [1, 1, 2, 2, 2] and placed.region_names == {2: "bone"} and placed.source == "flat.msh"
    with pytest.warns(UserWarning, match="from the origin"):
        ts.place(TOWER, at=(1e9, 0, 0))


@settings(max_examples=60, deadline=None)
@given(
    up=st.sampled_from("xyz"),
    scale=st.floats(1e-3, 1e3),
    rotate=st.tuples(*[st.floats(-720, 720)] * 3),
    at=st.tuples(*[st.floats(-10, 10)] * 3),
)
def test_any_placement_keeps_the_shape(up, scale, rotate, at):
    placed = ts.place(TOWER, up, scale, rotate, at)
    assert np.array_equal(placed.tets, TOWER.tets) and len(placed.flipped) == 0
    assert np.allclose(placed.volumes, scale**3 * TOWER.volumes, rtol=1e-9)
    x, X = placed.vertices - placed.vertices[0], scale * (TOWER.vertices - TOWER.vertices[0])
    assert np.allclose(x @ x.T, X @ X.T, atol=1e-8 * scale**2 * 40 + 1e-12)
    low, high = placed.vertices.min(axis=0), placed.vertices.max(axis=0)
    assert np.allclose((0.5 * (low + high)[0], low[1], 0.5 * (low + high)[2]), at, atol=1e-9 * (1 + scale))


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"up": "w"}, "up must be one of x, y, z, not 'w'"),
        ({"scale": 0}, "scale must be a number above 0, not 0"),
        ({"scale": float("nan")}, "scale must be a number above 0, not nan"),
        ({"scale": "2"}, "scale must be a number above 0, not '2'"),
        ({"rotate": (1, 2)}, r"rotate must be three finite numbers, not \(1, 2\)"),
        ({"at": (0, float("inf"), 0)}, r"at must be three finite numbers, not \(0, inf, 0\)"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(MeshError, match=f"place: {message}"):
        ts.place(TOWER, **arguments)


def test_only_meshes_are_placed():
    with pytest.raises(MeshError, match="place needs a TetMesh or a SurfaceMesh, not Scene"):
        ts.place(ts.Scene())


# --- commands ---------------------------------------------------------------------------------------------------------


def surface_file(path, vertices, triangles):
    meshio.write(path, meshio.Mesh(vertices, [("triangle", triangles)]))
    return path


def test_tetrahedralize_places_the_surface(tmp_path, capsys):
    """A tower in millimetres with z up; --edge-length is in metres."""
    pytest.importorskip("wildmeshing")
    path, out = surface_file(tmp_path / "tower.obj", TOWER.vertices, TOWER.surface), tmp_path / "tower.msh"
    options = "--up z --scale 0.001 --rotate 0 90 0 --at 0.5 -0.25 0 --edge-length 0.0008"
    assert main(["tetrahedralize", str(path), "--out", str(out), *shlex.split(options)]) == 0
    mesh = ts.read_mesh(out)
    assert np.allclose(mesh.vertices.min(axis=0), (0.499, -0.25, -0.0005), atol=1e-4)
    assert np.allclose(mesh.vertices.max(axis=0), (0.501, -0.244, 0.0005), atol=1e-4)
    assert 50 < mesh.n_tets < 5000
    assert re.search(r", y 0\.00[56]\d* \(-0\.2[45]\d* to -0\.24", capsys.readouterr().out)


@pytest.mark.filterwarnings("ignore:body 'tower'")
def test_scene_places_a_mesh(tmp_path):
    path, out = tmp_path / "tower.msh", tmp_path / "tower.toml"
    ts.write_mesh(path, TOWER)
    assert main(["scene", str(path), "--out", str(out), "--up", "z", "--scale", "0.5"]) == 0
    body = ts.read_scene(out)[0].body("tower")
    x = body.rest_positions + body.position
    assert np.ptp(x[:, 1]) == 3 and x[:, 1].min() == pytest.approx(0.25 * 3)  # it falls from a quarter of its height
    assert main(["scene", str(path), "--out", str(out), "--overwrite", "--up", "z", "--at", "1", "0", "-2"]) == 0
    body = ts.read_scene(out)[0].body("tower")
    x = body.rest_positions + body.position
    assert np.allclose(x.min(axis=0), (0.5, 0, -3)) and np.allclose(x.max(axis=0), (1.5, 6, -1))


@pytest.mark.parametrize("option", ["--up z", "--scale 2", "--rotate 0 90 0", "--at 0 0 0"])
def test_a_scene_is_not_placed(tmp_path, capsys, option):
    path = write(tmp_path / "beam.py", BEAM)
    assert main(["scene", str(path), "--out", str(tmp_path / "beam.toml"), *option.split()]) == 2
    assert f"{path}: --up, --scale, --rotate, --at place a mesh, and this is a scene" in capsys.readouterr().err
    assert not (tmp_path / "beam.toml").exists()


def test_a_scale_of_zero_is_refused_before_anything_is_written(tmp_path, capsys):
    path = surface_file(tmp_path / "tower.obj", TOWER.vertices, TOWER.surface)
    assert main(["tetrahedralize", str(path), "--out", str(tmp_path / "a.msh"), "--scale", "0"]) == 2
    assert "scale must be a number above 0, not 0.0" in capsys.readouterr().err and not (tmp_path / "a.msh").exists()


def test_closed_holes_are_reported_with_the_volume(tmp_path, capsys):
    """Two triangles that share no edge are missing in a ball of volume 4.1."""
    pytest.importorskip("wildmeshing")
    ball = ts.ball_mesh(radius=1.0, cells=6)
    used, corners = np.unique(ball.surface, return_inverse=True)
    corners = corners.reshape(-1, 3)
    apart = next(k for k in range(1, len(corners)) if not set(corners[k]) & set(corners[0]))
    path = surface_file(tmp_path / "ball.obj", ball.vertices[used], np.delete(corners, [0, apart], axis=0))
    assert ts.read_surface(path).n_holes == 2
    assert main(["tetrahedralize", str(path), "--out", str(tmp_path / "ball.msh"), "--edge-length", "0.4"]) == 0
    error = capsys.readouterr().err
    volume = ts.read_mesh(tmp_path / "ball.msh").volumes.sum()
    assert f"{path}: 2 holes were closed, and the tets fill {volume:.4g} m^3; the closing surface may be rough" in error
    assert volume == pytest.approx(ball.volumes.sum(), rel=0.05)


def test_info_names_the_axes(tmp_path, capsys):
    for path in (tmp_path / "tower.msh", tmp_path / "tower.obj"):
        if path.suffix == ".msh":
            ts.write_mesh(path, TOWER)
        else:
            surface_file(path, TOWER.vertices, TOWER.surface)
        assert main(["info", str(path)]) == 0
        shown = capsys.readouterr().out
        assert "extent     x 1 (9.5 to 10.5), y 2 (19 to 21), z 6 (27 to 33)" in shown
        assert "axes       y is taken for up" in shown


def test_millimetres_are_suspected_from_the_first_command_to_the_last(tmp_path, capsys):
    """A part of 60 mm that is read as 60 m: info's next command corrects it, scene and run warn; a large shape is meant so."""
    path = surface_file(tmp_path / "part.obj", 10 * TOWER.vertices, TOWER.surface)
    assert main(["info", str(path)]) == 0
    assert f"next       fill it with tets: taisoft tetrahedralize {path} --scale 0.001 --out part.msh" in capsys.readouterr().out
    ts.write_mesh(tmp_path / "part.msh", ts.TetMesh(10 * TOWER.vertices, TOWER.tets))
    warning = "taisoft: warning: mesh of 'part': its longest side is 60 m; was its file in millimetres?"
    assert main(["scene", str(tmp_path / "part.msh"), "--out", str(tmp_path / "part.toml")]) == 0
    assert warning in capsys.readouterr().err
    assert run(tmp_path / "part.toml", "--seconds", "0.001") == 0
    assert warning in capsys.readouterr().err
    small = ["--out", str(tmp_path / "small.toml"), "--scale", "0.001"]
    assert main(["scene", str(tmp_path / "part.msh"), *small]) == 0
    assert "millimetres" not in capsys.readouterr().err
    write(tmp_path / "beam.py", BEAM.replace("(4, 2, 2)", "(40, 20, 20)").replace("-1.99", "-19.9"))
    assert run(tmp_path / "beam.py", "--seconds", "0.001") == 0
    assert "millimetres" not in capsys.readouterr().err
