"""Bad input to `taisoft run`, through scene files:

* what cannot be simulated is refused before any output is written: status 2, and one sentence with file, item and rule;
* suspicious input runs, and the report lists it: mirrored, doubled, joined, distant and disconnected meshes, millimetres, nearly
  incompressible materials; names that USD does not allow are replaced.
"""

import contextlib
import io
import os
import random

import meshio
import numpy as np
import pytest

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
    options = {"file_format": "gmsh", "binary": False} if path.suffix == ".msh" else {}
    with contextlib.redirect_stdout(io.StringIO()):
        meshio.write(path, meshio.Mesh(points, list(cells)), **options)


def refusal(tmp_path, capsys, text, *arguments, scene="scene.toml") -> str:
    """Return the one sentence that refuses a scene, after checking that nothing was written."""
    path = write(tmp_path / scene, text)
    before = sorted(os.listdir(tmp_path))
    assert run(path, "--out", tmp_path / "out", *arguments) == 2
    message = capsys.readouterr().err
    assert sorted(os.listdir(tmp_path)) == before and message.startswith("taisoft: ") and message.count("\n") == 1, message
    return message


# --- meshes -----------------------------------------------------------------------------------------------------------


def with_vertex(value):
    points = X.copy()
    points[17, 0] = value
    return {"points": points}


def with_tet(tet):
    return {"cells": [("tetra", np.vstack([TETS[:5], [tet], TETS[5:]]))]}


FLAT = np.vstack([X, np.array([(5, 0, 0), (6, 0, 0), (5, 1, 0), (6, 1, 1e-10)])])
CROWDED = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.3, 0.3, 1), (0.3, 0.3, -1), (0.3, 0.3, 2)])
HEXAHEDRON = ("hexahedron", np.array([[0, 9, 12, 3, 1, 10, 13, 4]]))
MESHES = {
    "nan": (with_vertex(np.nan), "vertex 17 coordinate 0 is not finite"),
    "inf": (with_vertex(np.inf), "vertex 17 coordinate 0 is not finite"),
    "large": (with_vertex(1e39), "vertex 17 coordinate 0 is 1e+39 m, too large for a 32-bit float"),
    "beyond": (with_tet([0, 1, 3, SIZE]), "tet 5: vertex 27 does not exist (27 vertices, counted from 0)"),
    "negative": (with_tet([0, 1, 3, -1]), "tet 5: vertex -1 does not exist"),
    "from_one": ({"cells": [("tetra", TETS + 1)]}, "they seem to count from 1, subtract 1"),
    "inverted": (
        {"cells": [("tetra", np.vstack([TETS[:7], TETS[7:8, [0, 1, 3, 2]], TETS[8:]]))]},
        "1 of 48 tets are inverted, the first is tet 7; fix_orientation",
    ),
    "flat": ({"points": FLAT, "cells": [("tetra", np.vstack([TETS, [[27, 28, 29, 30]]]))]}, "tet 48 has no volume"),
    "no_tets": ({"cells": []}, "no tetrahedra; "),
    "nothing": ({"points": np.zeros((0, 3)), "cells": []}, "no tetrahedra; "),
    "surface": ({"cells": [("triangle", MESH.surface)]}, "no tetrahedra; 48 triangles found; make a volume mesh first"),
    "quads": ({"cells": [("tetra", TETS), ("quad", np.array([[0, 1, 4, 3]]))]}, "but the file holds 1 quad"),
    "hexahedra": ({"cells": [HEXAHEDRON]}, "but the file holds 1 hexahedron"),
    "three": (
        {"points": CROWDED, "cells": [("tetra", np.array([[0, 1, 2, 3], [0, 2, 1, 4], [0, 1, 2, 5]]))]},
        "face (0, 1, 2) is shared by 3 tets (0, 1, 2)",
    ),
}


@pytest.mark.parametrize("name", MESHES)
def test_broken_meshes_are_refused(tmp_path, capsys, name):
    parts, rule = MESHES[name]
    write_mesh(tmp_path / "part.vtk", **parts)
    message = refusal(tmp_path, capsys, scene_text('file = "part.vtk"'))
    assert f"scene.toml: bodies.part.mesh: {tmp_path}/part.vtk: " in message and rule in message


