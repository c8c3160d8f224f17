"""Pictures drawn in a process of their own: the link to it, the same bytes as those drawn between the steps, errors and ends."""

import os

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import OutputError
from taisoft.nested import from_json, to_json
from taisoft.output.viewpoint import framed_points
from taisoft.records import StepReport
from taisoft.scene.checks import store
from taisoft.scene.plan import Plan
from taisoft.view import pictures
from taisoft.view.link import Link, LinkClosed, SharedNodes
from taisoft.view.mirror import MirrorSimulation, describe_scene, describe_state
from taisoft.view.pictures import MIN_PICTURES, SLOTS, PictureOptions, PictureProcess, open_pictures, picture_writer
from taisoft.view.plots import Plots
from tests.view.drawing import connected_scene, marks_of, moving_scene, program
from tests.view.fake_simulator import FakeSimulator, beam_scene

SIZE = (160, 90)


def sent(message):
    return from_json(to_json(message))


def test_messages_keep_their_data():
    arrays = [np.arange(6.0).reshape(2, 3), np.zeros((0, 3)), np.array([[1, 2], [3, 4]], dtype=np.int32).T]
    message = {"text": "a 'name' of µm", "number": 1.5e-3, "nothing": None, "list": [1, True]}
    got = sent(message | {"arrays": arrays[:2], "nested": {"ids": arrays[2], "nan": float("nan"), "size": np.float64(2.5)}})
    assert {name: got[name] for name in message} == message
    assert np.isnan(got["nested"]["nan"]) and got["nested"]["size"] == 2.5
    for array, expected in zip((*got["arrays"], got["nested"]["ids"]), arrays):
        assert array.dtype == expected.dtype and array.shape == expected.shape and np.array_equal(array, expected)
    with pytest.raises(TypeError, match="JSON cannot hold a set"):
        sent({"names": {1, 2}})


def test_both_ends():
    link, other = Link.pair(5, slots=2)
    far = Link(other, SharedNodes(5, 2, os.dup(link.nodes.descriptor)))
    link.nodes.x[1], link.nodes.values[0] = np.arange(15.0).reshape(5, 3), np.arange(5.0)
    for name in ("x", "values"):
        assert np.array_equal(getattr(far.nodes, name), getattr(link.nodes, name))
    assert not far.nodes.x[0].any() and not far.nodes.values[1].any() and link.receive() is None
    link.send({"time": 1.0})
    assert far.receive(None) == {"time": 1.0}
    far.send({"commands": [["pause"]]})
    far.close()
    assert link.receive(1.0) == {"commands": [["pause"]]}, "what was sent before the end arrives"
    for use in (lambda: link.receive(1.0), lambda: link.send({"time": 2.0})):
        with pytest.raises(LinkClosed):
            use()
    link.close()


def test_only_what_is_shown_travels():
    sim = FakeSimulator(moving_scene())
    marks, x = marks_of(sim.scene), sim.positions()
    state = describe_state(sim, marks, set())
    assert "contacts" not in state and state["tractions"] == []
    state = sent(describe_state(sim, marks, {"tractions"}) | {"colour": "body"})
    assert state["tractions"][0].tolist() == [0.0, 0.0, 50.0]
    mirror = MirrorSimulation(sent(describe_scene(sim.scene, marks)), len(x))
    mirror.take(state, x, np.zeros(0))
    assert mirror.nodal_values is None
    mirror.take(state | {"colour": "stress"}, x, np.arange(float(len(x))))
    assert mirror.values_of("speed") is None and mirror.values_of("stress")[-1] == len(x) - 1
    assert np.array_equal(mirror.positions("two"), sim.positions("two")) and mirror.energies() == sim.energies()
    store(sim.scene.obstacle("rod"), path=lambda t: ((0, 0.25, 0), np.eye(3)))  # as a command does
    mirror.take(describe_state(sim, marks, set()) | {"colour": "body"}, x, np.zeros(0))
    assert mirror.scene.obstacles[2].pose(0.0)[0].tolist() == [0.0, 0.25, 0.0]
    sim.scene.add_obstacle(ts.Sphere((9, 0, 0), 0.1), name="late", path=lambda t: ((1.0 / (1.0 - t), 0, 0), np.eye(3)))
    sim.time = 1.0
    with pytest.raises(OutputError, match="the scene cannot be shown: obstacle 'late': the path must give"):
        describe_state(sim, marks_of(sim.scene), set())


def test_both_frame_the_same_fall():
    """Of one body; the others are held, prescribed or connected."""
    scene = beam_scene(("held", "moved", "one", "two", "three"))
    scene.up = "z"
    for body in scene.bodies[1:]:
        body.constraints.clear()
    scene.body("moved").move([0], lambda t: (0, t, 0))
    scene.add_spring(("one", 0), ("two", 0), 1.0)
    scene.add_obstacle(ts.HalfSpace((0, -2, 0), (0, 1, 0)))
    mirrored = MirrorSimulation(sent(describe_scene(scene, marks_of(scene))), 0).scene
    seen = framed_points(mirrored)
    assert mirrored.up == "z" and len(seen) == 6 * scene.bodies[0].n_nodes and np.array_equal(seen, framed_points(scene))


