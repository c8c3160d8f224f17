"""`checkpoint.npz` of a run's folder: its last good state, at the end and, where asked for, now and then before.

The one before it is kept as `checkpoint.previous.npz`, so that a run can go on where the last one cannot be read.
"""

import warnings
from collections.abc import Callable
from pathlib import Path

from taisoft.checkpoint import Checkpoint, read_checkpoint
from taisoft.errors import SimulationError
from taisoft.files import name_also, write_error

CHECKPOINT_NAME, PREVIOUS_NAME = "checkpoint.npz", "checkpoint.previous.npz"


class CheckpointWriter:
    """Observer that writes folder/checkpoint.npz. every: simulated time between two, at frames [s]; None for none of them.

    resumed: the checkpoint from which the run goes on; the folder's own then stays as the previous one, that of another run not.
    before: called before each of those, to bring to disk what else tells of the run up to then. notes: what the file is to hold
    beside the state.
    """

    def __init__(self, folder: str | Path, every: float | None = None, resumed: str | Path | None = None):
        self.path, self.every = Path(folder) / CHECKPOINT_NAME, every
        self.before: Callable[[], None] = lambda: None
        self.notes: Callable[[], dict] = dict
        self._last: float | None = None  # simulated time of the last one, or of the start
        resumed = None if resumed is None else Path(resumed).resolve()
        self._own = resumed == self.path.resolve()  # whether the file that is there is this run's
        self._spare = resumed == self.path.with_name(PREVIOUS_NAME).resolve()  # whether the previous one is all there is

    def frame(self, sim, _index: int) -> None:
        """Write if it is time. Raises OutputError."""
        if self._last is None:
            self._last = sim.time
        elif self.every is not None and sim.time - self._last >= self.every * (1.0 - 1e-9):
            self.before()
            self.write(sim)

    def write(self, sim) -> None:
        """Write sim's present state. Raises OutputError; the checkpoint that was there is still there then."""
        self._keep_previous()
        sim.save_checkpoint(self.path, self.notes())
        self._last, self._own = sim.time, True

    def _keep_previous(self) -> None:
        """Give the present file its second name."""
        previous = self.path.with_name(PREVIOUS_NAME)
        try:
            if self._own:
                name_also(self.path, previous)
            elif not self._spare:
                previous.unlink(missing_ok=True)
        except OSError as error:
            raise write_error(previous, error) from error

    def close(self) -> None:
        """Nothing to end."""


def read_last_good(path: str | Path) -> Checkpoint:
    """The checkpoint in a file or, where that cannot be read, the previous one beside it, and then a warning names both.

    Raises SimulationError where neither can be read, for the reason of the file that was named.
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
        warnings.warn(
            f"{error}; going on from the previous checkpoint instead, {previous}", UserWarning, stacklevel=2
        )
        return found
