"""Springs, tendons and attachments as parts of a scene:

* points are found in bodies of both orders, and follow affine motions; what is wrong is refused in one sentence;
* bodies and obstacles that a connection names must stay; other bodies in their place are noticed;
* scene files say where they are wrong; refined scenes and those of another order keep the connections;
* checkpoints resume bitwise, also with a tension that follows a path or was set; numbers and parts of connections are compared;
* the assumed order of integrators knows of damping and paths; copies have connections of their own.
"""

import re

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError, SimulationError
from taisoft.estimation.order import is_smooth
from taisoft.fem.springs import spring_table
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.locate import locate
from taisoft.scene.refine import refined, with_order
from tests.dynamics.scenes import connected_scene, cube, rubber
from tests.fem.oracle_springs import OracleSprings, shape_row
from tests.scene.toml_scenes import data, read


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
@pytest.mark.parametrize("mesh", [cube(cells=(5, 4, 4)), ts.ball_mesh(1.0, 4), ts.sheet_mesh((12, 12), (1, 0.01, 1))])
def test_points_are_found_and_follow_the_elements(mesh, order, recwarn):
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
    (lambda s: s.add_spring(A, B, "1"), "spring 'spring0': stiffness must be a number, not '1'"),
    (lambda s: s.add_spring(A, B, 1.0, rest_length=-1), "spring 'spring0': rest_length must be at least 0 m, not -1"),
    (lambda s: s.add_spring(A, B, 1.0, damping=-2), "spring 'spring0': damping must be at least 0 N s/m, not -2"),
    (lambda s: s.add_spring(A, B, 1.0, name=""), "scene: spring name must be a text that is not empty, not ''"),
    (lambda s: s.add_spring(A, A, 1.0), "spring 'spring0': a and b are the same point of body 'a'"),
    (lambda s: s.add_spring(A, ("a", (1e-13, 0, 0)), 1.0), "spring 'spring0': a and b are the same point of body 'a'"),
    (lambda s: s.add_spring(A, 3, 1.0), "spring 'spring0': b must be (name, point), the name of a body or obstacle and"),
    (lambda s: s.add_spring(A, ("c", 0), 1.0), "spring 'spring0': b: no body or obstacle is called 'c'"),
    (lambda s: s.add_spring(A, (3, 0), 1.0), "spring 'spring0': b: no body or obstacle is called 3"),
    (lambda s: s.add_spring(A, ("b", 8), 1.0), "spring 'spring0': b: the node must be a whole number from 0 to 7, not 8"),
    (lambda s: s.add_spring(A, ("b", (0, 0)), 1.0), "spring 'spring0': b: the point must have shape (3,), not (2,)"),
    (lambda s: s.add_spring(A, ("b", (0, np.nan, 0)), 1.0), "spring 'spring0': b: the point: entry [1] is nan, not finite"),
    (lambda s: s.add_spring(A, ("ground", 3), 1.0), "spring 'spring0': b: the point must have shape (3,), not ()"),
    (lambda s: s.add_spring(("a", (0, 2, 0)), B, 1.0), "spring 'spring0': a: the point lies outside of body 'a', by "),
    (
        lambda s: s.add_spring(("pin", (0, 0, 0)), ("ground", (0, 0, 0)), 1.0),
        "spring 'spring0': at least one point must be of a body",
    ),
    (lambda s: s.add_tendon([A], 1.0), "tendon 'tendon0': points must be a list of at least two"),
    (lambda s: s.add_tendon("ab", 1.0), "tendon 'tendon0': points must be a list of at least two"),
    (lambda s: s.add_tendon([A, B, 5], 1.0), "tendon 'tendon0': point 2 must be (name, point), the name of a body or obstacle"),
    (lambda s: s.add_tendon([A, B, B], 1.0), "tendon 'tendon0': points 1 and 2 coincide"),
    (lambda s: s.add_tendon([("a", (0, 0.45, 0)), ("b", (0, -0.45, 0))], 1.0), "tendon 'tendon0': points 0 and 1 coincide"),
    (lambda s: s.add_tendon([A, B], -1.0), "tendon 'tendon0': force must be at least 0 N, not -1: a tendon cannot push"),
    (lambda s: s.add_tendon([A, B], lambda t: -2.0 - t), "tendon 'tendon0': force must be at least 0 N, not -2: a tendon cannot"),
    (lambda s: s.add_tendon([A, B], (1, 2, 3)), "tendon 'tendon0': force must be a number, not of shape (3,)"),
    (
        lambda s: s.add_tendon([A, B], lambda t: (1, 2)),
        "tendon 'tendon0': the path's force at t = 0 must be a number, not of shape (2,)",
    ),
    (lambda s: s.add_tendon([A, B], lambda t: 1 / t), "tendon 'tendon0': the path failed at t = 0: ZeroDivisionError"),
    (lambda s: s.add_tendon([A, B], ts.KeyFrames([0], [(0, 0, 0)])), "tendon 'tendon0': force: key frames need values here"),
    (lambda s: s.add_tendon([A, B]), "tendon 'tendon0': give either a force or a length"),
    (lambda s: s.add_tendon([A, B], 1.0, length=1.0), "tendon 'tendon0': give either a force or a length"),
    (lambda s: s.add_tendon([A, B], 1.0, stiffness=1.0), "tendon 'tendon0': stiffness is that of a tendon of given length: give"),
    (lambda s: s.add_tendon([A, B], length=0.0), "tendon 'tendon0': length must be above 0 m, not 0"),
    (lambda s: s.add_tendon([A, B], length=lambda t: t), "tendon 'tendon0': length must be above 0 m, not 0"),
    (lambda s: s.add_tendon([A, B], length=1.0, stiffness=0), "tendon 'tendon0': stiffness must be greater than 0 N/m, not 0"),
    (
        lambda s: s.add_tendon([("pin", (0, 0, 0)), ("ground", (0, 0, 0))], 1.0),
        "tendon 'tendon0': at least one point must be of a body",
    ),
    (lambda s: s.attach("c", [0], "b", 1.0), "attachment 'attachment0': no body or obstacle is called 'c'"),
    (lambda s: s.attach("pin", [0], "b", 1.0), "attachment 'attachment0': 'pin' is an obstacle: give the body first"),
    (lambda s: s.attach("a", [0], "c", 1.0), "attachment 'attachment0': no body or obstacle is called 'c'"),
    (lambda s: s.attach("a", [0], "a", 1.0), "attachment 'attachment0': body 'a' cannot be attached to itself"),
    (lambda s: s.attach("a", [0], "ground", 0.0), "attachment 'attachment0': stiffness must be greater than 0 N/m, not 0.0"),
    (lambda s: s.attach("a", [0], "ground", 1.0, -1), "attachment 'attachment0': damping must be at least 0 N s/m, not -1"),
    (lambda s: s.attach("a", [9], "ground", 1.0), "attachment 'attachment0': node 9 does not exist"),
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


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("removed", ["a", "b"])
def test_bodies_that_a_connection_names_must_stay(kind, removed):
    scene = two()
    KINDS[kind](scene)
    scene.bodies.remove(scene.body(removed))
    message = f"^{kind} 'x': no body or obstacle is called '{removed}'"
    for call in (scene.check, lambda: ts.Simulator(scene, 1e-4), lambda: ts.solve_static(scene)):
        with pytest.raises(SceneError, match=message):
            call()
    elsewhere = ts.box_mesh((1, 1, 1), (1, 1, 1), center=(30, 0, 0))
    scene.add_body(elsewhere, rubber(), name=removed)  # another one in its place
    with pytest.raises(SceneError, match=f"^{kind} 'x': .* lies outside of body '[ab]'"):
        scene.check()


