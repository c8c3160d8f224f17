"""The output folder of a run. It has one writer; its files are complete or absent (`taisoft/files.py`).

The folder's lock is an advisory kernel lock (flock) on a file that holds the writer's process id. The kernel releases it when
the writer dies.
"""

import os
import re
from contextlib import suppress
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.files import part_path, publish, replacing, write_bytes, write_error

__all__ = [
    "LOCK_NAME",
    "RESULT_FILES",
    "RESULT_FOLDERS",
    "FolderLock",
    "OutputFolder",
    "check_free",
    "make_folder",
    "part_path",
    "publish",
    "replacing",
    "write_bytes",
    "write_error",
]

LOCK_NAME = "taisoft.lock"
RESULT_FILES = ("report.json", "steps.csv", "scene.usdc", "checkpoint.npz", "checkpoint.previous.npz", "video.mp4")
REPORT_FILES = ("report.json", "steps.csv")  # removed at once: beside the results of another run they would be wrong
# Left by a killed writer: see `taisoft.files.part_path`; USD adds temporary files with a suffix of its own
TEMPORARY = re.compile(r"\.\d+-\d+\.part$|\.usdc\.\d+-\d+\.[A-Za-z0-9]{6}$")
RESULT_FOLDERS = {"frames": "[0-9]*.png", "chunks": "points_*.usdc"}  # folder -> pattern of a run's files in it


def make_folder(path: str | Path) -> Path:
    """Create a folder with its parents, or accept an existing one. Raises OutputError."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise OutputError(f"cannot use {path} as a folder: a file has that name") from None
    except OSError as error:
        raise OutputError(f"cannot create the folder {path}: {error.strerror or error}") from error
    return path


def check_free(path: str | Path, overwrite: bool) -> dict:
    """Return the results in a folder, by name, without changing it. Raises OutputError if there are any and not overwrite."""
    found = _results(Path(path)) if Path(path).is_dir() else {}
    if found and not overwrite:
        raise OutputError(
            f"the output folder {path} already holds results ({', '.join(found)}): name another folder or ask to overwrite"
        )
    return found


class OutputFolder:
    """A run's folder: created or reused, checked, and locked until `close`.

    path: created if absent; an empty folder, or one without a run's files, is accepted. overwrite: accept a folder that holds
    results: report.json, steps.csv, frames and chunks are removed at once, every other file when its successor is complete.
    first: number of the first frame of a resumed run; results are accepted, earlier frames stay, `clear` removes later ones
    and report.json, and other files are only replaced. Raises OutputError if the folder cannot be written, another process
    writes to it, or it holds results without overwrite.
    """

    def __init__(self, path: str | Path, overwrite: bool = False, first: int | None = None):
        self.path = make_folder(path).absolute()  # a later change of the working directory must not move the output
        self._lock = FolderLock(self.path)
        try:
            self._old = check_free(path, overwrite) if first is None else {}
            _clear_parts(self.path)
            if first is None:
                _remove(self.path, *REPORT_FILES)
                _clear_frames(self.path, 0)
            _probe(self.path)
        except OSError as error:
            self.close()
            raise OutputError(f"cannot write to the output folder {path}: {error.strerror or error}") from error
        except BaseException:
            self.close()
            raise

    def clear(self, first: int) -> None:
        """Remove report.json, and an earlier run's frames and chunks from number `first` on. Raises OutputError."""
        try:
            _remove(self.path, "report.json")
            _clear_frames(self.path, first)
        except OSError as error:
            raise OutputError(f"cannot write to the output folder {self.path}: {error.strerror or error}") from error

    def discard_stale(self) -> None:
        """Remove an earlier run's result files that this run did not replace, so that the folder holds one run."""
        for name, identity in self._old.items():
            file = self.path / name
            if identity is not None and file.exists() and _identity(file) == identity:
                try:
                    file.unlink()
                except OSError as error:
                    raise OutputError(f"cannot remove the earlier run's {file}: {error.strerror or error}") from error

    def close(self) -> None:
        """Release the lock. A second call does nothing."""
        self._lock.close()

    def __enter__(self) -> "OutputFolder":
        return self

    def __exit__(self, kind, value, traceback) -> None:
        try:
            if kind is None:
                self.discard_stale()
        finally:
            self.close()


