"""Pictures and videos of a run: PNG, the thread that writes it, its errors, and ffmpeg."""

import shlex
import threading

import numpy as np
import pytest

from taisoft.cli.recording import Recording
from taisoft.errors import OutputError
from taisoft.output import picture_files
from taisoft.output.picture_files import VIDEO_NAME, FrameWriter, ffmpeg_command, find_ffmpeg, png_bytes, write_video
from tests.cli.command import run
from tests.output.png import decode
from tests.view.fake_simulator import FakeSimulator, beam_scene

needs_ffmpeg = pytest.mark.skipif(find_ffmpeg() is None, reason="there is no ffmpeg")


def test_a_png_decodes_to_the_same_image():
    for shape in ((1, 1, 3), (7, 5, 3), (48, 64, 3)):
        image = np.random.default_rng(3).integers(0, 256, shape, dtype=np.uint8)
        assert np.array_equal(decode(png_bytes(image)), image)
    for other in (image[..., 0], image.astype(float), image[:0]):
        with pytest.raises(ValueError, match="must be uint8"):
            png_bytes(other)


class GreyRenderer:
    """Draws images of one grey value: sim.step_count."""

    closed = False

    def image(self, sim):
        return np.full((6, 8, 3), sim.step_count, dtype=np.uint8)

    def close(self):
        self.closed = True


def writing(tmp_path, monkeypatch, write):
    """A writer whose files are written by `write(path, data)`."""
    monkeypatch.setattr(picture_files, "write_bytes", write)
    return FrameWriter(tmp_path, GreyRenderer()), FakeSimulator(beam_scene())


def test_pictures_wait_for_a_slow_disk(tmp_path, monkeypatch):
    """A few pictures are taken while the disk is stuck with one; then `frame` waits for it. All of them are written in order."""
    stuck, written, taken = threading.Event(), [], []

    def slow(path, data):
        assert stuck.wait(60)
        written.append((path.name, decode(data)[0, 0, 0]))

    def record():
        for index in range(100):
            writer.frame(sim, index)
            sim.step()
            taken.append(index)

    writer, sim = writing(tmp_path, monkeypatch, slow)
    recording = threading.Thread(target=record, daemon=True)
    recording.start()
    recording.join(0.2)
    assert recording.is_alive() and 2 <= len(taken) < 50 and written == []
    stuck.set()
    recording.join(60)
    for use in (writer.flush, writer.close, writer.close, writer.flush):
        use()
        assert written == [(f"{k:05d}.png", k) for k in range(100)]
    with pytest.raises(OutputError, match=r"^picture 1 cannot be written to .*frames: its writer is closed$"):
        writer.frame(sim, 1)


@pytest.mark.parametrize(
    "error, message",
    [(OutputError("the disk is full"), "^the disk is full$"), (MemoryError("a defect"), "00001.png: MemoryError: a defect$")],
)
def test_an_error_of_writing_is_raised_once_it_is_known(tmp_path, monkeypatch, error, message):
    written, queued = [], threading.Event()

    def failing(path, data):
        assert queued.wait(60)
        written.append(path.name)
        if path.name == "00001.png":
            raise error

    writer, sim = writing(tmp_path, monkeypatch, failing)
    for index in range(3):
        writer.frame(sim, index)
    queued.set()
    for use in (writer.flush, lambda: writer.frame(sim, 3), writer.close):
        with pytest.raises(OutputError, match=message):
            use()
    assert writer.renderer.closed and written == ["00000.png", "00001.png"]


def write_pictures(folder, first=0, size=(48, 64)):
    (folder / "frames").mkdir(parents=True)
    for k in range(5):
        (folder / "frames" / f"{first + k:05d}.png").write_bytes(png_bytes(np.full((*size, 3), 40 * k, dtype=np.uint8)))


@needs_ffmpeg
def test_every_picture_is_a_frame(tmp_path):
    """Of odd size, numbered from 31 on, in a folder with a name that ffmpeg would take for a pattern."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    folder = tmp_path / "50%d of it"
    write_pictures(folder, 31, size=(47, 63))
    (folder / "frames" / "2a.png").write_bytes(b"not a picture of the run")
    write_video(folder, 25.0)
    n, seconds = imageio_ffmpeg.count_frames_and_secs(str(folder / VIDEO_NAME))
    assert n == 5 and seconds == pytest.approx(0.2, abs=0.01)
    assert [path.name for path in folder.iterdir() if path.is_file()] == [VIDEO_NAME]
    (folder / VIDEO_NAME).unlink()
    (folder / "frames" / "00031.png").write_bytes(b"not a PNG")
    with pytest.raises(OutputError, match="video.mp4 cannot be made: ffmpeg says: "):
        write_video(folder, 25.0)
    assert not [path for path in folder.iterdir() if path.is_file()]


def test_command_is_printed_without_ffmpeg(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(picture_files, "find_spec", lambda name: None)
    monkeypatch.setattr(picture_files.shutil, "which", lambda name: None)
    out = tmp_path / "out"
    recording = Recording(str(out), overwrite=False)
    recording.video(30.0)
    assert not capsys.readouterr().err  # no pictures
    write_pictures(out)
    recording.video(30.0)
    recording.release()
    errors, command = capsys.readouterr().err, shlex.join(ffmpeg_command(out, 30.0))
    assert "pip install 'taisoft[video]'" in errors and command in errors and "-framerate 30 " in command
    with pytest.raises(OutputError, match="cannot be made without ffmpeg"):
        write_video(out, 30.0)


@needs_ffmpeg
def test_a_run_makes_a_video(beam, tmp_path):
    """Three frames at 30 per second, four times as slow."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert run(beam, "--video", "--out", tmp_path / "out", "--no-usd", "--slow", "4", "--size", "64x36") == 0
    n, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "out" / VIDEO_NAME))
    assert n == 4 and seconds == pytest.approx(4 * 4 / 30, abs=0.02)


def test_bad_sizes_and_speeds_are_refused(beam, tmp_path, capsys):
    for options, message in (
        ("--video --no-frames", "--video"),
        ("--slow 2", "--slow is the speed of the film, so it needs --video"),
        ("--video --slow 0", "--slow must be greater than 0"),
        ("--size 640", "--size 640: write width and height in pixels, such as 640x360"),
        ("--size 0x5", "both must be 1 to 16384"),
        ("--view 0 90", "--view: the elevation must be from -89 to 89 degrees, not 90"),
        ("--size 64x36 --no-frames", "--size needs --out"),
        ("--plots energies --no-frames", "--plots needs --out, the folder to write to, and pictures"),
    ):
        assert run(beam, "--out", tmp_path / "out", *options.split()) == 2
        assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
