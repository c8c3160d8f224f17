"""`taisoft run` takes a scene file as it takes the same scene in Python; what is bad leaves before any output; `taisoft scene`
writes one; the manual's example is one.
"""

import re

import pytest
from command import ROOT, SHORT_OUTPUT, report, run, write
from toml_scenes import BEAM_TOML, MESH, TURNED, data, read

import taisoft as ts
from taisoft.cli import main
from taisoft.cli.scene_file import load_scene


def test_a_run_of_a_scene_file_is_that_of_the_scene(tmp_path, beam):
    """The same steps, digit for digit, from a file written by hand and from one that `taisoft scene` has written."""
    assert main(["scene", str(beam), "--out", str(tmp_path / "written.toml")]) == 0
    hand = write(tmp_path / "hand.toml", BEAM_TOML)
    for path in (hand, tmp_path / "written.toml"):
        (scene, solver), (wanted, wanted_solver) = load_scene(str(path)), load_scene(str(beam))
        assert data(scene) == data(wanted) and solver == wanted_solver
    for path, out in ((beam, "python"), (hand, "toml")):
        assert run(path, "--out", tmp_path / out, "--set", "solver.dt=0.003", *SHORT_OUTPUT) == 0
    one, other = (tmp_path / out / "steps.csv" for out in ("python", "toml"))
    assert one.read_text() == other.read_text()
    assert report(tmp_path / "python")["settings"] == report(tmp_path / "toml")["settings"]


@pytest.mark.parametrize(
    "old, new, told",
    [
        ("young = 1e5", "young = -1", "bodies.beam.material.young must be greater than 0 Pa"),
        ("symplectic_euler", "simplectic_euler", "did you mean 'symplectic_euler'?"),
        ("seconds = 0.1", "seconds = 0.1\ndtt = 1", "solver.dtt is not known (did you mean dt?)"),
        ('shape = "box", cells = [4, 1, 1], size = [4, 2, 2]', 'file = "../a.msh"', "must lie inside"),
    ],
)
def test_bad_scene_files_leave_no_output(tmp_path, capsys, old, new, told):
    assert old in BEAM_TOML
    path = write(tmp_path / "bad.toml", BEAM_TOML.replace(old, new))
    assert run(path, "--out", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert told in error and error.startswith("taisoft: ") and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_allow_outside_is_an_option(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    ts.write_mesh(tmp_path / "a.msh", TURNED)
    path = write(tmp_path / "in" / "a.toml", MESH.format("../a.msh"))
    out = tmp_path / "b.toml"
    assert main(["scene", str(path), "--out", str(out)]) == 2
    assert "--allow-outside" in capsys.readouterr().err and not out.exists()
    assert main(["scene", str(path), "--out", str(out), "--allow-outside"]) == 0
    assert capsys.readouterr().out.splitlines() == [str(out), str(tmp_path / "b_mesh0.msh")]
    assert main(["scene", str(path), "--out", str(out), "--allow-outside"]) == 3


def test_the_scene_file_of_the_manual(tmp_path):
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "files.md").read_text(), re.DOTALL)
    assert len(blocks) == 1
    scene, solver = read(tmp_path, blocks[0])
    assert scene.bodies and scene.obstacles and solver
