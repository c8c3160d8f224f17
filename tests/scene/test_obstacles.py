"""Obstacles and their shapes:

* shapes are read-only, and invalid ones are refused by field;
* a shape's frame is a rotation to its own axes, and frame, size and pivot describe its exact solid;
* surfaces of solids are closed with outward normals, and mesh obstacles keep their vertices and triangles;
* a path is evaluated once at construction and gives a rigid motion about the pivot at every time.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.mesh.topology import opposite_half_edges
from taisoft.scene.obstacles import Shape
from tests.collision.rotations import rotation

TETRA = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=float)
FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
SHAPES = [
    ts.HalfSpace((1, 2, 3), (0, 2, 0)),
    ts.Sphere((1, 0, 0), 2),
    ts.Box((0, 1, 0), (1, 2, 3)),
    ts.Capsule((0, 0, 0), (2, 0, 0), 0.5),
    ts.MeshObstacle(TETRA, FACES),
]


def volume(vertices, triangles) -> float:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float(np.einsum("tx,tx->", a, np.cross(b, c)) / 6)


def test_kinds_pivots_sizes_and_surfaces():
    assert [shape.kind for shape in SHAPES] == [0, 1, 2, 3, 4]
    pivots = [(1, 2, 3), (1, 0, 0), (0, 1, 0), (1, 0, 0), (0.25, 0.25, 0.25)]
    sizes = [(0, 0, 0), (2, 0, 0), (1, 2, 3), (1, 0.5, 0), (0, 0, 0)]
    assert [shape.surface() is None for shape in SHAPES] == [True, True, False, True, False]
    for shape, pivot, size in zip(SHAPES, pivots, sizes):
        assert np.allclose(shape.pivot, pivot, atol=1e-15) and np.allclose(shape.size(), size, atol=1e-15)
        assert np.array_equal(shape.frame(), np.eye(3)) and shape.frame().dtype == shape.size().dtype == np.float64


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.word)
def test_shapes_cannot_be_changed(shape):
    field = next(iter(vars(shape)))
    with pytest.raises(AttributeError):
        setattr(shape, field, (0, 0, 0))
    assert not getattr(shape, field).flags.writeable
    if shape.surface() is not None:
        shape.surface()[0][:] = 0  # changes a copy
        assert np.any(shape.surface()[0])


def test_a_shape_keeps_its_own_copy():
    center, vertices, triangles = np.ones(3), TETRA.copy(), FACES.copy()
    sphere, mesh = ts.Sphere(center, 1), ts.MeshObstacle(vertices, triangles)
    center[:], vertices[:], triangles[:] = 9, 9, 9
    assert sphere.center.tolist() == [1, 1, 1] and np.array_equal(mesh.surface()[0], TETRA)
    assert np.array_equal(mesh.surface()[1], FACES) and mesh.triangles.dtype == np.int64


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -3, 0), (0, 0, 1e-200), (1, 1, 1), (-1e30, 2e30, 0.5e30), (1e-9, 1, 0)])
def test_frames_are_rotations(direction):
    unit = np.array(direction) / np.abs(direction).max()
    unit = unit / np.linalg.norm(unit)
    plane = ts.HalfSpace((0, 0, 0), direction)
    frames = [plane.frame(), ts.Capsule((0, 0, 0), direction, 1).frame()]
    assert np.allclose(plane.normal, unit, rtol=0, atol=1e-15)
    for frame, axis in zip(frames, (1, 0)):
        assert np.allclose(frame.T @ frame, np.eye(3), atol=1e-14) and np.linalg.det(frame) == pytest.approx(1)
        assert np.allclose(frame[:, axis], unit, atol=1e-15)


def test_frame_size_and_pivot_give_the_ends_of_a_capsule():
    capsule = ts.Capsule((1, 2, 3), (4, 0, 5), 0.3)
    ends = capsule.frame() @ np.array([(1, 0, 0), (-1, 0, 0)]).T * capsule.size()[0] + capsule.pivot[:, None]
    assert np.allclose(ends.T, [(4, 0, 5), (1, 2, 3)])


def test_a_box_has_twelve_outward_triangles():
    box = ts.Box((5, -1, 2), (1, 0.01, 3))
    vertices, triangles = box.surface()
    assert vertices.shape == (8, 3) and triangles.shape == (12, 3) and triangles.dtype == np.int64
    corners = np.indices((2, 2, 2)).reshape(3, -1).T * 2 - 1
    assert np.allclose(vertices, box.center + corners * box.half_extents)
    assert (opposite_half_edges(triangles) >= 0).all() and volume(vertices, triangles) == pytest.approx(8 * 0.03)
    x = vertices[triangles]
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    assert (np.einsum("tx,tx->t", normal, x.mean(axis=1) - box.center) > 0).all()


def test_meshes_may_be_open_inside_out_tiny_or_huge():
    ts.MeshObstacle(TETRA, FACES[:3])
    ts.MeshObstacle(TETRA, FACES[:, ::-1])
    ts.MeshObstacle(TETRA[:3].tolist(), [[0, 1, 2]])
    for scale in (1e-120, 1e30):
        ts.MeshObstacle(scale * TETRA, FACES)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: ts.HalfSpace((0, 0), (0, 1, 0)), r"^half-space: point must have shape \(3,\), not \(2,\)"),
        (lambda: ts.HalfSpace((0, 0, 0), (0, 0, 0)), "^half-space: normal must not be zero"),
        (lambda: ts.HalfSpace((0, 0, 0), (0, np.nan, 0)), "^half-space: normal: .* not finite"),
        (lambda: ts.HalfSpace((0, 0, 0), "up"), "^half-space: normal must be numbers"),
        (lambda: ts.Sphere((0, np.inf, 0), 1), "^sphere: center: .* not finite"),
        (lambda: ts.Sphere((0, 0, 0), 0), "^sphere: radius must be greater than 0 m, not 0"),
        (lambda: ts.Sphere((0, 0, 0), np.nan), "^sphere: radius must be finite"),
        (lambda: ts.Sphere((0, 0, 0), (1, 1, 1)), "^sphere: radius must be a number"),
        (lambda: ts.Box((0, 0, 0), (1, 0, 1)), r"^box: half_extents must be greater than 0 m, not \[1.0, 0.0, 1.0\]"),
        (lambda: ts.Box((0, 0, 0), 1.0), "^box: half_extents must have shape"),
        (lambda: ts.Capsule((0, 1, 0), (0, 1, 0), 1), "^capsule: a and b must not be the same point"),
        (lambda: ts.Capsule((0, 1, 0), (0, 2, 0), 0), "^capsule: radius must be greater than 0 m"),
        (lambda: ts.MeshObstacle(TETRA[:, :2], FACES), r"^mesh obstacle: vertices must have shape \(4, 3\), not \(4, 2\)"),
        (lambda: ts.MeshObstacle(None, FACES), "^mesh obstacle: vertices must be numbers"),
        (lambda: ts.MeshObstacle(TETRA * np.nan, FACES), r"^mesh obstacle: vertices: entry \[0, 0\] is nan"),
        (lambda: ts.MeshObstacle(TETRA, FACES[:, :2]), r"^mesh obstacle: triangles must be integers of shape \(t, 3\)"),
        (lambda: ts.MeshObstacle(TETRA, []), "^mesh obstacle: triangles must be integers .* t > 0"),
        (lambda: ts.MeshObstacle(TETRA, FACES * 1.0), "^mesh obstacle: triangles must be integers"),
        (lambda: ts.MeshObstacle(TETRA, [[0, 1], [2]]), "^mesh obstacle: triangles must be integers"),
        (lambda: ts.MeshObstacle(TETRA, FACES + 1), r"^mesh obstacle: triangle 1: vertex 4 does not exist \(4 vertices"),
        (lambda: ts.MeshObstacle(TETRA, FACES - 1), "^mesh obstacle: triangle 0: vertex -1 does not exist"),
        (lambda: ts.MeshObstacle(TETRA, [(0, 1, 2), (3, 1, 1)]), r"^mesh obstacle: triangle 1 \(3, 1, 1\) has no area"),
        (lambda: ts.MeshObstacle([(0, 0, 0), (1, 1, 1), (2, 2, 2)], [(0, 1, 2)]), "^mesh obstacle: triangle 0 .* no area"),
        (
            lambda: ts.MeshObstacle(TETRA, [(0, 1, 2), (0, 1, 3)]),
            r"^mesh obstacle: triangles 0 and 1 traverse their edge \(0, 1\) in the same direction",
        ),
        (
            lambda: ts.MeshObstacle([*TETRA, (1, 1, 1)], [(0, 1, 2), (1, 0, 3), (0, 1, 4)]),
            r"^mesh obstacle: edge \(0, 1\) belongs to 3 triangles \(0, 1, 2\); an edge may have at most two",
        ),
    ],
)
def test_invalid_shapes_are_refused(make, message):
    with pytest.raises(SceneError, match=message):
        make()


def test_an_obstacle_without_a_path_rests():
    ball = ts.Obstacle(SHAPES[1], "ball")
    translation, R = ball.pose(3.0)
    assert translation.tolist() == [0, 0, 0] and np.array_equal(R, np.eye(3))
    assert (ball.friction, ball.restitution, ball.path) == (0.5, 0.0, None)
    assert np.array_equal(ball.points_at(1.0, TETRA), TETRA)


def test_a_path_rotates_about_the_pivot():
    times = []

    def path(t):
        times.append(t)
        return (t, 0, 0), rotation((0, 0, 1), t)

    box = ts.Box((0, 1, 0), (1, 2, 3))
    door = ts.Obstacle(box, "door", path=path)
    assert times == [0.0]
    quarter = np.pi / 2
    points = door.points_at(quarter, np.array([(0, 1, 0), (1, 1, 0), (0, 2, 5)], dtype=float))
    assert np.allclose(points, [(quarter, 1, 0), (quarter, 2, 0), (quarter - 1, 1, 5)])
    vertices, triangles = box.surface()
    assert volume(door.points_at(0.7, vertices), triangles) == pytest.approx(48)


@pytest.mark.parametrize(
    "path, message",
    [
        ((0, 0, 0), "path must be a function of time, not"),
        (lambda t: None, r"the path must give \(translation, rotation\) and failed at t = 0: TypeError"),
        (lambda t: (0, 0, 0), r"the path must give \(translation, rotation\) and failed at t = 0: ValueError"),
        (lambda t: 1 / t, "the path .* failed at t = 0: ZeroDivisionError"),
        (lambda t: ((0, 0), np.eye(3)), r"the path's translation at t = 0 must have shape \(3,\), not \(2,\)"),
        (lambda t: ((0, 0, np.nan), np.eye(3)), "the path's translation at t = 0: .* not finite"),
        (lambda t: ((0, 0, 0), np.eye(2)), r"the path's rotation at t = 0 must have shape \(3, 3\)"),
        (lambda t: ((0, 0, 0), np.diag([1, np.inf, 1])), "the path's rotation at t = 0: .* not finite"),
        (lambda t: ((0, 0, 0), 1.00001 * np.eye(3)), "the path's rotation at t = 0 must be orthonormal to 1e-06"),
        (lambda t: ((0, 0, 0), np.diag([1, 1, -1])), "the path's rotation at t = 0 must be orthonormal"),
        (lambda t: ((0, 0, 0), 1e30 * rotation((1, 2, 3), 1)), "the path's rotation at t = 0 must be orthonormal"),
    ],
)
def test_invalid_paths_are_refused(path, message):
    with pytest.raises(SceneError, match=f"^obstacle 'door': {message}"):
        ts.Obstacle(SHAPES[2], "door", path=path)


def test_a_path_is_checked_at_every_time():
    door = ts.Obstacle(SHAPES[2], "door", path=lambda t: ((0, 0, 0), np.eye(3) * (1 + t)))
    with pytest.raises(SceneError, match="obstacle 'door': the path's rotation at t = 0.25 must be orthonormal"):
        door.pose(0.25)
    door = ts.Obstacle(SHAPES[2], "door", path=lambda t: ((0, 0, 0), rotation((1, 2, 3), t).astype(np.float32)))
    assert door.pose(0.3)[1].dtype == np.float64  # a rotation rounded to f32 is accepted


@pytest.mark.parametrize(
    "options, message",
    [
        ({"shape": (0, 0, 0)}, "shape must be a HalfSpace, Sphere, Box, Capsule or MeshObstacle, not tuple"),
        ({"shape": Shape()}, "shape must be a HalfSpace"),
        ({"shape": ts.Sphere}, "shape must be a HalfSpace"),
        ({"friction": -0.1}, "friction must be at least 0, not -0.1"),
        ({"friction": np.inf}, "friction must be finite"),
        ({"restitution": 1.5}, "restitution must be at least 0 and at most 1, not 1.5"),
    ],
)
def test_invalid_obstacles_are_refused(options, message):
    with pytest.raises(SceneError, match=f"^obstacle 'ball': {message}"):
        ts.Obstacle(**({"shape": SHAPES[1], "name": "ball"} | options))
