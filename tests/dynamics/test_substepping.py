"""Substepping, with a fake stepper: a point whose position is the time.

* a step that converges is one substep; one that does not is retried in 2 and 4 substeps and then whole, and later steps are
  not retried until one converges;
* substeps are as short as the closing rate requires where surfaces cross already, cover the step, and grow again after an event;
* a substep that met unknown contacts is repeated with them;
* a substep that ends in deep penetration, leaves the searched path, or whose contacts do not settle, is undone and halved, at
  most MAX_UNDONE times a step;
* a substep in which something passes through something is repeated, then halved, then held back and reported; it is halved
  sooner if its equations cannot be solved, and the substeps and steps after it are tried longer ever more seldom while they fail;
* bodies that close too fast for the shortest substep raise an error; after an error the state is that before the step.
"""

import numpy as np
import pytest

from taisoft.dynamics.results import StageResult
from taisoft.dynamics.substepping import (
    MAX_FAILED,
    MAX_PASSAGES,
    MAX_PATIENCE,
    MAX_SEARCHES,
    MAX_SUBSTEPS,
    MAX_UNDONE,
    LengthLimit,
    Substepping,
)
from taisoft.errors import SimulationError

DT = 0.1  # [s]


class FakeStepper:
    """Stepper, simulation state and contacts at once: x is the time reached. Tests set what its measurements return."""

    idle, is_linear, dissipative, had_impact, n_contacts, none_cross, is_stuck = False, False, True, False, 0, False, False

    def __init__(self):
        self.contact = self.paths = self.simulation = self.dirichlet = self.history = self
        self.x_now, self.step_count, self.flight = None, 4, np.zeros(0)
        self.x, self.saved = 0.0, 0.0
        self.taken: list[tuple[float, float]] = []
        self.kept: list[tuple[float, float]] = []
        self.retry_starts: list = []
        self.relative_penetration = self.crossing = self.penetration = 0.0
        self.converges = lambda time, dt: True
        self.closing = lambda time, dt: 0.0
        self.depth = lambda time, dt: 0.0
        self.left_path = self.has_new_contacts = self.passes = lambda time, dt: False
        self.held_back: list[tuple[float, float]] = []
        self.broken = False

    # the stepper

    def save_start(self):
        self.saved = self.x

    def return_to_start(self, already_undone=False):
        self.x, self.kept = self.saved, []

    def forget(self):
        self.forgotten = True

    def take_substep(self, time, dt):
        assert time == pytest.approx(self.x)
        self.taken.append((time, dt))
        self.start, self.x = self.x, time + dt
        self.kept.append((time, dt))
        good = self.converges(time, dt)
        return StageResult(3, 10, 1e-6 if good else 0.1, good, False)

    def restore_start(self):
        self.x = self.start
        self.kept.pop()

    def retry_substep(self, time, dt, start):
        self.retry_starts.append(start)
        return self.take_substep(time, dt)

    def undo_substep(self, released, discard_impulses):
        self.restore_start()

    # the simulation state and its contacts

    def state(self):
        return self.x, self.kept[-1]

    def set_state(self, x, last):
        self.x = x
        self.kept.append(last)

    def released(self):
        return []

    def measure_start(self, time, dt):
        return 0.0, self.closing(time, dt)

    def initial_crossing(self):
        return 0.0

    def left_searched(self, x_now):
        return self.left_path(*self.kept[-1])

    def find(self, as_searched=False):
        return self.passes(*(self.searched if as_searched else self.kept[-1]))

    def hold_back(self, x_start):
        self.held_back.append(self.kept[-1])

    def break_history(self):
        self.broken = True

    def penetrates_deeper(self, time, dt, before):
        return False

    def search_along_path(self, time, dt):
        self.searched = time, dt
        return self.has_new_contacts(time, dt)

    def closing_ratio_along_path(self):
        return 10.0

    def end(self, time, dt):
        self.relative_penetration = self.depth(*self.kept[-1])
        return self.relative_penetration

    def describe_fast_closing(self, dt, substeps):
        return "they close at 1 m/s"

    def _nothing(self, *_):
        pass

    start_step = start_substep = end_substep = count_flight = _nothing


