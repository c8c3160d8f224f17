"""Scenes, bodies and materials:

* Lamé's parameters follow from Young's modulus and Poisson's ratio; invalid material numbers are refused, near
  incompressibility is warned of, and a misspelt law gets a suggestion;
* gravity, positions, velocities, loads and paths are finite numbers of the right shape; names are unique among bodies and
  obstacles;
* nodes and triangles are selected by ids, masks or functions; empty selections, unknown ids and other results are refused;
* a node can be fixed twice, but a moved axis of a node has no other constraint;
* friction and restitution of a pair are those set, or follow from the two; collision settings are checked; a body's contact mode
  follows from its `collision`, and its sharp edges from its mesh.
"""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from taisoft.errors import SceneError
from taisoft.mesh.nodes import make_nodes
from taisoft.mesh.shapes import ball_mesh, box_mesh, sheet_mesh
from taisoft.scene.collision import CollisionSettings, has_sharp_edges, principal_extents
from taisoft.scene.material import LAWS
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


def still(t):
    return (0.0, 0.0, 0.0)


# --- materials --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("poisson", [-0.5, 0.0, 0.3, 0.49])
def test_lame_parameters_satisfy_hookes_law(poisson):
    rubber = Material(young=2e6, poisson=poisson)
    # uniaxial stress: a strain of (1, -nu, -nu) e gives a stress of young e along the axis and none across it
    trace = 1.0 - 2.0 * poisson
    assert 2 * rubber.mu + rubber.lam * trace == pytest.approx(2e6)
    assert -2 * rubber.mu * poisson + rubber.lam * trace == pytest.approx(0.0, abs=1e-6)


def test_a_material_holds_floats_and_a_law():
    rubber = Material(young=1000000, density=np.float32(900.0))
    assert type(rubber.young) is float and rubber.density == 900.0
    assert {Material(law=law).law for law in LAWS} == set(LAWS)


def test_near_incompressibility_is_warned_of_for_linear_tets():
    soft = Material(poisson=0.495)
    with pytest.warns(UserWarning, match="body 'locks': poisson = 0.495 is above 0.49, where linear tets lock"):
        Scene().add_body(box_mesh((1, 1, 1), (1, 1, 1)), soft, name="locks")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Scene().add_body(box_mesh((1, 1, 1), (1, 1, 1)), soft, order=2)


@pytest.mark.parametrize(
    "field, rule, values",
    [
        ("young", "be", [0, -1, np.nan, np.inf, "1e5 Pa", None, True, 1j, [1e5], 10**400]),
        ("density", "be", [0, -1, np.nan, "1000"]),
        ("friction", "be", [-0.1, np.inf]),
        ("restitution", "be", [-0.1, 1.5, np.nan]),
        ("mass_damping", "be", [-1e-9, "0"]),
        ("stiffness_damping", "be", [-1e-9, np.inf]),
        ("poisson", "be", [np.nan, "0.3", None]),
        ("poisson", r"lie in the open interval \(-1, 0.5\), not", [0.5, -1, -1.5, 0.5000001]),
        ("volume_floor", "be", [-0.1, 1e-4, 1.0, np.nan]),
        ("law", "be one of .*did you mean 'corotational'", ["corotated"]),
        ("law", "be one of .*did you mean 'stable_neo_hookean'", ["Neo_Hookean"]),
        ("law", "be one of st_venant_kirchhoff, corotational, stable_neo_hookean, not", ["hooke", "", None]),
    ],
)
def test_invalid_materials_are_refused(field, rule, values):
    for value in values:
        with pytest.raises(SceneError, match=f"^material: {field} must {rule}"):
            Material(**{field: value})


# --- bodies and obstacles ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gravity", [(0, -9.81), "down", (0, np.nan, 0), 9.81, None, ("0", "1", "2"), [[0, 1, 2]]])
def test_gravity_must_be_three_finite_numbers(gravity, scene):
    with pytest.raises(SceneError, match="^scene: gravity"):
        Scene(gravity=gravity)
    with pytest.raises(SceneError, match="^scene: gravity"):
        scene.gravity = gravity
    assert scene.gravity.tolist() == [0.0, -9.81, 0.0]


