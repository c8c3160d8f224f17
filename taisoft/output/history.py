"""History of step quantities in constant memory: minimum and maximum of every quantity over bins of consecutive steps.

A bin holds one step until CAPACITY bins are full. Then neighbours are merged in pairs, and from there on a bin holds twice as
many steps. So no peak is lost, however long a simulation runs, and early and late steps have the same resolution.
"""

import numpy as np

from taisoft.records import StepReport

CAPACITY = 256  # bins, an even number
QUANTITIES = (
    "kinetic",
    "elastic",
    "gravity",
    "total",  # [J], change since the start
    "newton_residual",
    "contact_residual",
    "newton_iterations",
    "linear_iterations",
    "contact_iterations",
    "n_contacts",
    "step_time",  # wall time [ms]
)


class History:
    """Minima and maxima of QUANTITIES over bins of steps.

    times: (n,) ends of the bins [s]; low, high: (n, k) minima and maxima over each, columns as QUANTITIES, NaN if unknown;
    last: (k,) values of the last step; begin: time of the start [s].
    """

    def __init__(self, capacity: int = CAPACITY):
        self._times = np.empty(capacity)
        self._low, self._high = np.empty((capacity, len(QUANTITIES))), np.empty((capacity, len(QUANTITIES)))
        self._clear()

    def _clear(self) -> None:
        self._n = self._steps_in_last = 0
        self._steps_per_bin = 1
        self._start_energies, self.begin = np.zeros(3), 0.0
        self.last = np.full(len(QUANTITIES), np.nan)

    @property
    def times(self) -> np.ndarray:
        """Ends of the bins (n,) [s]."""
        return self._times[: self._n]

    @property
    def low(self) -> np.ndarray:
        """Minima over each bin (n, k)."""
        return self._low[: self._n]

    @property
    def high(self) -> np.ndarray:
        """Maxima over each bin (n, k)."""
        return self._high[: self._n]

    def start(self, sim) -> None:
        """Clear the history; energies are recorded relative to sim's present ones."""
        self._clear()
        energies = sim.energies()
        self._start_energies[:], self.begin = (energies.kinetic, energies.elastic, energies.gravity), sim.time
        self._append(sim.time, np.where(np.arange(len(QUANTITIES)) < 4, 0.0, np.nan))

    def take(self, report: StepReport, seconds: float, explicit: bool, touching: bool) -> None:
        """Record a step, or a batch of explicit steps.

        seconds: its total wall time [s]; touching: whether contact forces are simulated. Quantities not simulated are NaN.
        """
        energies = np.array([report.kinetic, report.elastic, report.gravity]) - self._start_energies
        solved, touched = (np.nan if explicit else 1.0), (1.0 if touching else np.nan)
        row = np.array(
            [
                *energies,
                energies.sum(),
                report.residual * solved,
                report.contact_residual * touched,
                report.newton_iterations * solved,
                report.linear_iterations * solved,
                report.contact_iterations * touched / report.steps,
                report.n_contacts * touched,
                1e3 * seconds / report.steps,
            ]
        )
        self._append(report.time, np.where(np.isfinite(row), row, np.nan))

    def _append(self, time: float, row: np.ndarray) -> None:
        self.last = row
        if self._n and self._steps_in_last < self._steps_per_bin:
            k = self._n - 1
            self._low[k], self._high[k] = np.fmin(self._low[k], row), np.fmax(self._high[k], row)
            self._steps_in_last += 1
        else:
            if self._n == len(self._times):
                self._merge_pairs()
            k = self._n
            self._low[k] = self._high[k] = row
            self._n, self._steps_in_last = k + 1, 1
        self._times[k] = time

    def _merge_pairs(self) -> None:
        """Merge neighbouring bins in pairs; all bins are full."""
        half = self._n // 2
        self._times[:half] = self._times[1 : self._n : 2]
        self._low[:half] = np.fmin(self._low[0 : self._n : 2], self._low[1 : self._n : 2])
        self._high[:half] = np.fmax(self._high[0 : self._n : 2], self._high[1 : self._n : 2])
        self._n, self._steps_per_bin = half, 2 * self._steps_per_bin
