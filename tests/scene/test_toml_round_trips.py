"""Writing scene files: a scene with one of everything, and random numbers and names are read back bit for bit; what a
file cannot store is refused; existing files are replaced only with overwrite=True.
"""

import inspect

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.attributes import thawed
from taisoft.cli.run import RUN_KEYS
from taisoft.scene.checks import SOLVER_CHECKS
from taisoft.scene.fingerprint import scene_digest
from tests.cli.command import write
from tests.scene.toml_scenes import TURNED, floats, there_and_back

BALL = ts.SurfaceMesh(0.1 * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]), [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])


def everything() -> ts.Scene:
    """A scene with one of everything that a file can hold."""
    scene = ts.Scene(gravity=(0.1, -9.81, -0.0))
    scene.collision = ts.CollisionSettings("bvh", margin=1e-3, k_dop=14, field_cells=40, max_capacity=1000)
    scene.allow_initial_overlap, scene.contact_forces = True, False
    rubber, foam = ts.Material(young=1 / 3), ts.Material("corotational", 1e22, -0.3, 1e-7, 0.1, 0.2, 0.3, 0.4, 0.05)
    frames = ts.KeyFrames((0, 1 / 3), [(0, 0, 0), (0.1, 0, 0)], [(0, 0, 0), (0, 1e-3, 7)], (1, 2, 3), smooth=True, release=True)
    a = scene.add_body(TURNED, rubber, name="a", position=(0.1, 0.2, 1e-300), order=2, quadrature_degree=4, collision="proximity")
    a.fix([7, 5], axes="x")
    a.move([3, 1, 2], frames, axes="zy")
    a.add_traction(lambda c: c[:, 1] > 0.3, (1 / 7, 0, -0.0))
    a.add_traction([4, 2], (0, 1, 0))
    a.add_force(range(a.n_nodes), (0, 0, 1))
    a.add_force([2, 1], [(0, 0, 1), (1 / 3, 0, 0)])
    velocity = np.random.default_rng(0).standard_normal((12, 3))
    scene.add_body(TURNED, foam, name='b "2"\n\\ü', velocity=velocity)
    scene.add_body(ts.ball_mesh(0.3, 4, (1, 2, 3)), rubber, name="c.d", dilatation="mean")
    scene.add_body(ts.sheet_mesh((3, 3), (1, 0.3, 1), pattern="six"), rubber, name="1", poisson=0.45)
    full = ts.box_mesh((3, 3, 3), (3, 3, 3))
    spinning = scene.add_rigid_body(full, name="b", density=0.7, velocity=(0.1, 0, 0), angular_velocity=(0.1, 0.2, 0.3))
    spinning.add_force([1, 2], np.ones((2, 3)))
    spinning.add_force(None, (0, 1, 0))
    scene.body("1").embed(BALL, contact=True)
    a.embed(BALL)
    tets = full.tets[(np.abs(full.vertices[full.tets].mean(axis=1)) > 0.5).any(axis=1)]
    hollow = ts.TetMesh(full.vertices, tets, regions=np.arange(len(tets)) % 2 + 1, region_names={2: "core"})
    materials, young = {1: rubber, "core": ts.Material(density=1 / 3)}, np.linspace(1, 1e3, len(tets)) / 3
    shell = scene.add_body(hollow, materials, name="shell", young=young)
    shell.add_cavity(lambda c: np.abs(c).max(axis=1) < 0.6, volume=ts.KeyFrames((0, 1), values=(0.1, 1 / 3)), name="air")
    shell.add_pressure([1, 0], 1 / 7)
    shell.add_force([2, 3], ts.KeyFrames((0, 1), [(0, 0, 0), (0.1, 0, 0)]))
    scene.add_rigid_body(TURNED, name="f", position=(0, 8, 0))
    moved = scene.add_rigid_body(BALL, name="e", position=(0, 4, 0), young=0.7e8, friction=0.3, restitution=0.6)
    moved.fix("y")
    moved.move(ts.KeyFrames([0, 1], [(0, 0, 0), (0.2, 0, 0)]), "xz")
    scene.add_rigid_body(full, name="slow", position=(0, 6, 0), angular_velocity=(1, 0, 0)).velocity = (0, 1, 0)
    lift = ts.KeyFrames((1,), [(0, 1 / 3, 0)])
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (1, 2, 3)), name="ground", friction=0.1, restitution=0.9)
    scene.add_obstacle(ts.Sphere((0, 0, 0), 1 / 3), path=lift)
    turn = ts.KeyFrames((0, 1), rotations=[(0, 0, 0), (1, 2, 3)], pivot=(1, 1, 1))
    scene.add_obstacle(ts.Box((0, 0, 0), (1, 1 / 3, 1)), path=turn)
    scene.add_obstacle(ts.Capsule((0, 0, 0), (1 / 3, 0, 0), 2))
    scene.add_obstacle(ts.MeshObstacle(TURNED.vertices, TURNED.surface))
    scene.add_spring(("a", (0.1, 1 / 3, 0.2)), ("ground", (1 / 3, -0.0, 9)), 1 / 3, name="s.1")
    scene.add_spring(("c.d", 3), ("1", (0.1, 0.01, -0.2)), 1e-20, rest_length=1 / 7, damping=0.1)
    points = [("a", 12), ("ground", (0, 1 / 3, 0)), ("obstacle2", (0, 0, 1)), ('b "2"\n\\ü', 4)]
    scene.add_tendon(points, 1 / 3, name='line "1"')
    scene.add_tendon(points[::3], ts.KeyFrames((0, 1 / 3), values=(0.1, 5.0), smooth=True))
    scene.add_tendon(points[::3], length=ts.KeyFrames((0.0, 1.0), values=(1.0, 2.0), smooth=True), stiffness=5.0, name="winch")
    scene.add_tendon(points[::3], length=0.7, name="rope")
    scene.attach("a", lambda X: X[:, 0] > 0, "ground", 1 / 3, 1e-3)
    scene.attach("c.d", [4, 2], "obstacle2", 5.0, name="pins")
    scene.attach('b "2"\n\\ü', [4, 2], "a", 1e9)
    scene.attach("b", [3, 1], "ground", 5.0, name="of vertices")
    scene.set_contact("ground", "a", friction=0.3)
    scene.set_contact("a", 'b "2"\n\\ü', 0.1, 0.2)
    scene.set_contact("a", "a", restitution=0.3)
    return scene


