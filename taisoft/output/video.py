"""`video.mp4` from the pictures of a run, by ffmpeg: the one on the path, else that of the extra `video`."""

import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.output.files import replacing
from taisoft.output.frames import FRAMES_NAME

VIDEO_NAME = "video.mp4"
SECONDS = 600.0  # that an encoding may take


def find_ffmpeg() -> str | None:
    """Path of ffmpeg; None where there is none."""
    found = shutil.which("ffmpeg")
    if found is None and find_spec("imageio_ffmpeg") is not None:
        import imageio_ffmpeg

        try:
            found = imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError:  # a platform that it brings none for
            return None
    return found


def picture_numbers(folder: Path) -> list[str]:
    """Names, without their ending, of the pictures of a run in folder/frames."""
    return [path.stem for path in (folder / FRAMES_NAME).glob("*.png") if path.stem.isdecimal()]


def command(folder: Path, fps: float, ffmpeg: str = "ffmpeg", out: Path | None = None) -> list[str]:
    """What turns the pictures in folder/frames, shown at fps [1/s], into a film that common players and browsers show."""
    first, place = min(map(int, picture_numbers(folder))), str(folder / FRAMES_NAME).replace("%", "%%")
    return [
        ffmpeg, "-y", "-loglevel", "error", "-xerror", "-framerate", f"{fps:g}", "-start_number", str(first),
        "-i", f"{place}/%05d.png", "-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p",
        "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-movflags", "+faststart", "-f", "mp4", str(out or folder / VIDEO_NAME),
    ]  # fmt: skip


def write_video(folder: Path, fps: float) -> None:
    """Write folder/video.mp4 from the pictures in folder/frames. Raises OutputError; the file is whole or absent."""
    ffmpeg, path = find_ffmpeg(), folder / VIDEO_NAME
    if ffmpeg is None:
        raise OutputError(f"{path} cannot be made without ffmpeg: pip install 'taisoft[video]'")
    with replacing(path) as part:
        try:
            ended = subprocess.run(
                command(folder, fps, ffmpeg, part), stdin=subprocess.DEVNULL, capture_output=True, timeout=SECONDS, check=False,
                start_new_session=True,  # Ctrl-C is for the run, which ends it
            )
        except subprocess.TimeoutExpired as error:
            raise OutputError(f"{path} cannot be made: {error}") from error
        if ended.returncode != 0:
            said = ended.stderr.decode("utf-8", "replace").strip().splitlines()
            raise OutputError(f"{path} cannot be made: ffmpeg says: {said[-1] if said else ended.returncode}")