def test_bodies_and_obstacles_are_found_by_name(scene, body):
    other = scene.add_body(MESH, Material(), position=(1, 2, 3), velocity=np.ones((27, 3)))
    assert scene.body("beam") is body and scene.body("body0") is other and scene.bodies == [body, other]
    assert other.velocity.shape == (27, 3) and other.position.tolist() == [1, 2, 3]
    assert np.array_equal(other.rest_positions, MESH.vertices)  # position shifts the initial state only
    with pytest.raises(SceneError, match="no obstacle is called 'ground'; the scene has none"):
        scene.obstacle("ground")
    ground = scene.add_obstacle(GROUND, name="ground", friction=0.3, restitution=0.2)
    ball = scene.add_obstacle(Sphere((0, 0, 0), 1))
    assert scene.obstacle("ground") is ground and scene.obstacle("obstacle0") is ball
    assert scene.obstacles == [ground, ball] and scene.colliders == [body, other, ground, ball]
    assert (ground.shape, ground.friction, ground.restitution, ground.path) == (GROUND, 0.3, 0.2, None)
    for call, name, message in (
        (scene.body, "bean", "no body is called 'bean'; did you mean 'beam'"),
        (scene.body, 7, "no body is called 7"),
        (scene.body, "ground", "no body is called 'ground'; there are"),
        (scene.obstacle, "grund", "no obstacle is called 'grund'; did you mean 'ground'"),
    ):
        with pytest.raises(SceneError, match=message):
            call(name)
    assert "obstacles=['ground', 'obstacle0']" in repr(scene) and "obstacles" not in repr(Scene())


def test_names_are_unique_and_default_ones_skip_used_ones(scene):
    scene.add_body(MESH, Material(), name="body1")
    assert [scene.add_body(MESH, Material()).name for _ in range(2)] == ["body0", "body2"]
    scene.add_obstacle(GROUND, name="body3")
    assert scene.add_body(MESH, Material()).name == "body4"
    scene.add_body(MESH, Material(), name="obstacle0")
    assert scene.add_obstacle(GROUND).name == "obstacle1"
    for call, name, message in (
        (scene.add_obstacle, "body0", "obstacle name 'body0' is taken"),
        (scene.add_obstacle, " ", "obstacle name must be a text"),
        (lambda shape, name: scene.add_body(MESH, Material(), name), "body3", "body name 'body3' is taken"),
    ):
        with pytest.raises(SceneError, match=message):
            call(GROUND, name=name)


@pytest.mark.parametrize(
    "options, rule",
    [
        ({"name": "beam"}, "body name 'beam' is taken"),
        ({"name": "  "}, "body name must be a text that is not empty"),
        ({"order": 3}, "order must be 1 or 2, not 3"),
        ({"quadrature_degree": 2}, "quadrature_degree of order 1 must be 1, not 2"),
        ({"order": 2, "quadrature_degree": 3}, "quadrature_degree of order 2 must be 2 or 4, not 3"),
        ({"position": (0, np.nan, 0)}, r"position: entry \[1\] is nan, not finite"),
        ({"velocity": np.zeros((26, 3))}, r"velocity must have shape \(3,\) or \(27, 3\), not \(26, 3\)"),
        ({"mesh": MESH.vertices}, "mesh must be a TetMesh, not ndarray"),
        ({"material": {"young": 1e6}}, "materials are given by region, but its mesh has no regions"),
        ({"collision": "distance"}, "'b': collision must be one of auto, distance_field, proximity, not 'distance'; did you"),
    ],
)
def test_invalid_bodies_are_refused_and_leave_no_trace(scene, body, options, rule):
    with pytest.raises(SceneError, match=rule):
        scene.add_body(**({"mesh": MESH, "material": Material(), "name": "b"} | options))
    assert scene.bodies == [body]


# --- selections -------------------------------------------------------------------------------------------------------


