"""Contacts in a scene:

* names of bodies and obstacles are unique together, and a refused obstacle leaves no trace;
* friction and restitution of a pair are those set, or follow from the two; a snapshot does not follow later changes;
* collision settings are checked;
* a body's contact mode follows from its `collision`, and its sharp edges from its mesh.
"""

import numpy as np
import pytest

from taisoft.errors import SceneError
from taisoft.mesh.shapes import ball_mesh, box_mesh, sheet_mesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import opposite_half_edges
from taisoft.scene.collision import CollisionSettings, _largest_convex_angle, has_sharp_edges
from taisoft.scene.obstacles import Box, HalfSpace, Sphere
from taisoft.scene.scene import Material, Scene

MESH = box_mesh((2, 2, 2), (1.0, 1.0, 1.0))
GROUND = HalfSpace((0, 0, 0), (0, 1, 0))


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def body(scene):
    return scene.add_body(MESH, Material(), name="beam")


def test_obstacles_are_found_by_name(scene, body):
    ground = scene.add_obstacle(GROUND, name="ground", friction=0.3, restitution=0.2)
    ball = scene.add_obstacle(Sphere((0, 0, 0), 1))
    assert scene.obstacle("ground") is ground and scene.obstacle("obstacle0") is ball
    assert scene.obstacles == [ground, ball] and scene.colliders == [body, ground, ball]
    assert (ground.shape, ground.friction, ground.restitution, ground.path) == (GROUND, 0.3, 0.2, None)
    with pytest.raises(SceneError, match="no obstacle is called 'grund'; did you mean 'ground'"):
        scene.obstacle("grund")
    with pytest.raises(SceneError, match="no body is called 'ground'; there are"):
        scene.body("ground")
    with pytest.raises(SceneError, match="no obstacle is called 'ground'; the scene has none"):
        Scene().obstacle("ground")
    assert "obstacles=['ground', 'obstacle0']" in repr(scene) and "obstacles" not in repr(Scene())


def test_names_are_unique_among_bodies_and_obstacles(scene, body):
    with pytest.raises(SceneError, match="obstacle name 'beam' is taken"):
        scene.add_obstacle(GROUND, name="beam")
    scene.add_obstacle(GROUND, name="body0")
    with pytest.raises(SceneError, match="body name 'body0' is taken"):
        scene.add_body(MESH, Material(), name="body0")
    assert scene.add_body(MESH, Material()).name == "body1"
    scene.add_body(MESH, Material(), name="obstacle0")
    assert scene.add_obstacle(GROUND).name == "obstacle1"
    with pytest.raises(SceneError, match="obstacle name must be a text"):
        scene.add_obstacle(GROUND, name=" ")


def test_a_refused_obstacle_leaves_no_trace(scene):
    for options in ({"friction": -1}, {"path": lambda t: None}, {"shape": "ground"}):
        with pytest.raises(SceneError, match="^obstacle 'obstacle0': "):
            scene.add_obstacle(**({"shape": GROUND} | options))
    assert not scene.obstacles


def contact_scene() -> Scene:
    """Two bodies and two obstacles with different friction and restitution."""
    scene = Scene()
    scene.add_body(MESH, Material(friction=0.4, restitution=0.1), name="a")
    scene.add_body(MESH, Material(friction=0.9, restitution=0.3), name="b")
    scene.add_obstacle(GROUND, name="ground", friction=0.1, restitution=0.2)
    scene.add_obstacle(GROUND, name="ice", friction=0.0)
    return scene


def test_contact_numbers_follow_from_both_colliders():
    scene = contact_scene()
    assert scene.contact_numbers("a", "b") == pytest.approx((0.6, 0.3))
    assert scene.contact_numbers("ground", "a") == pytest.approx((0.2, 0.2))
    assert scene.contact_numbers("b", "ice") == (0.0, 0.3)
    assert scene.contact_numbers("b", "b") == (0.9, 0.3)
    scene.body("a").material = Material(friction=0.1)
    assert scene.contact_numbers("a", "b") == pytest.approx((0.3, 0.3))


