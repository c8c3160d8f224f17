"""A step in substeps: what cuts it, and where cutting ends.

One that does not converge is done again in equal substeps. With contacts each is so short, besides, that nothing passes unseen.

Before a substep: while contacts close fast it is as short as `tunnelling` asks. After it: it is undone and cut in half where it
led to motion much faster than was known when it was cut, to contacts that no search along its way settled, to something newly
deep or crossed, or, if it was short, where it did not converge. So a short event, an impact or a snap, takes short substeps
while it lasts and no longer.

No substep is shorter than the step over MAX_SUBSTEPS. What closes too fast even for that is refused; what ends deep, unsettled or
not converged all the same, or after UNDONE others were undone, is kept and reported.
"""

from enum import Enum, auto
from typing import TYPE_CHECKING

from taisoft.dynamics.ccd_limits import next_length
from taisoft.dynamics.contact import DEEP_CROSSING, DEEP_PENETRATION
from taisoft.dynamics.stage_result import StageResult, count_all, merge
from taisoft.errors import SimulationError

if TYPE_CHECKING:
    from taisoft.dynamics.implicit import ImplicitStepper

MAX_SUBSTEPS = 256  # of a step
MAX_CLOSING_RATIO = 2.0  # a substep may close so many times what was allowed: its speed was not known when the step was cut
SEARCHES = 3  # along the way that a substep took, where it left the one that was expected
UNDONE = 16  # substeps of a step that are undone for other reasons than speed: each costs a few solves
WORSE = 1.1  # what is deep already needs no shorter substeps before it is so many times as deep
RETRIES = 4  # equal parts at most of a step that is done again since it did not converge; only shorter substeps are cut for that
LOSSES = 2  # times in a row that one is cut for that: where it does not help, more does not either


class Fault(Enum):
    """Why a substep is undone."""

    FAST = auto()  # things could have passed each other
    UNSETTLED = auto()  # each way that it was tried along had contacts that were not known
    DEEP = auto()  # it ended in something newly deep, or crossed
    LOST = auto()  # it did not converge


