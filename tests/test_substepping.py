"""What cuts a step in substeps and undoes them, round a plain step that is faked: a point that moves by its time.

* a step that converges is one substep; one that does not is tried in 2 and 4, then as it was, and not again before one converges;
* substeps are as short as what closes asks for, cover the step without a gap, and grow again after an event;
* one that met contacts which were not known is taken again with them;
* one that ends deep, is fast where nobody had looked, or whose contacts do not settle, is undone and halved;
  after MAX_UNDONE of them the step goes on;
* what closes too fast for the shortest is refused, and an error leaves the state before the step.
"""

import numpy as np
import pytest

from taisoft.dynamics.results import StageResult
from taisoft.dynamics.substepping import MAX_SEARCHES, MAX_SUBSTEPS, MAX_UNDONE, Substepping
from taisoft.errors import SimulationError

DT = 0.1  # [s]


class Plain:
    """A stepper and its contacts at once: x is the time that it has stepped to. Its answers are set by the tests."""

    idle, is_linear, dissipative, had_impact, n_contacts = False, False, True, False, 0

    def __init__(self):
        self.contact = self.simulation = self.dirichlet = self.history = self
        self.x_now, self.step_count, self.flight = None, 4, np.zeros(0)
        self.x, self.marked = 0.0, 0.0
        self.taken: list[tuple[float, float]] = []
        self.kept: list[tuple[float, float]] = []
        self.starts: list = []  # what retries began with
        self.relative_penetration = self.crossing = self.penetration = 0.0
        self.converges = lambda time, dt: True
        self.closing = lambda time, dt: 0.0
        self.depth = lambda time, dt: 0.0
        self.astray = self.new_on_way = lambda time, dt: False

    # the stepper

    def save_start(self):
        self.marked = self.x

    def return_to_start(self, already_undone=False):
        self.x, self.kept = self.marked, []

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
        self.starts.append(start)
        return self.take_substep(time, dt)

    def undo_substep(self, released, discard_impulses):
        self.restore_start()

    # its world and contacts

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

    def left_searched_path(self, x_now):
        return self.astray(*self.kept[-1])

    def penetrates_deeper(self, time, dt, before):
        return False

    def search_along_path(self, time, dt):
        return self.new_on_way(time, dt)

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
def plain():
    return Plain()


def covers(plain, dt: float = DT) -> bool:
    """Whether the substeps that count follow each other and make the step."""
    starts = np.array([time for time, _ in plain.kept])
    lengths = np.array([length for _, length in plain.kept])
    return bool(np.allclose(starts, np.cumsum(lengths) - lengths) and np.isclose(lengths.sum(), dt))


def test_one_that_converges(plain):
    wrapped = Substepping(plain)
    result = wrapped.step(0.0, DT)
    assert plain.taken == [(0.0, DT)] and wrapped.substeps == 1 and result.converged and result.newton_iterations == 3


def test_one_that_converges_in_two(plain):
    plain.converges = lambda time, dt: dt <= 0.5 * DT
    wrapped = Substepping(plain)
    result = wrapped.step(0.0, DT)
    assert [dt for _, dt in plain.taken] == pytest.approx([DT, DT / 2, DT / 2]) and covers(plain)
    assert wrapped.substeps == 2 and result.converged and result.newton_iterations == 9 and wrapped.may_retry


def test_one_that_never_converges(plain):
    plain.converges = lambda time, dt: False
    wrapped = Substepping(plain)
    result = wrapped.step(0.0, DT)
    assert [dt for _, dt in plain.taken] == pytest.approx([DT, *[DT / 2] * 2, *[DT / 4] * 4, DT])
    assert wrapped.substeps == 1 and not result.converged and not wrapped.may_retry and plain.kept == [(0.0, DT)]
    plain.x, plain.taken = 0.0, []
    wrapped.step(0.0, DT)
    assert len(plain.taken) == 1  # substeps did not help in the step before
    plain.x, plain.converges = 0.0, lambda time, dt: True
    wrapped.step(0.0, DT)
    assert wrapped.may_retry


