"""Paths that cut a corner are accepted where a bent path is free; what goes through is refused.

Each case has a start, a displacement and what is right, whatever the check does.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.collision.near_list import STILL, TO_STATE
from tests.dynamics.scenes import dynamics

SOFT = ts.Material(young=1e6)


def plate(thickness: float = 0.02) -> ts.TetMesh:
    return ts.box_mesh((1, 8, 8), (thickness, 1.0, 1.0))


def moved(mesh: ts.TetMesh, *by: float) -> ts.TetMesh:
    return ts.TetMesh(mesh.vertices + by, mesh.tets)


def shell(inner: float, outer: float, half: float, width: float, n: int = 24) -> ts.TetMesh:
    """A part of a tube about z: from -half to half of an angle [rad] about y."""
    mesh = ts.box_mesh((n, 1, 1), (2.0 * half, outer - inner, width))
    angle, radius, z = mesh.vertices.T
    radius = radius + 0.5 * (inner + outer)
    return ts.TetMesh(np.column_stack([radius * np.sin(angle), radius * np.cos(angle), z]), mesh.tets)


def refused(scene: ts.Scene, move) -> bool:
    """Whether displacements move(positions) of body b, with obstacles over a second, are refused."""
    with dynamics(scene, dt=1.0, precision="f64") as made:
        contact, x = made.contact, made.state.state()[0]
        contact.start_step(0.0, 1.0)
        assert contact.paths.none_cross
        displacement = np.zeros_like(x)
        rows = made.state.layout.nodes(len(scene.bodies) - 1)
        displacement[rows] = move(x[rows])
        contact.paths.displacement.from_numpy(displacement)
        contact.detection.find(0.0, 1.0, path=contact.paths.displacement, none_cross=True)
        made.state.set_state(x + displacement, np.zeros_like(x))
        assert len(contact.detection.passages(TO_STATE)[0])  # the straight path passes something,
        passes = contact.paths.find()
        contact.detection.find(1.0, 0.0)
        assert len(contact.detection.passages(STILL)[0]) == 0  # and its end does not
        return passes


def two(a: ts.TetMesh, b: ts.TetMesh) -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(a, SOFT, name="a")
    scene.add_body(b, SOFT, name="b")
    return scene


THROUGH = {
    "sheet, plate": (plate(), moved(ts.box_mesh((1, 5, 5), (0.01, 0.4, 0.4)), -0.0155, 0.013, 0.021), 0.0315),
    "film, film": (plate(1e-4), moved(ts.box_mesh((1, 5, 5), (1e-4, 0.4, 0.4)), -2e-4, 0.013, 0.021), 4e-4),
    "cube, wall": (plate(), moved(ts.box_mesh((2, 2, 2), (0.05,) * 3), -0.1, 0.013, 0.021), 0.2),
    "cube, block": (ts.box_mesh((4, 4, 4), (1, 1, 1)), moved(ts.box_mesh((2, 2, 2), (0.05,) * 3), -0.6, 0.01, 0.02), 1.4),
    "rod, rod": (
        ts.box_mesh((1, 8, 1), (0.002, 0.6, 0.002)),
        moved(ts.box_mesh((1, 1, 8), (0.002, 0.002, 0.6)), -0.0021, 0.011, 0.013),
        0.0042,
    ),
}


@pytest.mark.gpu_path("film")
@pytest.mark.filterwarnings("ignore:.*needles.*", "ignore:.*lies? through its thickness.*")
@pytest.mark.parametrize("case", THROUGH)
def test_what_goes_through_is_refused(case):
    a, b, way = THROUGH[case]
    assert refused(two(a, b), lambda x: [way, 0.0, 0.0])


@pytest.mark.parametrize("radius, half_length", [(0.02, 0.2), (0.02, 0.0)])
def test_a_round_obstacle_shot_through_a_sheet_is_refused(radius, half_length):
    scene = ts.Scene(gravity=(0, 0, 0))
    path = ts.KeyFrames([0, 1], [(0, 0, 0), (0.12, 0, 0)])
    ends = ((-0.06, 0.01, -half_length), (-0.06, 0.01, half_length))
    scene.add_obstacle(ts.Capsule(*ends, radius) if half_length else ts.Sphere(ends[0], radius), name="shot", path=path)
    scene.add_body(ts.box_mesh((1, 8, 8), (0.02, 0.6, 0.6)), SOFT, name="sheet")
    assert refused(scene, np.zeros_like)


@pytest.mark.parametrize("slide, around", [(0.08, "body"), (0.16, "body"), (0.16, "two bodies"), (0.08, "capsule")])
def test_a_slide_over_a_curve_is_accepted(slide, around):
    """A sleeve turns about a pin, also between two shells; slide: over the radius."""
    scene, radius = ts.Scene(gravity=(0, 0, 0)), 0.5
    if around == "capsule":
        scene.add_obstacle(ts.Capsule((0, 0, -1), (0, 0, 1), radius), name="pin")
    else:
        scene.add_body(shell(0.3, radius, 1.2, 0.08), SOFT, name="pin")
    if around == "two bodies":
        scene.add_body(shell(1.0512 * radius / np.cos(0.05), 1.2 * radius, 1.2, 0.08), SOFT, name="shell")
    scene.add_body(shell(1.0006 * radius / np.cos(0.025), 1.05 * radius, 0.6, 0.05), SOFT, name="sleeve")
    turn = np.array([[np.cos(slide), -np.sin(slide), 0], [np.sin(slide), np.cos(slide), 0], [0, 0, 1]])
    assert not refused(scene, lambda x: x @ turn - x)


@pytest.mark.parametrize("depth", [1e-4, 5e-3])
def test_a_corner_over_a_ridge_is_accepted(depth):
    scene, half = ts.Scene(gravity=(0, 0, 0)), np.tan(0.5) * 0.3
    wedge = np.array(
        [[-half, -0.3, z] for z in (-0.3, 0.3)] + [[half, -0.3, z] for z in (-0.3, 0.3)] + [[0, 0, -0.3], [0, 0, 0.3]]
    )
    faces = [[0, 4, 2], [1, 3, 5], [0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3], [4, 0, 1], [4, 1, 5]]
    scene.add_obstacle(ts.MeshObstacle(wedge, np.array(faces)), name="wedge")
    c, s, d, e = np.cos(0.6), np.sin(0.6), np.cos(0.7), np.sin(0.7)
    mesh = ts.box_mesh((1, 1, 1), (0.1,) * 3)
    x = mesh.vertices @ (np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ np.array([[d, -e, 0], [e, d, 0], [0, 0, 1]])).T
    start = np.array([-0.12, -depth, 0.013]) - x[np.argmin(x[:, 1])]
    scene.add_body(ts.TetMesh(x + start, mesh.tets), SOFT, name="b")
    assert not refused(scene, lambda x: [0.24, 0.0, 0.0])


def test_a_cube_past_the_edge_of_a_wall_is_accepted():
    scene = two(ts.box_mesh((1, 8, 8), (0.02, 0.4, 0.4)), moved(ts.box_mesh((2, 2, 2), (0.05,) * 3), -0.1, 0.224, 0.021))
    assert not refused(scene, lambda x: [0.2, 0.0, 0.0])
