"""Adaptive substepping of implicit steps: when a step is cut, and when cutting ends.

A step that does not converge is repeated in equal substeps. With contacts, each must also miss no collision.

Before a substep: where surfaces cross already and contacts close fast, its length is limited by `contact_measures`. After it:
it is repeated with contacts that were found along its path, and with pairs that would have passed through each other
(`contact_paths`). It is undone and halved if these repetitions did not help, if the motion was much faster than known when it was
cut, if it left a new deep penetration or crossing, or, if it was short, when it did not converge. A short event, such as an
impact or a snap, therefore takes short substeps only while it lasts. How soon longer ones are tried again depends on how often
they failed (`LengthLimit`).

Where the Newton iterations of the step are used up (`newton_budget`), the substep under way is the last: what passes through
something on its path, or inverts tets, is held back, and in the rest of the step only what is prescribed moves.

No substep is shorter than the step over MAX_SUBSTEPS. Where surfaces cross already, motion that closes too fast even for that is
refused. A substep of minimum length, or after MAX_UNDONE others were undone, is kept and reported even if deep, unsettled or not
converged; bodies that would still pass through something are held back.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from enum import Enum, auto
from functools import partial
from typing import Protocol

import numpy as np

from taisoft.collision.intersections import CROSSED
from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.contact_measures import DEEP_PENETRATION, ROUNDING, next_length
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.results import StageResult, count_all, merge
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.state import StepState
from taisoft.errors import SimulationError

MAX_PASSAGES = 8  # repetitions of a substep with the pairs that would have passed through each other


class Fault(Enum):
    """Why a substep is undone."""

    FAST = auto()  # a collision could have been missed
    UNSETTLED = auto()  # every path it was tried along had unknown contacts
    CROSSED = auto()  # surfaces pass through each other on its path
    DEEP = auto()  # it ended in a new deep penetration or crossing
    UNCONVERGED = auto()  # it did not converge


class LengthLimit:
    """Longest substep that is tried, since one that is undone costs many times a short one.

    After a substep was undone the next ones are no longer than half of it, until `patience` of them were kept; the limit then
    doubles. Patience doubles with each substep that is undone and halves when one as long as a doubled limit is kept. The limit
    persists from step to step, until a substep that is a whole step is kept.
    """

    MAX_PATIENCE = 8
    HALF_TRIED = 0.51  # of a doubled limit: a substep up to this long, which divides a step equally, does not try it

    def __init__(self):
        self.longest, self.patience, self.n_kept = math.inf, 1, 0  # [s]; substeps; substeps kept under this limit
        self.is_trial = False  # whether the limit was doubled, and no substep of that length has been kept since

    def undo(self, length: float, again: bool) -> None:
        """Count a substep that was undone, for half its length. again: whether the one before, at the same place, was too."""
        self.patience = self.patience if again else min(2 * self.patience, self.MAX_PATIENCE)
        self.longest, self.n_kept, self.is_trial = 0.5 * length, 0, False

    def keep(self, length: float, dt: float) -> None:
        """Count a substep of a length that was kept in a step of dt."""
        is_whole = length > (1.0 - ROUNDING) * dt
        if self.longest == math.inf or (self.is_trial and length <= self.HALF_TRIED * self.longest and not is_whole):
            return
        if is_whole:
            self.__init__()
            return
        if self.is_trial:
            self.patience = max(1, self.patience // 2)
        self.n_kept, self.is_trial = self.n_kept + 1, False
        if self.n_kept >= self.patience:
            self.longest, self.n_kept, self.is_trial = 2.0 * self.longest, 0, True

    def snapshot(self) -> np.ndarray:
        """Return its state, (4,)."""
        return np.array([self.longest, self.patience, self.n_kept, self.is_trial])

    def restore(self, kept: np.ndarray) -> None:
        """Restore a `snapshot`."""
        self.longest, self.patience, self.n_kept, self.is_trial = float(kept[0]), int(kept[1]), int(kept[2]), bool(kept[3])


class Stepper(Protocol):
    """What takes the substeps: `ImplicitStepper`."""

    simulation: SimulationState
    contact: ContactStep | NoContacts
    start: StepState  # of the present substep
    is_linear: bool
    dissipative: bool
    begin_step: Callable[[], None]
    begin_substep: Callable[[float], None]
    take_substep: Callable[[float, float], StageResult]
    retry_substep: Callable[[float, float, np.ndarray], StageResult]
    hold_substep: Callable[[float, float], StageResult]
    undo_substep: Callable[..., None]
    return_to_first: Callable[[], None]
    hold_back_paths: Callable[[], bool]
    hold_back_inverted: Callable[[], float]
    is_spent: Callable[[], bool]
    forget: Callable[[], None]


class Substepping:
    """Wrap the plain steps of an implicit stepper: substeps, undoing and retries."""

    MAX_SUBSTEPS = 256  # per step
    MAX_CLOSING_RATIO = 2.0  # maximum closing ratio after a substep: its speed was not known when the step was cut
    MAX_SEARCHES = 3  # along a substep's actual path, if it left the expected one
    MAX_FAILED = 1  # attempts at a substep that did not converge, after which it is halved if something still passes
    MAX_UNDONE = 16  # per step, for reasons other than speed and trials of a longer substep: each costs a few solves
    WORSENING = 1.1  # growth of an existing penetration that counts as a new one
    RETRIES = 4  # maximum number of equal substeps after non-convergence; only shorter substeps are halved for that
    MAX_UNCONVERGED = 2  # maximum consecutive halvings for that: if they do not help, more do not either

    def __init__(self, stepper: Stepper):
        self._stepper, self._contact = stepper, stepper.contact
        self._deepest = self._most_crossed = 0.0  # over the finer side's mean surface edge: above it a penetration is new
        self.substeps = 1  # of the last step,
        self.held_part = 0.0  # and its part in which motion was held back for lack of Newton iterations
        self.limit = LengthLimit()
        self.may_retry = True  # whether shorter substeps may help; after they did not, False until a step converges

    def step(self, start: float, dt: float) -> StageResult:
        """Take one step of dt from a time [s].

        A step that does not converge is repeated in equal substeps; if these do not help, it is repeated as at first, without
        history. Linearly implicit steps do not iterate. Raise SimulationError if a step fails; the state is then the one before.
        """
        stepper, substeps, discarded = self._stepper, 1, []
        stepper.begin_step()
        while True:
            result, unconverged, taken = None, True, substeps
            try:
                results = self._in_substeps(start, dt, substeps)
                result, taken = merge(results), len(results)
                unconverged = not (result.converged or stepper.is_linear)
            except BaseException as error:  # Ctrl-C, too
                stepper.return_to_first()
                may_retry = self.may_retry
                stepper.forget()
                if substeps == 1 or stepper.is_spent() or not isinstance(error, SimulationError):
                    raise
                self.may_retry = may_retry  # only a retry failed
            if result is not None:
                discarded.append(result)
            may_help = self.may_retry and not (self._contact.paths.held_back or stepper.is_spent())
            if not (unconverged and may_help and (taken < self.RETRIES or substeps > 1)):
                break
            self.may_retry = taken < self.RETRIES
            substeps = min(2 * taken, self.RETRIES) if self.may_retry else 1
            stepper.return_to_first()
        self.substeps = taken
        self.may_retry = (self.may_retry and not stepper.is_spent()) or not unconverged
        return count_all(result, discarded[:-1])

    def _in_substeps(self, start: float, dt: float, substeps: int) -> list[StageResult]:
        """Take a step of dt from a time in equal or shorter substeps, each checked by `contact.end`.

        Raise SimulationError if contacts close too fast.
        """
        contact, stepper, may_retry = self._contact, self._stepper, self.may_retry and not self._stepper.is_linear
        shortest, longest = (1.0 - 1e-6) * dt / self.MAX_SUBSTEPS, dt / substeps
        results, remaining, undo_budget, self.held_part = [], dt, self.MAX_UNDONE, 0.0
        undone, n_unconverged, n_crossed = [], 0, 0  # of the current substep
        self._measure_start(start, dt)
        length = self._longest(longest, dt)
        while True:
            time, is_rest = start + (dt - remaining), stepper.is_spent()
            may_grow = bool(results) and not undone and undo_budget > 0
            if is_rest:
                length = remaining
            else:
                closing_ratio = partial(self._closing_ratio, time)
                length = next_length(closing_ratio, remaining, length, self._longest(longest, dt), may_grow)
            if length < shortest:
                if not contact.paths.none_cross:
                    self._refuse_fast_closing(dt)
                length = min(dt / self.MAX_SUBSTEPS, remaining)  # the check of its path suffices
            stepper.begin_substep(length)
            relative_penetration, last = contact.relative_penetration, length > remaining - shortest
            if is_rest:
                may_cut, (result, fault) = False, self._hold_substep(time, length)
                self.held_part += length / dt
            else:
                may_cut = undo_budget > 0 and length >= 2.0 * shortest
                result, fault = self._take_substep(time, length, may_cut)
                may_cut = may_cut and not stepper.is_spent()
            if fault == Fault.FAST and length < 2.0 * shortest:
                self._refuse_fast_closing(dt)
            is_held_back = False
            if fault == Fault.CROSSED and not may_cut:
                is_held_back = stepper.hold_back_paths()
                result, fault = replace(result, converged=result.converged and not is_held_back), None
            if stepper.is_spent() and not (is_rest or result.converged or fault == Fault.FAST):
                self._hold_back_inverted(length / dt)
            if fault != Fault.FAST and not (fault and may_cut):
                contact.penetration = contact.end(time + length, dt if last else length)
                is_short = length < (1.0 - ROUNDING) * min(longest, dt / self.RETRIES)
                fault = self._find_fault(result, may_retry and is_short and n_unconverged < self.MAX_UNCONVERGED)
            if fault == Fault.FAST or (fault and may_cut):
                is_trial = fault == Fault.CROSSED and self.limit.is_trial
                undo_budget -= not (fault == Fault.FAST or is_trial)
                n_unconverged += fault == Fault.UNCONVERGED
                undone.append(result)
                if fault == Fault.CROSSED:
                    self.limit.undo(length, again=n_crossed > 0)
                    n_crossed += 1
                stepper.undo_substep(discard_impulses=fault == Fault.UNCONVERGED)
                contact.relative_penetration, length = relative_penetration, 0.5 * length
                continue
            # the present penetration is not new for the next substep
            self._raise_limits(contact.relative_penetration, contact.crossing)
            contact.end_substep(stepper.start.x)
            contact.count_flight(length, stepper.dissipative)
            results.append(count_all(result, undone))
            if not is_held_back:
                self.limit.keep(length, dt)
            if last:
                return results
            remaining, undone, n_unconverged, n_crossed = remaining - length, [], 0, 0

    def _hold_substep(self, time: float, dt: float) -> tuple[StageResult, Fault | None]:
        """Take a substep in which only what is prescribed moves."""
        result = self._stepper.hold_substep(time, dt)
        return result, Fault.CROSSED if self._contact.paths.find() else None

    def _hold_back_inverted(self, of_step: float) -> None:
        """Hold back what the last substep, a part of the step, has inverted, and what then passes through something."""
        held = 1.0 - self._stepper.hold_back_inverted()
        self.held_part += of_step * held
        if held and self._contact.paths.find():
            self._stepper.hold_back_paths()

    def _longest(self, longest: float, dt: float) -> float:
        """The longest substep that is tried in a step of dt, up to a given length. The limit may stem from smaller steps."""
        return min(longest, max(self.limit.longest, dt / self.MAX_SUBSTEPS))

    def _closing_ratio(self, time: float, length: float) -> float:
        """Return the largest closing ratio of a substep; where nothing crosses 0, since the check of its path suffices."""
        return 0.0 if self._contact.paths.none_cross else self._contact.measure_start(time, length)[1]

    def _measure_start(self, start: float, dt: float) -> None:
        """Measure the start of a step; penetration that exists there needs no shorter substeps."""
        contact = self._contact
        relative_penetration, _ = contact.measure_start(start, dt)
        crossing = contact.initial_crossing()
        contact.relative_penetration = max(relative_penetration, crossing)
        self._deepest, self._most_crossed = DEEP_PENETRATION, CROSSED
        self._raise_limits(contact.relative_penetration, crossing)
        contact.start_step(dt)

    def _raise_limits(self, relative_penetration: float, crossing: float) -> None:
        """Raise the limits above which a penetration or crossing is new to WORSENING times the given ones."""
        self._deepest = max(self._deepest, self.WORSENING * relative_penetration)
        self._most_crossed = max(self._most_crossed, self.WORSENING * crossing)

    def _find_fault(self, result: StageResult, may_be_unconverged: bool) -> Fault | None:
        """Return the fault of a substep whose end has been measured, if any."""
        contact = self._contact
        if contact.relative_penetration > self._deepest or contact.crossing > self._most_crossed:
            return Fault.DEEP
        return Fault.UNCONVERGED if may_be_unconverged and not result.converged else None

    def _refuse_fast_closing(self, dt: float) -> None:
        number = self._stepper.simulation.step_count + 1
        raise SimulationError(f"step {number}: {self._contact.measures.describe_fast_closing(dt, self.MAX_SUBSTEPS)}")

    def _take_substep(self, time: float, dt: float, may_cut: bool) -> tuple[StageResult, Fault | None]:
        """Take a substep of dt from a time, and repeat it while its path has new contacts. Leave its end as the state."""
        contact, stepper, before = self._contact, self._stepper, self._contact.relative_penetration
        simulation, start, result = stepper.simulation, stepper.start, stepper.take_substep(time, dt)
        n_failed = 0
        for tries in range(MAX_PASSAGES + 1):
            as_searched = not contact.paths.left_searched(start.x)
            passes = as_searched and contact.paths.find()
            if as_searched and not passes and not contact.penetrates_deeper(time + dt, dt, before):
                break
            state = simulation.state()
            simulation.now.copy_nodes_from(start)
            new = contact.search_along_path(time, dt)
            if not as_searched:
                passes = contact.paths.find(as_searched=True)
                # contacts unknown so far matter only if something could have crossed
                new = contact.search_along_path(time, dt) if passes else new and not contact.paths.none_cross
            n_failed += not (result.converged or stepper.is_linear)
            shorter_helps = may_cut and n_failed >= self.MAX_FAILED
            hopeless = stepper.is_spent() or (passes and (contact.paths.is_stuck or shorter_helps))
            if not (new or passes) or tries >= (MAX_PASSAGES if passes else self.MAX_SEARCHES) or hopeless:
                simulation.set_state(*state)
                if passes:
                    return result, Fault.CROSSED
                if not contact.paths.none_cross and contact.measures.closing_ratio > self.MAX_CLOSING_RATIO:
                    return result, Fault.FAST
                return result, Fault.UNSETTLED if new else None
            result = count_all(stepper.retry_substep(time, dt, state[1]), [result])
        return result, None
