"""Atomic file writing: a file is complete or absent, whenever the process is killed.

A file is written under a temporary name in its own folder (`<name>.<pid>-<n>.part`), flushed, fsynced and renamed, and the
folder is fsynced. So a file under its final name is always complete.
"""

import errno
import itertools
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from taisoft.errors import OutputError, value_text

_part_numbers = itertools.count()


def cache_folders() -> Iterator[Path]:
    """Yield folders for results that can be recomputed: the user's cache, if the user has one, then the temporary folder."""
    home = os.path.expanduser("~")
    if chosen := os.environ.get("XDG_CACHE_HOME"):
        yield Path(chosen) / "taisoft"
    elif home != "~":  # "~" stays for a user without a home folder
        yield Path(home) / ".cache" / "taisoft"
    with suppress(OSError):  # no temporary folder is writable
        yield Path(tempfile.gettempdir()) / "taisoft"


def write_error(path: Path, error: OSError, n_bytes: int | None = None) -> OutputError:
    """Return the OutputError for a failed write: path, size if known [bytes], and the system's reason."""
    size = "" if n_bytes is None else f" ({n_bytes} bytes)"
    return OutputError(f"cannot write {path}{size}: {error.strerror or error}")


def as_path(path, what: str, error: type[Exception], rule: str = "be a file's name") -> Path:
    """Return a path. what: start of the message about a value that is none, with the rule that it breaks; or raise the error."""
    try:
        return Path(path)
    except TypeError:
        raise error(f"{what}: path must {rule}, not {value_text(path)}") from None


def part_path(path: Path) -> Path:
    """Return a temporary path beside `path`, unique within this process; it ends in `.part`."""
    return path.with_name(f"{path.name}.{os.getpid()}-{next(_part_numbers)}.part")


def publish(part: Path, path: Path) -> None:
    """Flush a finished temporary file to disk and rename it. Raises OSError; the temporary file then remains."""
    _fsync(part, os.O_RDWR)
    os.replace(part, path)
    if os.name == "posix":  # other systems cannot open a folder, and need not
        _fsync(path.parent, os.O_RDONLY)


@contextmanager
def replacing(path: str | Path, n_bytes: int | None = None) -> Iterator[Path]:
    """Yield a temporary path to write. At the end of the block it is renamed to `path`, or removed if the block failed.

    n_bytes: size to name in the message, if known. Raises OutputError for any OSError, inside the block too.
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


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write data to path atomically. Raises OutputError naming path and size."""
    with replacing(path, len(data)) as part, open(part, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _fsync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # some file systems cannot fsync a folder
            raise
    finally:
        os.close(descriptor)
