"""Scenes, bodies and materials: elastic constants, names, selections, constraints, friction and restitution of a pair, collision
settings, sharp edges; whatever is invalid is refused and leaves no trace.
"""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from taisoft.errors import SceneError
from taisoft.mesh.nodes import make_nodes
from taisoft.mesh.shapes import ball_mesh, box_mesh, sheet_mesh
from taisoft.scene.collision import CollisionSettings, has_sharp_edges, principal_extents
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.loads import LOAD_KINDS, BodyLoad, load_kind
from taisoft.scene.obstacles import Box, HalfSpace, Sphere
from taisoft.scene.scene import Material, Scene

MESH = box_mesh((2, 2, 2), (1.0, 1.0, 1.0))
GROUND = HalfSpace((0, 0, 0), (0, 1, 0))


@pytest.fixture
def scene() -> Scene:
    """Two bodies and two obstacles with different friction and restitution."""
    scene = Scene()
    scene.add_body(MESH, Material(friction=0.4, restitution=0.1), name="a")
    scene.add_body(MESH, Material(friction=0.9, restitution=0.3), name="b")
    scene.add_obstacle(GROUND, name="ground", friction=0.1, restitution=0.2)
    scene.add_obstacle(GROUND, name="ice", friction=0.0)
    return scene


def still(t):
    return (0.0, 0.0, 0.0)


def test_up_follows_gravity_unless_it_is_given():
    """And gravity up; the ground is level. Nothing else changes up, not even another gravity."""
    for arguments, up, gravity in (
        ({}, "y", (0, -9.81, 0)),
        ({"up": "z"}, "z", (0, 0, -9.81)),
        ({"gravity": (0, 0, -1)}, "z", (0, 0, -1)),
        ({"gravity": (0, 0, -1), "up": "y"}, "y", (0, 0, -1)),
        ({"gravity": (0, 0, 1)}, "y", (0, 0, 1)),
        ({"gravity": (0, -1e-9, -1)}, "y", (0, -1e-9, -1)),
    ):
        scene = Scene(**arguments)
        ground, high = scene.add_ground(), scene.add_ground(-0.5, 0.1, 0.2, "high")
        assert (
            scene.up == up and np.array_equal(scene.gravity, gravity) and (np.signbit(scene.gravity) == (scene.gravity < 0)).all()
        )
        axis = np.eye(3)["xyz".index(up)]
        assert np.array_equal(ground.shape.normal, axis) and not ground.shape.point.any() and ground.name == "ground"
        assert np.array_equal(high.shape.point, -0.5 * axis) and (high.friction, high.restitution) == (0.1, 0.2)
        scene.gravity = (0, 0, -2)
        scene.freeze()
        assert scene.up == scene.snapshot().up == up
        with pytest.raises(SceneError, match="^scene: up cannot change any more"):
            scene.up = "z"
    for value in ("x", 1, (0, 0, 1)):
        with pytest.raises(SceneError, match="^scene: up must be one of y, z, not "):
            Scene(up=value)


@pytest.mark.parametrize("poisson", [-0.5, 0.0, 0.49])
def test_lame_parameters_satisfy_hookes_law(poisson):
    rubber = Material(young=2e6, poisson=poisson)
    # uniaxial stress: a strain of (1, -nu, -nu) e gives a stress of young e along the axis and none across it
    trace = 1.0 - 2.0 * poisson
    assert 2 * rubber.mu + rubber.lam * trace == pytest.approx(2e6)
    assert -2 * rubber.mu * poisson + rubber.lam * trace == pytest.approx(0.0, abs=1e-6)


def test_near_incompressibility_is_warned_of_for_linear_tets():
    """From 0.45 their dilatation is a mean, unless a local one is given; quadratic tets have a mean one only if it is given."""
    mesh, with_region = box_mesh((1, 1, 1), (1, 1, 1)), np.r_[np.full(4, 0.3), 0.45]
    with pytest.warns(UserWarning, match="body 'locks': poisson = 0.45 is at least 0.45, where linear tets lock"):
        assert Scene().add_body(mesh, Material(poisson=0.45), name="locks", dilatation="local").dilatation == "local"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for expected, given in (
            ("mean", {"poisson": 0.45}),
            ("mean", {"poisson": with_region}),
            ("local", {"poisson": 0.4499}),
            ("mean", {"poisson": 0.3, "dilatation": "mean"}),
            ("local", {"poisson": 0.495, "order": 2}),
            ("mean", {"poisson": 0.495, "order": 2, "dilatation": "mean"}),
        ):
            body = Scene().add_body(mesh, Material(), **given)
            assert (body.dilatation, body.given_dilatation) == (expected, given.get("dilatation", "auto"))
        body = Scene().add_body(mesh, Material())
        body.poisson = 0.47
        assert body.dilatation == "mean"
        body.material = Material(poisson=0.4)
        assert body.dilatation == "local"


