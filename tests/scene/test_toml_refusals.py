"""Bad scene files are refused in one sentence with file, place and rule, before any output, and no code in a file is run; scene
files on the command line: `taisoft scene` writes one that holds the same scene, and the manual's example is valid.
"""

import re

import pytest

import taisoft as ts
from taisoft.cli import main
from taisoft.cli.scene_file import load_scene
from tests.cli.command import ROOT, run, write
from tests.scene.toml_scenes import BEAM_TOML, MESH, TEXT, TURNED, data, read

BAD = [
    ("young = 1e5", "youngs_modulu = 1e5", "materials.rubber.youngs_modulu is not known (did you mean young?)"),
    ("young = 1e5", 'young = "1e5 Pa"', "materials.rubber.young must be a number, not '1e5 Pa'"),
    ("young = 1e5", 'law = "neo_hookean"', "materials.rubber.law must be one of"),
    ("density = 500", "density = 1979-05-27", "materials.rubber.density is a date or a time"),
    ('material = "rubber"', 'material = "ruber"', "beam.material 'ruber' is not among the materials (did you mean rubber?)"),
    ('material = "rubber"', "material = 3", "bodies.beam.material must be a table, not 3"),
    ('material = "rubber"', "", "bodies.beam.material is missing"),
    ("dt = 0.01", "dtt = 1", "solver.dtt is not known (did you mean dt?); there are dt, integrator"),
    ("dt = 0.01", "allow_unstable = 1", "solver.allow_unstable must be True or False, not 1"),
    ("dt = 0.01", 'arch = "gpu"', "solver.arch must be one of cpu, cuda, not 'gpu'"),
    ('"implicit_euler"', "[1]", "solver.integrator must be a text, not [1]"),
    ("1e-4", "0", "solver.newton_tolerance must be greater than 0"),
    ("[0, -9.81, 0]", "[0, -9.81]", "gravity must have shape (3,), not (2,)"),
    ("[0, -9.81, 0]", f"[0, {10**30}, 0]", "gravity[1] is a whole number of more than 64 bits"),
    ("[0, -9.81, 0]", '[0, "-9.81", 0]', "gravity[1] must be a number, not '-9.81'"),
    ("[0, -9.81, 0]", "[0, -inf, 0]", "gravity[1] must be finite, not -inf"),
    ("gravity", "include = 'a.toml'\ngravity", "include is not known"),
    ("nodes = [8, 9]", "nodes = [8.0]", "bodies.beam.move[0].nodes must be a list of whole numbers"),
    ('between = ["beam", "ground"]', 'between = ["beam"]', "contacts[0].between must be a list of two names"),
    ("margin = 0.01", "margin = -1", "collision.margin must be at least 0 m"),
    ("[bodies.beam]", "[bodies.beam]\nordre = 2", "bodies.beam.ordre is not known (did you mean order?)"),
    ("order = 2", "order = 3", 'bodies."the ball".order must be 1 or 2, not 3'),
    ('[bodies."the ball"]', "[bodies.beam]", "Cannot declare"),
    ('[bodies."the ball"]', '[bodies.""]', 'bodies."": body name must be a text that is not empty'),
    ('shape = "box"', 'shape = "bax"', "bodies.beam.mesh.shape must be one of box, sheet, ball, not 'bax'; did you mean 'box'?"),
    ('shape = "box"', 'file = "box"', "bodies.beam.mesh.cells is not known"),
    ("cells = [2, 1, 1]", "cells = [2, 1]", "bodies.beam.mesh.cells must be three positive integers"),
    ("radius = 0.4", "radius = 0.4, pattern = 'six'", 'bodies."the ball".mesh.pattern is not known'),
    ("min = [-1,", "min = [1,", "bodies.beam.fix[0].nodes.box.min must not exceed max"),
    ("max = [-1, 1, 1]", "maxx = 1", "bodies.beam.fix[0].nodes.box.maxx is not known (did you mean max?)"),
    ("min = [-1, -1", "min = [-2, -1", ""),
    ("max = [-1, 1, 1]", "max = [-1, 1, -1]", "bodies.beam.fix[0]: no node is chosen"),
    ("[[bodies.beam.fix]]", "[bodies.beam.fix]", "bodies.beam.fix must be a list of tables [[bodies.beam.fix]], not a table"),
    ("nodes = [8, 9]", "nodes = [8, 12]", "bodies.beam.move[0]: node 12 does not exist"),
    ("nodes = [8, 9]", 'nodes = "X[:, 0] < 0"', 'bodies.beam.move[0].nodes must be "all", a list of ids'),
    ("nodes = [8, 9]", "", "bodies.beam.move[0].nodes is missing"),
    ('axes = "y"', 'axes = "x"', ""),
    ('nodes = [8, 9]\naxes = "y"', 'nodes = [1]\naxes = "x"', "bodies.beam.move[0]: node 1 is already fixed along x"),
    ("times = [0, 1]", "times = [0]", "bodies.beam.move[0].path.translations must have shape (1, 3), not (2, 3)"),
    ("release = true", "release = 1", "bodies.beam.move[0].path.release must be True or False"),
    ("traction = [0, 2000, 0]", "traction = 5", "bodies.beam.traction[0].traction must have shape (3,)"),
    ('"half_space"', '"plane"', "obstacles.ground.shape must be one of half_space, sphere, box, capsule, mesh"),
    ('shape = "half_space"', "", "obstacles.ground.shape is missing"),
    ("pivot = [5, 0, 0]", "release = true", "obstacles.pin: release is for nodes"),
    ('between = ["beam", "ground"]', 'between = ["beem", "ground"]', "contacts[0]: no body or obstacle is called 'beem'"),
    ("[[contacts]]", '[[contacts]]\nbetween = ["ground", "beam"]\nfriction = 1\n[[contacts]]', "between names 'beam' and"),
    ("dt = 0.01", "dt = 0.01 s", ", line 9: "),
    ("gravity", '"\x01"', ", line 2: Illegal character"),
    ("gravity", "gravity = [0, 0, 0]\ngravity", ", line 3: Cannot overwrite a value"),
    ("young = 1e5", f"young = 1{'0' * 5000}", "digits"),
    ("young = 1e5", f"young = {'[' * 5000}", "nested too deeply"),
]


