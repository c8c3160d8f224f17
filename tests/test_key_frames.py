"""Key frames promise:

* between keys translations are linear, or start and stop gently; before the first and after the last they stay;
* rotations turn evenly: about one axis by the difference of the angles, full turns too, else by the shortest turn;
* they lead nodes and obstacles alike, about a pivot in space or their own middle, and let nodes go at the last time;
* what is no sequence of keys is refused in one sentence.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import taisoft as ts

UP = [(0, 0, 0), (0, 2, 0), (0, 2, 4)]
MESH = ts.box_mesh((1, 1, 1), (1, 1, 1))


def turned(*vector) -> np.ndarray:
    return Rotation.from_rotvec(vector).as_matrix()


@pytest.mark.parametrize("t, there", [(-1, UP[0]), (1, UP[0]), (2, (0, 1, 0)), (3, UP[1]), (3.25, (0, 2, 1)), (9, UP[2])])
def test_translations_are_linear_and_the_ends_stay(t, there):
    translation, rotation = ts.KeyFrames((1, 3, 4), UP)(t)
    assert np.allclose(translation, there, rtol=0, atol=1e-15) and np.array_equal(rotation, np.eye(3))


def test_one_key_stays():
    frames = ts.KeyFrames((1,), [(1, 2, 3)], [(0, 0, np.pi / 2)])
    for t in (0.0, 1.0, 2.0):
        translation, rotation = frames(t)
        assert translation.tolist() == [1, 2, 3] and np.allclose(rotation, turned(0, 0, np.pi / 2), atol=1e-15)


def test_smooth_ones_rest_at_every_key():
    frames, h = ts.KeyFrames((1, 3, 4), UP, smooth=True), 1e-6
    for t in (1, 3, 4):
        assert np.abs(frames(t + h)[0] - frames(t - h)[0]).max() < 1e-10
    assert np.allclose(frames(2)[0], (0, 1, 0)) and np.allclose(frames(1.5)[0], (0, 2 * (3 / 16 - 2 / 64), 0))


def test_full_turns_about_one_axis_count():
    frames = ts.KeyFrames((0, 1, 2), rotations=[(0, 0, 0), (6 * np.pi, 0, 0), (-1, 0, 0)])
    for t, angle in ((1 / 6, np.pi), (0.5, 3 * np.pi), (0.75, 4.5 * np.pi), (1.5, 3 * np.pi - 0.5), (2, -1)):
        assert np.allclose(frames(t)[1], turned(angle, 0, 0), rtol=0, atol=1e-14)


def test_other_turns_take_the_shortest_way():
    a, b = (0.1, 2.0, -0.3), (1.0, 0.2, 3.0)
    frames = ts.KeyFrames((0, 1), rotations=[a, b])
    way = Rotation.from_matrix(turned(*a).T @ turned(*b)).as_rotvec()
    assert 1.0 < np.linalg.norm(way) < np.pi
    for t in (0, 0.3, 1):
        assert np.allclose(frames(t)[1], turned(*a) @ turned(*(t * way)), rtol=0, atol=1e-14)


def test_nodes_turn_about_the_pivot_in_space():
    position = np.array([1.0, 0, 0])
    for pivot, center in (((0.0, 0, 0), (0.0, 0, 0)), (None, (1.5, 0, 0))):
        body = ts.Scene().add_body(MESH, ts.Material(), position=position)
        ids = [7, 5, 6, 4]  # those at x = 0.5
        body.move(ids, ts.KeyFrames((0, 1), [(0, 0, 0), (0, 0, 1)], [(0, 0, 0), (0, 0, np.pi)], pivot))
        start = MESH.vertices[ids] + position
        there = start + body.constraints[0].path(1.0)
        assert np.allclose(there, (start - center) * (-1, -1, 1) + center + (0, 0, 1), rtol=0, atol=1e-14)


def test_obstacles_turn_about_the_pivot_in_space():
    corners = np.array([(1.0, 0, 0), (2.0, 0, 0)])
    for pivot, center in (((0.0, 0, 0), (0.0, 0, 0)), (None, (1.5, 0, 0))):
        frames = ts.KeyFrames((0, 1), [(0, 0, 0), (0, 0, 1)], [(0, 0, 0), (0, 0, np.pi)], pivot)
        obstacle = ts.Scene().add_obstacle(ts.Capsule(*corners, 0.1), path=frames)
        there = obstacle.points_at(1.0, corners)
        assert np.allclose(there, (corners - center) * (-1, -1, 1) + center + (0, 0, 1), rtol=0, atol=1e-14)


def test_nodes_go_free_at_the_last_time():
    body = ts.Scene().add_body(MESH, ts.Material(), name="a")
    body.move([0], ts.KeyFrames((0, 1), [(0, 0, 0), (0, 1, 0)], release=True))
    path = body.constraints[0].path
    assert path(0.5).tolist() == [0, 0.5, 0] and path(1.0) is None and path(2.0) is None
    with pytest.raises(ts.SceneError, match="body 'a': move: the path must give a displacement at t = 0, not None"):
        body.move([1], ts.KeyFrames((-1, 0), [(0, 0, 0), (0, 1, 0)], release=True))
    with pytest.raises(ts.SceneError, match="release is for nodes"):
        ts.Scene().add_obstacle(ts.Sphere((0, 0, 0), 1), path=ts.KeyFrames((1,), [(0, 0, 0)], release=True))


@pytest.mark.parametrize(
    "arguments, rule",
    [
        ({"times": ()}, r"times must have shape \(1,\), not \(0,\)"),
        ({"times": 1.0}, r"times must have shape \(1,\), not \(\)"),
        ({"times": (0, 0, 1)}, "times must ascend, but 0 follows 0"),
        ({"times": (0, 2, 1)}, "times must ascend, but 1 follows 2"),
        ({"times": (0, 1, np.inf)}, "times: .* not finite"),
        ({"times": (0, 1)}, r"translations must have shape \(2, 3\), not \(3, 3\)"),
        ({"translations": None}, "translations or rotations are needed"),
        ({"translations": "up"}, "translations must be numbers"),
        ({"rotations": [(0, 0, 0)]}, r"rotations must have shape \(3, 3\), not \(1, 3\)"),
        ({"rotations": np.full((3, 3), 1e7)}, r"rotations must be at most 1e\+06 rad"),
        ({"pivot": (0, 0)}, r"pivot must have shape \(3,\)"),
        ({"smooth": 1}, "smooth must be True or False"),
        ({"release": None}, "release must be True or False"),
    ],
)
def test_key_frames_outside_the_rules(arguments, rule):
    with pytest.raises(ts.SceneError, match=f"^key frames: {rule}"):
        ts.KeyFrames(**({"times": (0, 1, 2), "translations": UP} | arguments))


def test_key_frames_are_frozen():
    times = np.array([0.0, 1.0])
    frames = ts.KeyFrames(times, UP[:2])
    times[0] = 5.0
    assert frames.times.tolist() == [0, 1]
    with pytest.raises(ValueError):
        frames.translations[0] = 1.0
    with pytest.raises(AttributeError):
        frames.smooth = True
