"""What steps told over time, in a memory that does not grow: lows and highs of every quantity over runs of steps.

Runs hold one step each until CAPACITY of them are full; then neighbours are joined two by two, and from there on a run holds
twice as many steps. So no peak is lost, however long a simulation goes on, and early and late steps are told as finely.
"""

import numpy as np

from taisoft.records import StepReport

CAPACITY = 256  # runs, an even number
QUANTITIES = (
    "kinetic", "elastic", "gravity", "total",  # [J], change since the start
    "newton_residual", "contact_residual", "newton_iterations", "linear_iterations", "contact_iterations",
    "n_contacts", "step_time",  # wall time [ms]
)  # fmt: skip


class History:
    """times (n,) [s], the ends of the runs; low, high: (n, k) lows and highs over each, columns as QUANTITIES, NaN where unknown;
    last: (k,) of the last step; begin: time of the start [s]."""

    def __init__(self, capacity: int = CAPACITY):
        self._times = np.empty(capacity)
        self._low, self._high = np.empty((capacity, len(QUANTITIES))), np.empty((capacity, len(QUANTITIES)))
        self._empty()

    def _empty(self) -> None:
        self._n = self._in_last = 0
        self._per_run = 1  # steps
        self._energies, self.begin = np.zeros(3), 0.0
        self.last = np.full(len(QUANTITIES), np.nan)

    @property
    def times(self) -> np.ndarray:
        """(n,) [s]."""
        return self._times[: self._n]

    @property
    def low(self) -> np.ndarray:
        """(n, k)."""
        return self._low[: self._n]

    @property
    def high(self) -> np.ndarray:
        """(n, k)."""
        return self._high[: self._n]

    def start(self, sim) -> None:
        """Forget everything; from sim's present energies theirs are counted."""
        self._empty()
        now = sim.energies()
        self._energies[:], self.begin = (now.kinetic, now.elastic, now.gravity), sim.time
        self._append(sim.time, np.where(np.arange(len(QUANTITIES)) < 4, 0.0, np.nan))

    def take(self, report: StepReport, seconds: float, explicit: bool, touching: bool) -> None:
        """A step, or a batch of explicit ones.

        seconds: wall time of all of it [s]; touching: whether contact forces are modelled. What is not modelled is not known.
        """
        energies = np.array([report.kinetic, report.elastic, report.gravity]) - self._energies
        solved, met = (np.nan if explicit else 1.0), (1.0 if touching else np.nan)
        row = np.array([
            *energies, energies.sum(), report.residual * solved, report.contact_residual * met,
            report.newton_iterations * solved, report.linear_iterations * solved,
            report.contact_iterations * met / report.steps, report.n_contacts * met, 1e3 * seconds / report.steps,
        ])  # fmt: skip
        self._append(report.time, np.where(np.isfinite(row), row, np.nan))

    def _append(self, time: float, row: np.ndarray) -> None:
        self.last = row
        if self._n and self._in_last < self._per_run:
            k = self._n - 1
            self._low[k], self._high[k] = np.fmin(self._low[k], row), np.fmax(self._high[k], row)
            self._in_last += 1
        else:
            if self._n == len(self._times):
                self._join()
            k = self._n
            self._low[k] = self._high[k] = row
            self._n, self._in_last = k + 1, 1
        self._times[k] = time

    def _join(self) -> None:
        """Neighbours become one, of which each is full."""
        half = self._n // 2
        self._times[:half] = self._times[1 : self._n : 2]
        self._low[:half] = np.fmin(self._low[0 : self._n : 2], self._low[1 : self._n : 2])
        self._high[:half] = np.fmax(self._high[0 : self._n : 2], self._high[1 : self._n : 2])
        self._n, self._per_run = half, 2 * self._per_run