def test_an_attached_body_may_not_be_replaced_by_another_kind():
    scene = two()
    scene.attach("a", [2, 7], "ground", 1.0, name="x")
    scene.bodies.remove(scene.body("a"))
    tet = ts.TetMesh(np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)]), np.array([(0, 1, 2, 3)]))
    scene.add_body(tet, rubber(), name="a")
    with pytest.raises(SceneError, match="^attachment 'x': 'a' is no longer the body whose nodes are attached"):
        scene.check()
    scene.bodies.remove(scene.body("a"))
    scene.add_obstacle(ts.Sphere((50, 0, 0), 1.0), name="a")
    with pytest.raises(SceneError, match="^attachment 'x': 'a' is no longer the body whose nodes are attached"):
        scene.check()


def test_obstacles_that_a_connection_names_must_stay():
    scene = two()
    scene.add_spring(A, ("pin", (0, 8, 0)), 1.0, name="x")
    scene.obstacles.remove(scene.obstacle("pin"))
    with pytest.raises(SceneError, match="^spring 'x': no body or obstacle is called 'pin'"):
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


def test_static_needs_something_that_holds_each_group():
    scene = ts.Scene()
    scene.contact_forces = False
    for name, x in (("a", 0), ("b", 3), ("c", 6)):
        scene.add_body(cube((x, 0, 0)), rubber(), name=name)
    scene.add_spring(("a", 0), ("b", 0), 1e4)
    scene.add_spring(("c", (5.6, 0, 0)), ("b", 4), 1e4)
    with pytest.raises(SceneError, match="^body 'a': nothing holds it along xyz, so it has no static state"):
        ts.solve_static(scene)
    scene.body("c").fix([4, 5, 6, 7], axes="xz")
    with pytest.raises(SceneError, match="^body 'a': nothing holds it along y, so"):
        ts.solve_static(scene)
    scene.add_obstacle(ts.Sphere((0, 50, 0), 1.0), name="far")
    for node in range(8):
        scene.attach("b", [node], "far", 1e5)
    assert ts.solve_static(scene, tolerance=1e-3).converged