class Substepping:
    """Wraps the plain steps of an implicit stepper: retries, substeps, and what undoes them.

    The stepper takes one substep after the other (`take`), back and again with other contacts (`back`, `retry`), or from where it
    began with another length (`undo`); `mark` and `return_to_mark` keep a step's start and go back to it.
    """

    def __init__(self, stepper: "ImplicitStepper"):
        self._stepper, self._contact = stepper, stepper.contact
        self._deepest = self._most_crossed = 0.0  # over the finer side's mean surface edge: no deeper counts as newly deep
        self.substeps = 1  # that the last step was taken in
        self.recovers = True  # whether shorter substeps may help; where they did not, not before a step converges again

    def step(self, start: float, dt: float) -> StageResult:
        """One step of dt from a time [s].

        One that does not converge is done again in equal substeps, and where these do not help in those of before, anew and
        without the past. Linearly implicit steps have nothing that could converge. Where a step fails, it is abandoned: the state
        is that before it. Raises SimulationError.
        """
        stepper, substeps, given_up = self._stepper, 1, []
        stepper.mark()
        while True:
            result, lost, taken = None, True, substeps
            try:
                done = self._in_substeps(start, dt, substeps)
                result, taken = merge(done), len(done)
                lost = not (result.converged or stepper.is_linear)
            except BaseException as error:  # of Ctrl-C, too
                stepper.return_to_mark(taken_back=True)
                recovers = self.recovers
                stepper.forget()
                if substeps == 1 or not isinstance(error, SimulationError):
                    raise
                self.recovers = recovers  # it was only a try
            if result is not None:
                given_up.append(result)
            if not (lost and self.recovers and (taken < RETRIES or substeps > 1)):
                break
            self.recovers = taken < RETRIES
            substeps = min(2 * taken, RETRIES) if self.recovers else 1
            stepper.return_to_mark()
        self.substeps = taken
        self.recovers = self.recovers or not lost
        return count_all(result, given_up[:-1])

    def _in_substeps(self, start: float, dt: float, substeps: int) -> list[StageResult]:
        """A step of dt from a time, in equal parts or in more and shorter ones; `contact.end` has looked at its end.

        Raises SimulationError where things close too fast.
        """
        contact, stepper, recovers = self._contact, self._stepper, self.recovers and not self._stepper.is_linear
        shortest, longest = (1.0 - 1e-6) * dt / MAX_SUBSTEPS, dt / substeps
        results, left, length, spare = [], dt, longest, UNDONE
        undone, losses = [], 0  # of the substep that is tried
        self._begin(start, dt)
        while True:
            time = start + (dt - left)
            length = next_length(
                lambda part, time=time: contact.look(time, part)[1], left, length, longest, bool(results) and not undone
            )  # fmt: skip
            if length < shortest:
                self._refuse(dt)
            contact.start_substep(length)
            relative_penetration, last = contact.relative_penetration, length > left - shortest
            released = stepper.simulation.dirichlet.released()
            may_cut = spare > 0 and length >= 2.0 * shortest
            result, fault = self._take(time, length)
            if fault == Fault.FAST and length < 2.0 * shortest:
                self._refuse(dt)
            if fault != Fault.FAST and not (fault and may_cut):
                contact.penetration = contact.end(time + length, dt if last else length)
                fault = self._judge(result, recovers and length < min(longest, dt / RETRIES) and losses < LOSSES)
            if fault == Fault.FAST or (fault and may_cut):
                spare, losses = spare - (fault != Fault.FAST), losses + (fault == Fault.LOST)
                undone.append(result)
                stepper.undo(released, anew=fault == Fault.LOST)
                contact.relative_penetration, length = relative_penetration, 0.5 * length
                continue
            # what is deep now is deep already for the next
            self._allow(contact.relative_penetration, contact.crossing)
            contact.end_substep()
            contact.count_flight(length, stepper.lossy)
            results.append(count_all(result, undone))
            if last:
                return results
            left, undone, losses = left - length, [], 0

    def _begin(self, start: float, dt: float) -> None:
        """Look at the start of a step; what is deep there already needs no shorter substeps."""
        contact = self._contact
        relative_penetration, _ = contact.look(start, dt)
        crossing = contact.crossing_before()
        contact.relative_penetration = max(relative_penetration, crossing)
        self._deepest, self._most_crossed = DEEP_PENETRATION, DEEP_CROSSING
        self._allow(contact.relative_penetration, crossing)
        contact.start_step(dt)

    def _allow(self, relative_penetration: float, crossing: float) -> None:
        """No deeper than that, or not much, counts as newly deep or crossed."""
        self._deepest = max(self._deepest, WORSE * relative_penetration)
        self._most_crossed = max(self._most_crossed, WORSE * crossing)

    def _judge(self, result: StageResult, may_be_lost: bool) -> Fault | None:
        """What is wrong with a substep whose end has been looked at."""
        contact = self._contact
        if contact.relative_penetration > self._deepest or contact.crossing > self._most_crossed:
            return Fault.DEEP
        return Fault.LOST if may_be_lost and not result.converged else None

    def _refuse(self, dt: float) -> None:
        number = self._stepper.simulation.step_count + 1
        raise SimulationError(f"step {number}: {self._contact.too_fast(dt, MAX_SUBSTEPS)}")

    def _take(self, time: float, dt: float) -> tuple[StageResult, Fault | None]:
        """A substep of dt from a time; again, where it led to contacts that had not been found. Leaves its end as the state."""
        contact, stepper, before = self._contact, self._stepper, self._contact.relative_penetration
        simulation, result = stepper.simulation, stepper.take(time, dt)
        for tries in range(SEARCHES + 1):
            if not (contact.left_searched_path(stepper.history.x_now) or contact.penetrates_anew(time + dt, dt, before)):
                break
            state = simulation.state()
            stepper.back()
            new = contact.search_along_path(time, dt)
            if not new or tries == SEARCHES:
                simulation.set_state(*state)
                if contact.closing_ratio_along_path() > MAX_CLOSING_RATIO:
                    return result, Fault.FAST
                return result, Fault.UNSETTLED if new else None
            result = count_all(stepper.retry(time, dt, state[1]), [result])
        return result, None
