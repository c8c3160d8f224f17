"""Pictures drawn in a process of their own: the link to it, the same bytes as those drawn between the steps, errors and ends."""

import os
import signal
import subprocess
import threading
import time

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import OutputError
from taisoft.output.camera import framed_points
from taisoft.output.frames import FrameWriter
from taisoft.records import StepReport
from taisoft.scene.plan import Plan
from taisoft.view import link as links
from taisoft.view import pictures
from taisoft.view.link import Link, LinkClosed, SharedNodes, encode
from taisoft.view.mirror import MirrorSimulation, describe_scene, describe_state
from taisoft.view.pictures import MIN_PICTURES, SLOTS, PictureOptions, PictureProcess, open_pictures, picture_writer
from taisoft.view.plots import History, Plots
from tests.cli.command import BEAM, child, report, write
from tests.output.png import decode
from tests.view.drawing import connected_scene, is_alive, marks_of, moving_scene, program
from tests.view.fake_simulator import FakeSimulator, beam_scene

SIZE = (160, 90)


def sent(message):
    return links.decode(encode(message))


def test_messages_keep_their_data():
    message = {
        "text": "a 'name' of µm",
        "number": 1.5e-3,
        "nothing": None,
        "list": [1, True, [np.arange(6.0).reshape(2, 3), np.zeros((0, 3))]],
        "nested": {"ids": np.array([[1, 2], [3, 4]], dtype=np.int32).T, "nan": float("nan"), "size": np.float64(2.5)},
    }
    got = sent(message)
    assert got["text"] == message["text"] and got["number"] == 1.5e-3 and got["nothing"] is None
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
    link.send({"time": 1.0})
    assert links.receive(other, None) == {"time": 1.0}
    far.send({"commands": [["pause"]]})
    far.close()
    assert link.receive(1.0) == {"commands": [["pause"]]}, "what was sent before the end arrives"
    for use in (lambda: link.receive(1.0), lambda: link.send({"time": 2.0})):
        with pytest.raises(LinkClosed):
            use()
    link.close()


def test_only_what_is_shown_travels():
    sim = FakeSimulator(moving_scene())
    marks, n = marks_of(sim.scene), len(sim.positions())
    state = describe_state(sim, marks, set(), None)
    assert {"contacts", "history"}.isdisjoint(state) and state["tractions"] == []
    history = History()
    history.start(sim)
    state = sent(describe_state(sim, marks, {"tractions"}, history) | {"colour": "body"})
    mirror = MirrorSimulation(sent(describe_scene(sim.scene, marks)), n)
    mirror.take(state, sim.positions(), np.zeros(0))
    assert np.array_equal(mirror.history.high, history.high, equal_nan=True) and mirror.nodal_values is None
    assert state["tractions"][0].tolist() == [0.0, 0.0, 50.0]
    mirror.take(state | {"colour": "stress"}, sim.positions(), np.arange(float(n)))
    assert mirror.values_of("speed") is None and mirror.values_of("stress")[-1] == n - 1
    assert np.array_equal(mirror.positions("two"), sim.positions("two")) and mirror.energies() == sim.energies()
    sim.scene.add_obstacle(ts.Sphere((9, 0, 0), 0.1), name="late", path=lambda t: ((1.0 / (1.0 - t), 0, 0), np.eye(3)))
    sim.time = 1.0
    with pytest.raises(ts.OutputError, match="the scene cannot be shown: obstacle 'late': the path must give"):
        describe_state(sim, marks_of(sim.scene), set(), None)


def test_both_frame_the_same_fall():
    """Of one body; the others are held, prescribed or connected."""
    scene = beam_scene(("held", "moved", "one", "two", "three"))
    for name in ("moved", "one", "two", "three"):
        scene.body(name).constraints.clear()
    scene.body("moved").move([0], lambda t: (0, t, 0))
    scene.add_spring(("one", 0), ("two", 0), 1.0)
    scene.add_obstacle(ts.HalfSpace((0, -2, 0), (0, 1, 0)))
    seen = framed_points(MirrorSimulation(sent(describe_scene(scene, marks_of(scene))), 0).scene)
    assert len(seen) == 6 * scene.bodies[0].n_nodes and np.array_equal(seen, framed_points(scene))


class Shown(FakeSimulator):
    """With all that pictures show."""

    plan = Plan()
    plan.add("contact_forces", True, "two bodies", "")

    def tensions(self):
        return {one.name: k + self.time for k, one in enumerate((*self.scene.springs, *self.scene.tendons))}


CASES = {
    "connections": (connected_scene, PictureOptions(SIZE, layers=("wires", "connections", "pressures", "fixed_nodes"))),
    "contacts": (moving_scene, PictureOptions(SIZE, "speed", ("contacts", "tractions"), ("energies", "contacts"), "beams", True)),
}


@pytest.mark.parametrize("name", CASES)
def test_both_ways_write_the_same_bytes(name, tmp_path):
    build, options = CASES[name]
    sim = Shown(build())
    plots = Plots(sim, options.plots)
    between = picture_writer(tmp_path / "between", sim.scene, options, plots)
    beside = PictureProcess(tmp_path / "beside", sim, options, plots)
    for index in range(4):
        sim.time = 0.3 * index
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
    assert [path.name for path in own] == [path.name for path in other] == [f"{k:05d}.png" for k in range(4)]
    assert [a.name for a, b in zip(own, other) if a.read_bytes() != b.read_bytes()] == []
    assert len({path.read_bytes() for path in own}) == 4, "the pictures differ from each other"


