"""Image files, and the progress of a run:

* a PNG decodes to the same image, and frames are numbered with five digits;
* pictures are written by a thread while the run goes on, at most WAITING wait, and all are there after a flush or a close;
* a picture that cannot be written is an error at the next frame, flush or close, and no later one is written;
* a closed writer refuses pictures; observers are all closed, and report what could not be written;
* progress is a bar on a terminal and lines elsewhere, both with steps/s and the time left.
"""

import io
import re
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from taisoft.cli.recording import Observers
from taisoft.errors import OutputError
from taisoft.output import frames, report
from taisoft.output.frames import FrameWriter, png_bytes
from taisoft.output.report import Progress
from tests.output.png import decode
from tests.view.fake_simulator import FakeSimulator, beam_scene

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 5, 3), (48, 64, 3)])
def test_a_png_decodes_to_the_same_image(shape):
    image = np.random.default_rng(3).integers(0, 256, shape, dtype=np.uint8)
    assert np.array_equal(decode(png_bytes(image)), image)


@pytest.mark.parametrize("image", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)])
def test_png_refuses_other_arrays(image):
    with pytest.raises(ValueError, match="must be uint8"):
        png_bytes(image)


class GreyRenderer:
    """Draws images of one grey value: sim.step_count."""

    closed = False

    def image(self, sim):
        return np.full((6, 8, 3), sim.step_count, dtype=np.uint8)

    def close(self):
        self.closed = True


def test_frames_are_numbered_files(tmp_path):
    renderer = GreyRenderer()
    writer, sim = FrameWriter(tmp_path, renderer), FakeSimulator(beam_scene())
    for index in range(3):
        writer.frame(sim, index)
        sim.step()
    writer.close()
    assert renderer.closed
    files = sorted((tmp_path / "frames").iterdir())
    assert [path.name for path in files] == ["00000.png", "00001.png", "00002.png"]
    assert [decode(path.read_bytes())[0, 0, 0] for path in files] == [0, 1, 2]


def writing(tmp_path, monkeypatch, write):
    """A writer whose files are written by `write(path, data)`."""
    monkeypatch.setattr(frames, "write_bytes", write)
    return FrameWriter(tmp_path, GreyRenderer()), FakeSimulator(beam_scene())


def test_pictures_wait_for_a_slow_disk(tmp_path, monkeypatch):
    """WAITING pictures are taken while the disk is stuck with one; the next `frame` waits for it."""
    stuck, written = threading.Event(), []

    def slow(path, data):
        assert stuck.wait(60)
        written.append((path.name, decode(data)[0, 0, 0]))

    writer, sim = writing(tmp_path, monkeypatch, slow)
    for index in range(frames.WAITING + 1):
        writer.frame(sim, index)
        sim.step()
    assert written == []
    last = threading.Thread(target=writer.frame, args=(sim, frames.WAITING + 1))
    last.start()
    last.join(0.2)
    assert last.is_alive() and written == []
    stuck.set()
    last.join(60)
    writer.flush()
    assert written == [(f"{k:05d}.png", k) for k in range(frames.WAITING + 2)]
    writer.close()
    writer.close()
    assert len(written) == frames.WAITING + 2


@pytest.mark.parametrize("error", [OutputError("the disk is full"), MemoryError("a defect")])
@pytest.mark.parametrize("moment", ["frame", "flush", "close"])
def test_an_error_of_writing_is_raised_once_it_is_known(tmp_path, monkeypatch, error, moment):
    written, message = [], "^the disk is full$" if isinstance(error, OutputError) else "00001.png: MemoryError: a defect$"

    def failing(path, data):
        written.append(path.name)
        if path.name == "00001.png":
            raise error

    writer, sim = writing(tmp_path, monkeypatch, failing)
    for index in range(2):
        writer.frame(sim, index)
    if moment == "frame":
        with pytest.raises(OutputError, match=message):
            for index in range(2, 10_000):
                writer.frame(sim, index)
    elif moment == "flush":
        with pytest.raises(OutputError, match=message):
            writer.flush()
    with pytest.raises(OutputError, match=message):
        writer.close()
    assert writer.renderer.closed and written == ["00000.png", "00001.png"]


def test_a_closed_writer_refuses_pictures(tmp_path):
    writer, sim = FrameWriter(tmp_path, GreyRenderer()), FakeSimulator(beam_scene())
    writer.frame(sim, 0)
    writer.close()
    with pytest.raises(OutputError, match=r"^picture 1 cannot be written to .*frames: its writer is closed$"):
        writer.frame(sim, 1)
    flushing = threading.Thread(target=writer.flush, daemon=True)
    flushing.start()
    flushing.join(10)
    assert not flushing.is_alive() and len(list((tmp_path / "frames").iterdir())) == 1


def test_observers_close_all_members_and_report_errors_of_writing(tmp_path, monkeypatch):
    def failing(path, data):
        raise MemoryError("no memory")

    def defect():
        raise RuntimeError("a defect")

    writer, sim = writing(tmp_path, monkeypatch, failing)
    observers = Observers()
    observers.members += [writer, SimpleNamespace(close=defect)]
    writer.frame(sim, 0)
    with pytest.raises(RuntimeError, match="a defect"):
        observers.close()
    assert writer.renderer.closed and observers.members == [] and len(observers.errors) == 1
    assert observers.errors[0].endswith("00000.png: MemoryError: no memory")
    observers.close()


def test_a_writer_that_is_not_closed_does_not_keep_the_process(tmp_path):
    code = "import sys; sys.path[:0] = ['tests', '.']\nimport test_output_frames as t\nt.leave_open(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path], cwd=ROOT, timeout=60, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and done.stdout == "left\n", done.stderr
    assert all(path.suffix == ".png" and decode(path.read_bytes()).size for path in (tmp_path / "frames").glob("*.png"))


def leave_open(folder):
    writer, sim = FrameWriter(folder, GreyRenderer()), FakeSimulator(beam_scene())
    for index in range(5):
        writer.frame(sim, index)
    print("left", flush=True)


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """Wall time that advances by 2 s per call."""
    times = iter(range(0, 1000, 2))
    monkeypatch.setattr(report.time, "perf_counter", lambda: float(next(times)))


def advance(bar):
    sim = FakeSimulator(beam_scene())
    for index in range(6):
        bar.frame(sim, index)
        sim.time, sim.step_count = sim.time + 0.5, sim.step_count + 20
    bar.close()
    bar.close()


def test_progress_is_lines_in_a_file(clock):
    stream = io.StringIO()
    advance(Progress(10.0, "beam", stream))
    # frames at 0, 2, ..., 10 s, each of 20 steps and 0.5 s simulated; a line at the first one after 5 s
    assert stream.getvalue() == "beam: 1.500 of 10 s, 10 steps/s, 0:34 left\n"


def test_progress_leaves_compiling_out(clock):
    """Of 6 s until the line, 3 s went into compiling."""
    stream = io.StringIO()
    sim, bar = FakeSimulator(beam_scene()), Progress(10.0, "beam", stream)
    for index in range(4):
        bar.frame(sim, index)
        sim.time, sim.step_count, sim.compile_seconds = sim.time + 0.5, sim.step_count + 20, 3.0
    bar.close()
    assert stream.getvalue() == "beam: 1.500 of 10 s, 20 steps/s, 0:17 left\n"


def test_progress_is_a_bar_on_a_terminal(clock):
    stream = Terminal()
    advance(Progress(10.0, "beam", stream))
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())
    assert "10 steps/s" in text and "0:30 left" in text and "2.50 of 10 s" in text
