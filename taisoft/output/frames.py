"""Write `frames/00000.png ...`: one picture per frame, each file complete or absent."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from taisoft.output.files import make_folder, write_bytes

FRAMES_NAME = "frames"
_COMPRESSION = 4  # zlib level, 1 to 9: higher levels take twice the time for hardly fewer bytes


class FrameWriter:
    """Observer that writes folder/frames/<index>.png.

    folder: the run's folder; renderer: an object with `image(sim) -> uint8 (height, width, 3)` and `close()`, such as
    `taisoft.view.offscreen.Offscreen`, which is closed with this writer; annotate: (picture, sim, index) -> picture to write.
    Raises OutputError.
    """

    def __init__(self, folder: str | Path, renderer, annotate: Callable | None = None):
        self.folder = make_folder(Path(folder) / FRAMES_NAME)
        self.renderer, self._annotate = renderer, annotate

    def frame(self, sim, index: int) -> None:
        """Draw sim's present state and write it as picture number index. Raises OutputError."""
        picture = self.renderer.image(sim)
        if self._annotate is not None:
            picture = self._annotate(picture, sim, index)
        write_bytes(self.folder / f"{index:05d}.png", png_bytes(picture))

    def close(self) -> None:
        """Close the renderer."""
        self.renderer.close()


def png_bytes(image: np.ndarray) -> bytes:
    """Encode an 8-bit RGB image (height, width, 3) as PNG (ISO/IEC 15948), with rows filtered by their upper neighbour."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"a picture must be uint8 (height, width, 3), not {image.dtype} {image.shape}")
    height, width = image.shape[:2]
    rows = image.reshape(height, width * 3)
    filtered = np.empty((height, width * 3 + 1), dtype=np.uint8)
    filtered[:, 0] = 2  # filter type "up"
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])  # modulo 256, as the format requires
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, RGB, not interlaced
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered, _COMPRESSION)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
