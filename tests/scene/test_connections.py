"""Springs, tendons and attachments as parts of a scene:

* points are found in bodies of both orders and follow their elements; invalid connections are refused in one sentence;
* bodies and obstacles that a connection names must stay; another body in their place is noticed;
* nodes are attached exactly only once, and only between bodies whose forces can be shared;
* the digest tells connections apart.
"""

import re

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.fem.springs import spring_table
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.locate import locate
from tests.dynamics.scenes import connected_scene, cube, rubber
from tests.fem.oracle_springs import shape_row


def two(order: int = 1) -> ts.Scene:
    """Two cubes one above the other, and three obstacles, of which one moves."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    scene.add_body(cube(), rubber(), name="a", order=order)
    scene.add_body(cube(), rubber(), name="b", position=(0, 0.9, 0), order=order)
    scene.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)), name="ground")
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="pin")
    scene.add_obstacle(ts.Sphere((9, 9, 0), 1.0), name="lift", path=lambda t: ((0, t, 0), np.eye(3)))
    return scene


# --- points -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2])
def test_points_are_found_and_follow_the_elements(order):
    mesh = ts.ball_mesh(1.0, 4)
    body = ts.Scene().add_body(mesh, rubber(), order=order)
    rng = np.random.default_rng(2)
    inside = np.einsum("kv,kvi->ki", rng.dirichlet(np.ones(4), 40), mesh.vertices[mesh.tets[rng.integers(0, mesh.n_tets, 40)]])
    points = np.concatenate([inside, body.rest_positions[rng.integers(0, body.n_nodes, 40)]])
    nodes, weights, outside = locate(body, points)
    assert (outside == 0.0).all() and nodes.shape == weights.shape == (80, 4 if order == 1 else 10)
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-9
    at_nodes = np.sort(np.abs(weights[40:]), axis=1)
    assert np.abs(at_nodes[:, -1] - 1).max() < 1e-9 and np.abs(at_nodes[:, :-1]).max() < 1e-9
    A = np.eye(3) + 0.2 * rng.standard_normal((3, 3))
    moved = np.einsum("pk,pki->pi", weights, (body.rest_positions @ A.T + 1.0)[nodes])
    assert np.abs(moved - (points @ A.T + 1.0)).max() < 1e-9
    curved = body.rest_positions**2  # a quadratic motion, which tets of order 2 follow exactly
    found = np.einsum("pk,pki->pi", weights, curved[nodes])
    expected = np.stack([shape_row(body, point) @ curved for point in points])
    assert np.abs(found - expected).max() < 1e-8
    if order == 2:
        assert np.abs(found - points**2).max() < 1e-8


def test_points_outside_extrapolate_from_the_nearest_tet():
    body = ts.Scene().add_body(cube(), rubber())
    _, weights, outside = locate(body, np.array([[0.0, 0.45 + 0.02, 0.0], [0.0, 5.0, 0.0]]))
    assert 0.0 < outside[0] < 0.1 < outside[1]
    assert weights.sum(axis=1) == pytest.approx(1.0)


def test_a_point_far_from_the_centroids_of_its_tet_is_found(recwarn):
    """In the long tets of a bar beside many small ones, whose centroids are nearer."""
    fine, coarse = ts.box_mesh((8, 8, 8), (1, 1, 1), (0.5, 0.5, 0.5)), ts.box_mesh((1, 1, 1), (40, 1, 1), (-20.001, 0.5, 0.5))
    mesh = ts.TetMesh(np.concatenate([fine.vertices, coarse.vertices]), np.concatenate([fine.tets, coarse.tets + fine.n_verts]))
    body = ts.Scene().add_body(mesh, rubber())
    point = np.array([[-0.05, 0.4, 0.5]])
    nodes, _, outside = locate(body, point)
    assert outside[0] == 0.0 and (nodes >= fine.n_verts).all()


# --- what is refused ---------------------------------------------------------------------------------------------------

A, B = ("a", (0, 0, 0)), ("b", (0, 0, 0))
REFUSALS = [
    (lambda s: s.add_spring(A, B, -1.0), "spring 'spring0': stiffness must be at least 0 N/m, not -1.0"),
    (lambda s: s.add_spring(A, B, 1.0, rest_length=-1), "spring 'spring0': rest_length must be at least 0 m, not -1"),
    (lambda s: s.add_spring(A, B, 1.0, name=""), "scene: spring name must be a text that is not empty, not ''"),
    (lambda s: s.add_spring(A, A, 1.0), "spring 'spring0': a and b are the same point of body 'a'"),
    (lambda s: s.add_spring(A, 3, 1.0), "spring 'spring0': b must be (name, point), the name of a body or obstacle and"),
    (lambda s: s.add_spring(A, ("c", 0), 1.0), "spring 'spring0': b: no body or obstacle is called 'c'"),
    (lambda s: s.add_spring(A, ("b", 8), 1.0), "spring 'spring0': b: the node must be a whole number from 0 to 7, not 8"),
    (lambda s: s.add_spring(A, ("b", (0, 0)), 1.0), "spring 'spring0': b: the point must have shape (3,), not (2,)"),
    (lambda s: s.add_spring(A, ("ground", 3), 1.0), "spring 'spring0': b: the point must have shape (3,), not ()"),
    (lambda s: s.add_spring(("a", (0, 2, 0)), B, 1.0), "spring 'spring0': a: the point lies outside of body 'a', by "),
    (
        lambda s: s.add_spring(("pin", (0, 0, 0)), ("ground", (0, 0, 0)), 1.0),
        "spring 'spring0': at least one point must be of a body",
    ),
    (lambda s: s.add_tendon([A], 1.0), "tendon 'tendon0': points must be a list of at least two"),
    (lambda s: s.add_tendon([A, B, 5], 1.0), "tendon 'tendon0': point 2 must be (name, point), the name of a body or obstacle"),
    (lambda s: s.add_tendon([("a", (0, 0.45, 0)), ("b", (0, -0.45, 0))], 1.0), "tendon 'tendon0': points 0 and 1 coincide"),
    (lambda s: s.add_tendon([A, B], -1.0), "tendon 'tendon0': force must be at least 0 N, not -1: a tendon cannot push"),
    (lambda s: s.add_tendon([A, B], (1, 2, 3)), "tendon 'tendon0': force must be a number, not of shape (3,)"),
    (
        lambda s: s.add_tendon([A, B], lambda t: (1, 2)),
        "tendon 'tendon0': the path's force at t = 0 must be a number, not of shape (2,)",
    ),
    (lambda s: s.add_tendon([A, B], ts.KeyFrames([0], [(0, 0, 0)])), "tendon 'tendon0': force: key frames need values here"),
    (lambda s: s.add_tendon([A, B]), "tendon 'tendon0': give either a force or a length"),
    (lambda s: s.add_tendon([A, B], 1.0, length=1.0), "tendon 'tendon0': give either a force or a length"),
    (lambda s: s.add_tendon([A, B], 1.0, stiffness=1.0), "tendon 'tendon0': stiffness is that of a tendon of given length: give"),
    (lambda s: s.add_tendon([A, B], length=0.0), "tendon 'tendon0': length must be above 0 m, not 0"),
    (lambda s: s.add_tendon([A, B], length=1.0, stiffness=0), "tendon 'tendon0': stiffness must be greater than 0 N/m, not 0"),
    (
        lambda s: s.add_tendon([("pin", (0, 0, 0)), ("ground", (0, 0, 0))], 1.0),
        "tendon 'tendon0': at least one point must be of a body",
    ),
    (lambda s: s.attach("pin", [0], "b", 1.0), "attachment 'attachment0': 'pin' is an obstacle: give the body first"),
    (lambda s: s.attach("a", [0], "a", 1.0), "attachment 'attachment0': body 'a' cannot be attached to itself"),
    (lambda s: s.attach("a", [0], "ground", 0.0), "attachment 'attachment0': stiffness must be greater than 0 N/m, not 0.0"),
    (lambda s: s.attach("a", [0], "ground", 1.0, -1), "attachment 'attachment0': damping must be at least 0 N s/m, not -1"),
    (lambda s: s.attach("a", lambda X: X[:, 0] > 9, "ground", 1.0), "attachment 'attachment0': no node is chosen"),
    (lambda s: s.attach("a", [2, 0], "b", 1.0, name="{x}"), "attachment '{x}': node 0 of body 'a' lies outside of body 'b', by "),
]


@pytest.mark.parametrize("call, message", REFUSALS)
def test_bad_connections_are_refused_in_one_sentence(call, message):
    scene = two()
    before = scene_digest(scene)
    with pytest.raises(SceneError, match="^" + re.escape(message)) as caught:
        call(scene)
    assert "\n" not in str(caught.value) and scene_digest(scene) == before


def test_names_are_unique_among_all_connections():
    scene = two()
    assert scene.add_spring(A, B, 1.0).name == "spring0" and scene.add_spring(A, B, 1.0).name == "spring1"
    scene.add_tendon([A, B], 1.0, name="attachment0")
    assert scene.attach("a", [2, 3], "b", 1.0).name == "attachment1"
    with pytest.raises(SceneError, match="^scene: attachment name 'spring1' is taken; names must be unique"):
        scene.attach("a", [2], "b", 1.0, name="spring1")
    del scene.springs[0]
    assert scene.add_spring(A, B, 1.0).name == "spring0"
    assert [one.name for one in scene.connections] == ["spring1", "spring0", "attachment0", "attachment1"]
    with pytest.raises(SceneError, match="^scene: springs cannot be changed by hand: call scene.add_spring"):
        scene.springs.append(scene.springs[0])


KINDS = {
    "spring": lambda s: s.add_spring(A, B, 1.0, name="x"),
    "tendon": lambda s: s.add_tendon([A, B], 1.0, name="x"),
    "attachment": lambda s: s.attach("a", [2, 3], "b", 1.0, name="x"),
}


@pytest.mark.parametrize("kind, removed", [("spring", "a"), ("tendon", "b"), ("attachment", "a"), ("attachment", "b")])
def test_bodies_that_a_connection_names_must_stay(kind, removed):
    scene = two()
    KINDS[kind](scene)
    scene.bodies.remove(scene.body(removed))
    for call in (scene.check, lambda: ts.Simulator(scene, 1e-4)):
        with pytest.raises(SceneError, match=f"^{kind} 'x': no body or obstacle is called '{removed}'"):
            call()
    elsewhere = ts.box_mesh((1, 1, 1), (1, 1, 1), center=(30, 0, 0))
    scene.add_body(elsewhere, rubber(), name=removed)  # another one in its place
    with pytest.raises(SceneError, match=f"^{kind} 'x': .* lies outside of body '[ab]'"):
        scene.check()


def test_an_attached_body_may_not_be_replaced_by_another_kind():
    scene = two()
    scene.attach("a", [2, 7], "ground", 1.0, name="x")
    scene.bodies.remove(scene.body("a"))
    scene.add_obstacle(ts.Sphere((50, 0, 0), 1.0), name="a")
    with pytest.raises(SceneError, match="^attachment 'x': 'a' is no longer the body whose nodes are attached"):
        scene.check()


EXACT = [
    (lambda s: s.attach("a", [2], "b", damping=1.0), "damping is that of springs: give a stiffness, too"),
    (lambda s: s.body("b").fix([0]), "attachment 'x': node 0 of body 'b' is fixed or moved, too"),
    (lambda s: s.body("b").move([1], lambda t: (0, t, 0)), "attachment 'x': node 1 of body 'b' is fixed or moved, too"),
    (lambda s: s.attach("b", [0], "a", name="again"), "attachment 'again': node 0 of body 'b' is attached already"),
    (lambda s: s.attach("b", [1], "pin", name="again"), "attachment 'again': node 1 of body 'b' is attached already"),
    (lambda s: setattr(s.body("a"), "material", rubber(mass_damping=1.0)), "'b' and 'a' must have the same mass_damping"),
    (
        lambda s: setattr(s.body("b"), "material", rubber(stiffness_damping=1.0)),
        "'b' and 'a' must have the same stiffness_damping",
    ),
]


@pytest.mark.parametrize("change, message", EXACT)
def test_exact_attachments_that_cannot_be_kept_are_refused(change, message):
    scene = two()
    scene.attach("b", [0, 1], "a", name="x")
    scene.check()
    with pytest.raises(SceneError, match=message):
        change(scene)
        scene.check()


def test_nodes_of_a_mean_dilatation_are_not_attached_exactly():
    scene = two()
    scene.add_body(cube(), rubber(), name="c", position=(0, 1.8, 0), dilatation="mean")
    scene.attach("b", [2, 3], "c")
    scene.check()
    scene.attach("c", [4], "b")
    with pytest.raises(SceneError, match="nodes of body 'c' cannot be attached exactly, since its dilatation is a mean"):
        scene.check()


def test_bodies_may_move_before_the_start():
    """Springs follow: their rest length is the distance at the start. Attachments must still fit."""
    scene = two()
    scene.add_spring(A, B, 1.0)
    scene.body("b").position = (0, 3, 0)
    assert spring_table(scene).rest_length == pytest.approx([3.0])
    tendon = scene.add_tendon([A, B], 1.0, name="line")
    scene.body("b").position = (0, 0, 0)
    assert spring_table(scene).rest_length[0] == 0.0
    with pytest.raises(SceneError, match="^tendon 'line': points 0 and 1 coincide"):
        scene.check()
    scene.tendons.remove(tendon)
    scene.body("b").position = (0, 0.9, 0)
    scene.attach("a", [2, 3], "b", 1.0, name="x")
    scene.check()
    scene.body("b").position = (0, 3, 0)
    with pytest.raises(SceneError, match="^attachment 'x': node 3 of body 'a' lies outside of body 'b'"):
        scene.check()


# --- what other parts know ---------------------------------------------------------------------------------------------

RAMP = ts.KeyFrames((0.0, 0.01), values=(10.0, 60.0))


def pulled(force) -> ts.Scene:
    scene = connected_scene(damping=5.0)
    scene.tendons.clear()
    scene.add_tendon([("a", 1), ("pin", (0.1, 2.8, 0.0)), ("b", 6)], force, name="a/line")
    scene.add_tendon([("a", 3), ("b", 5)], 3.0, name="other")
    return scene


CHANGES = [
    lambda s: s.springs.pop(0),
    lambda s: s.add_spring(A, ("b", (0.7, 0.1, 0)), 1.0, name="new"),
    lambda s: s.attach("a", [0], "pin", 1.0, name="new"),
    lambda s: s.tendons.pop(),
    lambda s: (s.tendons.pop(), s.add_tendon([("a", 3), ("b", 5)], RAMP, name="other")),
    lambda s: (s.tendons.pop(), s.add_tendon([("a", 3), ("b", 6)], 3.0, name="other")),
    lambda s: (s.tendons.pop(), s.add_tendon([("a", 3), ("b", 5)], length=3.0, name="other")),
    lambda s: (s.tendons.pop(), s.add_tendon([("a", 3), ("b", 5)], length=3.0, stiffness=1.0, name="other")),
]


def test_the_digest_tells_connections_apart():
    scenes = [pulled(20.0) for _ in range(len(CHANGES) + 1)]
    for scene, change in zip(scenes, CHANGES):
        change(scene)
    assert len({scene_digest(scene) for scene in scenes}) == len(scenes) and scene_digest(pulled(20.0)) == scene_digest(
        scenes[-1]
    )