@pytest.fixture
def stepper():
    return FakeStepper()


def covers_step(stepper) -> bool:
    """Whether the substeps that were kept are contiguous and add up to the step."""
    starts = np.array([time for time, _ in stepper.kept])
    lengths = np.array([length for _, length in stepper.kept])
    return bool(np.allclose(starts, np.cumsum(lengths) - lengths) and np.isclose(lengths.sum(), DT))


def longest_kept(stepper) -> float:
    return max(dt for _, dt in stepper.kept)


def test_converged_step_is_one_substep(stepper):
    substepping = Substepping(stepper)
    result = substepping.step(0.0, DT)
    assert stepper.taken == [(0.0, DT)] and substepping.substeps == 1 and result.converged and result.newton_iterations == 3


def test_unconverged_step_is_retried_in_two(stepper):
    stepper.converges = lambda time, dt: dt <= 0.5 * DT
    substepping = Substepping(stepper)
    result = substepping.step(0.0, DT)
    assert [dt for _, dt in stepper.taken] == pytest.approx([DT, DT / 2, DT / 2]) and covers_step(stepper)
    assert substepping.substeps == 2 and result.converged and result.newton_iterations == 9 and substepping.may_retry


def test_retries_stop_until_a_step_converges(stepper):
    stepper.converges = lambda time, dt: False
    substepping = Substepping(stepper)
    result = substepping.step(0.0, DT)
    assert [dt for _, dt in stepper.taken] == pytest.approx([DT, *[DT / 2] * 2, *[DT / 4] * 4, DT])
    assert substepping.substeps == 1 and not result.converged and not substepping.may_retry and stepper.kept == [(0.0, DT)]
    stepper.x, stepper.taken = 0.0, []
    substepping.step(0.0, DT)
    assert len(stepper.taken) == 1
    stepper.x, stepper.converges = 0.0, lambda time, dt: True
    substepping.step(0.0, DT)
    assert substepping.may_retry


def test_linear_steps_are_not_retried(stepper):
    stepper.is_linear, stepper.converges = True, lambda time, dt: False
    assert not Substepping(stepper).step(0.0, DT).converged and len(stepper.taken) == 1


def test_substeps_are_short_only_while_bodies_close_fast(stepper):
    """They close fast between 0.04 and 0.06 s."""
    stepper.closing = lambda time, dt: 50.0 * dt / DT if time < 0.06 and time + dt > 0.04 else 0.0
    substepping = Substepping(stepper)
    substepping.step(0.0, DT)
    lengths = np.array([dt for _, dt in stepper.kept])
    assert covers_step(stepper) and substepping.substeps == len(lengths) > 5
    fast = [dt for time, dt in stepper.kept if 0.04 <= time < 0.06]
    assert max(fast) <= DT / 50 * 1.001 and lengths.max() > 3 * max(fast)


def test_where_nothing_crosses_speed_cuts_nothing(stepper):
    stepper.closing, stepper.none_cross = lambda time, dt: 50.0 * dt / DT, True
    substepping = Substepping(stepper)
    substepping.step(0.0, DT)
    assert stepper.kept == [(0.0, DT)] and substepping.substeps == 1


def test_closing_too_fast_for_the_shortest_substep_is_an_error(stepper):
    stepper.closing = lambda time, dt: 2.0 * MAX_SUBSTEPS * dt / DT if time > 0.049 else 1.9 * dt / DT
    with pytest.raises(SimulationError, match="step 5: they close at 1 m/s"):
        Substepping(stepper).step(0.0, DT)
    assert stepper.x == 0.0


def test_deep_penetration_halves_a_substep(stepper):
    stepper.depth = lambda time, dt: 1.0 if dt > DT / 8 else 0.0
    substepping = Substepping(stepper)
    substepping.step(0.0, DT)
    assert covers_step(stepper) and longest_kept(stepper) <= DT / 8 * 1.001 and len(stepper.taken) > len(stepper.kept)


