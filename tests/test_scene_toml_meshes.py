"""Mesh files of scene files: found beside the scene file; they stay in its folder, wherever links lead, unless that is lifted."""

import os

import numpy as np
import pytest
from command import write
from toml_scenes import MESH, TURNED, read

import taisoft as ts


def test_mesh_files_are_found_beside_the_scene_file(tmp_path, monkeypatch):
    (tmp_path / "meshes").mkdir()
    ts.write_mesh(tmp_path / "meshes" / "a.vtu", TURNED)
    monkeypatch.chdir("/")
    text = '\ufeff[bodies.a]\r\nmaterial = {}\r\nmesh = { file = "meshes/a.vtu", weld = 0, fix_orientation = true }\r\n'
    assert np.array_equal(read(tmp_path, text)[0].body("a").rest_positions, TURNED.vertices)


@pytest.mark.parametrize(
    "name, told",
    [
        ("gone.msh", "gone.msh: there is no such file"),
        ("", "must be a file's name, not ''"),
        ("a\\u0000.msh", "must be a file's name"),
        ("../out.msh", "must lie inside the scene file's folder, without '..'"),
        ("in/../a.msh", "must lie inside the scene file's folder, without '..'"),
        ("/etc/passwd", "must be one of"),
        ("OUT/out.msh", "must lie inside"),
        ("link.msh", "must lie inside"),
        ("folder/out.msh", "must lie inside"),
        ("pair.ele", "must lie inside"),
        ("circle.msh", "bodies.a.mesh"),
        ("a.xdmf", "other formats can name further files; --allow-outside (allow_outside=True) lifts this"),
        ("secret.msh", "not a supported mesh"),
    ],
)
def test_mesh_files_stay_inside(tmp_path, name, told):
    outside, inside = tmp_path / "out", tmp_path / "in"
    outside.mkdir()
    inside.mkdir()
    ts.write_mesh(outside / "out.msh", TURNED)
    ts.write_mesh(inside / "a.msh", TURNED)
    (outside / "pair.node").write_text("secret")
    (inside / "pair.ele").write_text("1 4 0\n1 1 2 3 4\n")
    links = {"link.msh": outside / "out.msh", "folder": outside, "pair.node": outside / "pair.node", "circle.msh": "circle.msh"}
    for link, to in links.items():
        os.symlink(to, inside / link)
    write(inside / "secret.msh", "passphrase")
    text = MESH.format(name.replace("OUT", str(outside)))
    with pytest.raises((ts.SceneError, ts.MeshError)) as caught:
        read(inside, text)
    assert told in str(caught.value) and str(caught.value).startswith(f"{inside / 'scene.toml'}: bodies.a.mesh")
    assert "passphrase" not in str(caught.value) and "secret" not in str(caught.value).replace("secret.msh", "")
    if "out.msh" in name or name == "link.msh":
        name = name.replace("../out.msh", "../out/out.msh")
        scene, _ = read(inside, MESH.format(name.replace("OUT", str(outside))), allow_outside=True)
        assert np.array_equal(scene.body("a").rest_positions, TURNED.vertices)
