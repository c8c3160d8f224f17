"""A version of taisoft, by its folder, run in processes of its own."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import taisoft
from taisoft.errors import SimulationError
from taisoft.output.files import make_folder

HERE = Path(taisoft.__file__).resolve().parents[1]


def version_in(folder: Path) -> "Version":
    """The version in a folder; another one than this keeps a cache of kernels there."""
    folder = folder.resolve()
    return Version(folder, None if folder == HERE else make_folder(folder / ".cache"))


@dataclass(frozen=True)
class Version:
    """cache: where its compiled kernels are kept; None: where they always are."""

    folder: Path
    cache: Path | None = None

    def run(self, program: Path, *task: str | int | Path) -> list[str]:
        """The lines that a program prints for a task. Raises SimulationError where it fails."""
        paths = {"PYTHONPATH": str(self.folder)} | ({} if self.cache is None else {"XDG_CACHE_HOME": str(self.cache)})
        done = subprocess.run(
            [sys.executable, str(program), *map(str, task)],
            env=os.environ | paths,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
            raise SimulationError(f"{self.folder}: task {' '.join(map(str, task))} ended with status {done.returncode}: {last}")
        return done.stdout.splitlines()

    def files(self) -> set[Path]:
        """What lies in the cache."""
        return {path for path in self.cache.rglob("*.tic*") if path.is_file()}