# in the order in which they are written
EVERY_SETTING = {"dt": np.float64(1 / 120), "integrator": "bdf2", "contact_solver": "auto", "self_collision": np.bool_(True)}
EVERY_SETTING |= {"precision": "f64", "arch": "cpu", "allow_unstable": False, "draggable": True, "newton_tolerance": 1e-5}
EVERY_SETTING |= {"linear_tolerance": None, "contact_tolerance": 1e-3, "tolerance": 0.01, "ramp": 0.5}
EVERY_SETTING |= {"budget": 0.01, "sleep": False, "seconds": np.int64(2), "fps": None}
EVERY_SETTING |= {"quantities": {"sag": "displacement.y beam 4 0.5 0.5", 'of "b"': "reaction b"}}


def test_a_scene_with_everything_is_read_back(tmp_path):
    there_and_back(tmp_path / "all.toml", everything(), EVERY_SETTING)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.toml", "all_mesh0.msh", "all_mesh1.msh"]  # shared
    text = (tmp_path / "all.toml").read_text()
    again, solver = ts.read_scene(tmp_path / "all.toml")
    made = everything()
    with thawed(made.body("a")):
        made.body("a").constraints = made.body("a").constraints[::-1]
    assert scene_digest(again) == scene_digest(made)
    ts.write_scene(tmp_path / "all.toml", again, solver, overwrite=True)
    assert (tmp_path / "all.toml").read_text() == text
    names = set(inspect.signature(ts.Simulator).parameters) - {"scene"}
    assert set(EVERY_SETTING) == set(SOLVER_CHECKS) == names | set(RUN_KEYS)


@pytest.mark.parametrize(
    "text, up", [('up = "z"', "z"), ("gravity = [0, 0, -9.81]", "z"), ('gravity = [0, 0, -9.81]\nup = "y"', "y")]
)
def test_up_and_the_ground_are_read_and_written(tmp_path, text, up):
    ground = '[obstacles.floor]\nshape = "ground"\nheight = -0.1\nfriction = 0.2\n'
    write(
        tmp_path / "a.toml",
        f'{text}\n{ground}[bodies.a]\nmaterial = {{}}\nmesh = {{ shape = "box", cells = [1, 1, 1], size = [1, 1, 1] }}',
    )
    scene, floor = ts.read_scene(tmp_path / "a.toml")[0], ts.Scene(up=up).add_ground(-0.1, 0.2)
    assert scene.up == up and scene.gravity.tolist() == [0, 0, -9.81] and repr(scene.obstacle("floor").shape) == repr(floor.shape)
    assert scene.obstacle("floor").friction == 0.2
    there_and_back(tmp_path / "b.toml", scene, {})


LARGEST = float(np.finfo(np.float32).max)
numbers = floats(-LARGEST, LARGEST)
vectors = st.tuples(*[floats(-1e30, 1e30)] * 3)
positive = floats(min_value=float(np.finfo(np.float32).tiny), max_value=LARGEST)
names = st.text(min_size=1, max_size=8).filter(str.strip)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_random_numbers_and_names_are_read_back(tmp_path, values):
    draw = values.draw
    scene = ts.Scene(gravity=draw(st.tuples(numbers, numbers, numbers)))
    scene.collision = ts.CollisionSettings(cell_ratio=draw(positive), margin=draw(st.none() | floats(0, 1e9)))
    loss, poisson = draw(floats(0, 1e38)), draw(floats(-1, 0.49, exclude_min=True))
    material = ts.Material(young=draw(positive), poisson=poisson, density=draw(positive), friction=loss, mass_damping=loss)
    name, other = draw(st.lists(names, min_size=2, max_size=2, unique=True))
    body = scene.add_body(ts.box_mesh((1, 2, 1), (1, 1, 1)), material, name=name, position=draw(vectors), velocity=draw(vectors))
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


