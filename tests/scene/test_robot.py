"""Robots as data: what a file's geoms become in a scene, where they stand, and what is refused.

* every kind of geom becomes a shape of its size at its place, turned so that z is up in scenes where y is;
* a mesh is touched as it is; one that bounds no solid by its convex hull, with a warning;
* URDF finds meshes by `package://`, and servos hold its joints where they start;
* each bad argument or file gets a sentence that names it.
"""

import sys

import numpy as np
import pytest

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.errors import MissingPackage

mujoco = pytest.importorskip("mujoco")

KINDS = """<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  .2 0 0  0 .3 0  0 0 .4" face="0 2 1  0 1 3  0 3 2  1 2 3"/>
    <hfield name="hills" nrow="2" ncol="2" size="1 1 1 1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1" pos="0 0 -1"/>
    <geom name="picture" type="box" size="9 9 9" contype="0" conaffinity="0"/>
    <body name="part" pos="1 2 3" euler="20 30 40">
      <joint name="slide" type="slide" range="-.1 .1"/>
      <joint name="ball" type="ball"/>
      <geom type="box" size=".1 .2 .3" pos=".1 0 0" euler="10 0 0"/>
      <geom type="sphere" size=".2"/>
      <geom type="capsule" size=".1 .3" euler="0 50 0"/>
      <geom type="cylinder" size=".1 .3" pos="0 .5 0"/>
      <geom type="ellipsoid" size=".1 .2 .3"/>
      <geom type="mesh" mesh="wedge"/>
    </body>
    HILLS
  </worldbody>
  <actuator><motor name="spin" joint="ball" gear="1 0 0" ctrlrange="-3 3"/></actuator>
  <keyframe><key name="home" qpos="0 1 0 0 0" ctrl="2"/></keyframe>
</mujoco>"""
URDF = """<robot name="arm">
  <link name="base"><collision><geometry><box size="1 1 1"/></geometry></collision></link>
  <link name="tip">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="package://own/meshes/tip.obj"/></geometry></collision>
  </link>
  <joint name="turn" type="continuous"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/></joint>
</robot>"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
FIN = "v 1 1 1\nf 2 3 5\n"  # a third triangle at an edge


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "kinds.xml"
    path.write_text(KINDS.replace("HILLS", ""))
    return path


def posed(obstacle) -> np.ndarray:
    """Vertices of an obstacle where it stands at the start (n,3)."""
    return obstacle.points_at(0.0, obstacle.shape.surface()[0])


@pytest.mark.parametrize("up", ["y", "z"])
def test_geoms_become_shapes_where_mujoco_has_them(file, up):
    robot = ts.Robot.load(file)
    scene = ts.Scene(up=up)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    placed = scene.add_robot(robot, name="r", position=(1.0, 0.0, 0.0), rotation=turn, friction=0.3)
    kinds = [type(scene.obstacle(name).shape).__name__ for name in placed.shapes]
    assert kinds == ["HalfSpace", "Box", "Sphere", "Capsule", "MeshObstacle", "MeshObstacle", "MeshObstacle"]
    assert list(placed.shapes)[:3] == ["r/world", "r/part", "r/part/1"]

    data = mujoco.MjData(robot.model)
    mujoco.mj_kinematics(robot.model, data)
    upright = np.eye(3) if up == "z" else np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for name, geom in placed.shapes.items():
        one, size = scene.obstacle(name), robot.model.geom_size[geom]
        assert one.friction == 0.3
        local = {"Box": size * [1, 1, 1], "Sphere": np.zeros(3), "Capsule": np.array([0, 0, size[1]])}
        if name == "r/world":
            own = (one.shape.point - (1.0, 0.0, 0.0), one.shape.normal)
            np.testing.assert_allclose(own, np.array([(0, 0, -1), (0, 0, 1)]) @ (turn @ upright).T, atol=1e-12)
            continue
        point = local[type(one.shape).__name__] if type(one.shape).__name__ in local else one.shape.vertices[0]
        there = data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ point
        np.testing.assert_allclose(one.points_at(0.0, point[None])[0], turn @ upright @ there + (1.0, 0.0, 0.0), atol=1e-12)
    extents = [np.ptp(scene.obstacle(f"r/part/{k}").shape.vertices, axis=0) for k in (3, 4)]
    np.testing.assert_allclose(extents, [(0.2, 0.2, 0.6), (0.2, 0.4, 0.6)], rtol=1e-12)
    wedge = np.array([(0, 0, 0), (0.2, 0, 0), (0, 0.3, 0), (0, 0, 0.4)])  # MuJoCo turns a mesh to its axes of inertia
    there = data.body("part").xpos + wedge @ data.body("part").xmat.reshape(3, 3).T
    expected = there @ (turn @ upright).T + (1.0, 0.0, 0.0)
    distances = np.linalg.norm(posed(scene.obstacle("r/part/5"))[:, None] - expected, axis=2)
    assert distances.min(axis=0).max() < 1e-7 and len(distances) == 4  # MuJoCo keeps vertices in single precision


def test_a_start_is_of_joints_a_key_frame_or_the_file(file):
    assert ts.Robot.load(file, keyframe="home").make_data().ctrl.tolist() == [2.0]
    half = np.sqrt(0.5)
    turned = ts.Robot.load(file, joints={"ball": (half, half, 0.0, 0.0)})
    assert turned.make_data().qpos.tolist() == [0.0, half, half, 0.0, 0.0] and turned.make_data().ctrl.tolist() == [0.0]


def test_urdf_finds_packages_and_servos_hold_where_it_starts(tmp_path):
    for folder in ("own/meshes", "own/urdf"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "own/meshes/tip.obj").write_text(TETRAHEDRON)
    path = tmp_path / "own/urdf/arm.urdf"
    path.write_text(URDF)
    robot = ts.Robot.load(path, joints={"turn": 0.5}, servo=(10.0, 1.0))
    assert robot.model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # Euler's would be unstable
    assert ts.Robot.load(path, servo={"turn": (20.0, 1.0)}).model.actuator_gainprm[0, 0] == 20.0
    start = robot.make_data()
    assert robot.links == ("tip",) and start.ctrl.tolist() == start.qpos.tolist() == [0.5]
    scene = ts.Scene(up="z")
    scene.add_robot(robot, links=("tip",))
    assert [one.name for one in scene.obstacles] == ["robot/tip"] and len(scene.obstacles[0].shape.triangles) == 4

    (tmp_path / "own/meshes/fin.obj").write_text(TETRAHEDRON + FIN)  # under its own name, since MuJoCo keeps files in memory
    path.write_text(URDF.replace("tip.obj", "fin.obj"))
    scene = ts.Scene(up="z")
    with pytest.warns(UserWarning, match="link 'tip': its mesh bounds no solid .* convex hull"):
        scene.add_robot(ts.Robot.load(path), links=("tip",))
    hull = scene.obstacles[0].shape
    assert len(hull.vertices) == 5 and len(hull.triangles) == 6
    volume = np.linalg.det(hull.vertices[hull.triangles]).sum() / 6
    assert volume == pytest.approx(0.5)  # 1/6 + 1/3, and outward

    (tmp_path / "own/meshes/fin.obj").unlink()
    with pytest.raises(ts.SceneError, match=r"mesh 'package:.*fin.obj' is neither in this folder"):
        ts.Robot.load(path)


@pytest.mark.parametrize(
    "arguments, text",
    [
        ({"joints": {"bal": 1.0}}, r"no joint is called 'bal' \(did you mean ball\?\)"),
        ({"joints": {"ball": (1.0, 2.0)}}, r"joint 'ball' must have shape \(4,\)"),
        ({"keyframe": "hom"}, "no key frame is called 'hom'"),
        ({"servo": {"bal": (1.0, 1.0)}}, "servo: no hinge or slider without an actuator is called 'bal'"),
        ({"joints": {"slide": 0.5}}, r"joint 'slide' must start within its limits \[-0.1, 0.1\], not at 0.5"),
        ({"servo": {"slide": (0.0, 1.0)}}, "servo must be a stiffness above 0"),
    ],
)
def test_bad_arguments_of_load_are_refused(file, arguments, text):
    with pytest.raises(ts.SceneError, match=f"kinds.xml: {text}"):
        ts.Robot.load(file, **arguments)


def test_bad_files_are_refused(file):
    for name, content, text in (
        ("none.xml", None, "there is no such file"),
        ("arm.sdf", "", "must be MJCF"),
        ("torn.xml", "<mujoco>", "MuJoCo cannot read this robot: .*"),
    ):
        path = file.with_name(name)
        if content is not None:
            path.write_text(content)
        with pytest.raises(ts.SceneError, match=f"{name}: .*{text}"):
            ts.Robot.load(path)
    file.write_text(KINDS.replace("HILLS", '<geom type="hfield" hfield="hills"/>'))
    with pytest.raises(ts.SceneError, match="link 'world': a geom of type mjGEOM_HFIELD cannot be touched"):
        ts.Scene(up="z").add_robot(ts.Robot.load(file))


def test_bad_places_are_refused_before_the_scene_changes(file):
    robot, scene = ts.Robot.load(file), ts.Scene(up="z")
    for arguments, text in (
        ({"links": ("prt",)}, r"no link is called 'prt' \(did you mean part\?\)"),
        ({"links": ()}, "has no shape that collides in these links"),
        ({"iterations": 0}, "iterations must be a whole number from 1"),
        ({"rotation": -np.eye(3)}, "its place's rotation .* determinant 1"),
        ({"control": {"spn": abs}}, r"no actuator is called 'spn' \(did you mean spin\?\)"),
        ({"control": {"spin": ts.KeyFrames((0.0,), translations=[(0, 0, 0)])}}, "control of 'spin': key frames need values here"),
        ({"control": {"spin": 5.0}}, "control of 'spin' must be within its limits -3 to 3, not 5"),
        ({"friction": -1.0}, "friction must be at least 0"),
    ):
        with pytest.raises(ts.SceneError, match=text):
            scene.add_robot(robot, **arguments)
    with pytest.raises(ts.SceneError, match="needs a Robot, as Robot.load returns it, not str"):
        scene.add_robot("arm.xml")
    assert not scene.robots and not scene.obstacles
    scene.add_robot(robot)
    with pytest.raises(ts.SceneError, match="'robot'"):
        scene.add_robot(robot)
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5, poisson=0.3))
    with pytest.raises(ts.SceneError, match="robot 'robot': a scene file cannot hold robots"):
        ts.write_scene(file.with_suffix(".toml"), scene)


SERVOS = """<mujoco>
  <worldbody>
    <body><joint name="a"/><geom size=".1"/><body pos="1 0 0"><joint name="b"/><geom size=".1"/></body></body>
  </worldbody>
  <equality><joint joint1="b" joint2="a"/></equality>
  <actuator><position name="a" joint="a" kp="5" gear="2" timeconst=".1"/></actuator>
  <keyframe><key name="k" qpos=".3 .3" ctrl=".1"/></keyframe>
