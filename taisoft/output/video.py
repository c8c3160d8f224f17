"""Encode the pictures of a run as `video.mp4` with ffmpeg: the one on PATH, else that of the extra `video`."""

import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.output.files import replacing
from taisoft.output.frames import FRAMES_NAME

VIDEO_NAME = "video.mp4"
TIMEOUT = 600.0  # of the encoding [s]


def find_ffmpeg() -> str | None:
    """Return the path of ffmpeg, or None if there is none."""
    found = shutil.which("ffmpeg")
    if found is None and find_spec("imageio_ffmpeg") is not None:
        import imageio_ffmpeg

        try:
            found = imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError:  # the package has no binary for this platform
            return None
    return found


def picture_numbers(folder: Path) -> list[str]:
    """Return the names, without suffix, of a run's pictures in folder/frames."""
    return [path.stem for path in (folder / FRAMES_NAME).glob("*.png") if path.stem.isdecimal()]


def command(folder: Path, fps: float, ffmpeg: str = "ffmpeg", out: Path | None = None) -> list[str]:
    """Return the ffmpeg command that encodes the pictures in folder/frames at fps [1/s], for common players and browsers."""
    first, frames = min(map(int, picture_numbers(folder))), str(folder / FRAMES_NAME).replace("%", "%%")
    return [
        ffmpeg,
        "-y",
        "-loglevel",
        "error",
        "-xerror",
        "-framerate",
        f"{fps:g}",
        "-start_number",
        str(first),
        "-i",
        f"{frames}/%05d.png",
        "-c:v",
        "libx264",
        "-crf",
        "18",
        "-pix_fmt",
        "yuv420p",
        "-vf",
        "pad=ceil(iw/2)*2:ceil(ih/2)*2",
        "-movflags",
        "+faststart",
        "-f",
        "mp4",
        str(out or folder / VIDEO_NAME),
    ]


def write_video(folder: Path, fps: float) -> None:
    """Write folder/video.mp4 from the pictures in folder/frames. Raises OutputError; the file is complete or absent."""
    ffmpeg, path = find_ffmpeg(), folder / VIDEO_NAME
    if ffmpeg is None:
        raise OutputError(f"{path} cannot be made without ffmpeg: pip install 'taisoft[video]'")
    with replacing(path) as part:
        try:
            result = subprocess.run(
                command(folder, fps, ffmpeg, part),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=TIMEOUT,
                check=False,
                start_new_session=True,  # Ctrl-C goes to the run, which ends ffmpeg
            )
        except subprocess.TimeoutExpired as error:
            raise OutputError(f"{path} cannot be made: {error}") from error
        if result.returncode != 0:
            lines = result.stderr.decode("utf-8", "replace").strip().splitlines()
            raise OutputError(f"{path} cannot be made: ffmpeg says: {lines[-1] if lines else result.returncode}")