class FolderLock:
    """A folder's lock, held until `close`. Raises OutputError if another process holds it or it cannot be taken."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._descriptor: int | None = _lock_folder(folder)

    def close(self) -> None:
        """Release the lock. A second call does nothing."""
        if self._descriptor is not None:
            with suppress(OSError):  # the folder may be gone; closing the descriptor frees the lock anyway
                (self._folder / LOCK_NAME).unlink()
            os.close(self._descriptor)
            self._descriptor = None


def _lock_folder(folder: Path) -> int:
    """Take the folder's lock and write the process id into it; return the open descriptor that holds it."""
    import fcntl  # POSIX only

    path = folder / LOCK_NAME
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise OutputError(f"cannot write to the output folder {folder}: {error.strerror or error}") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # the last holder may have removed this file between open and flock: then the lock is of no use
            if path.exists() and os.fstat(descriptor).st_ino == path.stat().st_ino:
                os.ftruncate(descriptor, 0)
                os.write(descriptor, f"{os.getpid()}\n".encode())
                return descriptor
            os.close(descriptor)
        except BlockingIOError:
            holder = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
            os.close(descriptor)
            raise OutputError(f"process {holder} is writing to the output folder {folder} (lock {path})") from None
        except OSError as error:
            os.close(descriptor)
            raise OutputError(f"cannot lock the output folder {folder}: {error.strerror or error}") from error


def _identity(file: Path) -> tuple[int, int]:
    """Return inode and modification time, which tell a file from its successor (an inode alone may be reused)."""
    status = file.stat()
    return status.st_ino, status.st_mtime_ns


def _results(folder: Path) -> dict[str, tuple[int, int] | None]:
    """Return an earlier run's results: file name -> identity, and subfolder name -> None."""
    found: dict[str, tuple[int, int] | None] = {}
    for name in RESULT_FILES:
        if (folder / name).exists():
            found[name] = _identity(folder / name)
    for name, pattern in RESULT_FOLDERS.items():
        if any((folder / name).glob(pattern)):
            found[f"{name}/"] = None
    return found


def _clear_frames(folder: Path, first: int) -> None:
    """Remove an earlier run's frames from number `first` on, and chunks whose first frame is among them."""
    for name, pattern in RESULT_FOLDERS.items():
        for file in (folder / name).glob(pattern):
            if first == 0 or _number(file) >= first:
                file.unlink()


def _remove(folder: Path, *names: str) -> None:
    """Remove files that exist; folders of these names are left for `_probe` to report."""
    for name in names:
        if not (folder / name).is_dir():
            (folder / name).unlink(missing_ok=True)


def _clear_parts(folder: Path) -> None:
    """Remove the temporary files of a killed writer, those of USD included."""
    found = [file for name, pattern in RESULT_FOLDERS.items() for file in (folder / name).glob(f"{pattern}.*")]
    found += [file for name in RESULT_FILES for file in folder.glob(f"{name}.*")]
    for file in found:
        if TEMPORARY.search(file.name):
            file.unlink()


def _number(file: Path) -> int:
    """Return the number of a frame, or of a chunk's first frame; -1 if the name has none."""
    text = file.stem.removeprefix("points_")
    return int(text) if text.isdecimal() else -1


def _probe(folder: Path) -> None:
    """Check that a file can be created and removed here, and that no result's name is taken by a folder or file."""
    for name in RESULT_FILES:
        if (folder / name).is_dir():
            raise OutputError(f"cannot write {folder / name}: a folder has that name")
    for name in RESULT_FOLDERS:
        if (folder / name).exists() and not (folder / name).is_dir():
            raise OutputError(f"cannot use {folder / name} as a folder: a file has that name")
    part = part_path(folder / "probe")
    try:
        part.write_bytes(b"taisoft\n")
    finally:
        part.unlink(missing_ok=True)
