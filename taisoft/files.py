"""Files that are whole or absent, whenever the process is killed.

A file is written under a temporary name in its own folder (`<name>.<pid>-<n>.part`), flushed, fsynced, renamed, and the
folder fsynced: whatever stands under a final name is complete.
"""

import errno
import itertools
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from taisoft.errors import OutputError

_part_numbers = itertools.count()


def cache_folders() -> Iterator[Path]:
    """Where what can be computed anew may be kept: the user's cache, where the user has one, and then the folder for what is
    temporary."""
    home = os.path.expanduser("~")
    if chosen := os.environ.get("XDG_CACHE_HOME"):
        yield Path(chosen) / "taisoft"
    elif home != "~":  # a user without a home
        yield Path(home) / ".cache" / "taisoft"
    with suppress(OSError):  # there is none that can be written
        yield Path(tempfile.gettempdir()) / "taisoft"


def write_error(path: Path, error: OSError, n_bytes: int | None = None) -> OutputError:
    """The OutputError that tells of a failed write: path, bytes where known, and the system's reason."""
    size = "" if n_bytes is None else f" ({n_bytes} bytes)"
    return OutputError(f"cannot write {path}{size}: {error.strerror or error}")


def part_path(path: Path) -> Path:
    """A temporary name beside path that no other file of this process has; leftovers end in `.part`."""
    return path.with_name(f"{path.name}.{os.getpid()}-{next(_part_numbers)}.part")


def publish(part: Path, path: Path) -> None:
    """Bring a finished temporary file to disk and to its final name. Raises OSError; then the part is still there."""
    _fsync(part, os.O_RDWR)
    os.replace(part, path)
    if os.name == "posix":  # elsewhere a folder cannot be opened, nor needs to be
        _fsync(path.parent, os.O_RDONLY)


@contextmanager
def replacing(path: str | Path, n_bytes: int | None = None) -> Iterator[Path]:
    """Yield a temporary path to fill; at the end of the block it becomes `path`, or vanishes if the block failed.

    n_bytes: size to name in the message, where known. Raises OutputError for any OSError, inside the block too.
    """
    path = Path(path)
    part = part_path(path)
    try:
        yield part
        publish(part, path)
    except OSError as error:
        raise write_error(path, error, n_bytes) from error
    finally:
        with suppress(OSError):  # gone after a rename; unreachable when the folder is
            part.unlink()


def name_also(path: Path, other: Path) -> None:
    """Let a file, if it is there, have another name too, which it takes from any other file in one step. Raises OSError."""
    part = part_path(other)
    try:
        try:
            os.link(path, part)
        except FileNotFoundError:
            return
        except OSError:  # a file system without links
            shutil.copyfile(path, part)
            _fsync(part, os.O_RDWR)
        os.replace(part, other)
    finally:
        with suppress(OSError):
            part.unlink()


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write data to path, whole or not at all. Raises OutputError naming path and size."""
    with replacing(path, len(data)) as part, open(part, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _fsync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems have no fsync for a folder
            raise
    finally:
        os.close(descriptor)
