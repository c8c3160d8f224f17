"""Pictures of a run: `frames/00000.png ...`, one per frame, and `video.mp4`, encoded from them. Each file is complete or absent.

The video is encoded by ffmpeg: the one on PATH, else that of the extra `video`.
"""

import shutil
import struct
import subprocess
import zlib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError
from taisoft.files import replacing, write_bytes
from taisoft.output.background import BackgroundWriter
from taisoft.output.folder import make_folder

FRAMES_NAME, VIDEO_NAME = "frames", "video.mp4"
COMPRESSION, SMALLEST = 2, 9  # zlib levels; 4 takes 1.7 times as long as 2 for a fifth fewer bytes, 9 several times as long
TIMEOUT = 600.0  # of the encoding [s]
ENCODING = "-c:v libx264 -crf 18 -pix_fmt yuv420p -vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -movflags +faststart -f mp4"


class FrameWriter:
    """Writes folder/frames/<index>.png of states, in a thread.

    folder: the run's folder; renderer: an object with `image(state) -> uint8 (height, width, 3)` and `close()`, such as
    `taisoft.view.offscreen.Offscreen`, which is closed with this writer; annotate: (picture, state, index) -> picture to write.
    A picture that cannot be written raises OutputError at the next call; later ones are not written. Raises OutputError.
    """

    def __init__(self, folder: str | Path, renderer, annotate: Callable | None = None):
        self.folder = make_folder(Path(folder) / FRAMES_NAME)
        self.renderer, self._annotate, self._writer = renderer, annotate, BackgroundWriter()

    def frame(self, state, index: int) -> None:
        """Draw a state, to be written as picture number index. Raises OutputError."""
        if self._writer.closed:
            raise OutputError(f"picture {index} cannot be written to {self.folder}: its writer is closed")
        picture = self.renderer.image(state)
        if self._annotate is not None:
            picture = self._annotate(picture, state, index)
        self._writer.write(self.folder / f"{index:05d}.png", lambda path: write_bytes(path, png_bytes(picture)))

    def flush(self) -> None:
        """Wait until all pictures are written. Raises OutputError."""
        self._writer.flush()

    def kept(self, time: float) -> dict:
        """Return what pictures from time [s] on depend on, as `Offscreen.kept`."""
        return self.renderer.kept(time)

    def close(self) -> None:
        """Write the pictures that wait, and close the renderer; a second call does nothing. Raises OutputError."""
        try:
            self._writer.close()
        finally:
            self.renderer.close()


def png_bytes(image: np.ndarray, level: int = COMPRESSION) -> bytes:
    """Encode an 8-bit RGB image (height, width, 3) as PNG (ISO/IEC 15948), with rows filtered by their upper neighbour.

    level: of compression by zlib, 1 to 9. Raises ValueError for another array.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"a picture must be uint8 (height, width, 3), not {image.dtype} {image.shape}")
    height, width = image.shape[:2]
    rows = image.reshape(height, width * 3)
    filtered = np.empty((height, width * 3 + 1), dtype=np.uint8)
    filtered[:, 0] = 2  # filter type "up"
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])  # modulo 256, as the format requires
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, RGB, not interlaced
    png = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(filtered, level)), (b"IEND", b"")):
        png += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return png


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


def picture_numbers(folder: Path) -> list[int]:
    """Return the numbers of a run's pictures in folder/frames."""
    return [int(path.stem) for path in (folder / FRAMES_NAME).glob("*.png") if path.stem.isdecimal()]


def ffmpeg_command(folder: Path, fps: float, ffmpeg: str = "ffmpeg", out: Path | None = None) -> list[str]:
    """Return the ffmpeg command that encodes the pictures in folder/frames at fps [1/s], for common players and browsers."""
    pattern = str(folder / FRAMES_NAME).replace("%", "%%") + "/%05d.png"
    pictures = ["-framerate", f"{fps:g}", "-start_number", str(min(picture_numbers(folder))), "-i", pattern]
    return [ffmpeg, "-y", "-loglevel", "error", "-xerror", *pictures, *ENCODING.split(), str(out or folder / VIDEO_NAME)]


def write_video(folder: Path, fps: float) -> None:
    """Write folder/video.mp4 from the pictures in folder/frames. Raises OutputError."""
    ffmpeg, path = find_ffmpeg(), folder / VIDEO_NAME
    if ffmpeg is None:
        raise OutputError(f"{path} cannot be made without ffmpeg: pip install 'taisoft[video]'")
    options = {"stdin": subprocess.DEVNULL, "capture_output": True, "timeout": TIMEOUT, "check": False}
    with replacing(path) as part:
        try:  # in a session of its own: Ctrl-C goes to the run, which ends ffmpeg
            result = subprocess.run(ffmpeg_command(folder, fps, ffmpeg, part), start_new_session=True, **options)
        except subprocess.TimeoutExpired as error:
            raise OutputError(f"{path} cannot be made: {error}") from error
        if result.returncode != 0:
            lines = result.stderr.decode("utf-8", "replace").strip().splitlines()
            raise OutputError(f"{path} cannot be made: ffmpeg says: {lines[-1] if lines else result.returncode}")
