"""The output folder of a run, and what observes its frames. The folder has one writer; its files are complete or absent.

The folder's lock is an advisory kernel lock (flock) on a file that holds the writer's process id. The kernel releases it when
the writer dies.
"""

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.files import part_path

LOCK_NAME = "taisoft.lock"
CHECKPOINT_NAME, PVD_NAME, REPORT = "checkpoint.npz", "scene.pvd", "report.json"
DRAWN_NAME = "drawn"  # folder of the pictures of `taisoft draw`, in that of the run
RESULT_FILES = (REPORT, "steps.csv", "frames.csv", "scene.usdc", PVD_NAME, CHECKPOINT_NAME, "video.mp4", "drawn/video.mp4")
# Left by a killed writer: see `taisoft.files.part_path`; USD adds temporary files with a suffix of its own
TEMPORARY = re.compile(r"\.\d+-\d+\.part$|\.usdc\.\d+-\d+\.[A-Za-z0-9]{6}$")
# folder -> pattern of a run's files in it, one for each frame or chunk of frames
RESULT_FOLDERS = {"frames": "[0-9]*.png", "chunks": "points_*.usdc", "vtu": "[0-9]*.vtu", "states": "*.npz"}
RESULT_FOLDERS |= {"drawn/frames": RESULT_FOLDERS["frames"]}


@contextmanager
def output_errors(failure: str) -> Iterator[None]:
    """Turn an OSError in the block into an OutputError: the failure and the system's reason."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{failure}: {error.strerror or error}") from error


def make_folder(path: str | Path) -> Path:
    """Create a folder with its parents, or accept an existing one. Raises OutputError."""
    path = Path(path)
    with output_errors(f"cannot create the folder {path}"):
        try:
            path.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise OutputError(f"cannot use {path} as a folder: a file has that name") from None
    return path


def check_free(path: str | Path, overwrite: bool) -> None:
    """Raise OutputError if a folder holds results, unless they may be overwritten; change nothing."""
    found = _results(Path(path)) if Path(path).is_dir() and not overwrite else []
    if found:
        raise OutputError(
            f"the output folder {path} already holds results ({', '.join(found)}): name another, or overwrite it (--overwrite)"
        )


class OutputFolder:
    """A run's folder: created or reused, checked, and locked until `close`.

    path: created if absent; an empty folder, or one without a run's files, is accepted. overwrite: results in it are removed.
    first: number of the first frame of a resumed run; results are accepted, earlier frames stay, `clear` removes later ones
    and report.json, and other files are only replaced. Raises OutputError if the folder cannot be written, another process
    writes to it, or it holds results without overwrite.
    """

    def __init__(self, path: str | Path, overwrite: bool = False, first: int | None = None):
        self.path = make_folder(path).absolute()  # a later change of the working directory must not move the output
        self._lock = FolderLock(self.path)
        try:
            with output_errors(f"cannot write to the output folder {path}"):
                if first is None:
                    check_free(path, overwrite)
                _clear_parts(self.path)
                _probe(self.path)
                if first is None:
                    self.clear(0, RESULT_FILES)
        except BaseException:
            self.close()
            raise

    def clear(self, first: int, files: Iterable[str] = (REPORT,)) -> None:
        """Remove files, and an earlier run's frames and chunks from number `first` on. Raises OutputError."""
        with output_errors(f"cannot write to the output folder {self.path}"):
            for name in files:
                (self.path / name).unlink(missing_ok=True)
            _clear_frames(self.path, first)

    def close(self) -> None:
        """Release the lock. A second call does nothing."""
        self._lock.close()


class Observer:
    """What gets the frames of a run."""

    def frame(self, sim, index: int) -> None:
        """Take sim's present state as frame number index. Raises OutputError."""
        raise NotImplementedError

    def flush(self) -> None:
        """Write what waits to be written. Raises OutputError."""

    def close(self) -> None:
        """Write what waits, and end; a second call does nothing. Raises OutputError."""
        self.flush()


class FolderLock:
    """A folder's lock, held until `close`. Raises OutputError if another process holds it or it cannot be taken."""

    def __init__(self, folder: Path):
        import fcntl  # POSIX only

        self._path, self._descriptor = folder / LOCK_NAME, None
        while self._descriptor is None:
            with output_errors(f"cannot write to the output folder {folder}"):
                descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # the last holder may have removed this file between open and flock: then the lock is of no use
                if self._path.exists() and os.fstat(descriptor).st_ino == self._path.stat().st_ino:
                    os.ftruncate(descriptor, 0)
                    os.write(descriptor, f"{os.getpid()}\n".encode())
                    self._descriptor = descriptor
            except BlockingIOError:
                holder = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
                raise OutputError(f"process {holder} is writing to the output folder {folder} (lock {self._path})") from None
            except OSError as error:
                raise OutputError(f"cannot lock the output folder {folder}: {error.strerror or error}") from error
            finally:
                if self._descriptor is None:
                    os.close(descriptor)

    def close(self) -> None:
        """Release the lock. A second call does nothing."""
        if self._descriptor is not None:
            with suppress(OSError):  # the folder may be gone; closing the descriptor frees the lock anyway
                self._path.unlink()
            os.close(self._descriptor)
            self._descriptor = None


def _results(folder: Path) -> list[str]:
    """Return the names of an earlier run's files, and of its subfolders."""
    files = [name for name in RESULT_FILES if (folder / name).exists()]
    return files + [f"{name}/" for name, pattern in RESULT_FOLDERS.items() if any((folder / name).glob(pattern))]


def _clear_frames(folder: Path, first: int) -> None:
    """Remove an earlier run's frames from number `first` on, and chunks whose first frame is among them."""
    for name, pattern in RESULT_FOLDERS.items():
        for file in (folder / name).glob(pattern):
            number = file.stem.removeprefix("points_")
            if first == 0 or (number.isdecimal() and int(number) >= first):
                file.unlink()


def _clear_parts(folder: Path) -> None:
    """Remove the temporary files of a killed writer, those of USD included."""
    found = [file for name, pattern in RESULT_FOLDERS.items() for file in (folder / name).glob(f"{pattern}.*")]
    found += [file for name in RESULT_FILES for file in folder.glob(f"{name}.*")]
    for file in found:
        if TEMPORARY.search(file.name):
            file.unlink()


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
