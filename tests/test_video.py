"""Films of a run's pictures:

* every picture is a frame of the film, at the run's frame rate, odd sizes too; the first need not be number 0;
* without ffmpeg the command is printed, and it is the one that is run elsewhere; a failure of ffmpeg is one sentence, no file;
* `taisoft run --video` makes it, and is refused without pictures.
"""

import shlex

import numpy as np
import pytest
from command import run

from taisoft.cli.recording import Recording
from taisoft.errors import OutputError
from taisoft.output import frames
from taisoft.output.frames import VIDEO_NAME, ffmpeg_command, find_ffmpeg, png_bytes, write_video

needs_ffmpeg = pytest.mark.skipif(find_ffmpeg() is None, reason="there is no ffmpeg")


def pictures(folder, first=0, n=5, size=(48, 64)):
    (folder / "frames").mkdir(parents=True)
    for k in range(first, first + n):
        picture = np.full((*size, 3), 40 * (k - first), dtype=np.uint8)
        (folder / "frames" / f"{k:05d}.png").write_bytes(png_bytes(picture))


@needs_ffmpeg
@pytest.mark.parametrize("first, size, name", [(0, (48, 64), "a b"), (31, (47, 63), "50%d")])
def test_every_picture_is_a_frame(first, size, name, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    folder = tmp_path / name
    pictures(folder, first, size=size)
    (folder / "frames" / "2a.png").write_bytes(b"another's")
    write_video(folder, 25.0)
    n, seconds = imageio_ffmpeg.count_frames_and_secs(str(folder / VIDEO_NAME))
    assert n == 5 and seconds == pytest.approx(0.2, abs=0.01)
    assert [path.name for path in folder.iterdir() if path.is_file()] == [VIDEO_NAME]


@needs_ffmpeg
def test_a_failure_is_told(tmp_path):
    pictures(tmp_path)
    (tmp_path / "frames" / "00000.png").write_bytes(b"no picture")
    with pytest.raises(OutputError, match="video.mp4 cannot be made: ffmpeg says: "):
        write_video(tmp_path, 25.0)
    assert not [path for path in tmp_path.iterdir() if path.is_file()]


def test_without_ffmpeg(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(frames, "find_spec", lambda name: None)
    monkeypatch.setattr(frames.shutil, "which", lambda name: None)
    assert find_ffmpeg() is None
    out = tmp_path / "out"
    recording = Recording(str(out), overwrite=False)
    recording.video(30.0)
    assert not capsys.readouterr().err  # no pictures, nothing to tell
    pictures(out)
    recording.video(30.0)
    recording.close()
    said = capsys.readouterr().err
    assert "pip install 'taisoft[video]'" in said and shlex.join(ffmpeg_command(out, 30.0)) in said and "-framerate 30 " in said
    with pytest.raises(OutputError, match="cannot be made without ffmpeg"):
        write_video(out, 30.0)


@needs_ffmpeg
def test_a_run_with_a_film(beam, tmp_path):
    out = tmp_path / "out"
    assert run(beam, "--video") == 2 and run(beam, "--video", "--out", out, "--no-frames") == 2 and not out.exists()
    assert run(beam, "--video", "--out", out, "--no-usd") == 0
    assert (out / VIDEO_NAME).stat().st_size > 1000
