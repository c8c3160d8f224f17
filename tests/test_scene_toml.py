"""Scene files promise:

* every demo, and a scene with one of everything, comes back from its file with the same numbers, bit for bit;
* so do random numbers and names; a random edit of a file is read or refused with SceneError or MeshError, and so is random text;
* selectors choose what they say, boundary included;
* what is unknown, missing, of another kind or outside the rules is told in one sentence with file, place and rule;
* mesh files stay in the scene file's folder, wherever links lead, unless that is lifted; nothing in a file is run;
* functions of time are refused, and what exists is not replaced unasked;
* `taisoft run` takes a scene file as it takes the same scene in Python; what is bad leaves before any output; `taisoft scene`
  writes one; the README's example is one.
"""

import inspect
import os
import re
import tomllib
import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from command import ROOT, SHORT_OUTPUT, report, run, write
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.cli import main
from taisoft.cli.scene_file import load_module, load_scene, shipped_files
from taisoft.cli.settings import RUN_KEYS
from taisoft.scene.solver import CHECKS
from taisoft.scene.toml_writer import toml_of

DEMOS = shipped_files("demos")

TEXT = """
gravity = [0, -9.81, 0]
allow_initial_overlap = true

[collision]
margin = 0.01

[solver]
dt = 0.01
integrator = "implicit_euler"
fps = "none"
newton_tolerance = 1e-4

[materials.rubber]
young = 1e5
density = 500

[bodies.beam]
material = "rubber"
mesh = { shape = "box", cells = [2, 1, 1], size = [2, 1, 1] }
position = [0, 1, 0]

[[bodies.beam.fix]]
nodes = { box = { min = [-1, -1, -1], max = [-1, 1, 1] } }
axes = "xz"

[[bodies.beam.move]]
nodes = [8, 9]
axes = "y"
path = { times = [0, 1], translations = [[0, 0, 0], [0, 0.5, 0]], release = true }

[[bodies.beam.traction]]
triangles = { half_space = { point = [0, -0.49, 0], normal = [0, 1, 0] } }
traction = [0, 2000, 0]

[[bodies.beam.force]]
nodes = "all"
force = [0, 0, 1]

[bodies."the ball"]
mesh = { shape = "ball", radius = 0.4, cells = 2 }
material = { friction = 0.1 }
position = [0, 3, 0]
order = 2

[obstacles.ground]
shape = "half_space"
point = [0, -5, 0]
normal = [0, 2, 0]
friction = 0.9

[obstacles.pin]
shape = "capsule"
a = [5, 0, 0]
b = [6, 0, 0]
radius = 0.1
path = { times = [0, 2], rotations = [[0, 0, 0], [0, 0, 6.28]], pivot = [5, 0, 0] }

[[contacts]]
between = ["beam", "ground"]
friction = 0.3
"""

BEAM_TOML = f"""
[solver]
dt = {1 / 240!r}
integrator = "symplectic_euler"
seconds = 0.1
fps = 30

[bodies.beam]
material = {{ young = 1e5 }}
mesh = {{ shape = "box", cells = [4, 1, 1], size = [4, 1, 1] }}

[[bodies.beam.fix]]
nodes = {{ half_space = {{ point = [-1.99, 0, 0], normal = [1, 0, 0] }} }}
"""


def path_data(path):
    frames = getattr(path, "frames", path)
    names = ("times", "translations", "rotations", "pivot", "smooth", "release")
    return {name: np.asarray(getattr(frames, name)).tobytes() for name in names} if path else None