def test_invalid_materials_are_refused():
    for field, rule, values in (
        ("young", "must be", [0, -1, np.nan, np.inf, "1e5 Pa", None, True, 1j, [1e5], 10**400]),
        ("young", "is .* too (large|small) for a 32-bit float", [1e300, 1e-60]),
        ("density", "must be", [0, np.nan, "1000"]),
        ("friction", "must be", [-0.1, np.inf]),
        ("restitution", "must be", [-0.1, 1.5, np.nan]),
        ("mass_damping", "must be", [-1e-9, "0"]),
        ("stiffness_damping", "must be", [-1e-9, np.inf]),
        ("poisson", r"must lie in the open interval \(-1, 0.5\), not", [0.5, -1]),
        ("volume_floor", "must be", [-0.1, 1e-4, 1.0, np.nan]),
        ("law", "must be one of .*did you mean 'corotational'", ["corotated"]),
        ("law", "must be one of st_venant_kirchhoff, corotational, .*, not", ["hooke", "", None]),
    ):
        for value in values:
            with pytest.raises(SceneError, match=f"^material: {field} {rule}"):
                Material(**{field: value})


def test_bodies_and_obstacles_are_found_by_name(scene):
    other = scene.add_body(MESH, Material(), position=(1, 2, 3), velocity=np.ones((27, 3)))
    assert scene.body("body0") is other and [body.name for body in scene.bodies] == ["a", "b", "body0"]
    assert other.velocity.shape == (27, 3) and other.position.tolist() == [1, 2, 3]
    assert np.array_equal(other.rest_positions, MESH.vertices)  # position shifts the initial state only
    ball = scene.add_obstacle(Sphere((0, 0, 0), 1), name="body1")
    assert scene.obstacle("body1") is ball and scene.add_obstacle(GROUND).name == "obstacle0"
    assert scene.add_body(MESH, Material()).name == "body2" and scene.colliders == [*scene.bodies, *scene.obstacles]
    ground = scene.obstacle("ground")
    assert (ground.shape, ground.friction, ground.restitution, ground.path) == (GROUND, 0.1, 0.2, None)
    with pytest.raises(SceneError, match="no obstacle is called 'ground'; there are none"):
        Scene().obstacle("ground")


def add(**options):
    return lambda s, b: s.add_body(**({"mesh": MESH, "material": Material(), "name": "c"} | options))