class Shown(FakeSimulator):
    """With all that pictures show."""

    plan = Plan()
    plan.add("contact_forces", True, "two bodies", "")

    def tensions(self):
        return {one.name: k + self.time for k, one in enumerate((*self.scene.springs, *self.scene.tendons))}


def fibrous_scene() -> ts.Scene:
    """With a body of fibres, too."""
    scene, box = connected_scene(), ts.box_mesh((2, 1, 1), (1, 0.4, 0.4))
    scene.add_body(box, ts.Material(active_stress=1.0), name="muscle", position=(0, -1, 0), fibres=(1, 0, 0))
    return scene


CASES = {
    "connections": (fibrous_scene, PictureOptions(SIZE, layers=("wires", "connections", "pressures", "fibres", "fixed_nodes"))),
    "contacts": (moving_scene, PictureOptions(SIZE, "speed", ("contacts", "tractions"), ("energies", "contacts"), "beams", True)),
}


@pytest.mark.parametrize("name", CASES)
def test_both_ways_write_the_same_bytes(name, tmp_path):
    """Also of more states than wait at once."""
    build, options = CASES[name]
    sim, n = Shown(build()), SLOTS + 4
    plots = Plots(sim, options.plots)
    between = picture_writer(tmp_path / "between", sim.scene, options, plots)
    beside = PictureProcess(tmp_path / "beside", sim, options, plots)
    assert os.getsid(beside.pid) == beside.pid, "a session of its own: Ctrl-C goes to the run"
    for index in range(n):
        sim.time = 0.1 * index
        plots.take(StepReport(time=sim.time, kinetic=sim.time, n_contacts=index), 0.01)
        between.frame(sim, index)
        beside.frame(sim, index)
    beside.flush()
    kept = [[writer.kept(t) for t in (sim.time, sim.time + 1.0)] for writer in (between, beside)]
    assert kept[0] == kept[1] and kept[0][1]["camera"] > 0.0
    assert (kept[0][1]["impulse"] > 0.0) == ("contacts" in options.layers)
    between.close()
    beside.close()
    beside.close()
    own, other = (sorted((tmp_path / where / "frames").iterdir()) for where in ("between", "beside"))
    assert [path.name for path in own] == [path.name for path in other] == [f"{k:05d}.png" for k in range(n)]
    assert [a.name for a, b in zip(own, other) if a.read_bytes() != b.read_bytes()] == []
    assert len({path.read_bytes() for path in own}) == n, "the pictures differ from each other"
    with pytest.raises(OutputError, match=r"^picture 1 cannot be written to .*frames: its writer is closed$"):
        beside.frame(sim, 1)


FAILING = """
import sys
from taisoft.view.child_process import serve
from taisoft.view.offscreen import Offscreen
from taisoft.view.picture_process import Drawing
image, left = Offscreen.image, [1, 2]
def failing(self, sim):
    if not left:
        raise MemoryError("3 GB")
    left.pop()
    return image(self, sim)
Offscreen.image = failing
serve(Drawing, *map(int, sys.argv[1:]))
"""


def test_an_error_is_raised_once_it_is_known(tmp_path):
    """Of the real process, at its third picture."""
    message = "^the drawing of pictures failed: not enough memory for a picture: 3 GB; available: .*$"
    sim = FakeSimulator(beam_scene())
    writer = PictureProcess(tmp_path, sim, PictureOptions(SIZE), child=program(FAILING))
    with pytest.raises(OutputError, match=message):
        for index in range(10_000):
            writer.frame(sim, index)
    for use in (writer.flush, lambda: writer.frame(sim, 0), writer.close):
        with pytest.raises(OutputError, match=message):
            use()
    assert not (tmp_path / "frames/00003.png").exists()


def test_few_pictures_or_a_single_core_need_no_process(tmp_path, monkeypatch):
    """And a process that cannot be started is an error."""
    sim = FakeSimulator(beam_scene())
    monkeypatch.setattr("sys.executable", str(tmp_path / "absent"))
    for missing, cores in ((1, 2), (0, 1)):
        monkeypatch.setattr(pictures, "usable_cores", lambda cores=cores: list(range(cores)))
        open_pictures(tmp_path, sim, PictureOptions(SIZE), None, MIN_PICTURES - missing).close()
    monkeypatch.setattr(pictures, "usable_cores", lambda: [0, 1])
    with pytest.raises(OutputError, match="^the drawing of pictures failed: its process cannot be started: No such file"):
        open_pictures(tmp_path, sim, PictureOptions(SIZE), None, MIN_PICTURES)