def data(scene: ts.Scene) -> dict:
    """What a scene says, as bytes and plain values that compare bit for bit."""
    bodies = []
    for b in scene.bodies:
        arrays = (b.rest_positions, b.nodes.elements, b.mesh.tets, b.mesh.surface, b.position, b.velocity)
        fixed = [(c.nodes.tolist(), c.axes.tolist()) for c in b.constraints if c.path is None]
        moved = [(c.nodes.tolist(), c.axes.tolist(), path_data(c.path)) for c in b.constraints if c.path is not None]
        starts = [c.path.starts.tobytes() for c in b.constraints if c.path is not None]
        loads = [(load.triangles.tolist(), load.value.tobytes()) for load in b.tractions]
        loads += [(load.nodes.tolist(), load.value.shape, load.value.tobytes()) for load in b.forces]
        numbers = (b.name, b.order, b.quadrature_degree, b.collision, b.material)
        bodies.append((numbers, [a.tobytes() for a in arrays], fixed, moved, starts, loads))
    obstacles = []
    for o in scene.obstacles:
        fields = {name: np.asarray(value).tobytes() for name, value in vars(o.shape).items()}
        obstacles.append((o.name, type(o.shape), fields, o.friction, o.restitution, path_data(o.path)))
    own = (scene.gravity.tobytes(), scene.collision, scene.allow_initial_overlap, scene.contact_forces)
    return {"bodies": bodies, "obstacles": obstacles, "own": own, "pairs": scene.contact_pairs}


def read(tmp_path: Path, text: str, **options) -> tuple[ts.Scene, dict]:
    return ts.read_scene(write(tmp_path / "scene.toml", text), **options)


def there_and_back(path: Path, scene: ts.Scene, solver: dict) -> None:
    ts.write_scene(path, scene, solver, overwrite=True)
    scene_again, solver_again = ts.read_scene(path)
    assert data(scene_again) == data(scene)
    assert solver_again == solver


def turned_box() -> ts.TetMesh:
    """A mesh that no shape function makes, its coordinates full of digits."""
    box, (c, s) = ts.box_mesh((1, 2, 1), (1.0, 1.0, 1.0)), (np.cos(0.3), np.sin(0.3))
    return ts.TetMesh(box.vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), box.tets)


TURNED = turned_box()

# --- there and back ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DEMOS)
def test_demos_come_back(tmp_path, name):
    demo = load_module(DEMOS[name])
    there_and_back(tmp_path / f"{name}.toml", demo.build(), demo.solver)


def everything() -> ts.Scene:
    """A scene that says everything a scene can say."""
    scene = ts.Scene(gravity=(0.1, -9.81, -0.0))
    scene.collision = ts.CollisionSettings("bvh", margin=1e-3, k_dop=14, field_cells=40, max_capacity=1000)
    scene.allow_initial_overlap, scene.contact_forces = True, False
    rubber, foam = ts.Material(young=1 / 3), ts.Material("corotational", 1e22, -0.3, 1e-7, 0.1, 0.2, 0.3, 0.4)
    frames = ts.KeyFrames((0, 1 / 3), [(0, 0, 0), (0.1, 0, 0)], [(0, 0, 0), (0, 1e-3, 7)], (1, 2, 3), smooth=True, release=True)
    a = scene.add_body(TURNED, rubber, name="a", position=(0.1, 0.2, 1e-300), order=2, quadrature_degree=4, collision="proximity")
    a.move([3, 1, 2], frames, axes="zy")
    a.fix([7, 5], axes="x")
    a.add_traction(lambda c: c[:, 1] > 0.3, (1 / 7, 0, -0.0))
    a.add_traction([4, 2], (0, 1, 0))
    a.add_force(range(a.n_nodes), (0, 0, 1))
    a.add_force([2, 1], [(0, 0, 1), (1 / 3, 0, 0)])
    velocity = np.random.default_rng(0).standard_normal((12, 3))
    scene.add_body(TURNED, foam, name='b "2"\n\\ü', velocity=velocity)
    scene.add_body(ts.ball_mesh(0.3, 4, (1, 2, 3)), rubber, name="c.d")
    scene.add_body(ts.sheet_mesh((3, 3), (1, 0.3, 1), pattern="six"), rubber, name="1")
    lift = ts.KeyFrames((1,), [(0, 1 / 3, 0)])
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (1, 2, 3)), name="ground", friction=0.1, restitution=0.9)
    scene.add_obstacle(ts.Sphere((0, 0, 0), 1 / 3), path=lift)
    turn = ts.KeyFrames((0, 1), rotations=[(0, 0, 0), (1, 2, 3)], pivot=(1, 1, 1))
    scene.add_obstacle(ts.Box((0, 0, 0), (1, 1 / 3, 1)), path=turn)
    scene.add_obstacle(ts.Capsule((0, 0, 0), (1 / 3, 0, 0), 2))
    scene.add_obstacle(ts.MeshObstacle(TURNED.vertices, TURNED.surface))
    scene.set_contact("ground", "a", friction=0.3)
    scene.set_contact("a", "a", restitution=0.3)
    scene.set_contact("a", 'b "2"\n\\ü', 0.1, 0.2)
    return scene


