"""Bad scene files are refused in one sentence with file, place and rule, and no code in a file is run; `taisoft scene` writes a
file that holds the same scene, and the manual's example is valid.
"""

import re

import pytest

import taisoft as ts
from taisoft.cli import main
from taisoft.cli.scene_file import load_scene
from tests.cli.command import ROOT, write
from tests.scene.toml_scenes import MESH, TEXT, TURNED, data, read

BAD = [
    ("young = 1e5", "youngs_modulu = 1e5", "materials.rubber.youngs_modulu is not known (did you mean young?)"),
    ("young = 1e5", 'young = "1e5 Pa"', "materials.rubber.young must be a number, not '1e5 Pa'"),
    ("density = 500", "density = 1979-05-27", "materials.rubber.density is a date or a time"),
    ('material = "rubber"', 'material = "ruber"', "beam.material 'ruber' is not among the materials (did you mean rubber?)"),
    ('material = "rubber"', "material = 3", "bodies.beam.material must be a table, not 3"),
    ('material = "rubber"', "", "bodies.beam.material is missing"),
    ('material = "rubber"', "material = {}\nmaterials = {}", "bodies.beam must have either a material or materials"),
    ("dt = 0.01", "dtt = 1", "solver.dtt is not known (did you mean dt?); there are dt, integrator"),
    ("dt = 0.01", 'arch = "gpu"', "solver.arch must be one of cpu, cuda, not 'gpu'"),
    ("dt = 0.01", "budget = true", "solver.budget must be a number, not True"),
    ("dt = 0.01", "quantities = { q = 3 }", "solver.quantities must be texts or functions by name, not 3"),
    ("1e-4", "0", "solver.newton_tolerance must be greater than 0"),
    ("[0, -9.81, 0]", f"[0, {10**30}, 0]", "gravity[1] is a whole number of more than 64 bits"),
    ("gravity", "include = 'a.toml'\ngravity", "include is not known"),
    ("nodes = [8, 9]", "nodes = [8.0]", "bodies.beam.move[0].nodes must be a list of whole numbers"),
    ('between = ["beam", "ground"]', 'between = ["beam"]', "contacts[0].between must be a list of two names"),
    ('[bodies."the ball"]', "[bodies.beam]", "Cannot declare"),
    ('[bodies."the ball"]', '[bodies.""]', 'bodies."": body name must be a text that is not empty'),
    (
        'shape = "box"',
        'shape = "bax"',
        "bodies.beam.mesh.shape must be one of box, sheet, ball, cylinder, not 'bax'; did you mean 'box'?",
    ),
    ('shape = "box"', 'file = "box"', "bodies.beam.mesh.cells is not known"),
    ("min = [-1,", "min = [1,", "bodies.beam.fix[0].nodes.box.min must not exceed max"),
    ("min = [-1, -1", "min = [-2, -1", ""),
    ("max = [-1, 1, 1]", "max = [-1, 1, -1]", "bodies.beam.fix[0]: no node is chosen"),
    ("[[bodies.beam.fix]]", "[bodies.beam.fix]", "bodies.beam.fix must be a list of tables [[bodies.beam.fix]], not a table"),
    ("nodes = [8, 9]", 'nodes = "X[:, 0] < 0"', 'bodies.beam.move[0].nodes must be "all", a list of ids'),
    ("nodes = [8, 9]", "", "bodies.beam.move[0].nodes is missing"),
    ('axes = "y"', 'axes = "x"', ""),
    ('nodes = [8, 9]\naxes = "y"', 'nodes = [1]\naxes = "x"', "bodies.beam.move[0]: node 1 is already fixed along x"),
    ("times = [0, 1]", "times = [0]", "bodies.beam.move[0].path.translations must have shape (1, 3), not (2, 3)"),
    ("path = { times = [0, 1], translations = [[0, 0, 0], [0, 0.5, 0]], release = true }", "", ""),
    ("release = true", "release = 1", "bodies.beam.move[0].path.release must be True or False"),
    ('"half_space"', '"plane"', "obstacles.ground.shape must be one of half_space, sphere, box, capsule, mesh"),
    ('shape = "half_space"', "", "obstacles.ground.shape is missing"),
    ("pivot = [5, 0, 0]", "release = true", "obstacles.pin: release is for nodes"),
    ('between = ["beam", "ground"]', 'between = ["beem", "ground"]', "contacts[0]: no body or obstacle is called 'beem'"),
    ("[[contacts]]", '[[contacts]]\nbetween = ["ground", "beam"]\nfriction = 1\n[[contacts]]', "between names 'beam' and"),
    ("gravity", 'background = "grey"\ngravity', "background must be '#rrggbb', such as '#d94a3d', or three numbers, not 'grey'"),
    ("gravity", 'background = ["#000000", 3]\ngravity', "background must have shape (3,), not ()"),
    (
        "gravity",
        "background = [[0, 0, 0], [0, 0, 2]]\ngravity",
        "background: red, green and blue must be from 0 to 1, not [0, 0, 2]",
    ),
    ("[collision]", "[[lights]]\ndirection = [0, 0, 0]\n[collision]", "lights[0].direction must not be zero"),
    ("[collision]", "[[lights]]\nstrength = 1\n[collision]", "lights[0].direction is missing"),
    ("[collision]", "[lights]\n[collision]", "lights must be a list of tables [[lights]], not a table"),
    ("[collision]", "[camera]\nposition = [[0, 0, 1], [0, 0, 2]]\ntimes = [1, 1]\n[collision]", "camera.times must ascend"),
    ("[collision]", "[camera]\nposition = [0, 0, 1]\nfollow = 'beem'\n[collision]", "camera: follow: no body is called 'beem'"),
    ("friction = 0.9", 'colour = "#12345g"', "obstacles.ground.colour must be '#rrggbb'"),
    ("friction = 0.9", "opacity = 0", "obstacles.ground.opacity must be at least 0.02 and at most 1, not 0"),
    ("position = [0, 3, 0]", "colour = [0, 1]", 'bodies."the ball".colour must have shape (3,), not (2,)'),
    ("position = [0, 3, 0]", "opacity = 0", 'bodies."the ball".opacity must be at least 0.02'),
    ("dt = 0.01", "dt = 0.01 s", ", line 9: "),
    ("gravity", '"\x01"', ", line 2: Illegal character"),
    ("young = 1e5", f"young = 1{'0' * 5000}", "digits"),
    ("young = 1e5", f"young = {'[' * 5000}", "nested too deeply"),
]


