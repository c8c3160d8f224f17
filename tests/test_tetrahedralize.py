"""Tets inside of surfaces:

* the tets of a ball enclose its volume, are all upright, keep to the edge length, wherever it lies and however large it is;
* the mesher's failure, and its absence, are told;
* `taisoft info`, `taisoft tetrahedralize` and `taisoft scene` on the way from a surface to a scene that can be run.
* a signal ends the mesher, too, and nothing is left of it.
"""

import signal
import subprocess
import time
import warnings

import meshio
import numpy as np
import pytest
from command import child
from test_surface_mesh import BALL, VOLUME, T, X

import taisoft as ts
from taisoft.cli import main
from taisoft.errors import MeshError
from taisoft.mesh import safe_reading, surface_mesh


@pytest.mark.parametrize("scale, shift, flipped", [(1.0, 0.0, False), (1e-3, 50.0, True)])
def test_tets_of_a_ball(scale, shift, flipped):
    pytest.importorskip("wildmeshing")
    surface = ts.SurfaceMesh(scale * X + shift, T[:, ::-1] if flipped else T, "ball")
    told = pytest.warns(UserWarning, match="point inward") if flipped else warnings.catch_warnings()
    with told:
        mesh = ts.tetrahedralize(surface, edge_length=0.25 * scale)
    assert mesh.volumes.sum() == pytest.approx(VOLUME * scale**3, rel=0.05) and mesh.volumes.min() > 0 and mesh.n_components == 1
    assert 40 < mesh.n_tets < 2000
    assert np.linalg.norm(mesh.vertices - shift, axis=1).max() < 0.53 * scale


def test_what_cannot_be_meshed_is_told(monkeypatch):
    surface = ts.SurfaceMesh(X, T, "ball.obj")
    for wrong in (0.0, -1.0, 9.0, np.nan, "x", True):
        with pytest.raises(MeshError, match="ball.obj: edge_length must be a length above 0 and below the diagonal"):
            ts.tetrahedralize(surface, edge_length=wrong)
    with pytest.raises(MeshError, match="needs a SurfaceMesh"):
        ts.tetrahedralize(BALL)
    with monkeypatch.context() as patch:
        patch.setattr(surface_mesh, "find_spec", lambda name: None)
        with pytest.raises(MeshError, match=r"ball.obj: .* needs the package wildmeshing: pip install 'taisoft\[mesh\]'"):
            ts.tetrahedralize(surface)
    monkeypatch.setattr(surface_mesh, "find_spec", lambda name: True)
    say = "import sys; sys.exit('terminate called\\nout of luck\\n')"
    Popen = subprocess.Popen
    monkeypatch.setattr(safe_reading.subprocess, "Popen", lambda command, **more: Popen([command[0], "-c", say], **more))
    with pytest.raises(MeshError, match="ball.obj: the mesher failed: out of luck"):
        ts.tetrahedralize(surface)


def test_from_a_surface_to_a_mesh(tmp_path, capsys):
    pytest.importorskip("wildmeshing")
    surface, out = tmp_path / "ball.obj", tmp_path / "ball.msh"
    meshio.write(surface, meshio.Mesh(X, [("triangle", T)]))
    assert main(["info", str(surface)]) == 0
    shown = capsys.readouterr().out
    assert f"{len(X)} vertices, {len(T)} triangles, 1 piece; no tets" in shown and "taisoft tetrahedralize" in shown
    assert main(["tetrahedralize", str(surface), "--out", str(out), "--edge-length", "0.25"]) == 0
    assert "surface triangles" in capsys.readouterr().out
    assert ts.read_mesh(out).volumes.sum() == pytest.approx(VOLUME, rel=0.05)
    assert main(["scene", str(out), "--out", str(tmp_path / "ball.toml")]) == 0
    scene, solver = ts.read_scene(tmp_path / "ball.toml")
    body, height = scene.body("ball"), np.ptp(scene.body("ball").rest_positions[:, 1])
    assert (body.rest_positions + body.position)[:, 1].min() == pytest.approx(0.25 * height) and scene.obstacle("ground")
    assert 0.5 < body.material.young / (100 * 1000 * 9.81 * height) < 2 and solver == {"dt": 0.01, "seconds": 2.0, "fps": 50.0}
    capsys.readouterr()
    assert main(["tetrahedralize", str(surface), "--out", str(out)]) == 3
    assert "--overwrite replaces it" in capsys.readouterr().err
    for path, code in ((tmp_path / "ball.txt", 2), (tmp_path / "none" / "ball.msh", 3)):
        assert main(["tetrahedralize", str(surface), "--out", str(path)]) == code and not path.exists()
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_mesher(number, tmp_path, monkeypatch):
    pytest.importorskip("wildmeshing")
    surface, folder = tmp_path / "ball.obj", tmp_path / "temporary"
    meshio.write(surface, meshio.Mesh(X, [("triangle", T)]))
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    process = child("tetrahedralize", surface, "--out", tmp_path / "ball.msh", "--edge-length", "0.005")
    end = time.monotonic() + 60
    while not list(folder.glob("taisoft-*/surface.npz")) and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(number)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 128 + number and told == "taisoft: ended by a signal; nothing was written\n"
    assert not list(folder.iterdir()) and not (tmp_path / "ball.msh").exists()