EVERY_SETTING = {
    "dt": 1 / 120, "integrator": "bdf2", "contact_solver": "auto", "self_collision": True, "precision": "f64", "arch": "cpu",
    "allow_unstable": False, "newton_tolerance": 1e-5, "linear_tolerance": None, "contact_tolerance": 1e-3, "seconds": 2,
    "fps": None,
}  # fmt: skip


def test_everything_comes_back(tmp_path):
    assert set(EVERY_SETTING) == set(CHECKS)
    there_and_back(tmp_path / "all.toml", everything(), EVERY_SETTING)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.toml", "all_mesh0.msh"]  # shared by two bodies
    text = (tmp_path / "all.toml").read_text()
    again, solver = ts.read_scene(tmp_path / "all.toml")
    ts.write_scene(tmp_path / "all.toml", again, solver, overwrite=True)
    assert (tmp_path / "all.toml").read_text() == text


def test_settings_are_those_of_the_simulator():
    names = set(inspect.signature(ts.Simulator).parameters) - {"scene"}
    assert set(CHECKS) == names | set(RUN_KEYS)


def test_numbers_of_numpy_are_written_as_plain_ones(tmp_path):
    scene = ts.Scene()
    scene.add_body(TURNED, ts.Material())
    solver = {"dt": np.float64(1 / 3), "seconds": np.int64(2), "self_collision": np.bool_(True), "fps": Fraction(1, 3)}
    ts.write_scene(tmp_path / "a.toml", scene, solver)
    assert ts.read_scene(tmp_path / "a.toml")[1] == {"dt": 1 / 3, "seconds": 2, "self_collision": True, "fps": 1 / 3}


def floats(*limits, **rules):
    """Without the smallest numbers: compiled code may set the processor to drop them."""
    return st.floats(*limits, allow_subnormal=False, **rules)


numbers = floats(allow_nan=False, allow_infinity=False, width=64)
vectors = st.tuples(*[floats(-1e100, 1e100)] * 3)
positive = floats(min_value=0, exclude_min=True, allow_infinity=False)
names = st.text(min_size=1, max_size=8).filter(str.strip)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_random_numbers_come_back(tmp_path, values):
    draw = values.draw
    scene = ts.Scene(gravity=draw(st.tuples(numbers, numbers, numbers)))
    scene.collision = ts.CollisionSettings(cell_ratio=draw(positive), margin=draw(st.none() | floats(0, 1e9)))
    loss = draw(floats(0, 1e300))
    material = ts.Material(
        young=draw(positive), poisson=draw(floats(-1, 0.49, exclude_min=True)), density=draw(positive), friction=loss,
        restitution=draw(floats(0, 1)), mass_damping=loss, stiffness_damping=draw(floats(0, 1e300)),
    )  # fmt: skip
    name, other = draw(st.lists(names, min_size=2, max_size=2, unique=True))
    body = scene.add_body(TURNED, material, name=name, position=draw(vectors), velocity=draw(vectors))
    times = sorted(draw(st.lists(numbers.filter(lambda t: t > 0), min_size=1, max_size=4, unique=True)))
    keys = [draw(vectors) for _ in times]
    small = st.tuples(*[floats(-1e6, 1e6)] * 3)
    turns = draw(st.none() | st.lists(small, min_size=len(times), max_size=len(times)))
    frames = ts.KeyFrames(times, keys, turns, pivot=draw(st.none() | vectors), smooth=draw(st.booleans()))
    ids = draw(st.lists(st.integers(0, 11), min_size=1, unique=True))
    body.move(ids, frames, axes=draw(st.sampled_from(["x", "zy", "xyz"])))
    body.add_force(ids, draw(st.lists(vectors, min_size=len(ids), max_size=len(ids)) | vectors))
    normal = draw(vectors.filter(lambda v: max(map(abs, v)) > 0))
    scene.add_obstacle(ts.HalfSpace(draw(vectors), normal), name=other)
    scene.set_contact(name, other, friction=loss)
    there_and_back(tmp_path / "random.toml", scene, {"dt": draw(positive), "fps": draw(st.none() | positive)})