# --- files --------------------------------------------------------------------------------------------------------------

TEXT = """
contact_forces = false
[bodies.a]
mesh = { shape = "box", cells = [2, 1, 1], size = [2, 1, 1] }
material = { young = 1e5 }
[bodies.b]
mesh = { shape = "box", cells = [2, 1, 1], size = [2, 1, 1] }
material = {}
position = [0, 1, 0]
[obstacles.pin]
shape = "sphere"
center = [0, 9, 0]
radius = 1
[springs.s]
a = ["a", [0, 0.5, 0]]
b = ["pin", [0, 3, 0]]
stiffness = 100
rest_length = 2.0
[tendons.t]
points = [["a", 3], ["pin", [0, 3, 0]], ["b", [0, 0, 0]]]
force = { times = [0, 1], values = [0, 50], smooth = true }
[attachments.j]
a = "a"
nodes = { half_space = { point = [0, 0.49, 0], normal = [0, -1, 0] } }
b = "b"
stiffness = 1e4
damping = 2
"""
BAD_FILES = [
    ("stiffness = 100", "stiffness = -1", "springs.s.stiffness must be at least 0 N/m, not -1"),
    ("stiffness = 100", "stifness = 1", "springs.s.stifness is not known (did you mean stiffness?)"),
    ("stiffness = 100", "", "springs.s.stiffness is missing"),
    ("rest_length = 2.0", "rest_length = true", "springs.s.rest_length must be a number, not True"),
    ('a = ["a", [0, 0.5, 0]]', "", "springs.s.a is missing"),
    ('a = ["a", [0, 0.5, 0]]', 'a = "a"', 'springs.s.a must be ["NAME", POINT], a body or an obstacle, and a position or a node'),
    ('a = ["a", [0, 0.5, 0]]', 'a = ["c", 0]', "springs.s.a: no body or obstacle is called 'c'"),
    ('a = ["a", [0, 0.5, 0]]', 'a = ["a", [0, 0.5]]', "springs.s.a: the point must have shape (3,), not (2,)"),
    ('a = ["a", [0, 0.5, 0]]', 'a = ["a", "x"]', "springs.s.a: the point must be numbers of shape (3,), not 'x'"),
    ('a = ["a", [0, 0.5, 0]]', 'a = ["a", [0, 2, 0]]', "springs.s.a: the point lies outside of body 'a'"),
    ("[springs.s]", "[[springs]]", "springs must be tables [springs.NAME], not a list of 1"),
    ("[springs.s]", "[springs.j]", "attachments.j: name 'j' is taken; names must be unique"),
    ("[tendons.t]", '[tendons.""]', 'tendons."": name must be a text that is not empty'),
    ('points = [["a", 3], ', "points = [", "tendons.t.points 1 and 2 coincide"),
    ('["a", 3]', '"a"', 'tendons.t.points[0] must be ["NAME", POINT], a body or an obstacle, and a position or a node id'),
    ('["a", 3]', '["a", 99]', "tendons.t: point 0: the node must be a whole number from 0 to 11, not 99"),
    ("values = [0, 50]", "values = [0]", "tendons.t.force.values must have shape (2,), not (1,)"),
    ("values = [0, 50]", "values = [-1, 50]", "tendons.t.force must be at least 0 N, not -1: a tendon cannot push"),
    ("force = {", "length = 3\nforce = {", "tendons.t: give either a force or a length"),
    ("force = {", "length = {", "tendons.t.length must be above 0 m, not 0"),
    ("force = {", "stiffness = 5\nforce = {", "tendons.t.stiffness is that of a tendon of given length"),
    ("values = [0, 50]", "translations = [[0, 0, 0], [1, 1, 1]]", "tendons.t.force: key frames need values here"),
    ("values = [0, 50], smooth", "values = [0, 50], smoth", "tendons.t.force.smoth is not known (did you mean smooth?)"),
    ('a = "a"', "a = 3", "attachments.j: no body or obstacle is called 3"),
    ('b = "b"', 'b = "a"', "attachments.j: body 'a' cannot be attached to itself"),
    ("nodes = {", "where = {", "attachments.j.where is not known"),
    ("[0, 0.49, 0]", "[0, 9, 0]", "attachments.j: no node is chosen"),
    ("normal = [0, -1, 0]", "normal = [0, 1, 0]", "attachments.j: node 1 of body 'a' lies outside of body 'b'"),
    ("damping = 2", "dampin = 2", "attachments.j.dampin is not known (did you mean damping?)"),
]


