"""Springs, tendons and attachments of a scene: points are found in bodies of both orders; invalid ones are refused; what they
name must stay; the digest tells scenes apart; refined scenes and those of another order keep them (files: test_toml_*.py).
"""

import re

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.fem.springs import spring_table
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.locate import locate
from taisoft.scene.refine import refined, with_order
from tests.dynamics.scenes import cube, rubber
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


@pytest.mark.parametrize("order", [1, 2])
def test_points_are_found_and_follow_the_elements(order):
    mesh = ts.ball_mesh(1.0, 4)
    body = ts.Scene().add_body(mesh, rubber(), order=order)
    rng = np.random.default_rng(2)
    inside = np.einsum("kv,kvi->ki", rng.dirichlet(np.ones(4), 40), mesh.vertices[mesh.tets[rng.integers(0, mesh.n_tets, 40)]])
    at = rng.integers(0, body.n_nodes, 40)
    points, x = np.concatenate([inside, body.rest_positions[at]]), rng.standard_normal((body.n_nodes, 3))
    nodes, weights, outside = locate(body, points)
    assert (outside == 0.0).all() and nodes.shape == weights.shape == (80, 4 if order == 1 else 10)
    found = np.einsum("pk,pki->pi", weights, x[nodes])
    assert np.abs(found - np.stack([shape_row(body, point) @ x for point in points])).max() < 1e-8
    assert np.abs(found[40:] - x[at]).max() < 1e-8


def test_points_outside_extrapolate_and_those_far_from_the_centroid_of_their_tet_are_found():
    """The latter in the long tets of a bar beside many small ones, whose centroids are nearer."""
    body = ts.Scene().add_body(cube(), rubber())
    _, weights, outside = locate(body, np.array([[0.0, 0.45 + 0.02, 0.0], [0.0, 5.0, 0.0]]))
    assert 0.0 < outside[0] < 0.1 < outside[1]
    assert weights.sum(axis=1) == pytest.approx(1.0)
    fine, coarse = ts.box_mesh((8, 8, 8), (1, 1, 1), (0.5, 0.5, 0.5)), ts.box_mesh((1, 1, 1), (40, 1, 1), (-20.001, 0.5, 0.5))
    mesh = ts.TetMesh(np.concatenate([fine.vertices, coarse.vertices]), np.concatenate([fine.tets, coarse.tets + fine.n_verts]))
    nodes, _, outside = locate(ts.Scene().add_body(mesh, rubber(), order=2), np.array([[-0.05, 0.4, 0.5]]))
    assert outside[0] == 0.0 and (nodes[:, :4] >= fine.n_verts).all()