REFUSALS = [  # the call on a scene and its body "a", and the message
    *((lambda s, b, g=g: setattr(s, "gravity", g), "^scene: gravity") for g in ((0, -9.81), "down", (0, np.nan, 0), None)),
    (lambda s, b: Scene(gravity=(0, -9.81)), "^scene: gravity"),
    (lambda s, b: s.body("aa"), "no body is called 'aa' .did you mean a[?]"),
    (lambda s, b: s.obstacle("grund"), "no obstacle is called 'grund' .did you mean ground"),
    (lambda s, b: s.add_obstacle(GROUND, name="a"), "obstacle name 'a' is taken"),
    (lambda s, b: s.add_obstacle(GROUND, name=" "), "obstacle name must be a text"),
    (add(name="ice"), "body name 'ice' is taken"),
    (add(order=3), "order must be 1 or 2, not 3"),
    (add(quadrature_degree=2), "quadrature_degree of order 1 must be 1, not 2"),
    (add(velocity=np.zeros((26, 3))), r"velocity must have shape \(3,\) or \(27, 3\), not \(26, 3\)"),
    (add(mesh=MESH.vertices), "mesh must be a TetMesh, not ndarray"),
    (add(material={"young": 1e6}), "materials are given by region, but its mesh has no regions"),
    (add(collision="distance"), "'c': collision must be one of auto, distance_field, proximity, not 'distance'; did you"),
    (lambda s, b: b.fix([-1]), "^body 'a': .*node -1 does not exist"),
    (lambda s, b: b.move([3, 27], still), "^body 'a': .*node 27 does not exist"),
    (lambda s, b: b.add_force([], (0, 0, 1)), "^body 'a': .*no node is chosen"),
    (lambda s, b: b.fix(np.ones(26, dtype=bool)), r"a mask must have shape \(27,\), not \(26,\)"),
    *((lambda s, b, ids=ids: b.fix(ids), "node ids must be a list of integers") for ids in ("left", [True, 3], [0.0, 1.0])),
    (lambda s, b: b.fix((MESH.vertices[:, 0] < 0).astype(int)), "a': fix: 27 node ids that are all 0 or 1 are a mask: give"),
    (lambda s, b: b.add_pressure(np.uint8([0, 255] * 24), 1.0), "48 surface triangle ids that are all 0 or 255 are a mask"),
    (lambda s, b: s.attach("a", [0, 1, 1], "ground"), "attachment0.*3 node ids that are all 0 or 1 are a mask"),
    (lambda s, b: b.fix(lambda X: X[:, 0]), r"must return a bool mask of shape \(27,\), not float64"),
    (lambda s, b: b.fix(lambda X: X.missing), "the selection function failed: AttributeError"),
    *((lambda s, b, axes=axes: b.fix([0], axes), "axes must be some of 'x', 'y', 'z'") for axes in ("", "xx", "w", None)),
    (lambda s, b: b.move([1, 2], lambda t: None), "^body 'a': move: .*must give a displacement at t = 0, not None"),
    (lambda s, b: b.move([1, 2], lambda t: (0, 0)), r"^body 'a': move: .*must have shape \(3,\) or \(2, 3\), not \(2,\)"),
    (lambda s, b: b.move([1, 2], lambda t: 1 / t), "^body 'a': move: .*the path failed at t = 0: ZeroDivisionError"),
    (lambda s, b: b.move([1, 2], (0, 0, 1)), "^body 'a': move: .*path must be a function of time"),
    (lambda s, b: b.add_traction([48], (0, 1, 0)), "surface triangle 48 does not exist"),
    (lambda s, b: b.add_traction([], (0, 1, 0)), "no surface triangle is chosen"),
    *((lambda s, b, v=v: b.add_traction([0], v), "add_traction: traction") for v in ((0, 1), 5.0, (0, np.nan, 0), "up")),
    *((lambda s, b, v=v: b.add_force([0], v), "add_force: force") for v in ((0, 1), 5.0, (0, np.nan, 0), "up")),
    (lambda s, b: s.set_contact("a", "grond", friction=1), "^scene: .*no body or obstacle is called 'grond' .did you mean gro"),
    (lambda s, b: s.set_contact("ground", "ice", friction=1), "^scene: .*'ground' and 'ice': one of the two must be a body"),
    (lambda s, b: s.set_contact("a", "b"), "^scene: .*'a' and 'b': give friction or restitution"),
    (lambda s, b: s.set_contact("a", "b", friction=-1), "^scene: .*'a' and 'b': friction must be at least 0"),
]


@pytest.mark.parametrize("call, message", REFUSALS)
def test_what_is_invalid_is_refused_and_leaves_no_trace(scene, call, message):
    before = scene_digest(scene)
    with pytest.raises(SceneError, match=message):
        call(scene, scene.body("a"))
    assert scene_digest(scene) == before and len(scene.bodies) == 2


def test_nodes_and_triangles_are_selected_by_ids_masks_and_functions(scene):
    body, left = scene.body("a"), MESH.vertices[:, 0] < -0.4
    expected = np.flatnonzero(left).tolist()
    for where in (expected, np.flatnonzero(left), left, lambda X: X[:, 0] < -0.4):
        assert body.fix(where).nodes.tolist() == expected
    assert body.fix([5, 3, 5]).nodes.tolist() == [5, 3]
    assert body.fix(4, axes="zx").axes.tolist() == [True, False, True]
    assert len(body.fix(lambda X: np.add(X, 1.0, out=X)[:, 0] > 1.4).nodes) == 9 and body.rest_positions.max() == 0.5  # a copy
    load = body.add_traction(lambda c: c[:, 1] > 0.49, (0, 2000, 0))
    assert load.triangles.tolist() == np.flatnonzero((MESH.vertices[MESH.surface][:, :, 1] > 0.49).all(axis=1)).tolist()
    assert body.tractions == (load,) and load.value.tolist() == [0, 2000, 0]


