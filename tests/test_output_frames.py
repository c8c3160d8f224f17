"""Image files, and the progress of a run:

* a PNG decodes to the same image, and frames are numbered with five digits;
* progress is a bar on a terminal and lines elsewhere, both with steps/s and the time left.
"""

import io
import re

import numpy as np
import pytest
from fake_simulator import FakeSimulator, beam_scene
from png import decode

from taisoft.output import report
from taisoft.output.frames import FrameWriter, png_bytes
from taisoft.output.report import Progress


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


def test_progress_is_a_bar_on_a_terminal(clock):
    stream = Terminal()
    advance(Progress(10.0, "beam", stream))
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())
    assert "10 steps/s" in text and "0:30 left" in text and "2.50 of 10 s" in text