PARTS = """
[bodies.a]
mesh = { shape = "box", cells = [2, 1, 1], size = [2, 1, 1] }
material = {}
[bodies.b]
mesh = { shape = "box", cells = [2, 1, 1], size = [2, 1, 1] }
material = {}
position = [0, 1, 0]
[rigid_bodies.r]
mesh = { vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] }
position = [0, 3, 0]
density = 600
fix = [{ axes = "y" }]
force = [{ force = [1, 0, 0] }, { nodes = [0, 3], force = [0, 0, 1] }]
[springs.s]
a = ["a", [0, 0.5, 0]]
b = ["r", [0.2, 0.2, 0.2]]
stiffness = 100
rest_length = 2.0
[tendons.t]
points = [["a", 3], ["r", [0.2, 0.2, 0.2]], ["b", [0, 0, 0]]]
force = { times = [0, 1], values = [0, 50], smooth = true }
[attachments.j]
a = "a"
nodes = { half_space = { point = [0, 0.49, 0], normal = [0, -1, 0] } }
b = "b"
stiffness = 1e4
damping = 2
"""
BAD_PARTS = [
    ('a = ["a", [0, 0.5, 0]]', 'a = "a"', 'springs.s.a must be ["NAME", POINT], a body or an obstacle, and a position or a node'),
    ('a = ["a", [0, 0.5, 0]]', 'a = ["a", [0, 2, 0]]', "springs.s.a: the point lies outside of body 'a'"),
    ("[springs.s]", "[[springs]]", "springs must be tables [springs.NAME], not a list of 1"),
    ('["a", 3], ', '["b", [0, 0, 0]], ["b", [0, 0, 0]], ', "tendons.t.points 0 and 1 coincide"),
    ('["a", 3]', '"a"', 'tendons.t.points[0] must be ["NAME", POINT], a body or an obstacle, and a position or a node id'),
    ("values = [0, 50], smooth", "values = [0, 50], smoth", "tendons.t.force.smoth is not known (did you mean smooth?)"),
    ("normal = [0, -1, 0]", "normal = [0, 1, 0]", "attachments.j: node 1 of body 'a' lies outside of body 'b'"),
    ("density = 600", "density = -1", "rigid_bodies.r.density must be greater than 0"),
    ("nodes = [0, 3]", "nodes = [0, 9]", "rigid_bodies.r.force[1]: node 9 does not exist"),
    ("[1, 2, 3]]", "[1, 2, 4]]", "rigid_bodies.r.mesh: triangle 3: vertex 4 does not exist"),
    ("\n[bodies.a]", 'body_order = ["a", "a"]\n[bodies.a]', "body_order must list each name"),
]
EVERY = [(TEXT, *row) for row in BAD] + [(PARTS, *row) for row in BAD_PARTS]