@pytest.mark.parametrize("old, new, refusal", BAD, ids=[f"{i}-{ascii(new[:30])}" for i, (_, new, _) in enumerate(BAD)])
def test_bad_entries_are_refused(tmp_path, old, new, refusal):
    assert TEXT.count(old) >= 1
    text = TEXT.replace(old, new, 1)
    if not refusal:  # a valid change, which shows that the invalid ones beside it are the cause
        assert read(tmp_path, text)
        return
    with pytest.raises((ts.SceneError, ts.MeshError)) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert refusal in message and message.startswith(str(tmp_path / "scene.toml")) and "\n" not in message
    assert re.match(rf"{re.escape(str(tmp_path / 'scene.toml'))}(: |, line )", message) and len(message) < 600


def test_bad_files_are_refused(tmp_path):
    for name, content, message in [
        ("gone.toml", None, "No such file"),
        ("empty.toml", b"", "bodies is missing"),
        ("none.toml", b"[bodies]", "bodies must hold a table [bodies.NAME]"),
        ("list.toml", b"bodies = []", "bodies must be tables [bodies.NAME], not a list of 0"),
        ("latin.toml", "# ü".encode("latin-1"), "byte 2 is not UTF-8"),
        ("yaml.toml", b"!!python/object/apply:os.system ['touch canary']", "line 1"),
    ]:
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ts.SceneError) as caught:
            ts.read_scene(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name)) and message in str(caught.value)
    with pytest.raises(ts.SceneError, match="Is a directory"):
        ts.read_scene(tmp_path)


# --- command line ----------------------------------------------------------------------------------------------------


def test_a_scene_file_holds_the_same_scene_as_python(tmp_path, beam):
    """One written by hand, and one written by `taisoft scene`."""
    assert main(["scene", str(beam), "--out", str(tmp_path / "written.toml")]) == 0
    for path in (write(tmp_path / "manual.toml", BEAM_TOML), tmp_path / "written.toml"):
        (scene, solver), (expected, expected_solver) = load_scene(str(path)), load_scene(str(beam))
        assert data(scene) == data(expected) and solver == expected_solver


def test_bad_scene_files_leave_no_output(tmp_path, capsys):
    for old, new, message in (
        ("young = 1e5", "young = -1", "bodies.beam.material.young must be greater than 0 Pa"),
        ("symplectic_euler", "simplectic_euler", "did you mean 'symplectic_euler'?"),
    ):
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
