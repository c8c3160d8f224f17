"""Obstacles and their shapes: frames, sizes, pivots and surfaces; rigid motions about the pivot of a path; key frames, linear or
smooth, with rotations and release; invalid ones are refused.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.mesh.topology import opposite_half_edges

TETRA = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=float)
FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
SHAPES = [
    ts.HalfSpace((1, 2, 3), (0, 2, 0)),
    ts.Sphere((1, 0, 0), 2),
    ts.Box((0, 1, 0), (1, 2, 3)),
    ts.Capsule((0, 0, 0), (2, 0, 0), 0.5),
    ts.MeshObstacle(TETRA, FACES),
]


def rotation_of(*vector) -> np.ndarray:
    """(3,3) of a rotation vector [rad]."""
    return Rotation.from_rotvec(vector).as_matrix()


def volume(vertices, triangles) -> float:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float(np.einsum("tx,tx->", a, np.cross(b, c)) / 6)


def test_pivots_sizes_and_surfaces():
    pivots = [(1, 2, 3), (1, 0, 0), (0, 1, 0), (1, 0, 0), (0.25, 0.25, 0.25)]
    sizes = [(0, 0, 0), (2, 0, 0), (1, 2, 3), (1, 0.5, 0), (0, 0, 0)]
    assert [shape.surface() is None for shape in SHAPES] == [True, True, False, True, False]
    for shape, pivot, size in zip(SHAPES, pivots, sizes):
        assert np.allclose(shape.pivot, pivot, atol=1e-15) and np.allclose(shape.size(), size, atol=1e-15)
        assert np.array_equal(shape.frame(), np.eye(3)) and shape.frame().dtype == shape.size().dtype == np.float64


def test_frames_are_rotations():
    for direction in ((1, 0, 0), (0, -3, 0), (0, 0, 1e-200), (1, 1, 1), (-1e30, 2e30, 0.5e30), (1e-9, 1, 0)):
        unit = np.array(direction) / np.abs(direction).max()
        unit = unit / np.linalg.norm(unit)
        plane = ts.HalfSpace((0, 0, 0), direction)
        assert np.allclose(plane.normal, unit, rtol=0, atol=1e-15)
        for frame, axis in ((plane.frame(), 1), (ts.Capsule((0, 0, 0), direction, 1).frame(), 0)):
            assert np.allclose(frame.T @ frame, np.eye(3), atol=1e-14) and np.linalg.det(frame) == pytest.approx(1)
            assert np.allclose(frame[:, axis], unit, atol=1e-15)


def test_a_box_has_twelve_outward_triangles():
    box = ts.Box((5, -1, 2), (1, 0.01, 3))
    vertices, triangles = box.surface()
    assert vertices.shape == (8, 3) and triangles.shape == (12, 3) and triangles.dtype == np.int64
    corners = np.indices((2, 2, 2)).reshape(3, -1).T * 2 - 1
    assert np.allclose(vertices, box.center + corners * box.half_extents)
    assert (opposite_half_edges(triangles) >= 0).all() and volume(vertices, triangles) == pytest.approx(8 * 0.03)


def test_invalid_obstacles_are_refused():
    for make, message in (
        (lambda: ts.HalfSpace((0, 0, 0), (0, 0, 0)), "^half-space: normal must not be zero"),
        (lambda: ts.Sphere((0, np.inf, 0), 1), "^sphere: center: .* not finite"),
        (lambda: ts.Sphere((0, 0, 0), 0), "^sphere: radius must be greater than 0 m, not 0"),
        (lambda: ts.Box((0, 0, 0), (1, 0, 1)), r"^box: half_extents must be greater than 0 m, not \[1.0, 0.0, 1.0\]"),
        (lambda: ts.Capsule((0, 1, 0), (0, 1, 0), 1), "^capsule: a and b must not be the same point"),
        (lambda: ts.MeshObstacle(TETRA[:, :2], FACES), r"^mesh obstacle: vertices must have shape \(n, 3\), not \(4, 2\)"),
        (lambda: ts.MeshObstacle(TETRA, FACES[:, :2]), r"^mesh obstacle: triangles must have shape \(n, 3\), not \(4, 2\)"),
        (lambda: ts.MeshObstacle(TETRA, FACES + 1), r"^mesh obstacle: triangle 1: vertex 4 does not exist \(4 vertices"),
        (lambda: ts.MeshObstacle(TETRA, [(0, 1, 2), (3, 1, 1)]), r"^mesh obstacle: triangle 1 \(3, 1, 1\) has no area"),
        (lambda: ts.MeshObstacle(TETRA, [(0, 1, 2), (0, 1, 3)]), r"triangles 0 and 1 traverse their edge \(0, 1\) in the same"),
        (lambda: ts.MeshObstacle([*TETRA, (1, 1, 1)], [(0, 1, 2), (1, 0, 3), (0, 1, 4)]), r"edge \(0, 1\) belongs to 3"),
        (lambda: ts.Obstacle((0, 0, 0), "a"), "^obstacle 'a': shape must be a HalfSpace, Sphere, Box, Capsule or MeshOb"),
        (lambda: ts.Obstacle(SHAPES[1], "a", friction=-0.1), "^obstacle 'a': friction must be at least 0, not -0.1"),
        (lambda: ts.Obstacle(SHAPES[1], "a", restitution=1.5), "^obstacle 'a': restitution must be at least 0 and at most 1"),
    ):
        with pytest.raises(SceneError, match=message):
            make()


def test_an_obstacle_rests_or_rotates_about_the_pivot_of_its_path():
    """A rotation rounded to f32 is accepted."""
    ball = ts.Obstacle(SHAPES[1], "ball")
    assert np.array_equal(ball.points_at(1.0, TETRA), TETRA) and (ball.friction, ball.restitution, ball.path) == (0.5, 0.0, None)
    door = ts.Obstacle(SHAPES[2], "door", path=lambda t: ((t, 0, 0), rotation_of(0, 0, t).astype(np.float32)))
    assert door.pose(0.3)[1].dtype == np.float64
    quarter = np.pi / 2
    points = door.points_at(quarter, np.array([(0, 1, 0), (1, 1, 0), (0, 2, 5)], dtype=float))
    assert np.allclose(points, [(quarter, 1, 0), (quarter, 2, 0), (quarter - 1, 1, 5)], atol=1e-6)


def test_invalid_paths_are_refused():
    for path, message in (
        ((0, 0, 0), "path must be a function of time, not"),
        (lambda t: None, r"the path must give \(translation, rotation\) and failed at t = 0: TypeError"),
        (lambda t: ((0, 0), np.eye(3)), r"the path's translation at t = 0 must have shape \(3,\), not \(2,\)"),
        (lambda t: ((0, 0, 0), 1.00001 * np.eye(3)), "the path's rotation at t = 0 must be orthonormal to 1e-06"),
        (lambda t: ((0, 0, 0), np.diag([1, 1, -1])), "the path's rotation at t = 0 must be orthonormal"),
        (lambda t: ((0, 0, 0), np.eye(3) * (1 + t)), "the path's rotation at t = 0.25 must be orthonormal"),
    ):
        with pytest.raises(SceneError, match=f"^obstacle 'door': {message}"):
            ts.Obstacle(SHAPES[2], "door", path=path).pose(0.25)


UP = [(0, 0, 0), (0, 2, 0), (0, 2, 4)]
MESH = ts.box_mesh((1, 1, 1), (1, 1, 1))


def test_translations_are_linear_or_smooth_between_keys_and_constant_outside():
    """A single key is constant; smooth ones have zero velocity at the keys."""
    single, linear = ts.KeyFrames((2,), [(1, 2, 3)], [(0, 0, np.pi / 2)]), ts.KeyFrames((1, 3, 4), UP)
    for t, expected in ((-1, UP[0]), (1, UP[0]), (2, (0, 1, 0)), (3, UP[1]), (3.25, (0, 2, 1)), (9, UP[2])):
        assert single(t)[0].tolist() == [1, 2, 3] and np.allclose(single(t)[1], rotation_of(0, 0, np.pi / 2), atol=1e-15)
        assert np.allclose(linear(t)[0], expected, rtol=0, atol=1e-15) and np.array_equal(linear(t)[1], np.eye(3))
    smooth, h = ts.KeyFrames((1, 3, 4), UP, smooth=True), 1e-6
    for t in (1, 3, 4):
        assert np.abs(smooth(t + h)[0] - smooth(t - h)[0]).max() < 1e-10
    assert np.allclose(smooth(2)[0], (0, 1, 0)) and np.allclose(smooth(1.5)[0], (0, 2 * (3 / 16 - 2 / 64), 0))


def test_rotations_keep_full_turns_about_one_axis_and_else_take_the_shortest_path():
    frames = ts.KeyFrames((0, 1, 2), rotations=[(0, 0, 0), (6 * np.pi, 0, 0), (-1, 0, 0)])
    for t, angle in ((1 / 6, np.pi), (0.75, 4.5 * np.pi), (1.5, 3 * np.pi - 0.5), (2, -1)):
        assert np.allclose(frames(t)[1], rotation_of(angle, 0, 0), rtol=0, atol=1e-14)
    a, b = (0.1, 2.0, -0.3), (1.0, 0.2, 3.0)
    relative = Rotation.from_matrix(rotation_of(*a).T @ rotation_of(*b)).as_rotvec()
    for t in (0, 0.3, 1):
        expected = rotation_of(*a) @ rotation_of(*(t * relative))
        assert np.allclose(ts.KeyFrames((0, 1), rotations=[a, b])(t)[1], expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("pivot, center", [((0.0, 0, 0), (0.0, 0, 0)), (None, (1.5, 0, 0))])
def test_nodes_and_obstacles_rotate_about_the_pivot(pivot, center):
    """pivot None: the center of the nodes or the obstacle."""
    frames = ts.KeyFrames((0, 1), [(0, 0, 0), (0, 0, 1)], [(0, 0, 0), (0, 0, np.pi / 2)], pivot)
    body = ts.Scene().add_body(MESH, ts.Material(), position=(1.0, 0, 0))
    ids = [7, 5, 6, 4]  # vertices at x = 0.5
    body.move(ids, frames)
    nodes, ends = MESH.vertices[ids] + (1.0, 0, 0), np.array([(1.0, 0, 0), (2.0, 0, 0)])
    obstacle = ts.Scene().add_obstacle(ts.Capsule(*ends, 0.1), path=frames)
    for start, end in ((nodes, nodes + body.constraints[0].path(1.0)), (ends, obstacle.points_at(1.0, ends))):
        assert np.allclose(end, (start - center)[:, [1, 0, 2]] * (-1, 1, 1) + center + (0, 0, 1), rtol=0, atol=1e-14)


def test_nodes_are_released_at_the_last_time():
    body = ts.Scene().add_body(MESH, ts.Material(), name="a")
    body.move([0], ts.KeyFrames((0, 1), [(0, 0, 0), (0, 1, 0)], release=True))
    path = body.constraints[0].path
    assert path(0.5).tolist() == [0, 0.5, 0] and path(1.0) is None and path(2.0) is None
    with pytest.raises(ts.SceneError, match="body 'a': move: the path must give a displacement at t = 0, not None"):
        body.move([1], ts.KeyFrames((-1, 0), [(0, 0, 0), (0, 1, 0)], release=True))
    with pytest.raises(ts.SceneError, match="release is for nodes"):
        ts.Scene().add_obstacle(ts.Sphere((0, 0, 0), 1), path=ts.KeyFrames((1,), [(0, 0, 0)], release=True))


def test_invalid_key_frames_are_refused():
    for arguments, message in (
        ({"times": 1.0}, r"times must have shape \(1,\), not \(\)"),
        ({"times": (0, 0, 1)}, "times must ascend, but 0 follows 0"),
        ({"times": (0, 1, np.inf)}, "times: .* not finite"),
        ({"times": (0, 1)}, r"translations must have shape \(2, 3\), not \(3, 3\)"),
        ({"translations": None}, "translations, rotations or values are needed"),
        ({"rotations": [(0, 0, 0)]}, r"rotations must have shape \(3, 3\), not \(1, 3\)"),
        ({"rotations": np.full((3, 3), 1e7)}, r"rotations must be at most 1e\+06 rad"),
        ({"pivot": (0, 0)}, r"pivot must have shape \(3,\)"),
        ({"smooth": 1}, "smooth must be True or False"),
    ):
        with pytest.raises(SceneError, match=f"^key frames: {message}"):
            ts.KeyFrames(**({"times": (0, 1, 2), "translations": UP} | arguments))
