"""How long the next part of an implicit step is: the one place that decides about halving.

The stepper asks nothing more once the Newton iterations of a step are used up, and where surfaces cross, contacts may allow less
(`PartCheck.most_units`).
"""

import math
from dataclasses import dataclass

import numpy as np

PARTS = 256  # the shortest part of a step is dt / PARTS: the unit of lengths


@dataclass
class PartLength:
    """The longest part of a step that is tried: half of one that was rejected, doubled after `patience` parts that were kept.

    It persists from step to step, until a whole step is kept or shorter parts have not helped.
    """

    MAX_PATIENCE = 4
    LEAST_UNCONVERGED = PARTS // 64  # units: parts up to this long are kept although Newton's method failed; then halving ends

    longest: float = math.inf  # [s]
    patience: int = 1
    n_kept: int = 0  # parts kept since the limit was last changed
    helps: bool = True  # whether shorter parts help Newton's method: after they did not, False until a part converges

    def units(self, dt: float) -> int:
        """The length of the next part of a step of dt [s]. The limit may stem from smaller steps."""
        return PARTS if self.longest >= dt else max(1, int(PARTS * self.longest / dt + 1e-6))

    def should_halve(self, free: bool, converged: bool, units: int) -> bool:
        """Whether a part is rejected for half of its length: if its way is not free, or Newton's method failed and shorter parts
        may help."""
        may_converge = self.helps and units > self.LEAST_UNCONVERGED
        return units > 1 and (not free or (not converged and may_converge))

    def halve(self, units: int, dt: float) -> None:
        """Count a part of a step of dt that was rejected."""
        self.longest, self.n_kept, self.patience = 0.5 * units / PARTS * dt, 0, min(2 * self.patience, self.MAX_PATIENCE)

    def keep(self, units: int, converged: bool) -> None:
        """Count a part that was kept."""
        gives_up = self.helps and not converged and units <= self.LEAST_UNCONVERGED
        if converged:
            self.helps = True
        self.n_kept += 1
        if gives_up:
            self.give_up()
        elif units == PARTS:
            self.longest, self.patience, self.n_kept = math.inf, max(1, self.patience // 2), 0
        elif self.n_kept >= self.patience:
            self.longest, self.n_kept = 2.0 * self.longest, 0

    def give_up(self) -> None:
        """Shorter parts do not help Newton's method: longer ones may as well be tried at once."""
        self.helps, self.longest, self.n_kept = False, math.inf, 0

    def snapshot(self) -> np.ndarray:
        """Return its state, (4,)."""
        return np.array([self.longest, self.patience, self.n_kept, self.helps])

    def restore(self, kept: np.ndarray) -> None:
        """Restore a `snapshot`."""
        self.longest, self.patience, self.n_kept, self.helps = float(kept[0]), int(kept[1]), int(kept[2]), bool(kept[3])