@pytest.mark.parametrize("old, new, message", BAD_FILES)
def test_wrong_tables_are_refused_with_their_place(tmp_path, old, new, message):
    assert old in TEXT
    if "coincide" in message:  # a tendon that passes the pin twice
        new += '["b", 0], ["pin", [0, 3, 0]], '
    with pytest.raises(SceneError) as caught:
        read(tmp_path, TEXT.replace(old, new, 1))
    assert str(caught.value).startswith(f"{tmp_path / 'scene.toml'}: {message}"), caught.value
    assert "\n" not in str(caught.value)


def test_tables_are_read(tmp_path):
    scene, _ = read(tmp_path, TEXT)
    spring, tendon, attachment = scene.connections
    assert (spring.stiffness, spring.rest_length, spring.damping, spring.owners) == (100.0, 2.0, 0.0, ["a", "pin"])
    assert tendon.points[0].position.tolist() == scene.body("a").rest_positions[3].tolist() and tendon.path(0.5) == 25.0
    assert attachment.damping == 2.0 and (scene.body("a").rest_positions[attachment.nodes][:, 1] == 0.5).all()
    again = tmp_path / "again.toml"
    ts.write_scene(again, scene)
    assert data(ts.read_scene(again)[0]) == data(scene)


# --- other meshes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [refined, lambda s: with_order(s, 2), lambda s: with_order(s, 1)])
@pytest.mark.parametrize("order", [1, 2])
def test_other_meshes_keep_the_connections(change, order):
    """Under an affine motion every spring pulls as before, and attachments are as stiff in all."""
    scene = two(order)
    scene.add_spring(A, ("b", (0.1, 0.2, 0.3)), 30.0, damping=4.0, name="s")
    scene.add_tendon([A, ("pin", (0, 8, 0)), B], lambda t: 7.0, name="t")
    scene.attach("a", lambda X: X[:, 1] > 0.44, "b", 100.0, 5.0, name="chosen")
    scene.attach("a", np.flatnonzero(scene.body("a").rest_positions[:, 1] < -0.44), "ground", 100.0, name="by id")
    changed = change(scene)
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
    if change is refined:
        assert len(changed.attachments[0].nodes) > len(scene.attachments[0].nodes)


def test_the_order_of_tets_may_not_strip_an_attachment_of_all_nodes():
    scene = two(2)
    middle = np.flatnonzero(scene.body("a").rest_positions[:, 1] > 0.44)[-1:]
    scene.attach("a", middle, "ground", 1.0, name="x")
    with pytest.raises(SceneError, match="^body 'a': only mid-edge nodes are chosen, which linear tets do not have"):
        with_order(scene, 1)


# --- checkpoints ------------------------------------------------------------------------------------------------------------


def pulled(force) -> ts.Scene:
    scene = connected_scene(damping=5.0)
    scene.tendons.clear()
    scene.add_tendon([("a", 1), ("pin", (0.1, 2.8, 0.0)), ("b", 6)], force, name="a/line")
    scene.add_tendon([("a", 3), ("b", 5)], 3.0, name="other")
    return scene


