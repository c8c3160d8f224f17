"""The link between a simulation and its window:

* messages keep their data and arrays; what is no plain data is refused; an end that is closed is noticed by both;
* node data are shared; a scene and its states, with paths that are functions, are drawn like the simulation itself.
"""

import os
from multiprocessing.connection import Connection

import numpy as np
import pytest

import taisoft as ts
from taisoft.output.camera import framed_points
from taisoft.view.connection_layer import ConnectionMarks
from taisoft.view.link import Link, LinkClosed, SharedNodes, decode, encode, receive
from taisoft.view.mirror import MirrorSimulation, describe_scene, describe_state
from taisoft.view.offscreen import Offscreen
from taisoft.view.plots import History
from taisoft.view.scene_view import scene_size
from tests.view.fake_simulator import FakeSimulator, beam_scene

MESSAGE = {
    "text": "a 'name' of µm",
    "number": 1.5e-3,
    "nothing": None,
    "list": [1, True, [np.arange(6.0).reshape(2, 3), np.zeros((0, 3))]],
    "nested": {"ids": np.array([[1, 2], [3, 4]], dtype=np.int32).T, "nan": float("nan"), "size": np.float64(2.5)},
}


def marks_of(scene) -> ConnectionMarks:
    return ConnectionMarks(scene, scene_size(scene))


def test_messages_keep_their_data():
    got = decode(encode(MESSAGE))
    assert got["text"] == MESSAGE["text"] and got["number"] == 1.5e-3 and got["nothing"] is None
    assert got["list"][:2] == [1, True] and np.isnan(got["nested"]["nan"]) and got["nested"]["size"] == 2.5
    arrays = (got["list"][2][0], got["list"][2][1], got["nested"]["ids"])
    for array, expected in zip(arrays, (np.arange(6.0).reshape(2, 3), np.zeros((0, 3)), np.array([[1, 3], [2, 4]], np.int32))):
        assert array.dtype == expected.dtype and array.shape == expected.shape and np.array_equal(array, expected)
    with pytest.raises(TypeError, match="a message cannot hold a set"):
        encode({"names": {1, 2}})


def test_both_ends():
    link, other = Link.pair(5, slots=2)
    nodes = SharedNodes(5, 2, os.dup(link.nodes.descriptor))
    link.nodes.x[1], link.nodes.values[0] = np.arange(15.0).reshape(5, 3), np.arange(5.0)
    assert np.array_equal(nodes.x[1], np.arange(15.0).reshape(5, 3)) and np.array_equal(nodes.values[0], np.arange(5.0))
    assert not nodes.x[0].any() and not nodes.values[1].any()
    assert link.receive() is None
    far = Link(other, nodes)
    far.send({"commands": [["pause"]]})
    assert link.receive(1.0) == {"commands": [["pause"]]}
    link.send({"time": 1.0})
    assert receive(other, None) == {"time": 1.0}
    far.close()
    with pytest.raises(LinkClosed):
        link.receive(1.0)
    with pytest.raises(LinkClosed):
        link.send({"time": 2.0})
    link.close()


def test_the_end_of_a_process_is_noticed_through_its_descriptor():
    link, other = Link.pair(0)
    copy = Connection(os.dup(other.fileno()))
    other.close()
    copy.send_bytes(encode({"closed": True}))
    copy.close()
    assert link.receive(1.0) == {"closed": True}, "what was sent before the end arrives"
    with pytest.raises(LinkClosed):
        link.receive(1.0)
    link.close()


def moving_scene():
    """Two beams, a load along a path, and obstacles of all shapes, of which two move along paths."""
    scene = beam_scene(("one", "two"))
    scene.bodies[0].add_traction(lambda c: c[:, 0] > 1.99, lambda t: (0.0, 20.0 * t, 50.0))
    scene.add_obstacle(ts.HalfSpace((0, -3, 0), (0, 1, 0)), name="ground")
    scene.add_obstacle(ts.Sphere((3, 0, 1), 0.4), name="ball", path=lambda t: ((0, t, 0), np.eye(3)))
    scene.add_obstacle(ts.Capsule((3, 1, 0), (3, 2, 0), 0.2), name="rod")
    scene.add_obstacle(ts.HalfSpace((-3, 0, 0), (1, 0, 0)), name="wall", path=lambda t: ((0.1 * t, 0, 0), np.eye(3)))
    box = ts.box_mesh((1, 1, 1), (0.5, 0.5, 0.5))
    scene.add_obstacle(ts.MeshObstacle(box.vertices + (0, 3, 0), box.surface), name="lid")
    scene.add_obstacle(ts.Box((0, -1.5, 0), (0.4, 0.1, 0.4)), name="slab")
    return scene


