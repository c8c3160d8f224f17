"""Write `checkpoint.npz` in a run's folder: its last good state, at the end and, if requested, at intervals before.

The previous one is kept as `checkpoint.previous.npz`, so that a run can resume if the last one cannot be read.
"""

import warnings
from collections.abc import Callable
from pathlib import Path

from taisoft.checkpoint import Checkpoint, read_checkpoint
from taisoft.errors import SimulationError
from taisoft.files import link_file, write_error

CHECKPOINT_NAME, PREVIOUS_NAME = "checkpoint.npz", "checkpoint.previous.npz"


class CheckpointWriter:
    """Observer that writes folder/checkpoint.npz.

    every: simulated time between checkpoints, which are written at frames [s]; None: only at the end. resumed: the checkpoint
    from which the run resumes; if it is the folder's own it is kept as the previous one, that of another run is not. before:
    called before each checkpoint at an interval, to flush the run's other files. notes: returns data to store with the state.
    """

    def __init__(self, folder: str | Path, every: float | None = None, resumed: str | Path | None = None):
        self.path, self.every = Path(folder) / CHECKPOINT_NAME, every
        self.before: Callable[[], None] = lambda: None
        self.notes: Callable[[], dict] = dict
        self._last: float | None = None  # simulated time of the last checkpoint, or of the start
        resumed = None if resumed is None else Path(resumed).resolve()
        self._own = resumed == self.path.resolve()  # whether the existing file is of this run
        self._from_previous = resumed == self.path.with_name(PREVIOUS_NAME).resolve()  # then it is the only good one

    def frame(self, sim, _index: int) -> None:
        """Write a checkpoint if one is due. Raises OutputError."""
        if self._last is None:
            self._last = sim.time
        elif self.every is not None and sim.time - self._last >= self.every * (1.0 - 1e-9):
            self.before()
            self.write(sim)

    def write(self, sim) -> None:
        """Write sim's present state. Raises OutputError; the existing checkpoint then remains."""
        self._keep_previous()
        sim.save_checkpoint(self.path, self.notes())
        self._last, self._own = sim.time, True

    def _keep_previous(self) -> None:
        """Keep the existing checkpoint under the previous one's name, or remove the previous one of another run."""
        previous = self.path.with_name(PREVIOUS_NAME)
        try:
            if self._own:
                link_file(self.path, previous)
            elif not self._from_previous:
                previous.unlink(missing_ok=True)
        except OSError as error:
            raise write_error(previous, error) from error

    def close(self) -> None:
        """Do nothing; part of the observer interface."""


def read_last_good(path: str | Path) -> Checkpoint:
    """Return the checkpoint in a file or, if that cannot be read, the previous one beside it, with a warning that names both.

    Raises SimulationError if neither can be read, with the reasons of both.
    """
    path = Path(path)
    previous = path.with_name(PREVIOUS_NAME)
    try:
        return read_checkpoint(path)
    except SimulationError as error:
        if path.name != CHECKPOINT_NAME or not previous.is_file():
            raise
        try:
            found = read_checkpoint(previous)
        except SimulationError as other:
            raise SimulationError(f"{error}; nor can the previous one be used: {other}") from None
        warnings.warn(f"{error}; resuming from the previous checkpoint instead, {previous}", UserWarning, stacklevel=2)
        return found
