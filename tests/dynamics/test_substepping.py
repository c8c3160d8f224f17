"""Substepping, with a fake stepper: a point whose position is the time.

* a step that converges is one substep; one that does not is retried in 2 and 4 substeps and then whole, and later steps are
  not retried until one converges;
* substeps are as short as the closing rate requires where surfaces cross already, cover the step, and grow again after an event;
* a substep that met unknown contacts, or in which something passes through something, is repeated; one that ends deep, leaves the
  searched path, or does not settle, is undone and halved, a bounded number of times; longer ones are tried ever more seldom;
* what passes in spite of all is held back and reported; bodies that close too fast for the shortest substep raise an error, and
  the state is that before the step.
"""

import numpy as np
import pytest

from taisoft.dynamics.results import StageResult
from taisoft.dynamics.substepping import Substepping
from taisoft.errors import SimulationError

DT = 0.1  # [s]


def never(time: float, dt: float) -> bool:
    return False


def longer_than(length: float):
    return lambda time, dt: dt > length


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
        self.left_path = self.has_new_contacts = self.passes = self.fails = never
        self.held_back: list[tuple[float, float]] = []
        self.broken = False

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
        good = self.converges(time, dt) and not self.fails(time, dt)
        return StageResult(3, 10, 1e-6 if good else 0.1, good, False)

    def restore_start(self):
        self.x = self.start
        self.kept.pop()

    def retry_substep(self, time, dt, start):
        self.retry_starts.append(start)
        return self.take_substep(time, dt)

    def undo_substep(self, released, discard_impulses):
        self.restore_start()

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


def take(stepper: FakeStepper, substepping: Substepping | None = None) -> tuple[list[float], StageResult]:
    """Take the next step. Return the lengths of its substeps, which must be contiguous and add up to the step, and its result."""
    start, stepper.taken, stepper.kept = stepper.x, [], []
    result = (substepping or Substepping(stepper)).step(start, DT)
    times, lengths = np.transpose(stepper.kept)
    assert np.allclose(times - start, np.cumsum(lengths) - lengths) and np.isclose(lengths.sum(), DT)
    return lengths.tolist(), result


def test_a_step_that_does_not_converge_is_retried_in_two_substeps(stepper):
    stepper.converges = longer_than(0.0)
    substepping = Substepping(stepper)
    lengths, result = take(stepper, substepping)
    assert lengths == [DT] and substepping.substeps == 1 and result.converged and result.newton_iterations == 3
    stepper.converges = lambda time, dt: dt <= 0.5 * DT
    lengths, result = take(stepper, substepping)
    assert [dt for _, dt in stepper.taken] == pytest.approx([DT, DT / 2, DT / 2]) and len(lengths) == 2
    assert substepping.substeps == 2 and result.converged and result.newton_iterations == 9 and substepping.may_retry


def test_retries_stop_until_a_step_converges(stepper):
    stepper.converges, substepping = never, Substepping(stepper)
    lengths, result = take(stepper, substepping)
    assert [dt for _, dt in stepper.taken] == pytest.approx([DT, *[DT / 2] * 2, *[DT / 4] * 4, DT])
    assert substepping.substeps == 1 and not result.converged and not substepping.may_retry and lengths == [DT]
    take(stepper, substepping)
    assert len(stepper.taken) == 1
    stepper.converges = longer_than(0.0)
    take(stepper, substepping)
    assert substepping.may_retry
    stepper.is_linear, stepper.converges = True, never  # linear steps are not retried
    assert not take(stepper, substepping)[1].converged and len(stepper.taken) == 1


def test_substeps_are_short_only_while_bodies_close_fast(stepper):
    """They close fast between 0.04 and 0.06 s. Where nothing crosses, the check of paths suffices."""
    stepper.closing = lambda time, dt: 50.0 * dt / DT if time < 0.06 and time + dt > 0.04 else 0.0
    substepping = Substepping(stepper)
    lengths, _ = take(stepper, substepping)
    fast = [dt for time, dt in stepper.kept if 0.04 <= time < 0.06]
    assert substepping.substeps == len(lengths) > 5 and max(fast) <= DT / 50 * 1.001 and max(lengths) > 3 * max(fast)
    stepper.x, stepper.none_cross = 0.0, True
    assert take(stepper)[0] == [DT]


def test_closing_too_fast_for_the_shortest_substep_is_an_error(stepper):
    """The shortest is a 256th of the step."""
    stepper.closing = lambda time, dt: (512.0 if time > 0.049 else 1.9) * dt / DT
    with pytest.raises(SimulationError, match="step 5: they close at 1 m/s"):
        Substepping(stepper).step(0.0, DT)
    assert stepper.x == 0.0


