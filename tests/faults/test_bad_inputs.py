"""Bad input to `taisoft run`, through scene files:

* what cannot be simulated is refused before any output is written: status 2, and one sentence with file, item and rule;
* suspicious input runs, and the report lists it: mirrored, doubled and distant meshes, millimetres, nearly incompressible
  materials; names that USD does not allow are replaced.
"""

import contextlib
import io
import os

import meshio
import numpy as np
import pytest
from pxr import Usd

import taisoft as ts
from taisoft.checkpoint import read_checkpoint
from tests.cli.command import SHORT_OUTPUT, report, run, write

MESH = ts.box_mesh((2, 2, 2), (1, 1, 1), pattern="six")
X, TETS = np.array(MESH.vertices), np.array(MESH.tets)
SIZE = len(X)  # 27
BOX = 'shape = "box", cells = [2, 2, 2], size = [1, 1, 1]'
GROUND = '[obstacles.ground]\nshape = "half_space"\npoint = [0, -2, 0]\nnormal = [0, 1, 0]\n'


def scene_text(mesh=BOX, material="", head="", more="", solver="dt = 0.01"):
    return (
        f"{head}\n[solver]\nseconds = 0.02\nfps = 50\n{solver}\n[bodies.part]\nmaterial = {{ {material} }}\n"
        f"mesh = {{ {mesh} }}\n{more}"
    )


def write_mesh(path, points=X, cells=(("tetra", TETS),)):
    with contextlib.redirect_stdout(io.StringIO()):
        meshio.write(path, meshio.Mesh(points, list(cells)))


PLATE = {
    "mesh": 'shape = "box", cells = [9, 1, 9], size = [9, 4, 9]',
    "more": GROUND.replace("-2", "-1.99"),
    "solver": 'dt = 0.01\nintegrator = "symplectic_euler"',
}
SMALL_BUFFERS = "[collision]\ninitial_capacity = 64\n"
SCENES = {  # for further broken meshes see tests/mesh, for further bad fields tests/scene/test_toml_refusals.py
    "mesh": (scene_text('file = "inverted.vtk"'), "1 of 48 tets are inverted, the first is tet 7; fix_orientation"),
    "young_large": (scene_text(material="young = 1e300"), "young is 1e+300, too large for a 32-bit float"),
    "passwd": (scene_text('file = "/etc/passwd"'), "bodies.part.mesh.file must be one of .msh, .vtk"),
    "expression": (scene_text(material="""young = "__import__('os').system('touch CANARY')\""""), "young must be a number, not"),
    "overlap": (
        scene_text(head=SMALL_BUFFERS, **PLATE),
        "'part' and 'ground' overlap at the start, 0.01 m deep: move them apart",
    ),
    "many_cells": (scene_text(BOX.replace("[2, 2, 2]", "[3000, 3000, 3000]")), "give 135000000000 tets, about 5.4e+04 GB"),
    "buffers": (scene_text(head="[collision]\ninitial_capacity = 2000000000", more=GROUND), "fit"),
}


@pytest.mark.parametrize("name", SCENES)
def test_bad_scenes_are_refused(tmp_path, capsys, name):
    text, rule = SCENES[name]
    write_mesh(tmp_path / "inverted.vtk", cells=[("tetra", np.vstack([TETS[:7], TETS[7:8, [0, 1, 3, 2]], TETS[8:]]))])
    path = write(tmp_path / "scene.toml", text.replace("CANARY", str(tmp_path / "canary")))
    before = sorted(os.listdir(tmp_path))
    assert run(path, "--out", tmp_path / "out") == 2
    message = capsys.readouterr().err
    assert message.startswith("taisoft: ") and "scene.toml" in message and rule in message and message.count("\n") == 1, message
    assert sorted(os.listdir(tmp_path)) == before


def test_an_initial_overlap_can_be_allowed(tmp_path):
    """The contact buffer is too small, grows, and is listed in the report."""
    text = scene_text(head="allow_initial_overlap = true\n" + SMALL_BUFFERS, **PLATE)
    assert run(write(tmp_path / "scene.toml", text), "--out", tmp_path / "out", *SHORT_OUTPUT) == 0
    assert report(tmp_path / "out")["buffer_growths"] == {"contacts": 1}


def test_suspicious_input_is_reported(tmp_path):
    """One run of many bodies: its report, its USD names and its last state."""
    files = {
        "mirrored": (X, TETS[:, [0, 1, 3, 2]]),
        "doubled": (np.vstack([X, X + [1, 0, 0]]), np.vstack([TETS, TETS + SIZE])),
        "far": (0.1 * X + 1e6, TETS),
        "near": (0.1 * X, TETS),
        "millimetres": (100.0 * X, TETS),
    }
    text = 'contact_forces = false\n[solver]\ndt = 0.01\nseconds = 0.05\nfps = 100\nprecision = "f32"\n'
    for name, (points, tets) in files.items():
        write_mesh(tmp_path / f"{name}.vtu", points, [("tetra", tets)])
        text += f'[bodies.{name}]\nmaterial = {{ young = 1e5 }}\nmesh = {{ file = "{name}.vtu" }}\n'
    for name, side in (("near", -0.04), ("far", 1e6 - 0.04)):
        text += f"[[bodies.{name}.fix]]\nnodes = {{ half_space = {{ point = [{side}, 0, 0], normal = [1, 0, 0] }} }}\n"
    names = ["1 cube", "a/b", "a_b", "\u00fc", "x" * 300, "../../x"]
    for name in names:
        text += f'[bodies."{name}"]\nmaterial = {{ young = 1e5, poisson = 0.495 }}\ndilatation = "local"\nmesh = {{ {BOX} }}\n'
    assert run(write(tmp_path / "scene.toml", text), "--out", tmp_path / "out", "--no-frames") == 0
    found = report(tmp_path / "out")
    problems = "\n".join(found["problems"])
    for sentence in (
        "mirrored.vtu: all 48 tets are inverted (a mirrored mesh?); all have been flipped",
        "doubled.vtu: 9 vertices coincide with another one, the first is vertex 27 on vertex 18",
        "far.vtu: the mesh lies 1e+06 m from the origin",
        "body 'millimetres': 100 m long and 1e+09 kg, its own weight strains it by about 9.8; a wave crosses it in 10 s, "
        "explicit steps must stay below ",
        "body '1 cube': poisson = 0.495 is at least 0.45, where linear tets lock",
    ):
        assert sentence in problems
    pieces = {body["name"]: body["pieces"] for body in found["bodies"]}
    assert [name for name, n in pieces.items() if n == 2] == ["doubled"] and set(pieces) == {*files, *names}
    # the same cube 1e6 m away bends alike, up to the tolerance of Newton's method in single precision
    x = read_checkpoint(tmp_path / "out" / "checkpoint.npz").state["simulation"]["x"]
    starts = dict(zip(pieces, np.cumsum([0] + [body["nodes"] for body in found["bodies"]])))
    moves = [x[starts[name] : starts[name] + SIZE] - files[name][0] for name in ("near", "far")]
    assert 1e-4 < np.abs(moves[0]).max() < 0.05 and np.abs(moves[0] - moves[1]).max() < 1e-4 * np.abs(moves[0]).max()
    stage = Usd.Stage.Open(str(tmp_path / "out" / "scene.usdc"))
    prims = stage.GetPrimAtPath("/World").GetChildren()
    assert sorted(prim.GetCustomDataByKey("taisoft:name") for prim in prims) == sorted(pieces)