@pytest.mark.parametrize("name", ["nan", "beyond", "negative", "inverted"])
def test_broken_gmsh_files_are_refused(tmp_path, capsys, name):
    """Gmsh tets refer to nodes by tags, which start at 1 here."""
    parts, rule = MESHES[name]
    write_mesh(tmp_path / "part.msh", **parts)
    rule = {"beyond": "tet 5: node 28 does not exist (27 nodes)", "negative": "tet 5: node 0 does not exist"}.get(name, rule)
    assert rule in refusal(tmp_path, capsys, scene_text('file = "part.msh"'))


def test_other_files_are_no_meshes(tmp_path, capsys):
    """Empty, truncated, random, and of a format without tets."""
    path, text = tmp_path / "part.msh", scene_text('file = "part.msh"')
    write_mesh(path)
    complete = path.read_bytes()
    for content, rule in (
        (b"", "the file is empty"),
        (complete[: complete.index(b"$Elements") + 300], "line 86: the file ends inside $Elements, before $EndElements"),
        (random.Random(0).randbytes(500), "not a supported mesh"),
    ):
        path.write_bytes(content)
        assert f"part.msh: {rule}" in refusal(tmp_path, capsys, text)
    write_mesh(tmp_path / "part.obj", cells=[("triangle", MESH.surface)])
    text = scene_text('file = "part.obj"')
    assert "no tetrahedra; 48 triangles found" in refusal(tmp_path, capsys, text, "--allow-outside")


@pytest.mark.parametrize("ending", [".msh", ".vtk", ".vtu", ".node"])
def test_messages_never_quote_a_file(tmp_path, capsys, ending):
    """A link or --allow-outside could point to any file."""
    secrets = [
        "root:passphrase:17",
        "passphrase 0 1\n2 passphrase",
        "passphrase",
        "1 3 0 0\n0 passphrase 0 0\n",
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\npassphrase\n",
        "<VTKFile><passphrase/></VTKFile>",
        "# vtk DataFile Version 4.2\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS passphrase 1",
        "# vtk DataFile Version 4.2\nx\nASCII\npassphrase",
        "MeshVersionFormatted 1\nDimension 3\nVertices\npassphrase",
        "# vtk DataFile Version 5.1\nx\npassphrase",
        "MeshVersionFormatted 1\nDimension passphrase",
    ]
    for secret in secrets:
        (tmp_path / f"part{ending}").write_text(secret)
        message = refusal(tmp_path, capsys, scene_text(f'file = "part{ending}"'), "--allow-outside")
        assert "passphrase" not in message, message


# --- numbers, keys and names ------------------------------------------------------------------------------------------