def test_nodes_are_selected_by_ids_masks_and_functions(body):
    left = MESH.vertices[:, 0] < -0.4
    expected = np.flatnonzero(left).tolist()
    for where in (expected, np.flatnonzero(left), left, lambda X: X[:, 0] < -0.4):
        assert body.fix(where).nodes.tolist() == expected
    assert body.fix([5, 3, 5]).nodes.tolist() == [5, 3]
    assert body.fix(4, axes="zx").axes.tolist() == [True, False, True]
    assert len(body.fix(lambda X: np.add(X, 1.0, out=X)[:, 0] > 1.4).nodes) == 9 and body.rest_positions.max() == 0.5  # a copy


@pytest.mark.parametrize(
    "where, rule",
    [
        ([-1], "node -1 does not exist"),
        ([3, 27], "node 27 does not exist"),
        ([], "no node is chosen"),
        (np.ones(26, dtype=bool), r"a mask must have shape \(27,\), not \(26,\)"),
        ("left", "list of integers"),
        ([[1], [2, 3]], "choose by node ids"),
        (lambda X: X[:, 0], r"must return a bool mask of shape \(27,\), not float64"),
        (lambda X: True, r"must return a bool mask of shape \(27,\), not bool of shape \(\)"),
        (lambda X: X.missing, "the selection function failed: AttributeError"),
    ],
)
def test_invalid_selections_are_refused(body, where, rule):
    for call in (body.fix, lambda where: body.move(where, still), lambda where: body.add_force(where, (0, 0, 1))):
        with pytest.raises(SceneError, match=f"^body 'beam': .*{rule}"):
            call(where)
    assert not body.constraints and not body.forces


def test_invalid_axes_are_refused(body):
    for axes in ("", "xx", "w", "XY", None, ["x"]):
        for call in (body.fix, lambda where, axes: body.move(where, still, axes=axes)):
            with pytest.raises(SceneError, match="axes must be some of 'x', 'y', 'z'"):
                call([0], axes=axes)


@pytest.mark.parametrize(
    "path, rule",
    [
        (lambda t: None, "must give a displacement at t = 0, not None"),
        (lambda t: (0, 0), r"must have shape \(3,\) or \(2, 3\), not \(2,\)"),
        (lambda t: 1 / t, "the path failed at t = 0: ZeroDivisionError"),
        ((0, 0, 1), "path must be a function of time"),
    ],
)
def test_invalid_paths_are_refused(body, path, rule):
    with pytest.raises(SceneError, match=f"^body 'beam': move: .*{rule}"):
        body.move([1, 2], path)
    assert not body.constraints


def test_contradicting_constraints_are_refused(body):
    body.fix([0, 1])
    body.fix([1, 2], "y")  # node 1 again
    body.move([2], still, "x")  # another axis of a fixed node
    for call, message in (
        (lambda: body.move([4, 3, 4], still), "move: node 4 is chosen twice"),
        (lambda: body.move([5, 1], still), "move: node 1 is already fixed along x"),
        (lambda: body.fix([0, 2]), "fix: node 2 is already moved along x"),
        (lambda: body.move([2], still, "zx"), "move: node 2 is already moved along x"),
    ):
        with pytest.raises(SceneError, match=message):
            call()
    body.move([5], still)  # refused above for node 1
    assert len(body.constraints) == 4


def test_tractions_select_triangles_by_their_centroids(body):
    load = body.add_traction(lambda c: c[:, 1] > 0.49, (0, 2000, 0))
    x = MESH.vertices[MESH.surface[load.triangles]]
    areas = 0.5 * np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1)
    assert areas.sum() == pytest.approx(1.0) and load.value.tolist() == [0, 2000, 0]
    assert body.tractions == [load] and body.add_traction([3, 1], (1, 0, 0)).triangles.tolist() == [3, 1]
    for where, rule in (([48], "surface triangle 48 does not exist"), ([], "no surface triangle is chosen")):
        with pytest.raises(SceneError, match=rule):
            body.add_traction(where, (0, 1, 0))


@pytest.mark.parametrize("value", [(0, 1), 5.0, (0, np.nan, 0), "up", None])
def test_loads_must_be_three_finite_numbers(body, value):
    with pytest.raises(SceneError, match="add_traction: traction"):
        body.add_traction([0], value)
    with pytest.raises(SceneError, match="add_force: force"):
        body.add_force([0], value)
    assert not body.tractions and not body.forces