STAND_IN = """
import sys, time
from pathlib import Path
from taisoft.view.child_process import serve
class Slow:
    def __init__(self, link, description):
        self.link, self.folder = link, Path(description["folder"])
    def run(self):
        while not (self.folder / "go").exists():
            time.sleep(0.01)
        while "end" not in (message := self.link.receive(None)):
            if "flush" in message:
                self.link.send({"flushed": True})
            else:
                x = self.link.nodes.x[message["slot"]].copy()
                (self.folder / f"{message['index']}.bin").write_bytes(x.tobytes())
                self.link.send({"drawn": message["time"], "kept": [{}, {}]})
serve(Slow, *map(int, sys.argv[1:]))
"""


def test_the_simulation_waits_for_a_full_queue_only(tmp_path, monkeypatch):
    """Few pictures, or a single core, need no process."""
    sim, expected = FakeSimulator(beam_scene()), []
    monkeypatch.setattr(pictures, "CHILD", program(STAND_IN))
    for missing, cores, kind in ((1, 2, FrameWriter), (0, 1, FrameWriter), (0, 2, PictureProcess)):
        monkeypatch.setattr(pictures, "usable_cores", lambda cores=cores: list(range(cores)))
        writer = open_pictures(tmp_path, sim, PictureOptions(SIZE), None, MIN_PICTURES - missing)
        assert type(writer) is kind
        if kind is FrameWriter:
            writer.close()

    def frame(index):
        sim.time = 0.1 * index
        expected.append(sim.positions().tobytes())
        writer.frame(sim, index)

    for index in range(SLOTS):
        frame(index)
    last = threading.Thread(target=frame, args=(SLOTS,))
    last.start()
    last.join(0.2)
    assert last.is_alive(), "one more than the queue holds waits"
    (tmp_path / "go").touch()
    last.join(60)
    for index in range(SLOTS + 1, 3 * SLOTS):
        frame(index)
    writer.close()
    assert [(tmp_path / f"{k}.bin").read_bytes() for k in range(3 * SLOTS)] == expected
    with pytest.raises(OutputError, match=r"^picture 1 cannot be written to .*frames: its writer is closed$"):
        writer.frame(sim, 1)


def failing(error: str) -> tuple[str, ...]:
    """The real process, whose third picture raises an error."""
    return program(f"""
import sys
from taisoft.view import offscreen
from taisoft.view.child_process import serve
from taisoft.view.picture_process import Drawing
image, count = offscreen.Offscreen.image, []
def failing(self, sim):
    count.append(1)
    if len(count) == 3:
        {error}
    return image(self, sim)
offscreen.Offscreen.image = failing
serve(Drawing, *map(int, sys.argv[1:]))
""")


@pytest.mark.parametrize(
    "moment, error, end",
    [
        ("frame", "raise MemoryError('3 GB')", "not enough memory for a picture: 3 GB; available: .*"),
        ("flush", "import os; os._exit(7)", "its process ended with exit status 7"),
    ],
)
def test_an_error_is_raised_once_it_is_known(moment, error, end, tmp_path):
    message = f"^the drawing of pictures failed: {end}$"
    sim = FakeSimulator(beam_scene())
    writer = PictureProcess(tmp_path, sim, PictureOptions(SIZE), child=failing(error))
    for index in range(4):
        writer.frame(sim, index)
    with pytest.raises(OutputError, match=message):
        if moment == "flush":
            writer.flush()
        for index in range(4, 10_000):
            writer.frame(sim, index)
    for use in (lambda: writer.frame(sim, 0), writer.close):
        with pytest.raises(OutputError, match=message):
            use()
    assert not (tmp_path / "frames/00003.png").exists()


def test_a_process_that_does_not_start(tmp_path):
    sim = FakeSimulator(beam_scene())
    with pytest.raises(OutputError, match="^the drawing of pictures failed: its process cannot be started: No such file"):
        PictureProcess(tmp_path, sim, PictureOptions(SIZE), child=(str(tmp_path / "absent"),))


def wait_for(condition) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_an_interrupted_run_leaves_its_pictures_and_no_process(tmp_path):
    """Ctrl-C goes to the terminal's whole group; the run then ends with all pictures so far."""
    scene, out = write(tmp_path / "beam.py", BEAM.replace('"seconds": 0.1', '"seconds": 1000.0')), tmp_path / "out"
    process = child("run", scene, "--headless", "--no-usd", "--out", out, start_new_session=True)
    try:
        wait_for(lambda: (out / "frames/00005.png").exists())
        command = ["ps", "-o", "pid=", "--ppid", str(process.pid)]
        (other,) = map(int, subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
        os.killpg(process.pid, signal.SIGINT)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    wait_for(lambda: not is_alive(other))
    written = sorted(path for path in (out / "frames").iterdir() if path.suffix == ".png")
    assert all(decode(path.read_bytes()).shape == (720, 1280, 3) for path in written)
    assert [path.name for path in written] == [f"{k:05d}.png" for k in range(len(written))]
    assert process.returncode == 130, error
    record = report(out)
    assert record["interrupted"] and len(written) == 1 + int(record["sim_seconds"] * 30 + 1e-6)