SCENES = {  # for further bad fields see test_scene_toml_refusals.py
    "margin": (
        scene_text(head="[collision]\nmargin = 1e-3", mesh=BOX.replace("[1, 1, 1]", "[1e-6, 1e-6, 1e-6]"), more=GROUND),
        "margin = 0.001 m is larger than the mean surface edge of body 'part', 5.69e-07 m",
    ),
    "poisson_below": (scene_text(material="poisson = -1"), "poisson must lie in the open interval (-1, 0.5), not -1"),
    "young_large": (scene_text(material="young = 1e300"), "young is 1e+300, too large for a 32-bit float"),
    "density_small": (scene_text(material="density = 1e-300"), "density is 1e-300, too small for a 32-bit float"),
    "dt_nan": (scene_text(solver="dt = nan"), "solver.dt must be finite, not nan"),
    "dt_small": (scene_text(solver="dt = 1e-30"), "in steps of 1e-30 s are more than 4.5e+15 steps: the run would never end"),
    "endless": (scene_text().replace("seconds = 0.02", "seconds = 1e30"), "the run would never end"),
    "friction_nan": (scene_text(more=GROUND + "friction = nan"), "obstacles.ground.friction must be finite, not nan"),
    "tolerance_below": (scene_text(solver="contact_tolerance = -1"), "solver.contact_tolerance must be greater than 0, not -1"),
    "unknown_setting": (scene_text(solver="max_iterations = 0"), "solver.max_iterations is not known"),
    "unstable": (
        scene_text(solver='dt = 0.01\nintegrator = "symplectic_euler"', material="young = 1e8"),
        "dt = 0.01 s is above the estimated stability limit of 0.000844 s of symplectic_euler: take a smaller dt",
    ),
    "gravity_large": (scene_text(head="gravity = [0, 1e300, 0]"), "gravity: entry [1] is 1e+300, too large for a 32-bit float"),
    "gone": (scene_text('file = "gone.msh"'), "gone.msh: there is no such file"),
    "kind": (scene_text().replace("{ shape", "7 # {"), "bodies.part.mesh must be a table, not 7"),
    "outside": (scene_text('file = "../../part.msh"'), "must lie inside the scene file's folder, without '..'"),
    "passwd": (scene_text('file = "/etc/passwd"'), "bodies.part.mesh.file must be one of .msh, .vtk"),
    "expression": (scene_text(material="""young = "__import__('os').system('touch CANARY')\""""), "young must be a number, not"),
    "selector": (scene_text(more="""[[bodies.part.fix]]\nnodes = "open('CANARY', 'w')"\n"""), 'nodes must be "all", a list of'),
    "yaml": ("!!python/object/apply:os.system ['touch CANARY']\n", "scene.toml, line 1: Invalid statement"),
    "many_cells": (scene_text(BOX.replace("[2, 2, 2]", "[3000, 3000, 3000]")), "give 135000000000 tets, about 5.4e+04 GB"),
    "buffers": (scene_text(head="[collision]\ninitial_capacity = 2000000000", more=GROUND), "fit"),
}


@pytest.mark.parametrize("name", SCENES)
def test_bad_scenes_are_refused(tmp_path, capsys, name):
    text, rule = SCENES[name]
    message = refusal(tmp_path, capsys, text.replace("CANARY", str(tmp_path / "canary")))
    assert "scene.toml" in message and rule in message and not (tmp_path / "canary").exists()


def test_other_files_are_no_scenes(tmp_path, capsys):
    text = f"!!python/object/apply:os.system ['touch {tmp_path / 'canary'}']\n"
    assert "neither a demo nor a .toml or .py file" in refusal(tmp_path, capsys, text, scene="scene.yaml")
    assert not (tmp_path / "canary").exists()


def test_too_many_steps_are_refused(tmp_path, capsys):
    """Also from options, and by the API."""
    scene = ts.read_scene(write(tmp_path / "a.toml", scene_text()))[0]
    assert "the run would never end" in refusal(tmp_path, capsys, scene_text(), "--seconds", "1e30")
    assert "the run would never end" in refusal(tmp_path, capsys, scene_text(), "--fps", "1e25")
    with ts.Simulator(scene) as sim, pytest.raises(ts.SimulationError, match="the run would never end"):
        sim.run(1e30, fps=None)


PLATE = {
    "mesh": 'shape = "box", cells = [9, 1, 9], size = [9, 4, 9]',
    "more": GROUND.replace("-2", "-1.99"),
    "solver": 'dt = 0.01\nintegrator = "symplectic_euler"',
}
SMALL_BUFFERS = "[collision]\ninitial_capacity = 64\n"


def test_an_initial_overlap_is_refused(tmp_path, capsys):
    message = refusal(tmp_path, capsys, scene_text(head=SMALL_BUFFERS, **PLATE))
    assert f"{tmp_path}/scene.toml: 'part' and 'ground' overlap at the start, 0.01 m deep: move them apart" in message


# --- suspicious input -------------------------------------------------------------------------------------------


def test_an_initial_overlap_can_be_allowed(tmp_path):
    """The contact buffer is too small, grows, and is listed in the report."""
    text = scene_text(head="allow_initial_overlap = true\n" + SMALL_BUFFERS, **PLATE)
    assert run(write(tmp_path / "scene.toml", text), "--out", tmp_path / "out", *SHORT_OUTPUT) == 0
    assert report(tmp_path / "out")["buffer_growths"] == {"contacts": 1}