@pytest.mark.parametrize(
    "faults, length, attempts",
    [
        (["depth"], DT / 8, 1),  # it ends deep
        (["left_path"], DT / 4, 1),  # it was faster than known when the step was cut
        (["left_path", "has_new_contacts"], DT / 2, 4),  # each path that is searched has unknown contacts
        (["passes"], DT / 2, 9),  # something passes through something whatever contacts are added,
        (["passes", "fails"], DT / 2, 1),  # which is not tried again with equations that cannot be solved
    ],
)
def test_a_substep_with_a_fault_is_repeated_and_then_halved(stepper, faults, length, attempts):
    for fault in faults:
        setattr(stepper, fault, longer_than(length))
    substepping = Substepping(stepper)
    lengths, result = take(stepper, substepping)
    assert max(lengths) == pytest.approx(length) and result.converged and not stepper.held_back
    assert sum(dt == DT for _, dt in stepper.taken) == attempts
    assert result.newton_iterations == 3 * len(stepper.taken) and substepping.substeps == len(lengths)


def test_the_number_of_undone_substeps_is_bounded(stepper):
    stepper.depth = lambda time, dt: 1.0 + time  # always deeper
    lengths, _ = take(stepper)
    assert 0 < len(stepper.taken) - len(lengths) <= 20 and stepper.relative_penetration > 1.0


@pytest.mark.parametrize("attempts, faults", [(2, ["left_path", "has_new_contacts"]), (4, ["passes"])])
def test_a_substep_that_met_unknown_contacts_is_repeated_with_them(stepper, attempts, faults):
    for fault in faults:
        setattr(stepper, fault, lambda time, dt: len(stepper.taken) <= attempts)
    lengths, result = take(stepper)
    assert stepper.taken == [(0.0, DT)] * (attempts + 1) and lengths == [DT] and result.converged and not stepper.broken
    assert stepper.retry_starts == [(0.0, DT)] * attempts  # each starts from the result before
    assert result.newton_iterations == 3 * (attempts + 1)


def test_a_path_that_was_left_is_checked_where_it_was_searched(stepper):
    stepper.left_path = stepper.passes = lambda time, dt: len(stepper.taken) == 1
    take(stepper)
    assert stepper.taken == [(0.0, DT)] * 2 and stepper.searched == (0.0, DT)


@pytest.mark.parametrize("length, is_stuck, first, most", [(DT / 16, True, 4, 23), (0.6 * DT, False, 1, 5)])
def test_substeps_that_keep_passing_are_tried_ever_more_seldom(stepper, length, is_stuck, first, most):
    stepper.passes, stepper.is_stuck = longer_than(length), is_stuck
    substepping, failed = Substepping(stepper), []
    for _ in range(12):
        take(stepper, substepping)
        failed.append(len({taken for taken in stepper.taken if taken[1] > 1.001 * length}))
    assert failed[0] >= first and max(failed[2:]) <= 2 and first <= sum(failed[2:]) <= most
    stepper.passes = never
    for _ in range(4):
        lengths, _ = take(stepper, substepping)
    assert lengths == [DT]


@pytest.mark.parametrize("length, is_stuck, undone", [(DT / 100, True, 17), (1.01 * DT / 128, False, 1)])
def test_nothing_is_held_back_where_shorter_substeps_pass(stepper, length, is_stuck, undone):
    """Neither trials of longer substeps in a step of more than a hundred, nor the search for a short one, use up the attempts."""
    stepper.passes, stepper.is_stuck = longer_than(length), is_stuck
    lengths, result = take(stepper)
    assert len(stepper.taken) - len(lengths) >= undone and not stepper.held_back and result.converged


def test_a_limit_from_small_steps_does_not_refuse_large_ones(stepper):
    substepping = Substepping(stepper)
    stepper.passes = longer_than(1e-3 * DT / 60)
    substepping.step(0.0, 1e-3 * DT)
    stepper.passes = never
    assert substepping.limit.longest < DT / 256 and substepping.step(stepper.x, DT).converged


def test_what_passes_in_spite_of_all_is_held_back_and_reported(stepper):
    stepper.passes = lambda time, dt: True
    _, result = take(stepper)
    assert stepper.held_back == stepper.kept and stepper.broken and not result.converged
    assert len(stepper.taken) < 30 * len(stepper.kept)


def test_an_error_in_a_retry_keeps_the_first_result(stepper):
    def fails(time, dt):
        if dt < DT and time > 0.0:
            raise SimulationError("not finite")
        return False

    stepper.converges = fails
    lengths, result = take(stepper)
    assert not result.converged and lengths == [DT]
