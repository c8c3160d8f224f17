"""Looks of scenes: colours, opacity, lights, background and camera are validated, kept by files and set by name, and change
nothing that a checkpoint compares.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.placing import FROM_Y_UP
from taisoft.output.viewpoint import Viewpoint
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.numbers import set_numbers
from tests.dynamics.scenes import cube, rubber
from tests.scene.toml_scenes import there_and_back


def plain() -> ts.Scene:
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="ball")
    scene.add_rigid_body(cube(), name="stone", position=(3, 0, 0))
    scene.add_ground(-2.0)
    scene.add_obstacle(ts.Sphere((0, 0, 9), 1.0), name="moon", path=ts.KeyFrames((0, 1), [(0, 0, 0), (1, 0, 0)]))
    return scene


def painted() -> ts.Scene:
    scene = plain()
    scene.background = "#102030", (1 / 3, 0.0, 1.0)
    scene.lights = [ts.Light((1, -2, 1 / 3), 0.3, "#ffd9a8"), ts.Light((-0.1, -1, 0), colour=(0.1, 0.2, 1 / 7))]
    scene.camera = ts.Camera([(0, 1, 9), (9, 1, 1 / 3)], fov=[30, 45], times=(0, 1 / 3), follow="ball")
    look = {"colour": "#d94a3d", "opacity": 1 / 3}
    for part in scene.bodies:
        part.colour, part.opacity = look.values()
    set_numbers(scene, {f"{name}.{key}": value for name in ("ground", "moon") for key, value in look.items()})
    return scene


def test_looks_are_kept_by_files_and_only_those_that_are_set(tmp_path):
    there_and_back(tmp_path / "a.toml", scene := painted(), {})
    text = (tmp_path / "a.toml").read_text()
    assert text.count('colour = "#d94a3d"') == 4 and 'colour = "#ffd9a8"' in text and repr(1 / 7) in text
    for value in ("#102030", ("#102030", "#405060"), (0.1, 0.2, 0.3)):
        scene.background = value
        there_and_back(tmp_path / "a.toml", scene, {})
    assert "background = [0.1, 0.2, 0.3]" in (tmp_path / "a.toml").read_text()
    scene.lights, scene.camera = (), ts.Camera((0, 0, 9))
    there_and_back(tmp_path / "a.toml", scene, {})
    assert "lights = []" in (tmp_path / "a.toml").read_text()
    there_and_back(tmp_path / "b.toml", plain(), {})
    text = (tmp_path / "b.toml").read_text()
    assert not any(word in text for word in ("colour", "opacity", "background", "lights", "camera"))


def test_looks_are_set_by_name_and_are_no_part_of_what_a_run_depends_on():
    scene = plain()
    before = scene_digest(scene)
    assert scene_digest(painted()) == before
    set_numbers(scene, {"ball.colour": "#ff0000", "moon.opacity": 0.4, "scene.background": "#000000", "stone.colour": [0, 1, 0]})
    assert scene.body("ball").colour.tolist() == [1, 0, 0] and scene.body("stone").colour.tolist() == [0, 1, 0]
    assert scene.obstacle("moon").opacity == 0.4 and not scene.background.any() and scene_digest(scene) == before
    assert scene.obstacle("moon").pose(1.0)[0].tolist() == [1, 0, 0]
    for name, value, message in (
        ("ball.colour", "red", "body 'ball': colour must be '#rrggbb', such as '#d94a3d', or three numbers, not 'red'"),
        ("moon.opacity", 0, "obstacle 'moon': opacity must be at least 0.02 and at most 1, not 0"),
        ("ball.color", "#ffffff", r"the scene has no number 'ball.color' \(did you mean ball.colour\?\)"),
        ("scene.background", [2, 0, 0], "scene: background: red, green and blue must be from 0 to 1"),
    ):
        with pytest.raises(ts.SceneError, match=message):
            set_numbers(scene, {name: value})


def test_a_run_is_resumed_with_other_looks(tmp_path):
    with ts.Simulator(plain(), dt=0.01) as sim:
        sim.step()
        sim.save_checkpoint(tmp_path / "a.npz")
    with ts.Simulator.load_checkpoint(tmp_path / "a.npz", painted()) as sim:
        assert sim.time == pytest.approx(0.01) and sim.scene.body("ball").opacity == 1 / 3


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: ts.Light((0, 0, 0)), "light: direction must not be zero"),
        (lambda: ts.Light((0, -1, 0), strength=-1), "light: strength must be at least 0"),
        (lambda: ts.Light((0, -1, 0), colour="#12345"), "light: colour must be '#rrggbb'"),
        (lambda: ts.Camera((0, 0, 0)), "camera: position and target must differ, but are the same"),
        (lambda: ts.Camera([(0, 0, 1)] * 2, times=(1, 1)), "camera: times must ascend"),
        (lambda: ts.Camera([(0, 0, 1), (0, 0, 0)], times=(1, 2)), "differ, but are the same at time 2 s"),
        (lambda: ts.Camera([(0, 0, 1), (0, 0, 2)]), "camera: key frames of position, target or fov need times"),
        (lambda: ts.Camera([(0, 0, 1), (0, 0)]), "camera: position must be numbers of shape"),
        (lambda: ts.Camera((0, 0, 1), fov="wide"), r"camera: fov must be a number, not 'wide'"),
        (lambda: ts.Camera((0, 0, 1), fov=150), "camera: fov must be from 1 to 120 degrees, not 150"),
        (lambda: ts.Camera((0, 0, 1), up="x"), "camera: up must be one of y, z, not 'x'"),
        (lambda: setattr(plain(), "lights", [ts.Light((0, 0, 1)), 3]), "scene: light 1 must be a Light, not 3"),
        (lambda: setattr(plain(), "lights", [ts.Light((0, 0, 1))] * 9), "scene: there are 9 lights; 8 are the most"),
        (lambda: setattr(plain(), "camera", (0, 0, 1)), "scene: camera must be a Camera or None, not tuple"),
    ],
)
def test_bad_looks_are_refused(make, message):
    with pytest.raises(ts.SceneError, match=message):
        make()


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_camera_passes_through_its_key_frames_the_short_way_around_its_target(up):
    """Before and after them it stays."""
    turn, eyes = FROM_Y_UP[up], np.array([(1.0, 1, -3), (-1, 1, -3), (-1, 2, -6)])
    camera = ts.Camera(eyes @ turn.T, (0, 1, 0) @ turn.T, fov=[40, 20, 20], times=[0, 1, 3])
    at = [Viewpoint(**camera.at(t, up)) for t in (-1.0, 0.0, 0.5, 1.0, 3.0, 9.0)]
    before, first, between, second, last, after = at
    for one, eye in ((before, 0), (first, 0), (second, 1), (last, 2), (after, 2)):
        assert np.allclose(one.position, turn @ eyes[eye]) and np.allclose(one.target, turn @ (0, 1, 0))
    assert 20 < between.fov < 40 and before.fov == pytest.approx(40) and after.fov == pytest.approx(20)
    sideways, _, back = between.position @ turn
    assert abs(sideways) < 0.5 and back == pytest.approx(-np.sqrt(10), abs=0.2), "behind the target, not in front of it"


def test_zoom_enlarges_the_picture():
    camera = ts.Camera((0, 0, 5), fov=[40, 20], times=[0, 1], follow="ball")
    near = camera.zoom(2.0)
    assert np.allclose(np.tan(np.radians(near.fov) / 2), np.tan(np.radians(camera.fov) / 2) / 2) and near.follow == "ball"
    with pytest.raises(ts.SceneError, match="camera: zoom must be greater than 0"):
        camera.zoom(0.0)
