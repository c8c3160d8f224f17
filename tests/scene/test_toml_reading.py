"""Reading scene files: selectors include their boundary; mesh files must lie in the file's folder, links resolved, unless
`allow_outside` is given (test_toml_refusals.py); a random edit of a file is read or refused with SceneError or MeshError.
"""

import os
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.scene.toml_values import toml_of
from tests.cli.command import write
from tests.scene.toml_scenes import MESH, TEXT, TURNED, floats, read


@pytest.mark.parametrize(
    "nodes, expected",
    [
        ('"all"', list(range(12))),
        ("{ box = { min = [-1, -0.5, -9], max = [0, -0.5, 9] } }", [0, 1, 4, 5]),
        ("{ half_space = { point = [0, 0, 0], normal = [1, 0, 0] } }", list(range(8))),
        ("{ half_space = { point = [0.5, 0, 0], normal = [-7, 0, 0] } }", [8, 9, 10, 11]),
    ],
)
def test_selectors_include_their_boundary(tmp_path, nodes, expected):
    text = TEXT.replace('nodes = "all"', f"nodes = {nodes}")
    body = read(tmp_path, text)[0].body("beam")
    assert body.forces[0].nodes.tolist() == expected
    assert body.constraints[0].nodes.tolist() == [0, 1, 2, 3] and body.constraints[0].axes.tolist() == [True, False, True]
    below = body.mesh.vertices[body.mesh.surface].mean(axis=1)[:, 1] <= -0.49
    assert body.tractions[0].triangles.tolist() == np.flatnonzero(below).tolist()


def test_encodings_of_scene_files(tmp_path, monkeypatch):
    """A byte-order mark and Windows line ends change nothing; UTF-16 is refused with advice; mesh files are beside the file."""
    text = '[bodies."µ"]\nmaterial = {}\nmesh = { file = "meshes/a.msh", weld = 0, fix_orientation = true }\n'
    (tmp_path / "meshes").mkdir()
    ts.write_mesh(tmp_path / "meshes" / "a.msh", TURNED)
    monkeypatch.chdir("/")
    for content in (text.encode(), b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode()):
        (tmp_path / "scene.toml").write_bytes(content)
        body = ts.read_scene(tmp_path / "scene.toml")[0].bodies[0]
        assert body.name == "µ" and np.array_equal(body.rest_positions, TURNED.vertices)
    (tmp_path / "scene.toml").write_text(text, encoding="utf-16")
    with pytest.raises(ts.SceneError, match="scene.toml: the file is UTF-16 text; save it as UTF-8$"):
        ts.read_scene(tmp_path / "scene.toml")


@pytest.mark.parametrize(
    "name, message",
    [
        ("gone.msh", "gone.msh: there is no such file"),
        ("../out.msh", "must lie inside the scene file's folder, without '..'"),
        ("OUT/out.msh", "must lie inside"),
        ("link.msh", "must lie inside"),
        ("pair.ele", "must lie inside"),
        ("a.xdmf", "other formats can name further files; --allow-outside (allow_outside=True) lifts this"),
        ("secret.msh", "not a supported mesh"),  # read by a child process
        ("secret.mesh", "not a supported mesh: expected MeshVersionFormatted"),
        ("secret.bdf", "line 1: not a supported mesh: expected the name of an entry, such as GRID"),
        ("secret.ply", "line 2: expected format ascii or binary 1.0"),
    ],
)
def test_mesh_files_must_lie_in_the_folder_of_the_scene_file(tmp_path, name, message):
    outside, inside = tmp_path / "out", tmp_path / "in"
    outside.mkdir()
    inside.mkdir()
    ts.write_mesh(outside / "out.msh", TURNED)
    ts.write_mesh(inside / "a.msh", TURNED)
    (outside / "pair.node").write_text("secret")
    (inside / "pair.ele").write_text("1 4 0\n1 1 2 3 4\n")
    os.symlink(outside / "out.msh", inside / "link.msh")
    os.symlink(outside / "pair.node", inside / "pair.node")
    if name.startswith("secret"):
        write(inside / name, ("ply\n" if "ply" in name else "") + "'pass\"' passphrase\nend_header\n")
    text = MESH.format(name.replace("OUT", str(outside)))
    text = text.replace("[bodies", "[rigid_bodies").replace("material = {}\n", "") if name.endswith(".ply") else text
    with pytest.raises((ts.SceneError, ts.MeshError)) as caught:
        read(inside, text)
    found = str(caught.value)
    assert message in found and found.startswith(f"{inside / 'scene.toml'}: {text[1 : text.index(']')]}.mesh")
    assert "passphrase" not in found and "secret" not in found.replace(name, "")


def places(values, at=()):
    """Paths of keys to all values of nested dicts and lists."""
    yield at
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in items:
        yield from places(value, (*at, key))


PLACES = [place for place in places(tomllib.loads(TEXT)) if place]
# no number that gives a large but valid mesh
scalars = st.integers(-3, 3) | st.integers(2**40) | floats() | st.text(max_size=5) | st.booleans()
scalars |= st.sampled_from(["1e5 Pa", "beam", "box", "all", "none", "rubber", "../a.msh", "__import__('os')"])
junk = scalars | st.lists(scalars, max_size=4) | st.lists(st.lists(scalars, max_size=3), max_size=3)
junk |= st.dictionaries(st.sampled_from(["shape", "file", "min", "box", "young", "a"]), scalars, max_size=2)


def read_or_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "edited.toml"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scene, solver = ts.read_scene(path)
        except (ts.SceneError, ts.MeshError) as error:
            text = str(error)
            assert text.startswith(str(path)) and text.count(str(path)) == 1 and "\n" not in text and len(text) < 1000
        else:
            assert isinstance(scene, ts.Scene) and isinstance(solver, dict)


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(PLACES), st.sampled_from(["replace", "remove", "rename"]), junk, st.text(max_size=8))
def test_random_edits_are_read_or_refused(tmp_path, place, action, value, name):
    tables = tomllib.loads(TEXT)
    parent = tables
    for key in place[:-1]:
        parent = parent[key]
    if action == "replace":
        parent[place[-1]] = value
    elif action == "remove" or isinstance(parent, list):
        del parent[place[-1]]
    else:
        parent[name] = parent.pop(place[-1])
    try:
        text = toml_of(tables)
    except (AttributeError, KeyError, TypeError):  # the writer cannot write a table in a list of other values
        return
    read_or_refused(tmp_path, text.encode())
