"""Scene files on the command line: `taisoft run` of one equals the same scene in Python, bad ones are refused before any output,
`taisoft scene` writes one, and the manual's example is valid.
"""

import re

import pytest

import taisoft as ts
from taisoft.cli import main
from taisoft.cli.scene_file import load_scene
from tests.cli.command import ROOT, SHORT_OUTPUT, report, run, write
from tests.scene.toml_scenes import BEAM_TOML, MESH, TURNED, data, read


def test_a_scene_file_runs_like_the_same_scene_in_python(tmp_path, beam):
    """With identical steps; a file written by hand and one written by `taisoft scene` hold the same scene."""
    assert main(["scene", str(beam), "--out", str(tmp_path / "written.toml")]) == 0
    manual = write(tmp_path / "manual.toml", BEAM_TOML)
    for path in (manual, tmp_path / "written.toml"):
        (scene, solver), (expected, expected_solver) = load_scene(str(path)), load_scene(str(beam))
        assert data(scene) == data(expected) and solver == expected_solver
    for path, out in ((beam, "python"), (manual, "toml")):
        assert run(path, "--out", tmp_path / out, "--set", "solver.dt=0.003", *SHORT_OUTPUT) == 0
    steps = [(tmp_path / out / "steps.csv").read_text() for out in ("python", "toml")]
    assert steps[0] == steps[1]
    assert report(tmp_path / "python")["settings"] == report(tmp_path / "toml")["settings"]


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("young = 1e5", "young = -1", "bodies.beam.material.young must be greater than 0 Pa"),
        ("symplectic_euler", "simplectic_euler", "did you mean 'symplectic_euler'?"),
        ("seconds = 0.1", "seconds = 0.1\ndtt = 1", "solver.dtt is not known (did you mean dt?)"),
        ('shape = "box", cells = [4, 1, 1], size = [4, 2, 2]', 'file = "../a.msh"', "must lie inside"),
    ],
)
def test_bad_scene_files_leave_no_output(tmp_path, capsys, old, new, message):
    assert old in BEAM_TOML
    path = write(tmp_path / "bad.toml", BEAM_TOML.replace(old, new))
    assert run(path, "--out", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("taisoft: ") and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_allow_outside_allows_meshes_of_other_folders(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    ts.write_mesh(tmp_path / "a.msh", TURNED)
    path = write(tmp_path / "in" / "a.toml", MESH.format("../a.msh"))
    out = tmp_path / "b.toml"
    assert main(["scene", str(path), "--out", str(out)]) == 2
    assert "--allow-outside" in capsys.readouterr().err and not out.exists()
    assert main(["scene", str(path), "--out", str(out), "--allow-outside"]) == 0
    assert capsys.readouterr().out.splitlines() == [str(out), str(tmp_path / "b_mesh0.msh")]
    assert main(["scene", str(path), "--out", str(out), "--allow-outside"]) == 3


def test_the_scene_file_of_the_manual_is_valid(tmp_path):
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "files.md").read_text(), re.DOTALL)
    assert len(blocks) == 1
    scene, solver = read(tmp_path, blocks[0])
    assert scene.bodies and scene.obstacles and solver


def test_the_order_of_a_scene_for_a_mesh(tmp_path, capsys):
    """--order sets it, a scene of its own refuses it, and an order edited in the file needs no other edit."""
    ts.write_mesh(tmp_path / "a.msh", ts.box_mesh((2, 1, 1), (2, 1, 1)))
    out = tmp_path / "a.toml"
    assert main(["scene", str(tmp_path / "a.msh"), "--out", str(out)]) == 0
    assert "quadrature_degree" not in out.read_text() and ts.read_scene(out)[0].bodies[0].order == 1
    write(out, out.read_text().replace("order = 1", "order = 2"))
    assert ts.read_scene(out)[0].bodies[0].quadrature_degree == 2
    assert main(["scene", str(tmp_path / "a.msh"), "--out", str(out), "--overwrite", "--order", "2"]) == 0
    assert ts.read_scene(out)[0].bodies[0].order == 2
    capsys.readouterr()
    assert main(["scene", str(out), "--out", str(tmp_path / "b.toml"), "--order", "2"]) == 2
    assert "--order is for a mesh" in capsys.readouterr().err