# --- random edits -----------------------------------------------------------------------------------------------------


def places(values, at=()):
    """The ways to all values of nested dicts and lists."""
    yield at
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in items:
        yield from places(value, (*at, key))


WAYS = [way for way in places(tomllib.loads(TEXT)) if way]
# No number that makes a large but possible mesh.
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


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(WAYS), st.sampled_from(["replace", "remove", "rename"]), junk, st.text(max_size=8))
def test_random_edits_are_read_or_refused(tmp_path, way, act, value, name):
    tables = tomllib.loads(TEXT)
    within = tables
    for key in way[:-1]:
        within = within[key]
    if act == "replace":
        within[way[-1]] = value
    elif act == "remove" or isinstance(within, list):
        del within[way[-1]]
    else:
        within[name] = within.pop(way[-1])
    try:
        text = toml_of(tables)
    except (AttributeError, KeyError, TypeError):  # a table in a list of others: the writer has no words for it
        return
    read_or_refused(tmp_path, text.encode())


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, len(TEXT)), st.integers(0, 12), st.text('[]{}=".\n#,\x00é-', max_size=5).map(str.encode) | st.binary())
def test_random_text_is_read_or_refused(tmp_path, start, length, more):
    more = bytes(byte for byte in more if not 48 <= byte <= 57)  # digits could ask for a huge mesh
    data = TEXT.encode()
    read_or_refused(tmp_path, data[:start] + more + data[start + length :])


# --- selectors --------------------------------------------------------------------------------------------------------


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


def test_mesh_files_are_found_beside_the_scene_file(tmp_path, monkeypatch):
    (tmp_path / "meshes").mkdir()
    ts.write_mesh(tmp_path / "meshes" / "a.vtu", TURNED)
    monkeypatch.chdir("/")
    text = '\ufeff[bodies.a]\r\nmaterial = {}\r\nmesh = { file = "meshes/a.vtu", weld = 0, fix_orientation = true }\r\n'
    assert np.array_equal(read(tmp_path, text)[0].body("a").rest_positions, TURNED.vertices)


# --- what is refused --------------------------------------------------------------------------------------------------

