"""Reading scene files:

* selectors choose what they say, boundary included;
* what is left out is as in Python;
* however many tables a file has, each is looked at once.
"""

import numpy as np
import pytest
from toml_scenes import TEXT, data, read

import taisoft as ts
from taisoft.scene.tables import Table


@pytest.mark.parametrize(
    "nodes, chosen",
    [
        ('"all"', list(range(12))),
        ("[9, 3]", [9, 3]),
        ("{ box = { min = [-1, -0.5, -9], max = [0, -0.5, 9] } }", [0, 1, 4, 5]),
        ("{ half_space = { point = [0, 0, 0], normal = [1, 0, 0] } }", list(range(8))),
        ("{ half_space = { point = [0.5, 0, 0], normal = [-7, 0, 0] } }", [8, 9, 10, 11]),
    ],
)
def test_selectors(tmp_path, nodes, chosen):
    text = TEXT.replace('nodes = "all"', f"nodes = {nodes}")
    body = read(tmp_path, text)[0].body("beam")
    assert body.forces[0].nodes.tolist() == chosen
    assert body.constraints[0].nodes.tolist() == [0, 1, 2, 3] and body.constraints[0].axes.tolist() == [True, False, True]
    below = body.mesh.vertices[body.mesh.surface].mean(axis=1)[:, 1] <= -0.49
    assert body.tractions[0].triangles.tolist() == np.flatnonzero(below).tolist()


def test_what_is_left_out_is_as_in_python(tmp_path):
    text = '[bodies.a]\nmaterial = {}\nmesh = { shape = "ball", radius = 1, cells = 4 }\n[obstacles.o]\nshape = "sphere"\n'
    scene, solver = read(tmp_path, text + "center = [0, 5, 0]\nradius = 1\n")
    wanted = ts.Scene()
    wanted.add_body(ts.ball_mesh(1, 4), ts.Material(), name="a")
    wanted.add_obstacle(ts.Sphere((0, 5, 0), 1), name="o")
    assert data(scene) == data(wanted) and solver == {}


def test_each_table_is_looked_at_once(tmp_path, monkeypatch):
    """So that a file of many materials is read in time that grows as the file does."""
    count, built = 2000, []

    def counted(table, file, place, *more):
        built.append(place)
        made(table, file, place, *more)

    made = Table.__init__
    monkeypatch.setattr(Table, "__init__", counted)
    text = "".join(f"[materials.m{i}]\nyoung = {i + 1}\n" for i in range(count))
    text += "".join(f'[obstacles.o{i}]\nshape = "sphere"\ncenter = [0, {i}, 9]\nradius = 1\n' for i in range(50))
    text += '[bodies.a]\nmaterial = "m1999"\nmesh = { shape = "ball", radius = 1, cells = 2 }\n'
    scene, _ = read(tmp_path, text)
    assert scene.body("a").material.young == 2000 and len(scene.obstacles) == 50
    assert built.count("materials") == built.count("obstacles") == built.count("bodies") == 1
    assert sum(place.startswith("materials.") for place in built) == count
