"""Pictures drawn in a process of their own: the link to it, the same bytes as those drawn between the steps, errors and ends."""

import os
from multiprocessing import Pipe

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import OutputError
from taisoft.nested import from_json, to_json
from taisoft.output.viewpoint import camera_viewpoint, framed_points
from taisoft.processes import Link, LinkClosed
from taisoft.records import StepReport
from taisoft.scene.checks import store
from taisoft.view import pictures
from taisoft.view.drawn import DrawnScene
from taisoft.view.link import SharedNodes
from taisoft.view.pictures import MIN_PICTURES, SLOTS, PictureOptions, PictureProcess, open_pictures, picture_writer
from taisoft.view.plots import Plots
from taisoft.view.sampling import Sampler
from tests.view.drawing import connected_scene, moving_scene, program, sampled, travelled
from tests.view.fake_simulator import FakeSimulator, beam_scene, plan_of

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
    nodes = SharedNodes(5, slots=2)
    same = SharedNodes(5, 2, os.dup(nodes.descriptor))
    nodes.displacement[1], nodes.values[0] = np.arange(15.0).reshape(5, 3), np.arange(5.0)
    for name in ("displacement", "values"):
        assert np.array_equal(getattr(same, name), getattr(nodes, name))
    assert not same.displacement[0].any() and not same.values[1].any()
    link, far = map(Link, Pipe())
    assert link.receive() is None
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
    state = sampled(sim)
    assert state.contacts == {} and state.tractions == [] and state.values == {}
    state = sampled(sim, {"tractions"}, "stress", "body")
    assert state.tractions[0].tolist() == [0.0, 0.0, 50.0] and list(state.values) == ["stress"]
    assert np.allclose(state.positions("two"), sim.positions("two"), atol=1e-6) and state.energies["elastic"] == 2.0
    assert list(state.poses) == ["ball", "wall"]
    store(sim.scene.obstacle("rod"), path=lambda t: ((0, 0.25, 0), np.eye(3)))  # as a command does
    assert sampled(sim).poses["rod"][0].tolist() == [0.0, 0.25, 0.0]
    sim.scene.add_obstacle(ts.Sphere((9, 0, 0), 0.1), name="late", path=lambda t: ((1.0 / (1.0 - t), 0, 0), np.eye(3)))
    sim.time = 1.0
    with pytest.raises(OutputError, match="the scene cannot be shown: obstacle 'late': the path must give"):
        sampled(sim)


def test_a_scene_travels_whole():
    """What is framed: of five bodies one falls, the others are held, prescribed or connected."""
    scene = beam_scene(("held", "moved", "one", "two", "three"))
    scene.up, scene.background = "z", ("#ffffff", "#000000")
    scene.lights, scene.camera = [ts.Light((0, -1, 0))], ts.Camera((1, 2, 3), fov=[20, 30], times=[0, 1], follow="one")
    scene.body("held").colour, scene.body("moved").opacity = "#ff0000", 0.5
    for body in scene.bodies[1:]:
        body.remove(*body.constraints)
    scene.body("moved").move([0], lambda t: (0, t, 0))
    scene.add_spring(("one", 0), ("two", 0), 1.0)
    scene.add_obstacle(ts.HalfSpace((0, -2, 0), (0, 1, 0)), colour=(0, 0, 1), opacity=0.25)
    seen = travelled(DrawnScene.of(scene))
    assert seen.up == "z" and len(seen.framed) == 6 * scene.bodies[0].n_nodes
    assert np.array_equal(seen.framed, framed_points(scene)) and np.array_equal(seen.background, scene.background)
    assert seen.bodies[0].colour.tolist() == [1, 0, 0] and (seen.bodies[1].opacity, seen.obstacles[0].opacity) == (0.5, 0.25)
    assert seen.obstacles[0].colour.tolist() == [0, 0, 1] and seen.lights[0].direction.tolist() == [0, -1, 0]
    x = seen.start + np.repeat(np.array([0, 0, 1, 0, 0]), scene.bodies[0].n_nodes)[:, None]
    cameras = [camera_viewpoint(one, 0.5, x) for one in (scene, seen)]
    assert cameras[0].fov == cameras[1].fov and np.array_equal(cameras[0].position, cameras[1].position)
    assert np.allclose(cameras[0].target, 1.0), "it follows the body"


