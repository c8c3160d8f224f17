"""Bad scene files: unknown, missing and invalid entries are refused in one sentence with file, place and rule; no code in a file
is run.
"""

import re

import pytest

import taisoft as ts
from tests.scene.toml_scenes import TEXT, read

BAD = [
    ("young = 1e5", "youngs_modulu = 1e5", "materials.rubber.youngs_modulu is not known (did you mean young?)"),
    ("young = 1e5", "young = 0", "materials.rubber.young must be greater than 0 Pa, not 0"),
    ("young = 1e5", 'young = "1e5 Pa"', "materials.rubber.young must be a number, not '1e5 Pa'"),
    ("young = 1e5", "young = true", "materials.rubber.young must be a number, not True"),
    ("young = 1e5", 'law = "neo_hookean"', "materials.rubber.law must be one of"),
    ("density = 500", "density = 1979-05-27", "materials.rubber.density is a date or a time"),
    ("{ friction = 0.1 }", "{ friction = -0.1 }", 'bodies."the ball".material.friction must be at least 0, not -0.1'),
    ('material = "rubber"', 'material = "ruber"', "beam.material 'ruber' is not among the materials (did you mean rubber?)"),
    ('material = "rubber"', "material = 3", "bodies.beam.material must be a table, not 3"),
    ('material = "rubber"', "", "bodies.beam.material is missing"),
    ("dt = 0.01", "dt = 0", "solver.dt must be greater than 0, not 0"),
    ("dt = 0.01", "dt = inf", "solver.dt must be finite, not inf"),
    ("dt = 0.01", 'dt = "none"', "solver.dt must be a number, not None"),
    ("dt = 0.01", "seconds = -1", "solver.seconds must be greater than 0"),
    ("dt = 0.01", "dtt = 1", "solver.dtt is not known (did you mean dt?); there are dt, integrator"),
    ("dt = 0.01", "allow_unstable = 1", "solver.allow_unstable must be True or False, not 1"),
    ("dt = 0.01", 'arch = "gpu"', "solver.arch must be one of cpu, cuda, not 'gpu'"),
    ('"implicit_euler"', "[1]", "solver.integrator must be a text, not [1]"),
    ("1e-4", "0", "solver.newton_tolerance must be greater than 0"),
    ("[0, -9.81, 0]", "[0, -9.81]", "gravity must have shape (3,), not (2,)"),
    ("[0, -9.81, 0]", '"down"', "gravity must be numbers of shape (3,)"),
    ("[0, -9.81, 0]", '[0, "-9.81", 0]', "gravity[1] must be a number, not '-9.81'"),
    ("[0, -9.81, 0]", "[0, true, 0]", "gravity[1] must be a number, not true"),
    ("[0, -9.81, 0]", "[0, -inf, 0]", "gravity[1] must be finite, not -inf"),
    ("[0, -9.81, 0]", f"[0, {10**30}, 0]", "gravity[1] is a whole number of more than 64 bits"),
    ("gravity", "include = 'a.toml'\ngravity", "include is not known"),
    ("overlap = true", "overlap = 1", "allow_initial_overlap must be True or False, not 1"),
    ("margin = 0.01", "margin = -1", "collision.margin must be at least 0 m"),
    ("[bodies.beam]", "[bodies.beam]\nordre = 2", "bodies.beam.ordre is not known (did you mean order?)"),
    ("order = 2", "order = 3", 'bodies."the ball".order must be 1 or 2, not 3'),
    ("position = [0, 3, 0]", "position = [[0], [1, 2]]", 'bodies."the ball".position must be numbers of shape (3,)'),
    ("position = [0, 3, 0]", "velocity = { x = 1 }", 'bodies."the ball".velocity must be numbers'),
    ('[bodies."the ball"]', "[bodies.beam]", "Cannot declare"),
    ('[bodies."the ball"]', '[bodies.""]', 'bodies."": body name must be a text that is not empty'),
    ("[obstacles.ground]", "[obstacles.beam]", "obstacles.beam: obstacle name 'beam' is taken"),
    ('shape = "box"', 'shape = "bax"', "bodies.beam.mesh.shape must be one of box, sheet, ball, not 'bax'; did you mean 'box'?"),
    ('shape = "box"', 'file = "box"', "bodies.beam.mesh.cells is not known"),
    ('shape = "box", ', "", "bodies.beam.mesh must have either a shape or a file"),
    ("cells = [2, 1, 1]", "cells = [2, 1]", "bodies.beam.mesh.cells must be three positive integers"),
    ("cells = [2, 1, 1]", "cells = [1000000000, 1000, 2]", "give more than the 50000000 tets allowed"),
    ("cells = [2, 1, 1], ", "", "bodies.beam.mesh.cells is missing"),
    ("radius = 0.4", "radius = 0.4, pattern = 'six'", 'bodies."the ball".mesh.pattern is not known'),
    ("radius = 0.4", "radius = '0.4'", 'bodies."the ball".mesh.radius must be three finite numbers'),
    ("min = [-1,", "min = [1,", "bodies.beam.fix[0].nodes.box.min must not exceed max"),
    ("max = [-1, 1, 1]", "max = [-1, 1]", "bodies.beam.fix[0].nodes.box.max must have shape (3,)"),
    ("max = [-1, 1, 1]", "maxx = 1", "bodies.beam.fix[0].nodes.box.maxx is not known (did you mean max?)"),
    ("box = {", "bax = {", "bodies.beam.fix[0].nodes.bax is not known (did you mean box?)"),
    ("min = [-1, -1", "min = [-2, -1", ""),
    ("max = [-1, 1, 1]", "max = [-1, 1, -1]", "bodies.beam.fix[0]: no node is chosen"),
    ('axes = "xz"', 'axes = "xx"', "bodies.beam.fix[0].axes must be some of 'x', 'y', 'z'"),
    ("[[bodies.beam.fix]]", "[bodies.beam.fix]", "bodies.beam.fix must be a list of tables [[bodies.beam.fix]], not a table"),
    ("nodes = [8, 9]", "nodes = [8, 12]", "bodies.beam.move[0]: node 12 does not exist"),
    ("nodes = [8, 9]", "nodes = [8.0]", "bodies.beam.move[0].nodes must be a list of whole numbers"),
    ("nodes = [8, 9]", 'nodes = "X[:, 0] < 0"', 'bodies.beam.move[0].nodes must be "all", a list of ids'),
    ("nodes = [8, 9]", "", "bodies.beam.move[0].nodes is missing"),
    ("nodes = [8, 9]", "nodes = {}", "bodies.beam.move[0].nodes must be"),
    ('axes = "y"', 'axes = "x"', ""),
    ('nodes = [8, 9]\naxes = "y"', 'nodes = [1]\naxes = "x"', "bodies.beam.move[0]: node 1 is already fixed along x"),
    ("times = [0, 1]", "times = [0]", "bodies.beam.move[0].path.translations must have shape (1, 3), not (2, 3)"),
    ("times = [0, 1]", "times = [-1, 0]", "bodies.beam.move[0]: the path must give a displacement at t = 0, not None"),
    ("release = true", "release = 1", "bodies.beam.move[0].path.release must be True or False"),
    ("release = true", "relase = true", "path.relase is not known (did you mean release?)"),
    ("traction = [0, 2000, 0]", "traction = 5", "bodies.beam.traction[0].traction must have shape (3,)"),
    ("triangles = {", "nodes = {", "bodies.beam.traction[0].nodes is not known"),
    ("point = [0, -0.49, 0]", "point = [0, -0.9, 0]", "bodies.beam.traction[0]: no surface triangle is chosen"),
    ("force = [0, 0, 1]", "force = [[0, 0, 1]]", "bodies.beam.force[0].force must have shape (3,) or (12, 3)"),
    ('"half_space"', '"plane"', "obstacles.ground.shape must be one of half_space, sphere, box, capsule, mesh"),
    ('"half_space"', '"sphere"', "obstacles.ground.point is not known"),
    ('shape = "half_space"', "", "obstacles.ground.shape is missing"),
    ("normal = [0, 2, 0]", "normal = [0, 0, 0]", "obstacles.ground.normal must not be zero"),
    ("normal = [0, 2, 0]", "", "obstacles.ground.normal is missing"),
    ("friction = 0.9", "friction = -1", "obstacles.ground.friction must be at least 0"),
    ("pivot = [5, 0, 0]", "release = true", "obstacles.pin: release is for nodes"),
    ('between = ["beam", "ground"]', 'between = ["beem", "ground"]', "contacts[0]: no body or obstacle is called 'beem'"),
    ('between = ["beam", "ground"]', 'between = ["pin", "ground"]', "contacts[0]: one of the two must be a body"),
    ('between = ["beam", "ground"]', 'between = ["beam"]', "contacts[0].between must be a list of two names"),
    ("friction = 0.3", "", "contacts[0]: give friction or restitution"),
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
