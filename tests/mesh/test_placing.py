"""Meshes from other programs: `place`, and the options --up, --scale, --rotate, --at and --order of `taisoft scene`; `taisoft
info` names the extent along each axis and suspects millimetres.
"""

import meshio
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.cli import main
from taisoft.errors import MeshError

TOWER = ts.box_mesh((1, 1, 3), (1, 2, 6), center=(10, 20, 30))  # 6 long along z


def test_the_up_axis_turns_to_y_before_scale_rotation_and_place():
    """z up: (1, 2, 3) -> (1, 3, -2); times 2: (2, 6, -4); a quarter turn about x: (2, 4, 6), then about y: (6, 4, -2)."""
    corner = ts.SurfaceMesh([(1, 2, 3), (0, 0, 0), (1, 0, 0)], [(0, 1, 2)], "corner", ["a note"])
    for up, point in (("y", (1, 2, 3)), ("z", (1, 3, -2)), ("x", (-2, 1, 3))):
        assert np.array_equal(ts.place(corner, up).vertices[0], point)
    placed = ts.place(corner, "z", 2, (90, 90, 0))
    assert np.array_equal(placed.vertices[0], (6, 4, -2)) and (placed.source, placed.warnings) == ("corner", ["a note"])
    low, high = (getattr(ts.place(TOWER, "z", 0.5, at=(1, 2, 3)).vertices, name)(axis=0) for name in ("min", "max"))
    assert np.array_equal(low, (0.75, 2, 2.5)) and np.array_equal(high, (1.25, 5, 3.5))


@settings(max_examples=40, deadline=None)
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
        ({"at": (0, float("inf"), 0)}, r"at must be three finite numbers, not \(0, inf, 0\)"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(MeshError, match=f"place: {message}"):
        ts.place(TOWER, **arguments)
    with pytest.raises(MeshError, match="place needs a TetMesh or a SurfaceMesh, not Scene"):
        ts.place(ts.Scene())


@pytest.mark.filterwarnings("ignore:body 'tower'")
def test_scene_places_a_mesh_but_no_scene(tmp_path, capsys):
    """An order edited in its file needs no other edit."""
    path, out = tmp_path / "tower.msh", tmp_path / "tower.toml"
    ts.write_mesh(path, TOWER)
    assert main(["scene", str(path), "--out", str(out), "--up", "z", "--scale", "0.5", "--order", "2"]) == 0
    body = ts.read_scene(out)[0].body("tower")
    x = body.rest_positions + body.position
    assert (
        body.order == 2 and np.ptp(x[:, 1]) == 3 and x[:, 1].min() == pytest.approx(0.25 * 3)
    )  # it falls from a quarter of its height
    assert main(["scene", str(path), "--out", str(out), "--overwrite", "--up", "z", "--at", "1", "0", "-2"]) == 0
    out.write_text(out.read_text().replace("order = 1", "order = 2"))
    body = ts.read_scene(out)[0].body("tower")
    x = body.rest_positions + body.position
    assert body.order == 2 and np.allclose(x.min(axis=0), (0.5, 0, -3)) and np.allclose(x.max(axis=0), (1.5, 6, -1))
    capsys.readouterr()
    for more, message in (
        (["--at", "0", "0", "0"], "--at place a mesh, and this is a scene"),
        (["--order", "2"], "--order is for a"),
    ):
        assert main(["scene", str(out), "--out", str(tmp_path / "b.toml"), *more]) == 2
        assert message in capsys.readouterr().err


def test_info_names_the_axes_and_suspects_millimetres(tmp_path, capsys):
    """A part of 60 mm that is read as 60 m: the next command that `info` proposes scales it."""
    path = tmp_path / "tower.obj"
    for scale, message in (
        (1, "extent     x 1 (9.5 to 10.5), y 2 (19 to 21), z 6 (27 to 33)"),
        (10, f"next       fill it with tets: taisoft tetrahedralize {path} --scale 0.001 --out tower.msh"),
    ):
        meshio.write(path, meshio.Mesh(scale * TOWER.vertices, [("triangle", TOWER.surface)]))
        assert main(["info", str(path)]) == 0
        shown = capsys.readouterr().out
        assert message in shown and "axes       y is taken for up" in shown and ("0.001" in shown) == (scale == 10)
    ts.write_mesh(tmp_path / "part.msh", ts.TetMesh(10 * TOWER.vertices, TOWER.tets))
    assert main(["scene", str(tmp_path / "part.msh"), "--out", str(tmp_path / "part.toml")]) == 0
    assert "mesh of 'part': its longest side is 60 m; was its file in millimetres?" in capsys.readouterr().err
