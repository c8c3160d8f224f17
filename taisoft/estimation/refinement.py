"""Trials from coarse to fine, and the error of the finest: from its distance to the one before, by the observed order.

Each has twice as many steps as the one before, or four times as many where twice seems too few. Two explicit trials show an
error by the nominal order; implicit ones may be too coarse for that, so that it takes three. Fewer must seem ten times better
than needed.

Of the first explicit trial, which has the largest stable steps, velocities show an error. It may be the run alone: of sudden
motion, too, if it seems ten times better than needed. Velocities of damped motion are themselves wrong, by an error of first
order. Its fastest part, repeated with a slightly smaller step, shows it.

After impacts of bodies without damping explicit steps show orders from 1.2 to 2. At most 1.25 counts, as an error from trials
with h and 2 h is then too small by 1.4 at first order, and too large by 2.2 at second. Orders above 2, which the integrator
does not have, are chance and count as 1. Any other sudden motion counts as of first order at most.

Velocity Verlet solves x'' = a + dt^2/12 x'''' up to dt^4 (Hairer, Lubich, Wanner, "Geometric Numerical Integration", 2006,
IX.9). A motion of frequency w thus lags by the phase (w dt)^2/24 w t, which is dt^2/24 times the total variation of its
acceleration. An impact may be late by dt.

Weak: one trial does not show small errors that grow exponentially.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from taisoft.estimation.first_choice import EXPLICIT, IMPLICIT
from taisoft.estimation.order import MIN_ORDER, difference_ratio, error_over_difference, observed_order
from taisoft.estimation.trials import Frames, Trial, distances

SAFETY = 0.8  # part of the tolerance that an error may take
UNSURE = 10.0  # a tolerance over the largest error that fewer trials, or one explicit one of sudden motion, may seem to have
REACH = {EXPLICIT: 3, IMPLICIT: 8}  # steps of a run over those of the last trial, at most
LEAST_REACH = 1.5  # the same, at least, where the run is not the last trial: a smaller ratio would amplify chance
FEWEST = {EXPLICIT: 2, IMPLICIT: 3}  # trials that show an error: fewer coarse implicit steps may agree and be wrong
LARGEST_STEP = 4  # frames in a step of the first implicit trial
LEAST_STEPS = 8  # of an implicit trial
MAX_TRIALS = 8
MAX_DEGRADED = 2  # trials that meet the tolerance but are degraded, and are left for a finer one
MAX_STALLED = 2  # trials in succession whose differences have not become smaller: the paths diverge
COARSE = 2  # implicit trials with fewer steps a frame do not count as stalled
SMALLER = Fraction(5, 4)  # steps of a slightly smaller size over those of the first explicit trial
MOST = 4  # steps of an explicit trial over those of the one before, at most
DISPERSION, IMPACT = 3.0, 1.25  # factors on the errors that velocities show
SMOOTH_ORDER = 2.0  # of the integrators; that of sudden motion is this, or higher, only by chance
IMPACT_ORDER = 1.25  # highest order that counts of explicit steps after impacts


@dataclass
class Refinement:
    """Trials of one integrator.

    sudden: whether velocities or forces may jump; nominal: order of the integrator in the scene; impacts: whether contacts alone
    lower it; trials: from coarse to fine; error: of the last one, over the excursion, None if unknown; order: observed, or None;
    tried: trials, with failed ones; differences: root mean squares of the distances between the last successive trials [m].
    """

    integrator: str
    sudden: bool
    nominal: int
    frames: Frames
    impacts: bool = False
    trials: list[Trial] = field(default_factory=list)
    error: float | None = None
    order: float | None = None
    stalled: int = 0  # see MAX_STALLED
    degraded: int = 0  # see MAX_DEGRADED
    tried: int = 0
    differences: list[float] = field(default_factory=list)

    def add(self, trial: Trial) -> None:
        """Add a trial, finer than all others, and estimate its error. Those that fail are left out."""
        self.tried += 1
        if trial.report.status == "failed":
            return
        for one in self.trials:
            one.end, one.fastest = {}, None  # it will not be the run
        self.trials.append(trial)
        if len(self.trials) < 2:
            explicit = self.integrator == EXPLICIT
            self.error = self._over_excursion(trial, self._shown_by_velocities(trial)) if explicit else None
            return
        before = self.trials[-2]
        pairs = itertools.pairwise(self.trials[-4:])
        self.differences = [float(np.sqrt(np.mean(distances(fine, coarse) ** 2))) for coarse, fine in pairs]
        self.order = self._observed_order()
        ratio = float(trial.per_frame / before.per_frame)
        distance = float(distances(trial, before).max()) * self.error_over_difference(ratio)
        self.error = self._over_excursion(trial, distance)

    @property
    def is_damped(self) -> bool:
        """Whether motion is smooth, but of first order, as with damping: its velocities themselves are wrong."""
        return self.nominal == 1 and not self.sudden

    def confirm(self, part: Trial) -> None:
        """Expect the error of the only trial, explicit and of damped motion, also from its fastest part with a smaller step.

        Errors of damping are of first order, and add up as velocities do.
        """
        trial = self.trials[0]
        if part.report.status == "failed":
            self.error = None
            return
        difference = float(distances(trial, part).max()) * error_over_difference(float(part.per_frame / trial.per_frame), 1.0)
        self.error = max(self.error, self._over_excursion(trial, difference * trial.times))

    def _shown_by_velocities(self, trial: Trial) -> float:
        """Error of an explicit trial [m], see above."""
        frame = self.frames.seconds
        dt = frame / float(trial.per_frame)
        error = dt * dt / 24.0 * (float(np.max(trial.variations)) + 2.0 * trial.jump) / frame
        return max(error, IMPACT * dt * trial.jump) if self.sudden else DISPERSION * error

    @property
    def assumed_order(self) -> float:
        """The observed order; where it was not observed the smallest, and where two trials could not show it the nominal one.

        Implicit trials may be too coarse for that: their order is then 1.
        """
        return self.order or (MIN_ORDER if len(self.differences) > 1 else self.nominal if self.integrator == EXPLICIT else 1.0)

    def error_over_difference(self, ratio: float) -> float:
        """Error of a run over its distance to one with steps larger by a ratio."""
        return error_over_difference(ratio, self.assumed_order)

    def excursion(self, trial: Trial) -> float:
        """A trial's largest excursion [m], 0 if it is rounding."""
        found = trial.excursion
        return found if found > self.frames.negligible else 0.0

    def _over_excursion(self, trial: Trial, distance: float) -> float:
        """An error of a trial [m], over the excursion."""
        excursion = self.excursion(trial)
        return distance / excursion if excursion else 0.0

    def _observed_order(self) -> float | None:
        """Order of the last three trials; None if they show none."""
        if len(self.differences) < 2:
            return None
        near, far = self.differences[-1], self.differences[-2]
        first, second, third = (float(trial.per_frame) for trial in self.trials[-3:])
        ratios = third / second, second / first
        least = max(self.differences[-3:-1]) / difference_ratio(MIN_ORDER, *ratios)
        stalled = near > self.frames.negligible and near >= least
        counts = self.integrator == EXPLICIT or self.trials[-1].per_frame >= COARSE
        self.stalled = self.stalled + 1 if stalled and counts else 0
        order = observed_order(near, far, SMOOTH_ORDER, *ratios)
        if order is None or not self.sudden:
            return order
        shows = self.impacts and self.integrator == EXPLICIT and order < SMOOTH_ORDER
        return min(order, IMPACT_ORDER if shows else 1.0)

    @property
    def diverges(self) -> bool:
        """Whether the paths of different steps diverge."""
        return self.stalled >= MAX_STALLED

    @property
    def is_over(self) -> bool:
        """Whether no further trial makes sense."""
        return self.tried >= MAX_TRIALS or self.diverges

    def steps_over_last(self, tolerance: float) -> float:
        """Steps that a tolerance needs over those of the last trial, from its error, at the nominal order."""
        return 1.0 if self.error is None else (self.error / (SAFETY * tolerance)) ** (1.0 / self.nominal)

    def meets(self, tolerance: float) -> bool:
        """Whether the last trial is likely to meet a tolerance."""
        return self.error is not None and self.error <= tolerance * self._allowed

    @property
    def _allowed(self) -> float:
        """Part of a tolerance that the error may take.

        A measured error of sudden motion is assumed to fall as slowly as it may, unless trials show more.
        """
        if self.are_few and (self.sudden or self.integrator == IMPLICIT):
            return 1.0 / UNSURE
        return SAFETY if self.are_few or not self.sudden or (self.order or 1.0) > 1.0 else 1.0

    def next_steps(self, tolerance: float, finest: Fraction) -> Fraction:
        """Steps in the time of a frame of the next explicit trial. finest: the most that were tried.

        Trials that show an order, or fail, are followed by one with twice as many.
        """
        few = len(self.trials) == self.tried < 3
        return finest * (MOST if few and self.steps_over_last(tolerance) > REACH[EXPLICIT] else 2)

    def steps_needed(self, tolerance: float) -> int | None:
        """Steps of the run in the time of a frame, if the trials show how many; None if they do not yet."""
        if self.error is None:
            return None
        last = self.trials[-1].per_frame
        if self.meets(tolerance):
            if self.trials[-1].report.status == "degraded" and self.degraded < MAX_DEGRADED:
                self.degraded += 1
                return None
            return math.ceil(last)
        if self.are_few:
            return None
        steps = self.likely_steps(tolerance)
        return math.ceil(steps) if steps <= REACH[self.integrator] * last else None

    @property
    def are_few(self) -> bool:
        """Whether there are too few trials to show an error."""
        return len(self.trials) < FEWEST[self.integrator]

    def likely_steps(self, tolerance: float) -> float:
        """Steps of a run in the time of a frame that the last trial does not meet the tolerance of, however many."""
        ratio = max(LEAST_REACH, (self.error / (SAFETY * tolerance)) ** (1.0 / self.assumed_order))
        return float(self.trials[-1].per_frame) * ratio


def implicit_sizes(count: int) -> Iterator[Fraction]:
    """Steps in the time of a frame of implicit trials of a run of `count` frames: fewer than one, then 1, 2, 4, ...

    Runs have at least a step a frame.
    """
    largest = LARGEST_STEP
    while largest > 1 and count < LEAST_STEPS * largest:
        largest //= 2
    steps = Fraction(1, largest)
    while steps * count < LEAST_STEPS:
        steps *= 2
    yield steps
    steps = max(Fraction(1), 2 * steps)
    while True:
        yield steps
        steps *= 2
