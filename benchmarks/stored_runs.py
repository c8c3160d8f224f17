"""Results of deterministic runs of `taisoft bench tolerance`, kept in the user's cache from one run of it to the next.

They are named by a digest of what they depend on: machine, scenes and code, without that which chooses steps.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError
from taisoft.files import cache_folders, replacing
from taisoft.machine import machine
from taisoft.many.store import NOT_COMPUTING, code_digest, digest

from .runner import files_digest

HERE = Path(__file__).parent
SOURCES = (HERE / "error_cases.py", HERE / "reference_cases" / "record.py")
NOT_RUNNING = (*NOT_COMPUTING, "estimation")  # folders of taisoft on which runs with given steps do not depend


class StoredRuns:
    """Arrays in a folder, by default of the user's cache, or computed anew if it cannot be used."""

    def __init__(self, folder: Path | None = None):
        self._on = [machine() | {"load": None}, code_digest(NOT_RUNNING), files_digest(SOURCES)]
        self._folder = folder or next(cache_folders(), Path(os.devnull)) / "tolerance"  # os.devnull cannot contain files

    def get(self, request: list, compute: Callable[[], np.ndarray]) -> np.ndarray:
        """The array of a request, plain data, or what `compute` returns, which is then stored."""
        path = self._folder / f"{digest([request, self._on])[:32]}.npy"
        with suppress(OSError, ValueError), open(path, "rb") as file:  # absent, or damaged
            return np.load(file, allow_pickle=False)
        found = compute()
        with suppress(OSError, OutputError):  # the folder is not writable
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as part, open(part, "wb") as file:
                np.save(file, found, allow_pickle=False)
        return found
