"""What no scene file can hold is refused, such as functions of time and turning paths made for something else, and what exists
is not replaced unasked.
"""

import numpy as np
import pytest
from command import write
from toml_scenes import TURNED

import taisoft as ts


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
    with pytest.raises(ts.SceneError, match=r"end in \.toml"):
        ts.write_scene(tmp_path / "a.tml", scene)
    with pytest.raises(ts.SceneError, match="needs a Scene, not dict"):
        ts.write_scene(path, {})
    with pytest.raises(ts.OutputError, match="cannot write .*: No such file"):
        ts.write_scene(tmp_path / "gone" / "a.toml", scene)
    obstacle = scene.add_obstacle(ts.Sphere((9, 9, 9), 1), name="s", path=lambda t: ((0, 0, 0), np.eye(3)))
    with pytest.raises(ts.SceneError, match="obstacle 's': moves along a function, which a file cannot store: use ts.KeyFrames"):
        ts.write_scene(path, scene)
    scene.obstacles.remove(obstacle)
    body.move([0], lambda t: (0, 0, 0))
    with pytest.raises(ts.SceneError, match="body 'a': moves along a function, which a file cannot store: use ts.KeyFrames"):
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


FRAMES = {"times": (0, 1), "translations": [(0, 0, 0), (0, 1, 0)]}
TURNS = FRAMES | {"rotations": [(0, 0, 0), (0, 0, 1)]}
PIVOT = {"pivot": (1, 0, 0)}


@pytest.mark.parametrize("frames, lost", [(FRAMES, False), (FRAMES | PIVOT, False), (TURNS, False), (TURNS | PIVOT, True)])
def test_the_path_of_another_obstacle(tmp_path, frames, lost):
    """It comes back as the same motion, or not at all."""
    scene = ts.Scene()
    scene.add_body(TURNED, ts.Material(), name="a")
    first = scene.add_obstacle(ts.Box((9, 9, 9), (1, 1, 1)), path=ts.KeyFrames(**frames))
    second = scene.add_obstacle(ts.Box((5, 9, 9), (1, 1, 1)), name="second", path=first.path)
    if lost:
        told = "obstacle 'second': rotates along a path made for a shape with another center, which a file cannot store"
        with pytest.raises(ts.SceneError, match=told):
            ts.write_scene(tmp_path / "a.toml", scene)
        assert not list(tmp_path.iterdir())
        return
    ts.write_scene(tmp_path / "a.toml", scene)
    again = ts.read_scene(tmp_path / "a.toml")[0].obstacle("second")
    for t in (0, 0.3, 1):
        assert all(np.array_equal(*pair) for pair in zip(again.path(t), second.path(t)))


@pytest.mark.parametrize("frames, lost", [(FRAMES, False), (TURNS, True)])
def test_the_path_of_other_nodes(tmp_path, frames, lost):
    scene = ts.Scene()
    body = scene.add_body(TURNED, ts.Material(), name="a")
    path = body.move([0, 1], ts.KeyFrames(**frames)).path
    body.move([2, 3], path)
    if lost:
        with pytest.raises(ts.SceneError, match="body 'a': rotates along a path made for nodes that start elsewhere, which a"):
            ts.write_scene(tmp_path / "a.toml", scene)
        assert not list(tmp_path.iterdir())
        return
    ts.write_scene(tmp_path / "a.toml", scene)
    again = ts.read_scene(tmp_path / "a.toml")[0].body("a").constraints[1].path
    assert all(np.array_equal(again(t), path(t)) for t in (0, 0.3, 1))
