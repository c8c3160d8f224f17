"""`checkpoint.npz` of a run's folder: its last good state, at the end and, where asked for, now and then before."""

from collections.abc import Callable
from pathlib import Path

CHECKPOINT_NAME = "checkpoint.npz"


class CheckpointWriter:
    """Observer that writes folder/checkpoint.npz. every: simulated time between two, at frames [s]; None for none of them.

    before: called before each of those, to bring to disk what else tells of the run up to then. notes: what the file is to hold
    beside the state.
    """

    def __init__(self, folder: str | Path, every: float | None = None):
        self.path, self.every = Path(folder) / CHECKPOINT_NAME, every
        self.before: Callable[[], None] = lambda: None
        self.notes: Callable[[], dict] = dict
        self._last: float | None = None  # simulated time of the last one, or of the start

    def frame(self, sim, _index: int) -> None:
        """Write if it is time. Raises OutputError."""
        if self._last is None:
            self._last = sim.time
        elif self.every is not None and sim.time - self._last >= self.every * (1.0 - 1e-9):
            self.before()
            self.write(sim)

    def write(self, sim) -> None:
        """Write sim's present state. Raises OutputError."""
        sim.save_checkpoint(self.path, self.notes())
        self._last = sim.time

    def close(self) -> None:
        """Nothing to end."""