def test_number_of_undone_substeps_is_bounded(stepper):
    stepper.depth = lambda time, dt: 1.0 + time  # always deeper
    Substepping(stepper).step(0.0, DT)
    assert (
        covers_step(stepper) and 0 < len(stepper.taken) - len(stepper.kept) <= MAX_UNDONE and stepper.relative_penetration > 1.0
    )


def test_leaving_the_searched_path_halves_a_substep(stepper):
    stepper.left_path = lambda time, dt: dt > DT / 4
    Substepping(stepper).step(0.0, DT)
    assert covers_step(stepper) and longest_kept(stepper) <= DT / 4 * 1.001


def test_substep_that_met_new_contacts_is_repeated(stepper):
    stepper.left_path = lambda time, dt: len(stepper.taken) <= 2
    stepper.has_new_contacts = lambda time, dt: True
    substepping = Substepping(stepper)
    result = substepping.step(0.0, DT)
    assert stepper.taken == [(0.0, DT)] * 3 and stepper.kept == [(0.0, DT)]
    assert stepper.retry_starts == [(0.0, DT)] * 2  # each retry starts from the previous result
    assert substepping.substeps == 1 and result.newton_iterations == 9


def test_contacts_that_do_not_settle_halve_a_substep(stepper):
    stepper.left_path = stepper.has_new_contacts = lambda time, dt: dt > DT / 2
    Substepping(stepper).step(0.0, DT)
    whole = [dt for _, dt in stepper.taken if dt == DT]
    assert covers_step(stepper) and len(stepper.kept) == 2 and len(whole) == MAX_SEARCHES + 1


def test_passages_are_searched_again_and_then_halve_a_substep(stepper):
    stepper.passes = lambda time, dt: dt > DT / 2
    substepping = Substepping(stepper)
    result = substepping.step(0.0, DT)
    whole = [dt for _, dt in stepper.taken if dt == DT]
    assert covers_step(stepper) and len(stepper.kept) == 2 and len(whole) == MAX_PASSAGES + 1
    assert not stepper.held_back and result.converged


def test_unconverged_passages_halve_a_substep_sooner(stepper):
    stepper.converges = lambda time, dt: dt <= DT / 2
    stepper.passes = lambda time, dt: dt > DT / 2
    result = Substepping(stepper).step(0.0, DT)
    whole = [dt for _, dt in stepper.taken if dt == DT]
    assert covers_step(stepper) and len(stepper.kept) == 2 and len(whole) == MAX_FAILED < MAX_PASSAGES and result.converged


def test_substeps_that_keep_passing_are_tried_ever_more_seldom(stepper):
    stepper.passes = lambda time, dt: dt > DT / 16
    stepper.is_stuck = True
    substepping, undone = Substepping(stepper), []
    for k in range(6):
        stepper.x, stepper.taken, stepper.kept = k * DT, [], []
        substepping.step(k * DT, DT)
        undone.append(len({taken for taken in stepper.taken if taken[1] > DT / 16 * 1.001}))
    assert undone[0] >= 4 and max(undone[2:]) <= 2 and sum(undone[2:]) >= 4 * 16 / MAX_PATIENCE / 2
    stepper.passes = lambda time, dt: False
    for k in range(6, 10):
        stepper.x, stepper.kept = k * DT, []
        substepping.step(k * DT, DT)
    assert substepping.substeps == 1  # it has ended


def test_length_limit_returns_from_its_snapshot():
    limit, other = LengthLimit(), LengthLimit()
    limit.undo(DT, again=False)
    limit.undo(DT / 2, again=True)
    assert limit.longest == DT / 4 and limit.patience == 2
    limit.keep(DT / 4, DT)
    limit.keep(DT / 4, DT)
    assert limit.longest == DT / 2 and limit.is_trial
    other.restore(limit.snapshot())
    assert vars(other) == vars(limit)
    limit.keep(DT / 8, DT)  # for another reason: it tells nothing
    assert vars(other) == vars(limit)
    limit.keep(DT / 2, DT)  # the longer one was kept: patience halves, and a whole step is tried
    assert limit.longest == DT and limit.is_trial and limit.patience == 1
    limit.undo(DT, again=False)
    assert limit.longest == DT / 2 and limit.patience == 2
    for _ in range(2):
        limit.keep(DT / 2, DT)
    limit.keep(DT, DT)
    assert vars(limit) == vars(LengthLimit())