def test_contact_numbers_are_set_by_pairs():
    scene = contact_scene()
    scene.set_contact("a", "ground", friction=0.7)
    assert scene.contact_numbers("a", "ground") == scene.contact_numbers("ground", "a") == (0.7, 0.2)
    scene.set_contact("ground", "a", restitution=1)
    assert scene.contact_numbers("a", "ground") == (0.7, 1.0)
    scene.set_contact("a", "a", friction=0, restitution=0.5)
    assert scene.contact_numbers("a", "a") == (0.0, 0.5)
    assert scene.contact_numbers("b", "ground") == pytest.approx((0.3, 0.3))
    assert scene.contact_pairs == {frozenset("a"): (0.0, 0.5), frozenset(("a", "ground")): (0.7, 1.0)}


@pytest.mark.parametrize(
    "names, numbers, rule",
    [
        (("a", "grond"), {"friction": 1}, "no body or obstacle is called 'grond'; did you mean 'ground'"),
        (("ground", "ice"), {"friction": 1}, "'ground' and 'ice': one of the two must be a body"),
        (("ground", "ground"), {"friction": 1}, "one of the two must be a body"),
        (("a", "b"), {}, "'a' and 'b': give friction or restitution"),
        (("a", "b"), {"friction": -1}, "'a' and 'b': friction must be at least 0"),
        (("a", "b"), {"friction": 1, "restitution": 2}, "restitution must be at least 0 and at most 1, not 2"),
        (("a", None), {"friction": 1}, "no body or obstacle is called None"),
    ],
)
def test_invalid_pairs_are_refused(names, numbers, rule):
    scene = contact_scene()
    with pytest.raises(SceneError, match=f"^scene: .*{rule}"):
        scene.set_contact(*names, **numbers)
    assert not scene.contact_pairs
    if numbers == {"friction": 1}:
        with pytest.raises(SceneError, match=f"^scene: .*{rule}"):
            scene.contact_numbers(*names)


def test_a_snapshot_does_not_follow_later_changes():
    scene = contact_scene()
    scene.set_contact("a", "b", friction=0.7)
    scene.collision = CollisionSettings(k_dop=14)
    twin = scene.snapshot()
    scene.set_contact("a", "b", friction=0.1)
    scene.add_obstacle(Box((0, 0, 0), (1, 1, 1)))
    scene.collision = CollisionSettings()
    assert twin.contact_numbers("a", "b") == (0.7, 0.3) and len(twin.obstacles) == 2
    assert twin.collision.k_dop == 14
    assert twin.body("a").collision == "auto" and twin.body("a").contact_mode == "proximity"


@pytest.mark.parametrize(
    "options, rule",
    [
        ({"broad_phase": "hash"}, "broad_phase must be one of auto, spatial_hash, bvh, not 'hash'"),
        ({"cell_ratio": 0}, "cell_ratio must be greater than 0, not 0"),
        ({"cell_ratio": np.inf}, "cell_ratio must be finite"),
        ({"margin": -1e-9}, "margin must be at least 0 m"),
        ({"margin": "1 mm"}, "margin must be a number"),
        ({"k_dop": 8}, "k_dop must be 6 or 14 or 18, not 8"),
        ({"field_cells": 7}, "field_cells must be a whole number from 8 to 256, not 7"),
        ({"field_cells": 32.0}, "field_cells must be a whole number"),
        ({"field_cells": True}, "field_cells must be a whole number"),
        ({"initial_capacity": 63}, "initial_capacity must be a whole number from 64 to 2147483647, not 63"),
        ({"max_capacity": 2**31}, "max_capacity must be a whole number from 64"),
        ({"initial_capacity": 200, "max_capacity": 100}, "initial_capacity 200 must not exceed max_capacity 100"),
    ],
)
def test_invalid_collision_settings_are_refused(options, rule):
    with pytest.raises(SceneError, match=f"^collision settings: {rule}"):
        CollisionSettings(**options)