def test_suspicious_input_is_reported(tmp_path):
    """One run of many bodies: its report, its USD names and its last state."""
    twice = np.vstack([TETS, TETS + SIZE])
    files = {
        "mirrored": (X, TETS[:, [0, 1, 3, 2]]),
        "doubled": (np.vstack([X, X + [1, 0, 0]]), twice),
        "corner": (np.vstack([X, X + 1.0]), twice),
        "edge": (np.vstack([X, X + [1, 1, 0]]), twice),
        "two": (np.vstack([X, X + [3, 0, 0]]), twice),
        "far": (0.1 * X + 1e6, TETS),
        "near": (0.1 * X, TETS),
        "millimetres": (100.0 * X, TETS),
        "turned": (X, np.vstack([TETS[:-1], TETS[-1:, [0, 1, 3, 2]]])),
    }
    options = {"corner": ", weld = 0", "edge": ", weld = 0", "turned": ", fix_orientation = true"}
    text = 'contact_forces = false\n[solver]\ndt = 0.01\nseconds = 0.05\nfps = 100\nprecision = "f32"\n'
    for name, (points, tets) in files.items():
        write_mesh(tmp_path / f"{name}.vtu", points, [("tetra", tets)])
        text += f'[bodies.{name}]\nmaterial = {{ young = 1e5 }}\nmesh = {{ file = "{name}.vtu"{options.get(name, "")} }}\n'
    for name, side in (("near", -0.04), ("far", 1e6 - 0.04)):
        text += f"[[bodies.{name}.fix]]\nnodes = {{ half_space = {{ point = [{side}, 0, 0], normal = [1, 0, 0] }} }}\n"
    names = ["1 cube", "a/b", "a_b", "\u00fc", "x" * 300, "../../x"]
    for name in names:
        text += f'[bodies."{name}"]\nmaterial = {{ young = 1e5, poisson = 0.495 }}\nmesh = {{ {BOX} }}\n'
    assert run(write(tmp_path / "scene.toml", text), "--out", tmp_path / "out", "--no-frames") == 0
    found = report(tmp_path / "out")
    problems = "\n".join(found["problems"])
    for sentence in (
        "mirrored.vtu: all 48 tets are inverted (a mirrored mesh?); all have been flipped",
        "doubled.vtu: 9 vertices coincide with another one, the first is vertex 27 on vertex 18",
        "corner.vtu: parts are joined at a vertex only at 1 vertices: 26",
        "edge.vtu: parts are joined at an edge only at 2 edges, the first is (24, 25)",
        "turned.vtu: 1 of 48 inverted tets have been flipped: 47",
        "far.vtu: the mesh lies 1e+06 m from the origin",
        "body 'millimetres': 100 m long and 1e+09 kg, its own weight strains it by about 9.8; a wave crosses it in 10 s, "
        "explicit steps must stay below ",
        "body '1 cube': poisson = 0.495 is above 0.49, where linear tets lock",
    ):
        assert sentence in problems
    pieces = {body["name"]: body["pieces"] for body in found["bodies"]}
    assert [name for name, n in pieces.items() if n == 2] == ["doubled", "two"] and set(pieces) == {*files, *names}
    assert_far_body_bends_alike(tmp_path / "out", files, {body["name"]: body["nodes"] for body in found["bodies"]})
    assert_prims_have_names(tmp_path / "out" / "scene.usdc", pieces)


def assert_far_body_bends_alike(out, files, sizes):
    """The same cube 1e6 m away bends alike, up to the tolerance of Newton's method in single precision."""
    x = read_checkpoint(out / "checkpoint.npz").state["simulation"]["x"]
    starts = dict(zip(sizes, np.cumsum([0, *sizes.values()])))
    moves = [x[starts[name] : starts[name] + SIZE] - files[name][0] for name in ("near", "far")]
    assert 1e-4 < np.abs(moves[0]).max() < 0.05 and np.abs(moves[0] - moves[1]).max() < 1e-4 * np.abs(moves[0]).max()


def assert_prims_have_names(path, names):
    """Every body has its own prim, and keeps its name as custom data."""
    from pxr import Usd

    stage = Usd.Stage.Open(str(path))
    kept = [prim.GetCustomDataByKey("taisoft:name") for prim in stage.GetPrimAtPath("/World").GetChildren()]
    assert sorted(kept) == sorted(names)
