"""Pictures drawn in a process of their own:

* the same bytes as those drawn between the steps, whatever the scene, layers, colours and plots, and the same kept scales;
* a run takes the process only for many pictures on several cores; a script needs no guard; the signal that ends a run leaves
  complete pictures and no process; nor does a caller that is killed;
* the simulation waits only for a full queue;
* a full disk, missing memory, a defect and a lost process are one sentence at the next call, and a run is then not ok.
"""

import os
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import OutputError
from taisoft.output.frames import FrameWriter
from taisoft.view import pictures
from taisoft.view.pictures import SLOTS, PictureOptions, PictureProcess, open_pictures, picture_writer
from taisoft.view.plots import Plots
from tests.cli.command import BEAM, ROOT, child, report, run, write
from tests.output.png import decode
from tests.view.fake_simulator import FakeSimulator, beam_scene
from tests.view.test_link import connected_scene, moving_scene

SIZE = (160, 90)
MANY = pictures.MIN_PICTURES
LONG_BEAM = BEAM.replace('"seconds": 0.1', '"seconds": 1.5')  # 46 pictures


def resting_scene() -> ts.Scene:
    """Two cubes, one on the other, on a ball that moves and on the ground, one of second order and with a load along a path."""
    scene, soft = moving_scene(), ts.Material(young=1e5, density=1000.0)
    for k in range(2):
        scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), soft, name=f"cube{k}", position=(6, -2.45 + 1.001 * k, 0), order=1 + k)
    return scene


CASES = {
    "connections": (connected_scene, PictureOptions(SIZE, layers=("wires", "connections", "pressures", "fixed_nodes")), "f32"),
    "contacts": (resting_scene, PictureOptions(SIZE, "speed", ("contacts", "tractions"), bar=True), "f64"),
    "texts": (resting_scene, PictureOptions(SIZE, "stress", plots=("energies", "contacts"), caption="cubes", bar=True), "f32"),
}


@pytest.mark.parametrize("name", CASES)
def test_both_ways_write_the_same_bytes(name, tmp_path):
    build, options, precision = CASES[name]
    if options.bar or options.caption:
        pytest.importorskip("matplotlib")
        pytest.importorskip("PIL")
    with ts.Simulator(build(), dt=0.01, precision=precision) as sim:
        plots = Plots(sim, options.plots)
        between = picture_writer(tmp_path / "between", sim.scene, options, plots)
        beside = PictureProcess(tmp_path / "beside", sim, options, plots)

        def on_frame(sim, index, _report):
            between.frame(sim, index)
            beside.frame(sim, index)

        sim.run(0.1, on_frame, fps=100, on_step=plots.take)
        beside.flush()
        kept = [[writer.kept(t) for t in (sim.time, sim.time + 1.0)] for writer in (between, beside)]
        assert kept[0] == kept[1] and kept[0][1]["camera"] > 0.0
        assert (kept[0][1]["impulse"] > 0.0) == ("contacts" in options.layers)
        between.close()
        beside.close()
        beside.close()
    own, other = (sorted((tmp_path / where / "frames").iterdir()) for where in ("between", "beside"))
    assert [path.name for path in own] == [path.name for path in other] == [f"{k:05d}.png" for k in range(11)]
    assert [a.name for a, b in zip(own, other) if a.read_bytes() != b.read_bytes()] == []
    assert len({path.read_bytes() for path in own}) > 5, "the pictures differ from each other"


def test_a_second_process_continues_the_scales(tmp_path):
    """Stress grows with time, so a picture of time 0 has another scale after one of time 9."""
    sim, kept = FakeSimulator(beam_scene()), {}

    def draw(writer, *times):
        for sim.time in times:
            writer.frame(sim, int(sim.time))
        writer.close()
        return (tmp_path / "frames/00000.png").read_bytes()

    one = draw(picture_writer(tmp_path, sim.scene, PictureOptions(SIZE, "stress"), None), 9.0, 0.0)
    alone = draw(picture_writer(tmp_path, sim.scene, PictureOptions(SIZE, "stress"), None), 0.0)
    for moment in (9.0, 0.0):
        writer = PictureProcess(tmp_path, sim, PictureOptions(SIZE, "stress", kept=kept))
        two = draw(writer, moment)
        kept = writer.kept(99.0)
    assert one == two != alone