def test_linear_steps_are_not_tried_again(plain):
    plain.is_linear, plain.converges = True, lambda time, dt: False
    assert not Substepping(plain).step(0.0, DT).converged and len(plain.taken) == 1


def test_what_closes_fast_takes_short_substeps(plain):
    """Fast between 0.04 and 0.06 s; before and after it substeps are longer."""
    plain.closing = lambda time, dt: 50.0 * dt / DT if time < 0.06 and time + dt > 0.04 else 0.0
    wrapped = Substepping(plain)
    wrapped.step(0.0, DT)
    lengths = np.array([dt for _, dt in plain.kept])
    assert covers(plain) and wrapped.substeps == len(lengths) > 5
    fast = [dt for time, dt in plain.kept if 0.04 <= time < 0.06]
    assert max(fast) <= DT / 50 * 1.001 and lengths.max() > 3 * max(fast)


def test_what_closes_too_fast_is_refused(plain):
    plain.closing = lambda time, dt: 2.0 * MAX_SUBSTEPS * dt / DT if time > 0.049 else 1.9 * dt / DT
    with pytest.raises(SimulationError, match="step 5: they close at 1 m/s"):
        Substepping(plain).step(0.0, DT)
    assert plain.x == 0.0


def test_one_that_ends_deep_is_halved(plain):
    plain.depth = lambda time, dt: 1.0 if dt > DT / 8 else 0.0
    wrapped = Substepping(plain)
    wrapped.step(0.0, DT)
    assert covers(plain) and max(dt for _, dt in plain.kept) <= DT / 8 * 1.001 and len(plain.taken) > len(plain.kept)


def test_after_so_many_undone_it_goes_on(plain):
    plain.depth = lambda time, dt: 1.0 + time  # deeper and deeper
    Substepping(plain).step(0.0, DT)
    assert covers(plain) and 0 < len(plain.taken) - len(plain.kept) <= MAX_UNDONE and plain.relative_penetration > 1.0


def test_one_that_was_faster_than_seen_is_halved(plain):
    plain.astray = lambda time, dt: dt > DT / 4
    Substepping(plain).step(0.0, DT)
    assert covers(plain) and max(dt for _, dt in plain.kept) <= DT / 4 * 1.001


def test_one_that_met_what_was_not_known_is_taken_again(plain):
    plain.astray = lambda time, dt: len(plain.taken) <= 2
    plain.new_on_way = lambda time, dt: True
    wrapped = Substepping(plain)
    result = wrapped.step(0.0, DT)
    assert plain.taken == [(0.0, DT)] * 3 and plain.kept == [(0.0, DT)]
    assert plain.starts == [(0.0, DT)] * 2  # each where the last one ended
    assert wrapped.substeps == 1 and result.newton_iterations == 9


def test_one_whose_contacts_do_not_settle_is_halved(plain):
    plain.astray = plain.new_on_way = lambda time, dt: dt > DT / 2
    Substepping(plain).step(0.0, DT)
    whole = [dt for _, dt in plain.taken if dt == DT]
    assert covers(plain) and len(plain.kept) == 2 and len(whole) == MAX_SEARCHES + 1


def test_an_error_leaves_the_state_before(plain):
    def fails(time, dt):
        raise KeyboardInterrupt

    plain.converges = fails
    with pytest.raises(KeyboardInterrupt):
        Substepping(plain).step(0.0, DT)
    assert plain.x == 0.0 and plain.forgotten


def test_an_error_in_a_try_is_one_that_does_not_help(plain):
    def fails(time, dt):
        if dt < DT and time > 0.0:
            raise SimulationError("spoilt")
        return False

    plain.converges = fails
    result = Substepping(plain).step(0.0, DT)
    assert not result.converged and plain.kept == [(0.0, DT)]