class Shown(FakeSimulator):
    """With all that pictures show."""

    plan = plan_of(True, "two bodies")

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
    sampler = Sampler(sim.scene)
    between = picture_writer(tmp_path / "between", sampler.drawn, options, plots)
    beside = PictureProcess(tmp_path / "beside", sampler.drawn, options, plots)
    assert os.getsid(beside.pid) == beside.pid, "a session of its own: Ctrl-C goes to the run"
    for index in range(n):
        sim.time = 0.1 * index
        plots.take(StepReport(time=sim.time, kinetic=sim.time, n_contacts=index), 0.01)
        state = sampler.state(sim, options.layers, [options.colour])
        between.frame(state, index)
        beside.frame(state, index)
    beside.flush()
    kept = [[writer.kept(t) for t in (sim.time, sim.time + 1.0)] for writer in (between, beside)]
    assert kept[0] == kept[1] and kept[0][1]["camera"][-1] > 0.0
    assert (kept[0][1]["impulse"] > 0.0) == ("contacts" in options.layers)
    between.close()
    beside.close()
    beside.close()
    own, other = (sorted((tmp_path / where / "frames").iterdir()) for where in ("between", "beside"))
    assert [path.name for path in own] == [path.name for path in other] == [f"{k:05d}.png" for k in range(n)]
    assert [a.name for a, b in zip(own, other) if a.read_bytes() != b.read_bytes()] == []
    assert len({path.read_bytes() for path in own}) == n, "the pictures differ from each other"
    with pytest.raises(OutputError, match=r"^picture 1 cannot be written to .*frames: its writer is closed$"):
        beside.frame(state, 1)


FAILING = """
from taisoft.view.link import serve
from taisoft.view.offscreen import Offscreen
from taisoft.view.picture_process import Drawing
image, left = Offscreen.image, [1, 2]
def failing(self, sim):
    if not left:
        raise MemoryError("3 GB")
    left.pop()
    return image(self, sim)
Offscreen.image = failing
serve(Drawing)
"""


def test_an_error_is_raised_once_it_is_known(tmp_path):
    """Of the real process, at its third picture."""
    message = "^the drawing of pictures failed: not enough memory for a picture: 3 GB; available: .*$"
    state = sampled(FakeSimulator(beam_scene()))
    writer = PictureProcess(tmp_path, state.scene, PictureOptions(SIZE), child=program(FAILING))
    with pytest.raises(OutputError, match=message):
        for index in range(10_000):
            writer.frame(state, index)
    for use in (writer.flush, lambda: writer.frame(state, 0), writer.close):
        with pytest.raises(OutputError, match=message):
            use()
    assert not (tmp_path / "frames/00003.png").exists()


def test_few_pictures_or_a_single_core_need_no_process(tmp_path, monkeypatch):
    """And a process that cannot be started is an error."""
    scene = DrawnScene.of(beam_scene())
    monkeypatch.setattr("sys.executable", str(tmp_path / "absent"))
    for missing, cores in ((1, 2), (0, 1)):
        monkeypatch.setattr(pictures, "usable_cores", lambda cores=cores: list(range(cores)))
        open_pictures(tmp_path, scene, PictureOptions(SIZE), None, MIN_PICTURES - missing).close()
    monkeypatch.setattr(pictures, "usable_cores", lambda: [0, 1])
    with pytest.raises(OutputError, match="^the drawing of pictures failed: its process cannot be started: No such file"):
        open_pictures(tmp_path, scene, PictureOptions(SIZE), None, MIN_PICTURES)
