"""Videos of a run's pictures:

* every picture is a frame at the run's frame rate, for odd sizes and any first number;
* without ffmpeg its command is printed; a failure of ffmpeg is reported in one sentence and leaves no file;
* `taisoft run --video` makes a video, and is rejected without pictures.
"""

import shlex

import numpy as np
import pytest

from taisoft.cli.recording import Recording
from taisoft.errors import OutputError
from taisoft.output import frames
from taisoft.output.frames import VIDEO_NAME, ffmpeg_command, find_ffmpeg, png_bytes, write_video
from tests.cli.command import run

needs_ffmpeg = pytest.mark.skipif(find_ffmpeg() is None, reason="there is no ffmpeg")


def write_pictures(folder, first=0, n=5, size=(48, 64)):
    (folder / "frames").mkdir(parents=True)
    for k in range(first, first + n):
        picture = np.full((*size, 3), 40 * (k - first), dtype=np.uint8)
        (folder / "frames" / f"{k:05d}.png").write_bytes(png_bytes(picture))


@needs_ffmpeg
@pytest.mark.parametrize("first, size, name", [(0, (48, 64), "a b"), (31, (47, 63), "50%d")])
def test_every_picture_is_a_frame(first, size, name, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    folder = tmp_path / name
    write_pictures(folder, first, size=size)
    (folder / "frames" / "2a.png").write_bytes(b"not a picture of the run")
    write_video(folder, 25.0)
    n, seconds = imageio_ffmpeg.count_frames_and_secs(str(folder / VIDEO_NAME))
    assert n == 5 and seconds == pytest.approx(0.2, abs=0.01)
    assert [path.name for path in folder.iterdir() if path.is_file()] == [VIDEO_NAME]


@needs_ffmpeg
def test_failure_of_ffmpeg_is_reported(tmp_path):
    write_pictures(tmp_path)
    (tmp_path / "frames" / "00000.png").write_bytes(b"not a PNG")
    with pytest.raises(OutputError, match="video.mp4 cannot be made: ffmpeg says: "):
        write_video(tmp_path, 25.0)
    assert not [path for path in tmp_path.iterdir() if path.is_file()]


def test_command_is_printed_without_ffmpeg(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(frames, "find_spec", lambda name: None)
    monkeypatch.setattr(frames.shutil, "which", lambda name: None)
    assert find_ffmpeg() is None
    out = tmp_path / "out"
    recording = Recording(str(out), overwrite=False)
    recording.video(30.0)
    assert not capsys.readouterr().err  # no pictures
    write_pictures(out)
    recording.video(30.0)
    recording.close()
    errors = capsys.readouterr().err
    command = shlex.join(ffmpeg_command(out, 30.0))
    assert "pip install 'taisoft[video]'" in errors and command in errors and "-framerate 30 " in command
    with pytest.raises(OutputError, match="cannot be made without ffmpeg"):
        write_video(out, 30.0)


@needs_ffmpeg
def test_run_writes_a_video(beam, tmp_path):
    out = tmp_path / "out"
    assert run(beam, "--video") == 2 and run(beam, "--video", "--out", out, "--no-frames") == 2 and not out.exists()
    assert run(beam, "--video", "--out", out, "--no-usd") == 0
    assert (out / VIDEO_NAME).stat().st_size > 1000


@needs_ffmpeg
def test_size_and_slowness_are_options(beam, tmp_path, capsys):
    """Three frames at 30 per second, four times as slow."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    out = tmp_path / "out"
    assert run(beam, "--video", "--out", out, "--no-usd", "--slow", "4", "--size", "64x36") == 0
    n, seconds = imageio_ffmpeg.count_frames_and_secs(str(out / VIDEO_NAME))
    assert n == 4 and seconds == pytest.approx(4 * 4 / 30, abs=0.02)
    assert next(imageio_ffmpeg.read_frames(str(out / VIDEO_NAME)))["size"] == (64, 36)


@pytest.mark.parametrize(
    "options, message",
    [
        ("--slow 2", "--slow is the speed of the film, so it needs --video"),
        ("--video --slow 0", "--slow must be greater than 0"),
        ("--size 640", "--size 640: write width and height in pixels, such as 640x360"),
        ("--size 0x5", "both must be 1 to 16384"),
        ("--view 0 90", "--view: the elevation must be from -89 to 89 degrees, not 90"),
        ("--view nan 0", "--view: azimuth must be"),
        ("--view 0 10 --no-frames", "--view needs --out"),
        ("--size 64x36 --no-frames", "--size needs --out"),
    ],
)
def test_bad_sizes_and_speeds_are_refused(beam, tmp_path, capsys, options, message):
    assert run(beam, "--out", tmp_path / "out", *options.split()) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
