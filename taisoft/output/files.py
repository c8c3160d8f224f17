"""A run's folder, which has one writer; its files are whole or absent (`taisoft/files.py`).

The folder's lock is an advisory kernel lock (flock) on a file that holds the writer's process id, so that a dead writer's
lock is free.
"""

import os
import re
from contextlib import suppress
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.files import part_path, publish, replacing, write_bytes, write_error

__all__ = [
    "LOCK_NAME", "RESULT_FILES", "RESULT_FOLDERS", "FolderLock", "OutputFolder", "check_free", "make_folder", "part_path",
    "publish", "replacing", "write_bytes", "write_error",
]  # fmt: skip

LOCK_NAME = "taisoft.lock"
RESULT_FILES = ("report.json", "steps.csv", "scene.usdc", "checkpoint.npz", "checkpoint.previous.npz", "video.mp4")
TELLING_FILES = ("report.json", "steps.csv")  # what tells of a run: beside the results of another one they would lie
# What a writer that was killed leaves: see `taisoft.files.part_path`; USD writes beside that under an ending of its own
TEMPORARY = re.compile(r"\.\d+-\d+\.part$|\.usdc\.\d+-\d+\.[A-Za-z0-9]{6}$")
RESULT_FOLDERS = {"frames": "[0-9]*.png", "chunks": "points_*.usdc"}  # folder -> the files in it that are ours


def make_folder(path: str | Path) -> Path:
    """Create a folder with its parents, or accept the one that is there. Raises OutputError."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise OutputError(f"cannot use {path} as a folder: a file has that name") from None
    except OSError as error:
        raise OutputError(f"cannot create the folder {path}: {error.strerror or error}") from error
    return path


def check_free(path: str | Path, overwrite: bool) -> dict:
    """The results that a folder holds already, by name; OutputError when there are any and overwrite is off. Only looks."""
    found = _results(Path(path)) if Path(path).is_dir() else {}
    if found and not overwrite:
        raise OutputError(
            f"the output folder {path} already holds results ({', '.join(found)}): name another folder or ask to overwrite"
        )
    return found


class OutputFolder:
    """A run's folder: created or taken over, checked, and locked until `close`.

    path: created where absent; an empty folder, or one with files that are not a run's, is accepted. overwrite: take a
    folder that holds results: report.json, steps.csv, frames and chunks go at once, each other file when its successor is
    complete. first: of a run that goes on, the number of its first frame; results are accepted, what is before it stays, what
    comes after goes with `clear`, as report.json does, and other files go only for their successors. Raises OutputError when
    the folder cannot be written, another process writes to it, or it holds results without overwrite.
    """

    def __init__(self, path: str | Path, overwrite: bool = False, first: int | None = None):
        self.path = make_folder(path).absolute()  # a later change of the working directory must not move the output
        self._lock = FolderLock(self.path)
        try:
            self._old = check_free(path, overwrite) if first is None else {}
            _clear_parts(self.path)
            if first is None:
                _remove(self.path, *TELLING_FILES)
                _clear_frames(self.path, 0)
            _probe(self.path)
        except OSError as error:
            self.close()
            raise OutputError(f"cannot write to the output folder {path}: {error.strerror or error}") from error
        except BaseException:
            self.close()
            raise

    def clear(self, first: int) -> None:
        """Remove report.json, and an earlier run's frames and chunks from that number on. Raises OutputError."""
        try:
            _remove(self.path, "report.json")
            _clear_frames(self.path, first)
        except OSError as error:
            raise OutputError(f"cannot write to the output folder {self.path}: {error.strerror or error}") from error

    def discard_stale(self) -> None:
        """Remove the earlier run's result files that this run did not replace, so that a folder tells of one run."""
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
    """A folder's lock, held until `close`. Raises OutputError where another process has it, or where none can be had."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._descriptor: int | None = _lock_folder(folder)

    def close(self) -> None:
        """Release it. A second call does nothing."""
        if self._descriptor is not None:
            with suppress(OSError):  # the folder may be gone; the kernel frees the lock with the descriptor anyway
                (self._folder / LOCK_NAME).unlink()
            os.close(self._descriptor)
            self._descriptor = None


def _lock_folder(folder: Path) -> int:
    """Take the folder's lock and write our pid into it; returns the open descriptor that holds it."""
    import fcntl  # POSIX only, like the rest of the lock

    path = folder / LOCK_NAME
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise OutputError(f"cannot write to the output folder {folder}: {error.strerror or error}") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # the last holder may have removed this file between our open and our lock: then it locks nothing
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
    """Tells a file from its successor: inode and time of change (an inode alone is used again)."""
    status = file.stat()
    return status.st_ino, status.st_mtime_ns


def _results(folder: Path) -> dict[str, tuple[int, int] | None]:
    """Results of an earlier run: file name -> identity, and subfolder name -> None."""
    found: dict[str, tuple[int, int] | None] = {}
    for name in RESULT_FILES:
        if (folder / name).exists():
            found[name] = _identity(folder / name)
    for name, pattern in RESULT_FOLDERS.items():
        if any((folder / name).glob(pattern)):
            found[f"{name}/"] = None
    return found


def _clear_frames(folder: Path, first: int) -> None:
    """Remove an earlier run's frames, and chunks that begin with them, from that number on."""
    for name, pattern in RESULT_FOLDERS.items():
        for file in (folder / name).glob(pattern):
            if first == 0 or _number(file) >= first:
                file.unlink()


def _remove(folder: Path, *names: str) -> None:
    """Remove files, where they are there; what is a folder is left for `_probe`."""
    for name in names:
        if not (folder / name).is_dir():
            (folder / name).unlink(missing_ok=True)


def _clear_parts(folder: Path) -> None:
    """Remove what a killed writer left under temporary names: ours, and those that USD gives while it writes ours."""
    found = [file for name, pattern in RESULT_FOLDERS.items() for file in (folder / name).glob(f"{pattern}.*")]
    found += [file for name in RESULT_FILES for file in folder.glob(f"{name}.*")]
    for file in found:
        if TEMPORARY.search(file.name):
            file.unlink()


def _number(file: Path) -> int:
    """Of a frame, or of a chunk's first frame; -1 where the name has none."""
    text = file.stem.removeprefix("points_")
    return int(text) if text.isdecimal() else -1


def _probe(folder: Path) -> None:
    """Prove by doing that files can be created, renamed and removed here, and that no result's name is a folder."""
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