def test_collision_settings_are_frozen_and_hold_plain_numbers(scene):
    assert scene.collision == CollisionSettings() and scene.collision.margin is None
    settings = CollisionSettings("bvh", 3, np.float32(0.5), np.int64(18), 8, 64, 64)
    assert (type(settings.cell_ratio), type(settings.margin), type(settings.k_dop)) == (float, float, int)
    scene.collision = settings
    with pytest.raises(AttributeError):
        settings.margin = 1.0
    with pytest.raises(SceneError, match="scene: collision must be CollisionSettings, not str"):
        scene.collision = "bvh"
    assert scene.collision is settings


def prism(sides: int, height: float = 1.0) -> TetMesh:
    """A regular prism about the y axis; the angle between neighbouring sides is 360/sides degrees."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.zeros(sides), -np.sin(angle)], axis=1)
    vertices = np.concatenate([[(0, 0, 0), (0, height, 0)], ring, ring + (0, height, 0)])
    k, n = np.arange(sides), (np.arange(sides) + 1) % sides
    low, high, low_next, high_next = 2 + k, 2 + sides + k, 2 + n, 2 + sides + n
    zero, one = np.zeros(sides, dtype=int), np.ones(sides, dtype=int)
    tets = [(zero, low, low_next, one), (one, low, low_next, high), (one, low_next, high_next, high)]
    return TetMesh(vertices, np.concatenate([np.stack(t, axis=1) for t in tets]), fix_orientation=True)


def test_boxes_sheets_and_prisms_have_sharp_edges_and_balls_do_not(scene):
    ball = ball_mesh(1.0, 8)
    rotated = TetMesh(ball.vertices @ np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0].T, ball.tets)
    rows = {
        "ball": (ball, False),
        "rotated": (rotated, False),
        "sheet": (sheet_mesh((8, 8), (4, 0.05, 4)), True),
        "box": (box_mesh((4, 4, 4), (1, 1, 1)), True),
        "coarse": (prism(4), True),
    }
    for name, (mesh, sharp) in rows.items():
        for order in (1, 2):
            assert has_sharp_edges(scene.add_body(mesh, Material(), name=f"{name}{order}", order=order).nodes) == sharp, name


def test_only_convex_edges_are_sharp():
    for sides in (3, 5, 6, 7):  # a tube: a prism without its caps
        mesh = prism(sides)
        x = mesh.vertices[mesh.surface]
        walls = mesh.surface[np.abs(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])[:, 1]) < 1e-9]
        angle = _largest_convex_angle(mesh.vertices, walls, opposite_half_edges(walls))
        assert angle == pytest.approx(360 / sides, abs=1e-6)
        hollow = walls[:, ::-1]
        assert _largest_convex_angle(mesh.vertices, hollow, opposite_half_edges(hollow)) == pytest.approx(0, abs=1e-5)


def test_parts_joined_at_an_edge_count_as_sharp(scene):
    vertices = np.array([(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 0, 1), (-1, 0, 0), (-1, 0, -1)], dtype=float)
    with pytest.warns(UserWarning, match="joined at an edge"):
        mesh = TetMesh(vertices, [(1, 0, 2, 3), (1, 0, 4, 5)])
    assert has_sharp_edges(scene.add_body(mesh, Material()).nodes)


def test_the_contact_mode_follows_from_collision(scene, body):
    assert body.collision == "auto" and body.contact_mode == scene.snapshot().body("beam").contact_mode == "proximity"
    other = scene.add_body(MESH, Material(), collision="distance_field")
    assert other.contact_mode == "distance_field"
    body.collision = "distance_field"
    assert body.contact_mode == "distance_field"
    with pytest.raises(SceneError, match="^body 'beam': collision must be one of auto, distance_field, proximity"):
        body.collision = "sdf"
    assert body.contact_mode == "distance_field"
