"""Trials from coarse to fine, and the error of the finest: from its distance to the one before, by the observed order.

The first explicit trial, which has the largest stable steps, is alone. What its velocities show, and its distance to a slightly
smaller step in its hardest part, give the expected error. Impacts and releases make it unsure: unless it is far below the
tolerance, a second trial takes slightly smaller steps all the way. It may still be wrong by a factor of ten.

Where errors fall with dt at least, and twice as many steps seem too few, the second trial takes four times as many, and may be
the run. Its distance to the first is almost the whole error of that one, and less by chance than one to a trial with half as many
steps. It errs by a third of it; at an order of only 1/2 by three times as much, where half as many steps err by 2.4 times
as much as shown. If it is not the run, the trial between them may show the order, or else a finer one does.

After impacts of bodies without damping explicit steps show orders from 1.2 to 2. At most 1.25 counts, as an error from trials
with h and 2 h is then too small by 1.4 at first order, and too large by 2.2 at second. Orders above 2, which the integrator does
not have, are chance and count as 1. Any other sudden motion counts as of first order at most.

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
from taisoft.estimation.trials import FASTEST, HARDEST, Frames, Trial, distances

SAFETY = 0.8  # part of the tolerance that an error may take, unless it is likely to be less
REACH = {EXPLICIT: 2, IMPLICIT: 8}  # steps of a run over those of the last trial, at most
LEAST_REACH = 1.5  # the same, at least, where the run is not the last trial: a smaller ratio would amplify chance
FEWEST = {EXPLICIT: 2, IMPLICIT: 3}  # trials that show an error: fewer coarse implicit steps may agree and be wrong
SMALLER = Fraction(5, 4)  # steps of a slightly smaller size over those of the first explicit trial
CHANCE = 0.5  # part of an expected error of sudden motion that may be chance
SKIPPED = 4  # steps of the second explicit trial over those of the first where it skips one of twice as many
MOST = 4.0  # steps of the second explicit trial over those of the first, at most
LARGEST_STEP = 4  # frames in a step of the first implicit trial
LEAST_STEPS = 8  # of an implicit trial
MAX_TRIALS = 8
MAX_DEGRADED = 2  # trials that meet the tolerance but are degraded, and are left for a finer one
MAX_STALLED = 2  # trials in succession whose differences have not become smaller: the paths diverge
COARSE = 2  # implicit trials with fewer steps a frame do not count as stalled
DISPERSION, IMPACT = 3.0, 1.25  # factors on the errors that velocities show
SMOOTH_ORDER = 2.0  # of the integrators; that of sudden motion is this, or higher, only by chance
IMPACT_ORDER, LIKELY_ORDER = 1.25, 1.5  # of explicit steps after impacts: highest that counts, and the one to plan with
UNSURE = 8.0  # a tolerance over the largest error that fewer trials, or one explicit one of sudden motion, may seem to have


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
    unsure: float = 1.0  # factor by which `error` must be below a tolerance
    stalled: int = 0  # see MAX_STALLED
    degraded: int = 0  # see MAX_DEGRADED
    tried: int = 0
    differences: list[float] = field(default_factory=list)

    def add(self, trial: Trial) -> None:
        """Add a trial, and estimate the error of the one with the smallest steps. Those that fail are left out."""
        self.tried += 1
        if trial.report.status == "failed":
            return
        self.trials = sorted([*self.trials, trial], key=lambda one: one.per_frame)
        for one in self.trials[:-1]:
            one.end, one.parts = {}, {}  # it will not be the run
        if len(self.trials) < 2:
            return
        before, last = self.trials[-2:]
        pairs = itertools.pairwise(self.trials[-4:])
        self.differences = [float(np.sqrt(np.mean(distances(fine, coarse) ** 2))) for coarse, fine in pairs]
        self.order = self._observed_order()
        self.unsure = UNSURE / SAFETY if self.are_few else self._measured
        ratio = float(last.per_frame / before.per_frame)
        self._set_error(last, float(distances(last, before).max()) * self.error_over_difference(ratio))

    @property
    def _measured(self) -> float:
        """`unsure` of a measured error: of sudden motion it is assumed to fall as slowly as it may, unless trials show more."""
        return 1.0 if self.sudden and (self.order or 1.0) <= 1.0 else 1.0 / SAFETY

    def expect(self) -> None:
        """Expect the error of the only trial, explicit, from its velocities alone."""
        trial, self.unsure = self.trials[0], (UNSURE if self.sudden else 1.0) / SAFETY
        self._set_error(trial, self._expected_error(trial))

    @property
    def is_of_first_order(self) -> bool:
        """Whether motion is smooth, but of first order, as with damping: its velocities themselves are wrong."""
        return self.nominal == 1 and not self.sudden

    def confirm(self, hardest: Trial, fastest: Trial | None = None) -> None:
        """Expect the error of the only trial also from its hardest part, run with a slightly smaller step.

        Of smooth motion errors add up as changes of its velocities do, and of damped motion with time. fastest: the fastest part
        of damped motion, run with that step too. It shows the errors of damping, of first order, which add up as velocities do;
        those of changes are then of second order, as without damping.
        """
        trial = self.trials[0]
        if any(part is not None and part.report.status == "failed" for part in (hardest, fastest)):
            self.error = None
        elif self.error:
            if fastest is not None:
                of_changes = self._shown(trial, hardest, 2) * trial.parts[HARDEST].times
                shown = max(of_changes, self._shown(trial, fastest, 1) * trial.parts[FASTEST].times)
            else:
                times = 1.0 if self.sudden else trial.parts[HARDEST].times
                times = self.frames.count / self.frames.part if self.is_of_first_order else times
                shown = self._shown(trial, hardest, self.nominal) * times
            self._set_error(trial, max(self._expected_error(trial), shown))

    def replace_first(self, trial: Trial) -> None:
        """Replace the first trial, explicit, by one with a slightly smaller step, and expect its error."""
        self.tried += 1
        if trial.report.status == "failed":
            return
        before, self.trials, self.unsure = self.trials, [trial], self._measured
        if before or not self.excursion(trial):
            shown = self._shown(trial, before[0], self.nominal) if before else 0.0
            self._set_error(trial, max(self._expected_error(trial), shown))

    @staticmethod
    def _shown(trial: Trial, other: Trial, order: int) -> float:
        """Error of a trial as its distance to another one shows it [m]."""
        less, more = sorted((trial.per_frame, other.per_frame))
        return float(distances(trial, other).max()) * error_over_difference(float(more / less), order)

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

    def _set_error(self, trial: Trial, distance: float) -> None:
        """Set the error of a trial [m], over the excursion."""
        excursion = self.excursion(trial)
        self.error = distance / excursion if excursion else 0.0

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

    def _expected_error(self, trial: Trial) -> float:
        """Error of an explicit trial [m], from its velocities; see above."""
        frame = self.frames.seconds
        dt = frame / float(trial.per_frame)
        error = dt * dt / 24.0 * (float(np.max(trial.variations)) + 2.0 * trial.jump) / frame
        return max(error, IMPACT * dt * trial.jump) if self.sudden else DISPERSION * error

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

    def second_steps(self, least: int, ratio: float) -> tuple[Fraction, bool]:
        """Steps in the time of a frame of the second explicit trial, and whether it is nearly equal to the first and replaces it.

        least: steps of the first; ratio: `steps_over_last` of it, from its velocities alone. Of sudden motion part of the error
        may be chance, which the comparison of nearly equal steps amplifies.
        """
        more = slightly_more(least)
        largest = float(more / least - 1) / CHANCE if self.sudden else float(SMALLER)
        if ratio <= largest or not self.trials:
            return more, True
        if self.nominal == 1:
            return Fraction(SKIPPED * least if ratio > 2.0 else 2 * least), False
        return Fraction(math.ceil(least * min(MOST, max(LEAST_REACH, ratio)))), False

    def next_steps(self, tolerance: float, finest: Fraction) -> Fraction:
        """Steps in the time of a frame of the next explicit trial after the second. finest: the most that were tried.

        If the second skipped a size, that one is made up for where it may show, by the likely order, that REACH is enough.
        """
        if len(self.trials) < 2 or self.trials[-1].per_frame < finest or self.nominal > 1:
            return 2 * finest
        ratio = float(finest / self.trials[-2].per_frame)
        order = LIKELY_ORDER if self.impacts else 1.0
        error = self.error / self.error_over_difference(ratio) * error_over_difference(ratio, order)
        more = (error / (SAFETY * tolerance)) ** (1.0 / order)
        if ratio == SKIPPED and self.tried == 2 and more <= REACH[EXPLICIT]:
            return finest / 2
        return Fraction(math.ceil(finest * min(MOST, more))) if self.impacts and more > 2.0 else 2 * finest

    def meets(self, tolerance: float) -> bool:
        """Whether the last trial is likely to meet a tolerance."""
        return self.error is not None and self.error * self.unsure <= tolerance

    def steps_needed(self, tolerance: float) -> int | None:
        """Steps of the run in the time of a frame, if the trials show how many; None if they do not yet."""
        if not self.trials or self.error is None:
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


def slightly_more(least: int) -> Fraction:
    """Steps of a slightly smaller size, in the time of a frame."""
    return Fraction(math.ceil(SMALLER * least))


def implicit_sizes(count: int) -> Iterator[Fraction]:
    """Steps in the time of a frame of implicit trials of a run of `count` frames, in the order in which they are run.

    Runs have at least a step a frame. The second trial has one, since it may already be far better than it must be. Otherwise the
    one between it and the first is made up for, to show the order.
    """
    largest = LARGEST_STEP
    while largest > 1 and count < LEAST_STEPS * largest:
        largest //= 2
    first = Fraction(1, largest)
    while first * count < LEAST_STEPS:
        first *= 2
    yield first
    finest = max(Fraction(1), 2 * first)
    yield finest
    if 4 * first == finest:
        yield 2 * first
    while True:
        finest *= 2
        yield finest