A, B = ("a", (0, 0, 0)), ("b", (0, 0, 0))
REFUSALS = [
    (lambda s: s.add_spring(A, B, -1.0), "spring 'spring0': stiffness must be at least 0 N/m, not -1.0"),
    (lambda s: s.add_spring(A, B, 1.0, rest_length=-1), "spring 'spring0': rest_length must be at least 0 m, not -1"),
    (lambda s: s.add_spring(A, B, 1.0, name=""), "scene: spring name must be a text that is not empty, not ''"),
    (lambda s: s.add_spring(A, A, 1.0), "spring 'spring0': a and b are the same point of body 'a'"),
    (lambda s: s.add_spring(A, 3, 1.0), "spring 'spring0': b must be (name, point), the name of a body or obstacle and"),
    (lambda s: s.add_spring(A, ("c", 0), 1.0), "spring 'spring0': b: no body or obstacle is called 'c'"),
    (lambda s: s.add_spring(A, ("b", 8), 1.0), "spring 'spring0': b: the node must be a whole number from 0 to 7, not 8"),
    (lambda s: s.add_spring(("a", (0, 2, 0)), B, 1.0), "spring 'spring0': a: the point lies outside of body 'a', by "),
    (lambda s: s.add_spring(("pin", (0, 0, 0)), ("ground", (0, 0, 0)), 1.0), "spring 'spring0': at least one point must be of a"),
    (lambda s: s.add_tendon([A], 1.0), "tendon 'tendon0': points must be a list of at least two"),
    (lambda s: s.add_tendon([A, B, 5], 1.0), "tendon 'tendon0': point 2 must be (name, point), the name of a body or obstacle"),
    (lambda s: s.add_tendon([("a", (0, 0.45, 0)), ("b", (0, -0.45, 0))], 1.0), "tendon 'tendon0': points 0 and 1 coincide"),
    (lambda s: s.add_tendon([A, B], -1.0), "tendon 'tendon0': force must be at least 0 N, not -1: a tendon cannot push"),
    (lambda s: s.add_tendon([A, B], lambda t: (1, 2)), "tendon 'tendon0': the path's force at t = 0 must be a number, not of"),
    (lambda s: s.add_tendon([A, B], ts.KeyFrames([0], [(0, 0, 0)])), "tendon 'tendon0': force: key frames need values here"),
    (lambda s: s.add_tendon([A, B]), "tendon 'tendon0': give either a force or a length"),
    (lambda s: s.add_tendon([A, B], 1.0, stiffness=1.0), "tendon 'tendon0': stiffness is that of a tendon of given length: give"),
    (lambda s: s.add_tendon([A, B], length=0.0), "tendon 'tendon0': length must be above 0 m, not 0"),
    (lambda s: s.add_tendon([A, B], length=1.0, stiffness=0), "tendon 'tendon0': stiffness must be greater than 0 N/m, not 0"),
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
    assert [one.name for one in scene.connections] == ["spring0", "spring1", "attachment0", "attachment1"]


CONNECTIONS = {
    "spring": lambda s: s.add_spring(A, B, 1.0, name="x"),
    "tendon": lambda s: s.add_tendon([A, B], 1.0, name="x"),
    "attachment": lambda s: s.attach("a", [2, 3], "b", 1.0, name="x"),
}


def test_bodies_that_a_connection_names_must_stay():
    for kind, add in CONNECTIONS.items():
        for removed in "ab":
            scene = two()
            add(scene)
            scene.remove(scene.body(removed))
            with pytest.raises(SceneError, match=f"^{kind} 'x': no body or obstacle is called '{removed}'"):
                scene.check()
    scene = two()
    CONNECTIONS["attachment"](scene)
    scene.remove(scene.bodies[0])
    scene.add_obstacle(ts.Sphere((50, 0, 0), 1.0), name="a")
    with pytest.raises(SceneError, match="^attachment 'x': 'a' is no longer the body whose nodes are attached"):
        scene.check()


def attach_a_mean(scene: ts.Scene) -> None:
    scene.add_body(cube(), rubber(), name="c", position=(0, 1.8, 0), dilatation="mean")
    scene.attach("c", [4], "b")


EXACT = [
    (attach_a_mean, "nodes of body 'c' cannot be attached exactly, since its dilatation is a mean"),
    (lambda s: s.attach("a", [2], "b", damping=1.0), "damping is that of springs: give a stiffness, too"),
    (lambda s: s.body("b").fix([0]), "attachment 'x': node 0 of body 'b' is fixed or moved, too"),
    (lambda s: s.body("b").move([1], lambda t: (0, t, 0)), "attachment 'x': node 1 of body 'b' is fixed or moved, too"),
    (lambda s: s.attach("b", [0], "a", name="again"), "attachment 'again': node 0 of body 'b' is attached already"),
    (lambda s: s.attach("b", [1], "pin", name="again"), "attachment 'again': node 1 of body 'b' is attached already"),
    (lambda s: setattr(s.body("a"), "material", rubber(mass_damping=1.0)), "'b' and 'a' must have the same mass_damping"),
    (lambda s: setattr(s.body("b"), "material", rubber(stiffness_damping=1.0)), "'b' and 'a' must have the same stiffness_damp"),
]


@pytest.mark.parametrize("change, message", EXACT)
def test_exact_attachments_that_cannot_be_kept_are_refused(change, message):
    scene = two()
    scene.attach("b", [0, 1], "a", name="x")
    scene.check()
    with pytest.raises(SceneError, match=message):
        change(scene)
        scene.check()


def test_bodies_may_move_before_the_start():
    """Springs follow: their rest length is the distance at the start. Tendons and attachments must still fit."""
    scene = two()
    scene.add_spring(A, B, 1.0)
    for height in (3.0, 0.0):
        scene.body("b").position = (0, height, 0)
        assert spring_table(scene).rest_length == pytest.approx([height])
    scene.body("b").position = (0, 0.9, 0)
    scene.add_tendon([A, B], 1.0, name="line")
    scene.attach("a", [2, 3], "b", 1.0, name="x")
    scene.check()
    for height, message in (
        (0, "tendon 'line': points 0 and 1 coincide"),
        (3, "attachment 'x': node 3 of body 'a' lies outside"),
    ):
        scene.body("b").position = (0, height, 0)
        with pytest.raises(SceneError, match=f"^{message}"):
            scene.check()


def connected() -> ts.Scene:
    scene = two()
    scene.add_spring(A, B, 1.0, damping=5.0)
    scene.add_tendon([A, ("pin", (0.1, 2.8, 0.0)), ("b", 6)], 20.0)
    scene.add_tendon([("a", 3), ("b", 5)], 3.0, name="other")
    return scene


RAMP = ts.KeyFrames((0.0, 0.01), values=(10.0, 60.0))
CHANGES = [
    lambda s: s.remove(s.springs[0]),
    lambda s: s.add_spring(A, ("b", (0.2, 0.1, 0)), 1.0, name="new"),
    *(lambda s, n=n, k=k: s.attach("a", [n], "pin", k, name="new") for n, k in ((0, 1.0), (1, 1.0), (0, 2.0))),
    lambda s: s.remove(s.tendons[-1]),
    lambda s: (s.remove(s.tendons[-1]), s.add_tendon([("a", 3), ("b", 5)], RAMP, name="other")),
    lambda s: (s.remove(s.tendons[-1]), s.add_tendon([("a", 3), ("b", 6)], 3.0, name="other")),
    lambda s: (s.remove(s.tendons[-1]), s.add_tendon([("a", 3), ("b", 5)], length=3.0, name="other")),
    lambda s: (s.remove(s.tendons[-1]), s.add_tendon([("a", 3), ("b", 5)], length=3.0, stiffness=1.0, name="other")),
    lambda s: setattr(s.body("a"), "position", (0, 0, 1)),
    lambda s: setattr(s.body("a"), "velocity", (0, 0, 1)),
    lambda s: setattr(s.body("a"), "young", np.linspace(1e3, 1e4, 5)),
    lambda s: s.body("a").fix([0]),
    lambda s: s.body("a").fix([0], "x"),
    lambda s: s.body("a").add_force([0], (0, 0, 1)),
    lambda s: s.body("a").add_force([0], (0, 0, 2)),
    lambda s: s.body("a").add_traction([0], (0, 0, 1)),
    lambda s: s.set_contact("a", "b", friction=0.1),
    lambda s: setattr(s, "gravity", (0, 0, 1)),
    lambda s: s.add_obstacle(ts.Sphere((0, 0, 99), 1)),
    lambda s: s.add_obstacle(ts.Sphere((0, 0, 99), 2)),
    lambda s: s.add_obstacle(ts.Sphere((0, 0, 99), 1), path=ts.KeyFrames((0, 1), [(0, 0, 0), (0, 0, 1)])),
]


def test_the_digest_tells_scenes_apart():
    scenes = [connected() for _ in range(len(CHANGES) + 1)]
    for scene, change in zip(scenes, CHANGES):
        change(scene)
    assert len({scene_digest(scene) for scene in scenes}) == len(scenes)
    assert scene_digest(connected()) == scene_digest(scenes[-1])


@pytest.mark.parametrize("order, other", [(1, "refined"), (2, "refined"), (1, 2), (2, 1)])
def test_other_meshes_keep_the_connections(order, other):
    """Under an affine motion every spring pulls as before, and attachments are as stiff in all."""
    scene = two(order)
    scene.add_spring(A, ("b", (0.1, 0.2, 0.3)), 30.0, damping=4.0, name="s")
    scene.add_tendon([A, ("pin", (0, 8, 0)), B], lambda t: 7.0, name="t")
    scene.attach("a", lambda X: X[:, 1] > 0.44, "b", 100.0, 5.0, name="chosen")
    scene.attach("a", np.flatnonzero(scene.body("a").rest_positions[:, 1] < -0.44), "ground", 100.0, name="by id")
    changed = refined(scene) if other == "refined" else with_order(scene, other)
    assert [one.name for one in changed.connections] == ["s", "t", "chosen", "by id"] and len(scene.attachments) == 2
    affine = np.array([[1.1, 0.1, 0.0], [0.0, 0.9, 0.2], [0.1, 0.0, 1.2]])
    forces = []
    for one in (scene, changed):
        x = np.concatenate([body.rest_positions + body.position for body in one.bodies])
        x[one.bodies[0].n_nodes :] += (0.1, 0.0, 0.0)
        table = spring_table(one)
        pulls = table.pulls(x @ affine.T, x, np.array([7.0]))
        forces.append([pulls[table.elements["s"]], pulls[table.elements["t"]]])
        chosen = pulls[table.elements["chosen"]]
        k = [a.stiffness * len(a.nodes) for a in one.attachments]
        # between the bodies all nodes have the same stretch and rate
        forces[-1] += [chosen.sum(axis=0), k, [a.damping * len(a.nodes) for a in one.attachments]]
    for before, after in zip(*forces):
        assert after == pytest.approx(np.array(before), rel=1e-9, abs=1e-9)
    if other == "refined":
        assert len(changed.attachments[0].nodes) > len(scene.attachments[0].nodes)


def test_exact_attachments_of_refined_scenes_reach_twice_as_many_heights():
    """A tenth of a tet's height outside of the other body is a fifth of a finer one's; mid-edge nodes alone cannot be kept."""
    scene = ts.Scene()
    for k, name in enumerate(("left", "right")):
        scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), ts.Material(), name=name, position=(0.1035 * k, 0.0, 0.0))
    scene.attach("right", lambda X: X[:, 0] < -0.0499, "left")
    finer = refined(scene)
    finer.check()
    assert len(finer.attachments[0].nodes) == len(with_order(scene, 2).attachments[0].nodes) == 25
    scene = two(2)
    middle = np.flatnonzero(scene.body("a").rest_positions[:, 1] > 0.44)[-1:]
    scene.attach("a", middle, "ground", 1.0, name="x")
    with pytest.raises(SceneError, match="^body 'a': only mid-edge nodes are chosen, which linear tets do not have"):
        with_order(scene, 1)