@pytest.mark.parametrize(
    "n_pictures, cores, kind", [(MANY, [0, 1], PictureProcess), (MANY - 1, [0, 1], FrameWriter), (MANY, [3], FrameWriter)]
)
def test_few_pictures_and_a_single_core_need_no_process(n_pictures, cores, kind, tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "usable_cores", lambda: cores)
    sim = FakeSimulator(beam_scene())
    writer = open_pictures(tmp_path, sim, PictureOptions(SIZE), None, n_pictures)
    writer.frame(sim, 0)
    writer.close()
    assert type(writer) is kind and decode((tmp_path / "frames/00000.png").read_bytes()).shape == (90, 160, 3)
    with pytest.raises(OutputError, match=r"^picture 1 cannot be written to .*frames: its writer is closed$"):
        writer.frame(sim, 1)


def test_a_script_without_a_guard(tmp_path):
    """A run of 46 pictures in a process without modules of its own."""
    scene = write(tmp_path / "beam.py", LONG_BEAM)
    script = write(tmp_path / "script.py", "import sys\nfrom taisoft.cli import main\nprint('once', main(sys.argv[1:]))\n")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, script, "run", scene, "--headless", "--no-usd", "--out", tmp_path / "out"]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0 and done.stdout.count("once") == 1 and done.stdout.rstrip().endswith("once 0"), done.stderr
    assert len(list((tmp_path / "out/frames").iterdir())) == 46 and report(tmp_path / "out")["status"] == "ok"


# --- the queue --------------------------------------------------------------------------------------------------------

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


def program(code: str) -> tuple[str, ...]:
    return sys.executable, "-c", code


def test_the_simulation_waits_for_a_full_queue_only(tmp_path):
    sim = FakeSimulator(beam_scene())
    writer = PictureProcess(tmp_path, sim, PictureOptions(SIZE), child=program(STAND_IN))
    expected = []

    def frame(index):
        sim.time = 0.1 * index
        expected.append(sim.positions().tobytes())
        writer.frame(sim, index)

    for index in range(SLOTS):
        frame(index)
    last = threading.Thread(target=frame, args=(SLOTS,))
    last.start()
    last.join(0.5)
    assert last.is_alive(), "one more than the queue holds waits"
    (tmp_path / "go").touch()
    last.join(60)
    for index in range(SLOTS + 1, 3 * SLOTS):
        frame(index)
    writer.close()
    assert [(tmp_path / f"{k}.bin").read_bytes() for k in range(3 * SLOTS)] == expected


# --- errors -----------------------------------------------------------------------------------------------------------


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


ENDS = {
    ("frame", "raise MemoryError('3 GB')"): "not enough memory for a picture: 3 GB; available: .*",
    ("flush", "raise ValueError('odd')"): "ValueError: odd",
    ("close", "import os; os._exit(7)"): "its process ended with exit status 7",
    ("frame", "import os; os.kill(os.getpid(), 9)"): "its process ended by signal SIGKILL",
}


@pytest.mark.parametrize("moment, error", ENDS)
def test_an_error_is_raised_once_it_is_known(moment, error, tmp_path):
    message = f"^the drawing of pictures failed: {ENDS[moment, error]}$"
    sim = FakeSimulator(beam_scene())
    writer = PictureProcess(tmp_path, sim, PictureOptions(SIZE), child=failing(error))
    for index in range(4):
        writer.frame(sim, index)
    if moment == "frame":
        with pytest.raises(OutputError, match=message):
            for index in range(4, 10_000):
                writer.frame(sim, index)
        with pytest.raises(OutputError, match=message):
            writer.frame(sim, 0)
    elif moment == "flush":
        with pytest.raises(OutputError, match=message):
            writer.flush()
    with pytest.raises(OutputError, match=message):
        writer.close()
    assert not (tmp_path / "frames/00003.png").exists()