@pytest.mark.parametrize("text, old, new, refusal", EVERY, ids=[f"{i}-{ascii(row[2][:30])}" for i, row in enumerate(EVERY)])
def test_bad_entries_are_refused(tmp_path, text, old, new, refusal):
    assert text.count(old) >= 1
    text = text.replace(old, new, 1)
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


def test_a_written_file_holds_the_same_scene_as_python(tmp_path, beam):
    path = tmp_path / "written.toml"
    assert main(["scene", str(beam), "--out", str(path)]) == 0
    (scene, solver), (expected, expected_solver) = load_scene(str(path)), load_scene(str(beam))
    assert data(scene) == data(expected) and solver == expected_solver


def test_allow_outside_allows_meshes_of_other_folders(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    ts.write_mesh(tmp_path / "a.msh", TURNED)
    path = write(tmp_path / "in" / "a.toml", MESH.format("../a.msh"))
    command = ["scene", str(path), "--out", str(tmp_path / "b.toml")]
    assert main(command) == 2 and "--allow-outside" in capsys.readouterr().err and not (tmp_path / "b.toml").exists()
    assert main([*command, "--allow-outside"]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "b.toml"), str(tmp_path / "b_mesh0.msh")]


def test_rigid_bodies_and_connections_are_read(tmp_path):
    scene, _ = read(tmp_path, PARTS)
    body, (spring, tendon, attachment) = scene.body("r"), scene.connections
    assert body.mass == pytest.approx(100.0) and body.constraints[0].axes.tolist() == [False, True, False]
    assert [force.nodes.tolist() for force in body.forces] == [[0, 1, 2, 3], [4, 7]]  # vertices follow the four masses
    assert (spring.stiffness, spring.rest_length, spring.damping, spring.owners) == (100.0, 2.0, 0.0, ["a", "r"])
    assert tendon.points[0].position.tolist() == scene.body("a").rest_positions[3].tolist() and tendon.path(0.5) == 25.0
    assert attachment.damping == 2.0 and (scene.body("a").rest_positions[attachment.nodes][:, 1] == 0.5).all()


def test_the_scene_file_of_the_manual_is_valid(tmp_path):
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "files.md").read_text(), re.DOTALL)
    assert len(blocks) == 1
    scene, solver = read(tmp_path, blocks[0])
    assert scene.bodies and scene.obstacles and solver