BAD = [
    ("young = 1e5", "youngs_modulu = 1e5", "materials.rubber.youngs_modulu is not known (did you mean young?)"),
    ("young = 1e5", "young = 0", "materials.rubber.young must be greater than 0 Pa, not 0"),
    ("young = 1e5", "young = nan", "materials.rubber.young must be finite, not nan"),
    ("young = 1e5", 'young = "1e5 Pa"', "materials.rubber.young must be a number, not '1e5 Pa'"),
    ("young = 1e5", "young = true", "materials.rubber.young must be a number, not True"),
    ("young = 1e5", "poisson = 0.5", "materials.rubber.poisson must lie in the open interval"),
    ("young = 1e5", 'law = "neo_hookean"', "materials.rubber.law must be one of"),
    ("density = 500", "density = 0", "materials.rubber.density must be greater than 0 kg/m^3"),
    ("density = 500", "density = 1979-05-27", "materials.rubber.density is a date or a time"),
    ("{ friction = 0.1 }", "{ friction = -0.1 }", 'bodies."the ball".material.friction must be at least 0, not -0.1'),
    ("{ friction = 0.1 }", "{ restitution = 1.5 }", "material.restitution must be at least 0 and at most 1"),
    ('material = "rubber"', 'material = "ruber"', "beam.material 'ruber' is not among the materials (did you mean rubber?)"),
    ('material = "rubber"', "material = 3", "bodies.beam.material must be a table, not 3"),
    ('material = "rubber"', "", "bodies.beam.material is missing"),
    ("dt = 0.01", "dt = 0", "solver.dt must be greater than 0, not 0"),
    ("dt = 0.01", "dt = -0.01", "solver.dt must be greater than 0"),
    ("dt = 0.01", "dt = inf", "solver.dt must be finite, not inf"),
    ("dt = 0.01", 'dt = "none"', "solver.dt must be a number, not None"),
    ("dt = 0.01", "seconds = -1", "solver.seconds must be greater than 0"),
    ("dt = 0.01", "dtt = 1", "solver.dtt is not known (did you mean dt?); there are dt, integrator"),
    ("dt = 0.01", "allow_unstable = 1", "solver.allow_unstable must be True or False, not 1"),
    ("dt = 0.01", 'arch = "gpu"', "solver.arch must be one of cpu, cuda, not 'gpu'"),
    ('"implicit_euler"', "[1]", "solver.integrator must be a text, not [1]"),
    ("1e-4", "0", "solver.newton_tolerance must be greater than 0"),
    ("1e-4", "1", "solver.newton_tolerance must be below 1"),
    ("[0, -9.81, 0]", "[0, -9.81]", "gravity must have shape (3,), not (2,)"),
    ("[0, -9.81, 0]", '"down"', "gravity must be numbers of shape (3,)"),
    ("[0, -9.81, 0]", '[0, "-9.81", 0]', "gravity[1] must be a number, not '-9.81'"),
    ("[0, -9.81, 0]", "[0, true, 0]", "gravity[1] must be a number, not true"),
    ("[0, -9.81, 0]", "[0, -inf, 0]", "gravity[1] must be finite, not -inf"),
    ("[0, -9.81, 0]", f"[0, {10**30}, 0]", "gravity[1] is a whole number of more than 64 bits"),
    ("gravity", "include = 'a.toml'\ngravity", "include is not known"),
    ("overlap = true", "overlap = 1", "allow_initial_overlap must be True or False, not 1"),
    ("margin = 0.01", "margin = -1", "collision.margin must be at least 0 m"),
    ("margin = 0.01", "k_dop = 7", "collision.k_dop must be 6 or 14 or 18"),
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
    ('axes = "xz"', 'axes = "xx"', "bodies.beam.fix[0].axes must name some of 'x', 'y', 'z'"),
    ("[[bodies.beam.fix]]", "[bodies.beam.fix]", "bodies.beam.fix must be a list of tables [[bodies.beam.fix]], not a table"),
    ("nodes = [8, 9]", "nodes = [8, 12]", "bodies.beam.move[0]: node 12 does not exist"),
    ("nodes = [8, 9]", "nodes = [8, 8]", "bodies.beam.move[0]: node 8 is chosen twice"),
    ("nodes = [8, 9]", "nodes = [8.0]", "bodies.beam.move[0].nodes must be a list of whole numbers"),
    ("nodes = [8, 9]", 'nodes = "X[:, 0] < 0"', "bodies.beam.move[0].nodes must be \"all\", a list of ids"),
    ("nodes = [8, 9]", "", "bodies.beam.move[0].nodes is missing"),
    ("nodes = [8, 9]", "nodes = {}", "bodies.beam.move[0].nodes must be"),
    ('axes = "y"', 'axes = "x"', ""),
    ("nodes = [8, 9]\naxes = \"y\"", 'nodes = [1]\naxes = "x"', "bodies.beam.move[0]: node 1 is already fixed along x"),
    ("times = [0, 1]", "times = [0, 0]", "bodies.beam.move[0].path.times must ascend, but 0 follows 0"),
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
    ("friction = 0.3", "friction = -1", "contacts[0].friction must be at least 0"),
    ("friction = 0.3", "", "contacts[0]: give friction or restitution"),
    ("[[contacts]]", '[[contacts]]\nbetween = ["ground", "beam"]\nfriction = 1\n[[contacts]]', "between names 'beam' and"),
    ("dt = 0.01", "dt = 0.01 s", ", line 9: "),
    ("gravity", '"\x01"', ", line 2: Illegal character"),
    ("gravity", "gravity = [0, 0, 0]\ngravity", ", line 3: Cannot overwrite a value"),
    ("young = 1e5", f"young = 1{'0' * 5000}", "digits"),
    ("young = 1e5", f"young = {'[' * 5000}", "nested too deeply"),
]  # fmt: skip