def test_a_mirror_is_drawn_like_the_simulation():
    scene = moving_scene()
    sim = FakeSimulator(scene)
    sim.time = 0.7
    found = sim.contacts()
    found.point, found.normal, found.impulse = (np.array([[0.0, 1, 0]]) for _ in range(3))
    sim.contacts = lambda: found
    description = decode(encode(describe_scene(scene, marks_of(scene))))
    mirror = MirrorSimulation(description, len(sim.positions()))
    layers = ("wires", "contacts", "tractions", "fixed_nodes")
    state = decode(encode(describe_state(sim, marks_of(sim.scene), set(layers), None) | {"colour": "stress"}))
    mirror.take(state, sim.positions(), np.arange(len(sim.positions()), dtype=float))
    marks = {sim: None, mirror: mirror.marks}
    own, seen = (Offscreen(one.scene, (320, 180), layers=layers, marks=marks[one]).image(one) for one in marks)
    assert np.array_equal(own, seen) and own.std() > 10
    assert np.array_equal(mirror.positions("two"), sim.positions("two")) and mirror.energies() == sim.energies()
    assert mirror.values_of("speed") is None and mirror.values_of("stress")[-1] == len(sim.positions()) - 1


def test_only_what_is_shown_travels():
    sim = FakeSimulator(moving_scene())
    state = describe_state(sim, marks_of(sim.scene), set(), None)
    assert {"contacts", "history"}.isdisjoint(state) and state["tractions"] == []
    history = History()
    history.start(sim)
    state = decode(encode(describe_state(sim, marks_of(sim.scene), {"tractions"}, history) | {"colour": "body"}))
    mirror = MirrorSimulation(describe_scene(sim.scene, marks_of(sim.scene)), len(sim.positions()))
    mirror.take(state, sim.positions(), np.zeros(0))
    assert np.array_equal(mirror.history.high, history.high, equal_nan=True) and mirror.nodal_values is None
    assert state["tractions"][0].tolist() == [0.0, 0.0, 50.0]


def connected_scene() -> ts.Scene:
    """A bar with a skin, under pressure, on a spring and a tendon, and attached to another bar by springs."""
    scene = beam_scene(("one", "two"))
    vertices = 0.2 * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
    scene.body("one").embed(ts.SurfaceMesh(vertices, np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])))
    scene.body("two").add_pressure([0, 1, 2], lambda t: 50.0 + t)
    scene.add_spring(("one", (0, 0, 0)), ("two", (0, 0, 0)), stiffness=10.0, rest_length=0.5)
    scene.add_tendon([("one", (0.5, 0, 0)), ("two", (0.5, 0, 0)), ("two", (1, 0, 0))], 3.0)
    scene.add_rigid_body(ts.box_mesh((1, 1, 1), (0.4, 0.4, 0.4)), name="rigid", position=(4, 0, 0)).fix()
    return scene


def test_connections_pressures_skins_and_rigid_bodies_travel():
    with ts.Simulator(connected_scene(), dt=0.01) as sim:
        sim.step()
        marks, layers = marks_of(sim.scene), ("wires", "connections", "pressures", "fixed_nodes")
        mirror = MirrorSimulation(decode(encode(describe_scene(sim.scene, marks))), len(sim.positions()))
        state = decode(encode(describe_state(sim, marks, set(layers), None) | {"colour": "body"}))
        mirror.take(state, sim.positions(), np.zeros(len(sim.positions())))
        own = Offscreen(sim.scene, (320, 180), layers=layers).image(sim)
        seen = Offscreen(mirror.scene, (320, 180), layers=layers, marks=mirror.marks).image(mirror)
        without = Offscreen(mirror.scene, (320, 180), layers=("wires",), marks=mirror.marks).image(mirror)
        assert np.array_equal(own, seen) and not np.array_equal(seen, without)


def test_both_frame_the_same_fall():
    """Of one body; the others are held, prescribed or connected."""
    scene = beam_scene(("held", "moved", "one", "two", "three"))
    for name in ("moved", "one", "two", "three"):
        scene.body(name).constraints.clear()
    scene.body("moved").move([0], lambda t: (0, t, 0))
    scene.add_spring(("one", 0), ("two", 0), 1.0)
    scene.add_obstacle(ts.HalfSpace((0, -2, 0), (0, 1, 0)))
    seen = framed_points(MirrorSimulation(decode(encode(describe_scene(scene, marks_of(scene)))), 0).scene)
    assert len(seen) == 6 * scene.bodies[0].n_nodes and np.array_equal(seen, framed_points(scene))


def test_a_path_that_fails_is_an_output_error():
    sim = FakeSimulator(moving_scene())
    sim.scene.add_obstacle(ts.Sphere((9, 0, 0), 0.1), name="late", path=lambda t: ((1.0 / (1.0 - t), 0, 0), np.eye(3)))
    describe_state(sim, marks_of(sim.scene), set(), None)
    sim.time = 1.0
    with pytest.raises(ts.OutputError, match="the scene cannot be shown: obstacle 'late': the path must give"):
        describe_state(sim, marks_of(sim.scene), set(), None)
