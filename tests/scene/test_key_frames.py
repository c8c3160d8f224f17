"""Key frames:

* translations between keys are linear, or smooth with zero velocity at the keys; outside the keys they are constant;
* rotations have a constant rate: about one axis by the difference of the angles, full turns included, else by the shortest one;
* they move nodes and obstacles about a fixed pivot or their own center, and can release nodes at the last time;
* invalid keys are refused.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import taisoft as ts

UP = [(0, 0, 0), (0, 2, 0), (0, 2, 4)]
MESH = ts.box_mesh((1, 1, 1), (1, 1, 1))


def rotation_of(*vector) -> np.ndarray:
    """(3,3) of a rotation vector [rad]."""
    return Rotation.from_rotvec(vector).as_matrix()


@pytest.mark.parametrize("t, expected", [(-1, UP[0]), (1, UP[0]), (2, (0, 1, 0)), (3, UP[1]), (3.25, (0, 2, 1)), (9, UP[2])])
def test_translations_are_linear_between_keys_and_constant_outside(t, expected):
    translation, rotation = ts.KeyFrames((1, 3, 4), UP)(t)
    assert np.allclose(translation, expected, rtol=0, atol=1e-15) and np.array_equal(rotation, np.eye(3))


def test_a_single_key_is_constant():
    frames = ts.KeyFrames((1,), [(1, 2, 3)], [(0, 0, np.pi / 2)])
    for t in (0.0, 1.0, 2.0):
        translation, rotation = frames(t)
        assert translation.tolist() == [1, 2, 3] and np.allclose(rotation, rotation_of(0, 0, np.pi / 2), atol=1e-15)


def test_smooth_key_frames_have_zero_velocity_at_keys():
    frames, h = ts.KeyFrames((1, 3, 4), UP, smooth=True), 1e-6
    for t in (1, 3, 4):
        assert np.abs(frames(t + h)[0] - frames(t - h)[0]).max() < 1e-10
    assert np.allclose(frames(2)[0], (0, 1, 0)) and np.allclose(frames(1.5)[0], (0, 2 * (3 / 16 - 2 / 64), 0))


def test_full_turns_about_one_axis_are_kept():
    frames = ts.KeyFrames((0, 1, 2), rotations=[(0, 0, 0), (6 * np.pi, 0, 0), (-1, 0, 0)])
    for t, angle in ((1 / 6, np.pi), (0.5, 3 * np.pi), (0.75, 4.5 * np.pi), (1.5, 3 * np.pi - 0.5), (2, -1)):
        assert np.allclose(frames(t)[1], rotation_of(angle, 0, 0), rtol=0, atol=1e-14)


def test_rotations_about_different_axes_take_the_shortest_path():
    a, b = (0.1, 2.0, -0.3), (1.0, 0.2, 3.0)
    frames = ts.KeyFrames((0, 1), rotations=[a, b])
    relative = Rotation.from_matrix(rotation_of(*a).T @ rotation_of(*b)).as_rotvec()
    assert 1.0 < np.linalg.norm(relative) < np.pi
    for t in (0, 0.3, 1):
        assert np.allclose(frames(t)[1], rotation_of(*a) @ rotation_of(*(t * relative)), rtol=0, atol=1e-14)


@pytest.mark.parametrize("pivot, center", [((0.0, 0, 0), (0.0, 0, 0)), (None, (1.5, 0, 0))])
def test_nodes_and_obstacles_rotate_about_the_pivot(pivot, center):
    """pivot None: the center of the nodes or the obstacle."""
    frames = ts.KeyFrames((0, 1), [(0, 0, 0), (0, 0, 1)], [(0, 0, 0), (0, 0, np.pi)], pivot)
    body = ts.Scene().add_body(MESH, ts.Material(), position=(1.0, 0, 0))
    ids = [7, 5, 6, 4]  # vertices at x = 0.5
    body.move(ids, frames)
    nodes, ends = MESH.vertices[ids] + (1.0, 0, 0), np.array([(1.0, 0, 0), (2.0, 0, 0)])
    obstacle = ts.Scene().add_obstacle(ts.Capsule(*ends, 0.1), path=frames)
    for start, end in ((nodes, nodes + body.constraints[0].path(1.0)), (ends, obstacle.points_at(1.0, ends))):
        assert np.allclose(end, (start - center) * (-1, -1, 1) + center + (0, 0, 1), rtol=0, atol=1e-14)


def test_nodes_are_released_at_the_last_time():
    body = ts.Scene().add_body(MESH, ts.Material(), name="a")
    body.move([0], ts.KeyFrames((0, 1), [(0, 0, 0), (0, 1, 0)], release=True))
    path = body.constraints[0].path
    assert path(0.5).tolist() == [0, 0.5, 0] and path(1.0) is None and path(2.0) is None
    with pytest.raises(ts.SceneError, match="body 'a': move: the path must give a displacement at t = 0, not None"):
        body.move([1], ts.KeyFrames((-1, 0), [(0, 0, 0), (0, 1, 0)], release=True))
    with pytest.raises(ts.SceneError, match="release is for nodes"):
        ts.Scene().add_obstacle(ts.Sphere((0, 0, 0), 1), path=ts.KeyFrames((1,), [(0, 0, 0)], release=True))


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"times": ()}, r"times must have shape \(1,\), not \(0,\)"),
        ({"times": 1.0}, r"times must have shape \(1,\), not \(\)"),
        ({"times": (0, 0, 1)}, "times must ascend, but 0 follows 0"),
        ({"times": (0, 2, 1)}, "times must ascend, but 1 follows 2"),
        ({"times": (0, 1, np.inf)}, "times: .* not finite"),
        ({"times": (0, 1)}, r"translations must have shape \(2, 3\), not \(3, 3\)"),
        ({"translations": None}, "translations, rotations or values are needed"),
        ({"translations": "up"}, "translations must be numbers"),
        ({"rotations": [(0, 0, 0)]}, r"rotations must have shape \(3, 3\), not \(1, 3\)"),
        ({"rotations": np.full((3, 3), 1e7)}, r"rotations must be at most 1e\+06 rad"),
        ({"pivot": (0, 0)}, r"pivot must have shape \(3,\)"),
        ({"smooth": 1}, "smooth must be True or False"),
        ({"release": None}, "release must be True or False"),
    ],
)
def test_invalid_key_frames_are_refused(arguments, message):
    with pytest.raises(ts.SceneError, match=f"^key frames: {message}"):
        ts.KeyFrames(**({"times": (0, 1, 2), "translations": UP} | arguments))


def test_key_frames_cannot_be_changed():
    times = np.array([0.0, 1.0])
    frames = ts.KeyFrames(times, UP[:2])
    times[0] = 5.0
    assert frames.times.tolist() == [0, 1]
    with pytest.raises(ValueError):
        frames.translations[0] = 1.0
    with pytest.raises(AttributeError):
        frames.smooth = True