@pytest.mark.parametrize("old, new, told", BAD, ids=[f"{i}-{ascii(new[:30])}" for i, (_, new, _) in enumerate(BAD)])
def test_bad_input(tmp_path, old, new, told):
    assert TEXT.count(old) >= 1
    text = TEXT.replace(old, new, 1)
    if not told:  # a change that breaks no rule, to see that its neighbours do
        assert read(tmp_path, text)
        return
    with pytest.raises((ts.SceneError, ts.MeshError)) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert told in message and message.startswith(str(tmp_path / "scene.toml")) and "\n" not in message
    assert re.match(rf"{re.escape(str(tmp_path / 'scene.toml'))}(: |, line )", message) and len(message) < 600


def test_bad_files(tmp_path):
    for name, content, told in [
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
        assert str(caught.value).startswith(str(tmp_path / name)) and told in str(caught.value)
    with pytest.raises(ts.SceneError, match="Is a directory"):
        ts.read_scene(tmp_path)


MESH = '[bodies.a]\nmaterial = {{}}\nmesh = {{ file = "{}" }}\n'


@pytest.mark.parametrize(
    "name, told",
    [
        ("gone.msh", "gone.msh: there is no such file"),
        ("", "must be a file's name, not ''"),
        ("a\\u0000.msh", "must be a file's name"),
        ("../out.msh", "must lie inside the scene file's folder, without '..'"),
        ("in/../a.msh", "must lie inside the scene file's folder, without '..'"),
        ("/etc/passwd", "must be one of"),
        ("OUT/out.msh", "must lie inside"),
        ("link.msh", "must lie inside"),
        ("folder/out.msh", "must lie inside"),
        ("pair.ele", "must lie inside"),
        ("circle.msh", "bodies.a.mesh"),
        ("a.xdmf", "other formats can name further files; --allow-outside (allow_outside=True) lifts this"),
        ("secret.msh", "not a supported mesh"),
    ],
)
def test_mesh_files_stay_inside(tmp_path, name, told):
    outside, inside = tmp_path / "out", tmp_path / "in"
    outside.mkdir()
    inside.mkdir()
    ts.write_mesh(outside / "out.msh", TURNED)
    ts.write_mesh(inside / "a.msh", TURNED)
    (outside / "pair.node").write_text("secret")
    (inside / "pair.ele").write_text("1 4 0\n1 1 2 3 4\n")
    links = {"link.msh": outside / "out.msh", "folder": outside, "pair.node": outside / "pair.node", "circle.msh": "circle.msh"}
    for link, to in links.items():
        os.symlink(to, inside / link)
    write(inside / "secret.msh", "passphrase")
    text = MESH.format(name.replace("OUT", str(outside)))
    with pytest.raises((ts.SceneError, ts.MeshError)) as caught:
        read(inside, text)
    assert told in str(caught.value) and str(caught.value).startswith(f"{inside / 'scene.toml'}: bodies.a.mesh")
    assert "passphrase" not in str(caught.value) and "secret" not in str(caught.value).replace("secret.msh", "")
    if "out.msh" in name or name == "link.msh":
        name = name.replace("../out.msh", "../out/out.msh")
        scene, _ = read(inside, MESH.format(name.replace("OUT", str(outside))), allow_outside=True)
        assert np.array_equal(scene.body("a").rest_positions, TURNED.vertices)


# --- what is not written ----------------------------------------------------------------------------------------------


def test_what_no_file_can_hold(tmp_path):
    scene = ts.Scene()
    path = tmp_path / "a.toml"
    with pytest.raises(ts.SceneError, match="the scene holds no body"):
        ts.write_scene(path, scene)
    body = scene.add_body(TURNED, ts.Material(), name="a")
    with pytest.raises(ts.SceneError, match=r"solver: no setting is called 'dtt' \(did you mean dt\?\)"):
        ts.write_scene(path, scene, {"dtt": 1})
    with pytest.raises(ts.SceneError, match="solver: dt must be a number, not '1'"):
        ts.write_scene(path, scene, {"dt": "1"})
    with pytest.raises(ts.SceneError, match=r"ends in \.toml"):
        ts.write_scene(tmp_path / "a.tml", scene)
    with pytest.raises(ts.SceneError, match="needs a Scene, not dict"):
        ts.write_scene(path, {})
    with pytest.raises(ts.OutputError, match="cannot write .*: No such file"):
        ts.write_scene(tmp_path / "gone" / "a.toml", scene)
    obstacle = scene.add_obstacle(ts.Sphere((9, 9, 9), 1), name="s", path=lambda t: ((0, 0, 0), np.eye(3)))
    with pytest.raises(ts.SceneError, match="obstacle 's': moves along a function, which no file can hold: use ts.KeyFrames"):
        ts.write_scene(path, scene)
    scene.obstacles.remove(obstacle)
    body.move([0], lambda t: (0, 0, 0))
    with pytest.raises(ts.SceneError, match="body 'a': moves along a function, which no file can hold: use ts.KeyFrames"):
        ts.write_scene(path, scene)
    body.constraints.clear()
    scene.add_body(TURNED, ts.Material(), name="\ud800")
    with pytest.raises(ts.SceneError, match="not a character of Unicode"):
        ts.write_scene(path, scene)
    assert not list(tmp_path.iterdir())


def test_what_exists_is_replaced_only_on_request(tmp_path):
    scene = ts.Scene()
    scene.add_body(TURNED, ts.Material(), name="a")
    write(tmp_path / "a_mesh0.msh", "precious")
    with pytest.raises(ts.OutputError, match="a_mesh0.msh: the file exists"):
        ts.write_scene(tmp_path / "a.toml", scene)
    assert [path.name for path in tmp_path.iterdir()] == ["a_mesh0.msh"]
    assert ts.write_scene(tmp_path / "a.toml", scene, overwrite=True) == [tmp_path / "a.toml", tmp_path / "a_mesh0.msh"]
    with pytest.raises(ts.OutputError, match="a.toml: the file exists"):
        ts.write_scene(tmp_path / "a.toml", scene)


# --- the command line -------------------------------------------------------------------------------------------------


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
        ('shape = "box", cells = [4, 1, 1], size = [4, 1, 1]', 'file = "../a.msh"', "must lie inside"),
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
    assert capsys.readouterr().out.split() == [str(out), str(tmp_path / "b_mesh0.msh")]
    assert main(["scene", str(path), "--out", str(out), "--allow-outside"]) == 3


def test_the_scene_file_of_the_readme(tmp_path):
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 1
    scene, solver = read(tmp_path, blocks[0])
    assert scene.bodies and scene.obstacles and solver