FRAMES = {"times": (0, 1), "translations": [(0, 0, 0), (0, 1, 0)]}
ROTATIONS = FRAMES | {"rotations": [(0, 0, 0), (0, 0, 1)]}
PIVOT = {"pivot": (1, 0, 0)}


def test_scenes_that_a_file_cannot_store_are_refused(tmp_path):
    scene, path = ts.Scene(), tmp_path / "a.toml"

    def refused(message: str, target=path, given=scene, solver=None) -> None:
        with pytest.raises((ts.SceneError, ts.OutputError), match=message):
            ts.write_scene(target, given, solver or {})
        assert not list(tmp_path.iterdir())

    refused("the scene holds no body")
    body = scene.add_body(TURNED, ts.Material(), name="a")
    refused(r"solver: no setting is called 'dtt' \(did you mean dt\?\)", solver={"dtt": 1})
    refused("solver: quantities must be texts or functions by name, not 3", solver={"quantities": {"q": 3}})
    refused("solver: quantity 'q' is a function, which a file cannot store: use a text", solver={"quantities": {"q": len}})
    refused(r"end in \.toml", tmp_path / "a.tml")
    refused("needs a Scene, not dict", given={})
    refused("cannot write .*: No such file", tmp_path / "gone" / "a.toml")
    obstacle = scene.add_obstacle(ts.Sphere((9, 9, 9), 1), name="s", path=lambda t: ((0, 0, 0), np.eye(3)))
    refused("obstacle 's': moves along a function, which a file cannot store: use ts.KeyFrames")
    scene.remove(obstacle)
    body.move([0], lambda t: (0, 0, 0))
    refused("body 'a': moves along a function, which a file cannot store: use ts.KeyFrames")
    body.remove(*body.constraints)
    body.move([2, 3], body.move([0, 1], ts.KeyFrames(**ROTATIONS)).path)
    refused("body 'a': rotates along a path made for nodes that start elsewhere")
    body.remove(*body.constraints)
    tendon = scene.add_tendon([("a", 0), ("a", 5)], lambda t: 1.0, name="line")
    refused("tendon 'line': has a force along a function, which a file cannot store: use ts.Key")
    scene.remove(tendon)
    late = scene.add_rigid_body(TURNED, name="late")
    late.move(ts.KeyFrames((0, 1), rotations=[(0, 0, 0), (0, 1, 0)]))
    late.position = (1, 0, 0)
    refused("rigid body 'late': its position was set after its path")
    scene.remove(late)
    scene.add_body(TURNED, ts.Material(), name="\ud800")
    refused("not a character of Unicode")


def test_existing_files_are_replaced_only_on_request(tmp_path):
    scene = ts.Scene()
    scene.add_body(TURNED, ts.Material(), name="a")
    write(tmp_path / "a_mesh0.msh", "old")
    with pytest.raises(ts.OutputError, match="a_mesh0.msh: the file exists"):
        ts.write_scene(tmp_path / "a.toml", scene)
    assert [path.name for path in tmp_path.iterdir()] == ["a_mesh0.msh"]
    assert ts.write_scene(tmp_path / "a.toml", scene, overwrite=True) == [tmp_path / "a.toml", tmp_path / "a_mesh0.msh"]
    with pytest.raises(ts.OutputError, match="a.toml: the file exists"):
        ts.write_scene(tmp_path / "a.toml", scene)


def test_a_path_shared_by_obstacles_keeps_its_motion_or_is_refused(tmp_path):
    for k, frames in enumerate((FRAMES | PIVOT, ROTATIONS, ROTATIONS | PIVOT)):
        scene, path = ts.Scene(), tmp_path / f"{k}.toml"
        scene.add_body(TURNED, ts.Material(), name="a")
        first = scene.add_obstacle(ts.Box((9, 9, 9), (1, 1, 1)), path=ts.KeyFrames(**frames)).path
        second = scene.add_obstacle(ts.Box((5, 9, 9), (1, 1, 1)), name="second", path=first).path
        if frames == ROTATIONS | PIVOT:
            with pytest.raises(ts.SceneError, match="obstacle 'second': rotates along a path made for a shape with an"):
                ts.write_scene(path, scene)
            continue
        ts.write_scene(path, scene)
        again = ts.read_scene(path)[0].obstacle("second").path
        assert all(np.array_equal(*pair) for t in (0, 0.3, 1) for pair in zip(again(t), second(t)))