def test_whole_steps_that_fail_are_tried_ever_more_seldom(stepper):
    stepper.passes = lambda time, dt: dt > 0.6 * DT
    substepping, whole = Substepping(stepper), []
    for _ in range(12):
        stepper.taken.clear()
        substepping.step(stepper.x, DT)
        whole.append(any(dt > 0.6 * DT for _, dt in stepper.taken))
    assert whole[0] and sum(whole) < 6


def test_trials_of_longer_substeps_use_up_no_budget(stepper):
    """A step that needs more than a hundred substeps tries longer ones more often than MAX_UNDONE times."""
    stepper.passes, stepper.is_stuck = lambda time, dt: dt > DT / 100, True
    result = Substepping(stepper).step(0.0, DT)
    assert len(stepper.taken) - len(stepper.kept) > MAX_UNDONE
    assert covers_step(stepper) and not stepper.held_back and result.converged


def test_no_substep_is_held_back_where_shorter_ones_pass(stepper):
    """Passages end at a 128th of the step only: what takes all attempts of a step to find out is not forgotten in it."""
    stepper.passes = lambda time, dt: dt > 1.01 * DT / 128
    result = Substepping(stepper).step(0.0, DT)
    assert covers_step(stepper) and result.converged and not stepper.held_back


def test_a_limit_from_small_steps_does_not_refuse_large_ones(stepper):
    substepping = Substepping(stepper)
    stepper.passes = lambda time, dt: dt > 1e-3 * DT / 60
    substepping.step(0.0, 1e-3 * DT)
    stepper.passes, stepper.none_cross = lambda time, dt: False, False
    assert substepping.limit.longest < DT / 256 and substepping.step(stepper.x, DT).converged


def test_passages_end_with_the_repetition_that_has_none(stepper):
    stepper.passes = lambda time, dt: len(stepper.taken) <= 4
    result = Substepping(stepper).step(0.0, DT)
    assert stepper.taken == [(0.0, DT)] * 5 and stepper.kept == [(0.0, DT)] and result.converged and not stepper.broken


def test_what_passes_in_spite_of_all_is_held_back_and_reported(stepper):
    stepper.passes = lambda time, dt: True
    result = Substepping(stepper).step(0.0, DT)
    assert covers_step(stepper) and stepper.held_back == stepper.kept and stepper.broken and not result.converged
    assert len(stepper.taken) <= (MAX_PASSAGES + 1) * (MAX_UNDONE + len(stepper.kept)) * 3  # retries of the step included


def test_a_path_that_was_left_is_checked_where_it_was_searched(stepper):
    stepper.left_path = lambda time, dt: len(stepper.taken) == 1
    stepper.passes = lambda time, dt: len(stepper.taken) == 1
    Substepping(stepper).step(0.0, DT)
    assert stepper.taken == [(0.0, DT)] * 2 and stepper.searched == (0.0, DT)


def test_error_restores_the_state_before_the_step(stepper):
    def fails(time, dt):
        raise KeyboardInterrupt

    stepper.converges = fails
    with pytest.raises(KeyboardInterrupt):
        Substepping(stepper).step(0.0, DT)
    assert stepper.x == 0.0 and stepper.forgotten


def test_error_in_a_retry_keeps_the_first_result(stepper):
    def fails(time, dt):
        if dt < DT and time > 0.0:
            raise SimulationError("not finite")
        return False

    stepper.converges = fails
    result = Substepping(stepper).step(0.0, DT)
    assert not result.converged and stepper.kept == [(0.0, DT)]
