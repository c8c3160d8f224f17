"""Springs, tendons and attachments in scene files and on other meshes:

* what a file holds is read, and written again the same; errors are located;
* refined scenes and those of another order keep the connections, and their forces under an affine motion.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.fem.springs import spring_table
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.refine import refined, with_order
from tests.scene.test_connections import A, B, two
from tests.scene.toml_scenes import data, read

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
    ('a = ["a", [0, 0.5, 0]]', 'a = "a"', 'springs.s.a must be ["NAME", POINT], a body or an obstacle, and a position or a node'),
    ('a = ["a", [0, 0.5, 0]]', 'a = ["a", "x"]', "springs.s.a: the point must be numbers of shape (3,), not 'x'"),
    ('a = ["a", [0, 0.5, 0]]', 'a = ["a", [0, 2, 0]]', "springs.s.a: the point lies outside of body 'a'"),
    ("[springs.s]", "[[springs]]", "springs must be tables [springs.NAME], not a list of 1"),
    ('points = [["a", 3], ', "points = [", "tendons.t.points 1 and 2 coincide"),
    ('["a", 3]', '"a"', 'tendons.t.points[0] must be ["NAME", POINT], a body or an obstacle, and a position or a node id'),
    ("values = [0, 50]", "values = [0]", "tendons.t.force.values must have shape (2,), not (1,)"),
    ("values = [0, 50], smooth", "values = [0, 50], smoth", "tendons.t.force.smoth is not known (did you mean smooth?)"),
    ("nodes = {", "where = {", "attachments.j.where is not known"),
    ("normal = [0, -1, 0]", "normal = [0, 1, 0]", "attachments.j: node 1 of body 'a' lies outside of body 'b'"),
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
    winding = ts.KeyFrames((0.0, 1.0), values=(1.0, 2.0), smooth=True)
    scene.add_tendon([("a", 3), ("b", (0.1, 0.1, 0.2))], length=winding, stiffness=5.0, name="winch")
    scene.add_tendon([("a", 3), ("b", (0.3, 0.1, 0.2))], length=0.7, name="rope")
    scene.attach("b", [0], "a", name="exact")
    assert attachment.damping == 2.0 and (scene.body("a").rest_positions[attachment.nodes][:, 1] == 0.5).all()
    again = tmp_path / "again.toml"
    ts.write_scene(again, scene)
    found = ts.read_scene(again)[0]
    assert data(found) == data(scene) and scene_digest(found) == scene_digest(scene)
    scene.add_tendon([("a", 3), ("b", (0.3, 0.1, 0.2))], lambda t: 1.0, name="pull")
    with pytest.raises(SceneError, match="^tendon 'pull': its force is a function, which a file cannot store: use ts.KeyFrames"):
        ts.write_scene(tmp_path / "b.toml", scene)


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


def test_the_order_of_tets_may_not_strip_an_attachment_of_all_nodes():
    scene = two(2)
    middle = np.flatnonzero(scene.body("a").rest_positions[:, 1] > 0.44)[-1:]
    scene.attach("a", middle, "ground", 1.0, name="x")
    with pytest.raises(SceneError, match="^body 'a': only mid-edge nodes are chosen, which linear tets do not have"):
        with_order(scene, 1)


def test_exact_attachments_of_refined_scenes_reach_twice_as_many_heights():
    """Nodes that lie outside of the other body by a tenth of a tet's height lie outside by a fifth of a finer one's."""
    scene = ts.Scene()
    for k, name in enumerate(("left", "right")):
        scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1)), ts.Material(), name=name, position=(0.1035 * k, 0.0, 0.0))
    scene.attach("right", lambda X: X[:, 0] < -0.0499, "left")
    finer = refined(scene)
    finer.check()
    assert len(finer.attachments[0].nodes) == len(with_order(scene, 2).attachments[0].nodes) == 25