def test_contradicting_constraints_are_refused(scene):
    body = scene.body("a")
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


def test_contact_numbers_follow_from_both_colliders_or_are_set(scene):
    assert scene.contact_numbers("a", "b") == pytest.approx((0.6, 0.3))
    assert scene.contact_numbers("ground", "a") == pytest.approx((0.2, 0.2))
    assert scene.contact_numbers("b", "ice") == (0.0, 0.3)
    assert scene.contact_numbers("b", "b") == (0.9, 0.3)
    scene.body("a").material = Material(friction=0.1)
    assert scene.contact_numbers("a", "b") == pytest.approx((0.3, 0.3))
    scene.set_contact("a", "ground", friction=0.7)
    assert scene.contact_numbers("a", "ground") == scene.contact_numbers("ground", "a") == (0.7, 0.2)
    scene.set_contact("ground", "a", restitution=1)
    scene.set_contact("a", "a", friction=0, restitution=0.5)
    assert scene.contact_pairs == {frozenset("a"): (0.0, 0.5), frozenset(("a", "ground")): (0.7, 1.0)}


def test_a_snapshot_does_not_follow_later_changes(scene):
    scene.set_contact("a", "b", friction=0.7)
    scene.collision = CollisionSettings(k_dop=14)
    companion = scene.snapshot()
    scene.set_contact("a", "b", friction=0.1)
    scene.add_obstacle(Box((0, 0, 0), (1, 1, 1)))
    scene.collision = CollisionSettings()
    scene.body("a").collision = "distance_field"
    assert companion.contact_numbers("a", "b") == (0.7, 0.3) and len(companion.obstacles) == 2 and companion.collision.k_dop == 14
    assert companion.body("a").contact_mode == "proximity" and scene.body("a").contact_mode == "distance_field"


def test_invalid_collision_settings_are_refused():
    for options, rule in (
        ({"broad_phase": "hash"}, "broad_phase must be one of auto, spatial_hash, bvh, not 'hash'"),
        ({"cell_ratio": 0}, "cell_ratio must be greater than 0, not 0"),
        ({"margin": -1e-9}, "margin must be at least 0 m"),
        ({"k_dop": 8}, "k_dop must be 6 or 14 or 18, not 8"),
        ({"field_cells": 7}, "field_cells must be a whole number from 8 to 256, not 7"),
        ({"initial_capacity": 63}, "initial_capacity must be a whole number from 64 to 2147483647, not 63"),
        ({"max_capacity": 2**31}, "max_capacity must be a whole number from 64"),
        ({"initial_capacity": 200, "max_capacity": 100}, "initial_capacity 200 must not exceed max_capacity 100"),
    ):
        with pytest.raises(SceneError, match=f"^collision settings: {rule}"):
            CollisionSettings(**options)


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


def test_what_is_removed_takes_its_contacts_with_it(scene):
    a, b = scene.bodies
    scene.set_contact(a.name, b.name, friction=0.3)
    scene.remove(b)
    assert not scene.contact_pairs and scene.bodies == (a,)
    with pytest.raises(SceneError, match=r"remove: .* is none of its bodies.*: pass them one by one, as in remove\(\*items\)"):
        scene.remove([a])


def test_kinds_of_loads_are_checked(scene, monkeypatch):
    monkeypatch.setattr("taisoft.scene.loads.LOAD_KINDS", dict(LOAD_KINDS))

    class Own(BodyLoad):
        items = "triangles"

    class Scalar(Own):
        shapes = ((),)

    class OnNodes(BodyLoad):
        items, arrows = "nodes", "tractions"

    for cls, kind, message in (
        (Own, "fix", "'fix': scene files have another use for this name"),
        (Scalar, "own", "'own': the values of a dead load have shape"),
        (OnNodes, "own", "'own': arrows are drawn on triangles"),
    ):
        with pytest.raises(SceneError, match=f"^load kind {message}"):
            load_kind(kind)(cls)
    body = scene.bodies[0]
    for call, message in (
        (lambda: body.add_load("wind", [0], 1.0), "add_load: kind must be one of traction, force, pressure, cavity, not 'wind'"),
        (lambda: body.add_load("force", [0]), "add_force: force: missing a required argument: 'force'"),
        (lambda: body.add_load("force", [0], (1, 0, 0), strength=2.0), "add_force: force: got an unexpected keyword argument"),
    ):
        with pytest.raises(SceneError, match=message):
            call()