# --- contacts --------------------------------------------------------------------------------------------------------


def contact_scene() -> Scene:
    """Two bodies and two obstacles with different friction and restitution."""
    scene = Scene()
    scene.add_body(MESH, Material(friction=0.4, restitution=0.1), name="a")
    scene.add_body(MESH, Material(friction=0.9, restitution=0.3), name="b")
    scene.add_obstacle(GROUND, name="ground", friction=0.1, restitution=0.2)
    scene.add_obstacle(GROUND, name="ice", friction=0.0)
    return scene


def test_contact_numbers_follow_from_both_colliders_or_are_set():
    scene = contact_scene()
    assert scene.contact_numbers("a", "b") == pytest.approx((0.6, 0.3))
    assert scene.contact_numbers("ground", "a") == pytest.approx((0.2, 0.2))
    assert scene.contact_numbers("b", "ice") == (0.0, 0.3)
    assert scene.contact_numbers("b", "b") == (0.9, 0.3)
    scene.body("a").material = Material(friction=0.1)
    assert scene.contact_numbers("a", "b") == pytest.approx((0.3, 0.3))
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
        (("a", "b"), {}, "'a' and 'b': give friction or restitution"),
        (("a", "b"), {"friction": -1}, "'a' and 'b': friction must be at least 0"),
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
        ({"margin": -1e-9}, "margin must be at least 0 m"),
        ({"k_dop": 8}, "k_dop must be 6 or 14 or 18, not 8"),
        ({"field_cells": 7}, "field_cells must be a whole number from 8 to 256, not 7"),
        ({"initial_capacity": 63}, "initial_capacity must be a whole number from 64 to 2147483647, not 63"),
        ({"max_capacity": 2**31}, "max_capacity must be a whole number from 64"),
        ({"initial_capacity": 200, "max_capacity": 100}, "initial_capacity 200 must not exceed max_capacity 100"),
    ],
)
def test_invalid_collision_settings_are_refused(options, rule):
    with pytest.raises(SceneError, match=f"^collision settings: {rule}"):
        CollisionSettings(**options)


def test_the_contact_mode_follows_from_collision():
    scene = Scene()
    body = scene.add_body(MESH, Material(), name="beam")
    assert body.collision == "auto" and body.contact_mode == scene.snapshot().body("beam").contact_mode == "proximity"
    assert scene.add_body(MESH, Material(), collision="distance_field").contact_mode == "distance_field"
    body.collision = "distance_field"
    assert body.contact_mode == "distance_field"


def test_edges_are_sharp_if_they_are_convex_by_more_than_60_degrees():
    """The surface of a hole has concave edges only."""
    for mesh, sharp in ((ball_mesh(1.0, 8), False), (sheet_mesh((8, 8), (4, 0.05, 4)), True), (MESH, True)):
        nodes = make_nodes(mesh, 1)
        assert has_sharp_edges(nodes) == has_sharp_edges(make_nodes(mesh, 2)) == sharp
        assert not has_sharp_edges(replace(nodes, surface=nodes.surface[:, ::-1]))
        assert has_sharp_edges(replace(nodes, surface=np.tile(nodes.surface, (2, 1))))  # as of parts joined at an edge
    for degrees in (58.0, 62.0):  # of the normals of a roof's two sides
        height = np.tan(np.radians(degrees / 2))
        x = np.array([(0, height, 0), (0, height, 1), (1, 0, 0), (-1, 0, 0)])
        roof = replace(nodes, positions=x, surface=np.array([(0, 1, 2), (1, 0, 3)]))
        assert has_sharp_edges(roof) is (degrees > 60.0)


def test_principal_extents_are_the_sides_of_a_turned_box():
    box, turn = box_mesh((2, 1, 3), (1, 2, 3)), np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    assert sorted(principal_extents(box.vertices @ turn.T + (5, 6, 7), box.surface)) == pytest.approx([1, 2, 3])