RAMP = ts.KeyFrames((0.0, 0.01), values=(10.0, 60.0))


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet", "implicit_euler", "bdf2"])
@pytest.mark.parametrize("force, value", [(20.0, None), (RAMP, None), (20.0, 35.0), (RAMP, 35.0)])
def test_checkpoints_resume_bitwise(tmp_path, integrator, force, value):
    with ts.Simulator(pulled(force), dt=1e-3, integrator=integrator) as sim:
        for n in range(8):
            if n == 2 and value is not None:
                sim.set_tension("a/line", value)
            if n == 4:
                sim.save_checkpoint(tmp_path / "c.npz")
            sim.step()
        x, v, tension = sim.positions(), sim.velocities(), sim.joint_force("a/line")
        sim.reset()
        assert sim.joint_force("a/line") == (value or (20.0 if force == 20.0 else 10.0))  # changed numbers stay
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", pulled(force)) as sim:
        for _ in range(4):
            sim.step()
        assert np.array_equal(sim.positions(), x) and np.array_equal(sim.velocities(), v)
        assert sim.joint_force("a/line") == tension
        sim.rebuild(integrator="implicit_euler")
        assert sim.joint_force("a/line") == tension


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda s: s.springs.pop(0), "differs in spring 'pushes'"),
        (lambda s: s.add_spring(A, ("b", (0.7, 0.1, 0)), 1.0, name="new"), "differs in spring 'new'"),
        (lambda s: s.attach("a", [0], "pin", 1.0, name="new"), "differs in attachment 'new'"),
        (lambda s: s.tendons.pop(), "differs in tendon 'other'"),
        (lambda s: (s.tendons.pop(), s.add_tendon([("a", 3), ("b", 5)], 4.0, name="other")), "tendon 'other': force is 4.0 in"),
        (lambda s: (s.tendons.pop(), s.add_tendon([("a", 3), ("b", 5)], RAMP, name="other")), "differs in tendon 'other'"),
        (lambda s: (s.tendons.pop(), s.add_tendon([("a", 3), ("b", 6)], 3.0, name="other")), "differs in tendon 'other'"),
    ],
)
def test_checkpoints_of_other_connections_are_refused(tmp_path, change, message):
    path = tmp_path / "c.npz"
    with ts.Simulator(pulled(20.0), dt=1e-4, integrator="symplectic_euler") as sim:
        sim.save_checkpoint(path)
    other = pulled(20.0)
    change(other)
    assert scene_digest(other) != scene_digest(pulled(20.0)) == scene_digest(pulled(20.0))
    with pytest.raises(SceneError, match=message):
        ts.Simulator.load_checkpoint(path, other)


# --- what other parts know ------------------------------------------------------------------------------------------------


def test_damped_springs_and_paths_lower_the_assumed_order():
    assert is_smooth(pulled(20.0), touches=False) is False  # damped
    assert is_smooth(connected_scene(), touches=False) is False  # a tendon may slacken
    for force, smooth in ((20.0, True), (RAMP, False)):
        scene = connected_scene()
        scene.tendons.clear()
        scene.add_tendon([("a", 3), ("b", 5)], force)
        assert is_smooth(scene, touches=False) is smooth
    scene = two()
    assert is_smooth(scene, touches=False) is True
    scene.attach("a", [0], "lift", 1.0)
    assert is_smooth(scene, touches=False) is False


def test_a_snapshot_has_connections_of_its_own():
    scene = pulled(20.0)
    copied = scene.snapshot()
    copied.springs.clear()
    copied.tendons.clear()
    copied.attach("a", [1], "pin", 1.0)
    assert (len(scene.springs), len(scene.tendons), len(scene.attachments)) == (4, 2, 2)
    assert OracleSprings(copied).elements.keys() == {"to an obstacle", "to a body", "attachment0"}


def test_unknown_names_of_tensions_and_forces():
    scene = two()
    scene.add_spring(A, B, 1.0, name="s")
    with ts.Simulator(scene, 1e-4, "symplectic_euler") as sim:
        with pytest.raises(SceneError, match="^set_tension: no tendon is called 's'"):
            sim.set_tension("s", 1.0)
        with pytest.raises(SceneError, match="^joint_force: no spring, tendon or attachment is called 3"):
            sim.joint_force(3)
    with pytest.raises(SimulationError, match="closed"):
        sim.joint_force("s")