</mujoco>"""


def test_servos_hold_where_they_start_whatever_their_gear_and_filter(file):
    path = file.with_name("servos.xml")
    path.write_text(SERVOS)
    data = ts.Robot.load(path, joints={"a": 0.5}).make_data()
    assert data.ctrl.tolist() == data.act.tolist() == [1.0]  # twice the angle
    data = ts.Robot.load(path, keyframe="k", servo={"b": (1.0, 0.1)}).make_data()
    assert data.ctrl == pytest.approx([0.1, 0.3])
    assert ts.Robot.load(path, servo=(1.0, 0.1)).model.nu == 1  # the other joint follows


def test_shapes_of_one_name_are_numbered_and_meshes_inside_out_are_turned(tmp_path):
    path, inward = tmp_path / "names.xml", "0 1 2  0 3 1  0 2 3  1 3 2"
    mesh = f'<asset><mesh name="m" inertia="shell" vertex="0 0 0 1 0 0 0 1 0 0 0 1" face="{inward}"/></asset>'
    geom = '<geom type="mesh" mesh="m"/>'
    path.write_text(
        f'<mujoco>{mesh}<worldbody><body name="a">{geom}{geom}</body><body name="a/1">{geom}</body></worldbody></mujoco>'
    )
    scene = ts.Scene(up="z")
    placed = scene.add_robot(ts.Robot.load(path), name="r")
    assert sorted(placed.shapes) == ["r/a", "r/a/1", "r/a/1/1"] and sorted(placed.shapes.values()) == [0, 1, 2]
    shape = scene.obstacle("r/a").shape
    assert np.linalg.det(shape.vertices[shape.triangles]).sum() / 6 == pytest.approx(1 / 6)


def test_without_the_package_a_sentence_says_what_to_install(file, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ts.SceneError, match=r"a robot needs the package mujoco, .* pip install 'taisoft\[robot\]'"):
        ts.Robot.load(file)
    with pytest.raises(MissingPackage, match="robot_arm.py, line .* a robot needs"):  # `warm` and benchmarks leave such demos out
        load_scene("robot_arm")
