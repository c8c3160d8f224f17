"""`taisoft info`, `tetrahedralize` and `scene`: from a surface or a mesh of another program to a scene."""

import meshio
import numpy as np
import pytest

import taisoft as ts
from taisoft.cli import main
from tests.mesh.test_surface_mesh import VOLUME, T, X

TOWER = ts.box_mesh((1, 1, 3), (1, 2, 6), center=(10, 20, 30))  # 6 long along z


def test_commands_lead_from_a_surface_to_a_scene(tmp_path, capsys):
    """`taisoft info`, `taisoft tetrahedralize` of a spheroid in millimetres, with z up and two holes, and `taisoft scene`."""
    pytest.importorskip("wildmeshing")
    surface, out = tmp_path / "ball.obj", tmp_path / "ball.msh"
    apart = next(k for k in range(1, len(T)) if not set(T[k]) & set(T[0]))
    meshio.write(surface, meshio.Mesh(1000 * X * (1, 1, 2), [("triangle", np.delete(T, [0, apart], axis=0))]))
    assert main(["info", str(surface)]) == 0
    assert f"{len(X)} vertices, {len(T) - 2} triangles, 1 piece; no tets" in capsys.readouterr().out
    options = "--up z --scale 0.001 --rotate 0 90 0 --at 0.5 -0.25 0 --edge-length 0.4".split()
    for path, more, code, message in (
        (tmp_path / "ball.txt", options, 2, "a mesh can be written as"),
        (out, options, 0, "2 holes were closed, and the tets fill"),
        (out, options, 3, "--overwrite replaces it"),
    ):
        assert main(["tetrahedralize", str(surface), "--out", str(path), *more]) == code
        error = capsys.readouterr().err
        assert message in error and (code == 0 or error.count("\n") == 1) and path.exists() == (path == out)
    mesh = ts.read_mesh(out)
    assert mesh.volumes.sum() == pytest.approx(2 * VOLUME, rel=0.08) and 50 < mesh.n_tets < 5000
    assert np.allclose(mesh.vertices.min(axis=0), (0.0, -0.25, -0.5), atol=0.05)
    assert np.allclose(mesh.vertices.max(axis=0), (1.0, 1.75, 0.5), atol=0.05)
    assert main(["scene", str(out), "--out", str(tmp_path / "ball.toml")]) == 0
    scene, solver = ts.read_scene(tmp_path / "ball.toml")
    body, height = scene.body("ball"), np.ptp(scene.body("ball").rest_positions[:, 1])
    assert (body.rest_positions + body.position)[:, 1].min() == pytest.approx(0.25 * height) and scene.obstacle("ground")
    assert 0.5 < body.material.young / (100 * 1000 * 9.81 * height) < 2 and solver == {"dt": 0.01, "seconds": 2.0, "fps": 50.0}


@pytest.mark.filterwarnings("ignore:body 'tower'")
def test_scene_places_a_mesh_but_no_scene(tmp_path, capsys):
    path, out = tmp_path / "tower.msh", tmp_path / "tower.toml"
    ts.write_mesh(path, TOWER)
    command = ["scene", str(path), "--out", str(out), "--up", "z", "--scale", "0.5", "--at", "1", "0", "-2", "--order", "2"]
    assert main(command) == 0
    body = ts.read_scene(out)[0].body("tower")
    x = body.rest_positions + body.position
    assert body.order == 2 and np.allclose(x.min(axis=0), (0.75, 0, -2.5)) and np.allclose(x.max(axis=0), (1.25, 3, -1.5))
    assert main([*command, "--to", "z", "--overwrite"]) == 0
    scene = ts.read_scene(out)[0]
    x = scene.body("tower").rest_positions + scene.body("tower").position
    assert scene.up == "z" and scene.obstacle("ground").shape.normal.tolist() == [0, 0, 1]
    assert np.allclose(x.min(axis=0), (0.75, -0.5, -2)) and np.allclose(x.max(axis=0), (1.25, 0.5, 1))
    capsys.readouterr()
    for option, message in ((command[8:12], "--at place a mesh, and this is a scene"), (command[12:], "--order is for a")):
        assert main(["scene", str(out), "--out", str(tmp_path / "b.toml"), *option]) == 2
        assert message in capsys.readouterr().err


def test_info_measures_welds_cracks_and_suspects_millimetres(tmp_path, capsys):
    """A part of 60 mm that is read as 60 m: the next command that `info` proposes scales it. A surface and a mesh in which each
    element has its own vertices, a little apart; a USD stage is not welded."""

    def info(name: str, *options: str) -> str:
        assert main(["info", str(tmp_path / name), *options]) == 2 * name.endswith("usda")
        return "".join(capsys.readouterr())

    for scale, message in (
        (1, "extent     x 1 (9.5 to 10.5), y 2 (19 to 21), z 6 (27 to 33)"),
        (10, f"next       fill it with tets: taisoft tetrahedralize {tmp_path / 'tower.obj'} --scale 0.001 --out tower.msh"),
    ):
        meshio.write(tmp_path / "tower.obj", meshio.Mesh(scale * TOWER.vertices, [("triangle", TOWER.surface)]))
        shown = info("tower.obj")
        assert message in shown and "axes       y is taken for up" in shown and ("0.001" in shown) == (scale == 10)
    for name, kind, cells in (("a.obj", "triangle", TOWER.surface), ("a.vtu", "tetra", TOWER.tets)):
        x, surface = TOWER.vertices[cells].reshape(-1, 3), kind == "triangle"
        x = x + 1e-4 * np.random.default_rng(2).uniform(-1, 1, x.shape)
        meshio.write(tmp_path / name, meshio.Mesh(x, [(kind, np.arange(len(x)).reshape(cells.shape))]))
        cracked, welded = info(name), info(name, "--weld", "1e-3")
        assert f"{len(cells)} pieces" in cracked and ("cracks at most" in cracked) == surface
        assert "1 piece" in welded and "were welded" in welded and ("--weld 0.001 --out" in welded) == surface
    assert "--weld is for other files" in info("a.usda", "--weld", "0")