def test_a_process_that_does_not_start(tmp_path):
    sim = FakeSimulator(beam_scene())
    with pytest.raises(OutputError, match="^the drawing of pictures failed: its process cannot be started: No such file"):
        PictureProcess(tmp_path, sim, PictureOptions(SIZE), child=(str(tmp_path / "absent"),))
    writer = PictureProcess(tmp_path, sim, PictureOptions(SIZE), child=program("import sys; sys.exit(5)"))
    with pytest.raises(OutputError, match="^the drawing of pictures failed: its process ended with exit status 5$"):
        writer.flush()
    with pytest.raises(OutputError):
        writer.close()


def test_a_picture_that_cannot_be_written_ends_the_run(tmp_path, monkeypatch, capsys):
    """The folder of the pictures is removed after the second frame."""
    scene, out = write(tmp_path / "beam.py", LONG_BEAM), tmp_path / "out"
    frame, moved = PictureProcess.frame, out / "elsewhere"

    def remove(self, sim, index):
        if index == 2:
            self.flush()
            (out / "frames").rename(moved)
        frame(self, sim, index)

    monkeypatch.setattr(PictureProcess, "frame", remove)
    assert run(scene, "--out", out, "--no-usd") == 3
    error = capsys.readouterr().err
    assert re.search(r"taisoft: cannot write \S+/frames/00002.png \(\d+ bytes\): No such file or directory\n", error), error
    assert report(out)["status"] == "degraded" and [path.name for path in sorted(moved.iterdir())] == ["00000.png", "00001.png"]


def test_a_lost_process_ends_the_run(tmp_path, monkeypatch, capsys):
    scene, out, frame = write(tmp_path / "beam.py", LONG_BEAM), tmp_path / "out", PictureProcess.frame

    def kill(self, sim, index):
        if index == 10:
            os.kill(self.pid, signal.SIGKILL)
        frame(self, sim, index)

    monkeypatch.setattr(PictureProcess, "frame", kill)
    assert run(scene, "--out", out, "--no-usd") == 3
    sentence = "the drawing of pictures failed: its process ended by signal SIGKILL"
    assert f"taisoft: {sentence}\n" in capsys.readouterr().err
    assert report(out)["status"] == "degraded" and sentence in report(out)["problems"]


# --- ends of the caller -----------------------------------------------------------------------------------------------


def children(pid: int) -> list[int]:
    """Processes that a process has started and that have not ended."""
    found = subprocess.run(["ps", "-o", "pid=,stat=", "--ppid", str(pid)], capture_output=True, text=True, check=False).stdout
    return [int(line.split()[0]) for line in found.splitlines() if not line.split()[1].startswith("Z")]


def is_alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for(condition) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left(number, tmp_path):
    """Ctrl-C goes to the terminal's whole group; the run then ends with all pictures so far."""
    scene, out = write(tmp_path / "beam.py", LONG_BEAM.replace('"seconds": 1.5', '"seconds": 1000.0')), tmp_path / "out"
    process = child("run", scene, "--headless", "--no-usd", "--out", out, start_new_session=True)
    try:
        wait_for(lambda: (out / "frames/00005.png").exists())
        (other,) = children(process.pid)
        os.killpg(process.pid, number)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    wait_for(lambda: not is_alive(other))
    written = sorted(path for path in (out / "frames").iterdir() if path.suffix == ".png")
    assert all(decode(path.read_bytes()).shape == (720, 1280, 3) for path in written)
    assert [path.name for path in written] == [f"{k:05d}.png" for k in range(len(written))]
    if number == signal.SIGINT:
        assert process.returncode == 130, error
        record = report(out)
        assert record["interrupted"] and len(written) == 1 + int(record["sim_seconds"] * 30 + 1e-6)
        assert np.isfinite(record["wall_seconds"])
