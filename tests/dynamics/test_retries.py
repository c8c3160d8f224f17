"""Implicit steps that are done again, without and with contacts:

* a step that does not converge, or ends too deep, is retried from its start with twice as many substeps, and prescribed nodes
  that it released are prescribed again; the result equals that many steps, and the report counts the iterations of all attempts;
* where a step fails, the state is that before it.

Substepping, with a fake stepper: a point whose position is the time.

* a step that does not converge is retried in 2 and 4 substeps and then whole, and later steps are not until one converges;
* a substep that met unknown contacts, or in which something passes through something, is repeated; one that ends deep, leaves the
  searched path, or does not settle, is undone and halved, a bounded number of times; longer ones are tried ever more seldom;
* what passes in spite of all is held back and reported.
"""

from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import implicit
from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.newton_budget import NewtonBudget
from taisoft.dynamics.results import StageResult
from taisoft.dynamics.substepping import LengthLimit, Substepping
from taisoft.errors import SimulationError
from tests.dynamics.contact_scenes import ground, material

DT, RELEASE = 0.02, 0.015  # [s]
TIGHT = {"precision": "f64", "newton_tolerance": 1e-11, "contact_tolerance": 1e-10}


def bar() -> ts.Scene:
    """A bar that is held at one end; the other is moved and released within the first step."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((4, 1, 1), (0.4, 0.1, 0.1)), material(young=2e4), name="bar")
    body.fix(lambda X: X[:, 0] < -0.19)
    body.move(lambda X: X[:, 0] > 0.19, lambda t: (0.0, -2.0 * t, 0.0) if t < RELEASE else None)
    return scene


def pressed() -> ts.Scene:
    """A cube that is pressed on the ground until its upper side is released."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((1, 1, 1), (0.2, 0.2, 0.2)), material(), name="cube", position=(0, 0.101, 0))
    body.move(lambda X: X[:, 1] > 0.09, lambda t: (0.0, -0.1 * t, 0.0) if t < RELEASE else None)
    scene.add_obstacle(ground(), name="ground", friction=0.3)
    return scene


@pytest.fixture(scope="module", params=["implicit_euler", "bdf2", "implicit_midpoint", "contacts"])
def shared_sim(request):
    contacts = request.param == "contacts"
    integrator = "implicit_euler" if contacts else request.param
    with ts.Simulator(pressed() if contacts else bar(), DT, integrator, **TIGHT) as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    shared_sim.dt = DT
    shared_sim.reset()
    return shared_sim


def by(*names: str):
    """Run a test with these simulators only."""
    return pytest.mark.parametrize("shared_sim", names, indirect=True)


def check_retry(sim, retry) -> None:
    """retry: makes the first try bad. The step must equal two half ones, and count the iterations of both tries."""
    sim.dt = DT / 2
    reports = [sim.step() for _ in range(2)]
    x, v = sim.positions(), sim.velocities()
    sim.dt = DT
    sim.reset()
    reports.append(sim.step())
    assert reports[-1].substeps == 1 and np.abs(sim.positions() - x).max() > 1e-6  # [m]
    sim.reset()
    retry()
    report = sim.step()
    assert report.converged and report.substeps == 2 and sim.step_count == 1 and sim.time == DT
    assert report.newton_iterations >= sum(one.newton_iterations for one in reports) - 1
    assert np.abs(sim.positions() - x).max() < 1e-9 and np.abs(sim.velocities() - v).max() < 1e-7


def test_a_step_that_does_not_converge_is_cut_into_substeps(sim, monkeypatch):
    solve, results = implicit.solve, []

    def first_unconverged(system, stage):
        results.append(solve(system, stage))
        # `unbalanced` of a discarded try must not reach the report
        bad = {"converged": False, "unbalanced": (0.5, "body 'bar'")} if len(results) == 1 else {}
        return replace(results[-1], **bad)

    check_retry(sim, lambda: monkeypatch.setattr(implicit, "solve", first_unconverged))


@pytest.mark.parametrize("limit", [3, 6])
def test_a_step_ends_at_its_bound_of_iterations(sim, monkeypatch, limit):
    """No tet inverts, what is prescribed moves on, and the report names a node and what acts there."""
    (body,), sim.dt = sim.scene.bodies, DT / 2
    monkeypatch.setattr(NewtonBudget, "limit", limit)
    sim.set_state(velocities=30.0 * np.random.default_rng(0).standard_normal(sim.positions().shape))
    report, moved = sim.step(), body.constraints[-1]
    assert not report.converged and 0 < report.newton_iterations <= limit and report.n_inverted == 0 and sim.time == sim.dt
    displacement = (sim.positions() - body.rest_positions - body.position)[moved.nodes]
    assert np.abs(displacement - moved.path(sim.dt)).max() < 1e-12
    assert "least balanced is node " in report.problems[0] and f" of body '{body.name}', between " in report.problems[0]


def patch_end(patch, events: dict, measure: str = "relative_penetration") -> list:
    """Patch the measurement at the end of a substep. events: by number of the call, an exception, or a value of the measure."""
    calls, end = [], ContactStep.end

    def patched(contact, time, dt):
        depth = end(contact, time, dt)
        calls.append((time, dt))
        event = events.get(len(calls))
        if isinstance(event, Exception):
            raise event
        if event is not None:
            setattr(contact, measure, event)
        return depth

    patch.setattr(ContactStep, "end", patched)
    return calls


@by("contacts")
@pytest.mark.parametrize("measure, depth", [("relative_penetration", 1.0), ("crossing", 3e-3)])
def test_a_step_that_ends_too_deep_is_retried(sim, monkeypatch, measure, depth):
    calls = []
    check_retry(sim, lambda: calls.append(patch_end(monkeypatch, {1: depth}, measure)))
    assert calls == [[(DT, DT), (DT / 2, DT / 2), (DT, DT)]] and sim.contact_force("ground")[1] < 0.0


@by("implicit_euler", "contacts")
@pytest.mark.parametrize("call, error", [(1, ts.SimulationError("no room")), (3, KeyboardInterrupt())])
def test_a_failed_step_leaves_the_state_before_it(sim, monkeypatch, call, error):
    """In the first try, after the release, and Ctrl-C in the second substep of the second try; prescribed nodes, too."""
    x, v, solve, calls = sim.positions(), sim.velocities(), implicit.solve, []

    def failing(system, stage):
        calls.append(stage)
        if len(calls) == call:
            raise error
        return replace(solve(system, stage), converged=False)

    with monkeypatch.context() as patch:
        patch.setattr(implicit, "solve", failing)
        with pytest.raises(type(error)):
            sim.step()
    assert np.array_equal(sim.positions(), x) and np.array_equal(sim.velocities(), v)
    assert sim.time == 0.0 and sim.step_count == 0
    sim.set_state(velocities=np.ones_like(v))  # 0 on axes that are still constrained
    for body in sim.scene.bodies:
        now = sim.velocities(body.name)
        assert not any(now[np.ix_(c.nodes, np.flatnonzero(c.axes))].any() for c in body.constraints)
    sim.set_state(velocities=v)
    sim.step()
    first = sim.positions()
    sim.reset()
    sim.step()
    assert np.abs(sim.positions() - first).max() < 1e-9  # [m], as of a new simulator


STEP = 0.02  # [s]; in the second step a quarter of it is rounded down


def longer_than(length: float):
    return lambda time, dt: dt > length


class FakeStepper:
    """Stepper, simulation state and contacts at once: x is the time reached. What is not defined does nothing and measures 0.

    Tests set when something happens, as functions of a substep's start and length.
    """

    is_linear = none_cross = is_stuck = False
    relative_penetration = crossing = x = 0.0
    step_count, closing_ratio = 4, 10.0

    def __init__(self):
        self.contact = self.paths = self.measures = self.simulation = self.now = self.start = self
        self.taken, self.kept, self.held_back, self.retry_starts = [], [], [], []
        self.converges = lambda time, dt: True
        self.depth = self.left_path = self.has_new_contacts = self.passes = self.fails = lambda time, dt: 0.0

    def __getattr__(self, name: str):
        return lambda *args, **given: 0.0

    def measure_start(self, time, dt):
        return 0.0, 0.0

    def begin_step(self):
        self.first = self.x

    def return_to_first(self):
        self.x, self.kept = self.first, []

    def take_substep(self, time, dt):
        assert time == pytest.approx(self.x)
        self.before = self.x
        self.set_state(time + dt, (time, dt))
        self.taken.append((time, dt))
        good = self.converges(time, dt) and not self.fails(time, dt)
        return StageResult(3, 10, 1e-6 if good else 0.1, good, False)

    def undo_substep(self, discard_impulses=False):
        self.x = self.before
        self.kept.pop()

    copy_nodes_from = undo_substep

    def retry_substep(self, time, dt, start):
        self.retry_starts.append(start)
        return self.take_substep(time, dt)

    def state(self):
        return self.x, self.kept[-1]

    def set_state(self, x, last):
        self.x = x
        self.kept.append(last)

    def left_searched(self, x_start):
        return self.left_path(*self.kept[-1])

    def find(self, as_searched=False):
        return self.passes(*(self.searched if as_searched else self.kept[-1]))

    def hold_back_paths(self):
        self.held_back.append(self.kept[-1])
        return True

    def search_along_path(self, time, dt):
        self.searched = time, dt
        return self.has_new_contacts(time, dt)

    def end(self, time, dt):
        self.relative_penetration = self.depth(*self.kept[-1])


@pytest.fixture
def stepper():
    return FakeStepper()


def take(stepper: FakeStepper, substepping: Substepping | None = None) -> tuple[list[float], StageResult]:
    """Take the next step. Return the lengths of its substeps, which must be contiguous and add up to the step, and its result."""
    start, stepper.taken, stepper.kept = stepper.x, [], []
    result = (substepping or Substepping(stepper)).step(start, STEP)
    times, lengths = np.transpose(stepper.kept)
    assert np.allclose(times - start, np.cumsum(lengths) - lengths) and np.isclose(lengths.sum(), STEP)
    return lengths.tolist(), result


def test_a_step_that_does_not_converge_is_retried_until_that_does_not_help(stepper):
    substepping, stepper.converges = Substepping(stepper), lambda time, dt: dt <= 0.5 * STEP
    lengths, result = take(stepper, substepping)
    assert [dt for _, dt in stepper.taken] == pytest.approx([STEP, STEP / 2, STEP / 2]) and result.newton_iterations == 9
    assert result.converged and substepping.may_retry and len(lengths) == substepping.substeps == 2
    stepper.converges = longer_than(STEP)
    lengths, result = take(stepper, substepping)
    assert [dt for _, dt in stepper.taken] == pytest.approx([STEP, *[STEP / 2] * 2, *[STEP / 4] * 4, STEP])
    assert substepping.substeps == 1 and not result.converged and not substepping.may_retry and lengths == [STEP]
    take(stepper, substepping)
    assert len(stepper.taken) == 1
    stepper.converges = longer_than(0.0)
    take(stepper, substepping)
    assert substepping.may_retry
    stepper.is_linear, stepper.converges = True, longer_than(STEP)  # linear steps are not retried
    assert not take(stepper, substepping)[1].converged and len(stepper.taken) == 1


@pytest.mark.parametrize(
    "faults, length, attempts",
    [
        (["depth"], STEP / 8, 1),  # it ends deep
        (["left_path"], STEP / 4, 1),  # it was faster than known when the step was cut
        (["left_path", "has_new_contacts"], STEP / 2, 4),  # each path that is searched has unknown contacts
        (["passes"], STEP / 2, 9),  # something passes through something whatever contacts are added,
        (["passes", "fails"], STEP / 2, 1),  # which is not tried again with equations that cannot be solved
    ],
)
def test_a_substep_with_a_fault_is_repeated_and_then_halved(stepper, faults, length, attempts):
    for fault in faults:
        setattr(stepper, fault, longer_than(length))
    substepping = Substepping(stepper)
    lengths, result = take(stepper, substepping)
    assert max(lengths) == pytest.approx(length) and result.converged and not stepper.held_back
    assert sum(dt == STEP for _, dt in stepper.taken) == attempts
    assert result.newton_iterations == 3 * len(stepper.taken) and substepping.substeps == len(lengths)


def test_the_number_of_undone_substeps_is_bounded(stepper):
    stepper.depth = lambda time, dt: 1.0 + time  # always deeper
    lengths, _ = take(stepper)
    assert 0 < len(stepper.taken) - len(lengths) <= 20 and stepper.relative_penetration > 1.0


@pytest.mark.parametrize(
    "fault, lengths", [("left_path", [STEP]), ("depth", [STEP / 2, STEP / 2]), ("passes", [STEP / 2, STEP / 2])]
)
def test_the_rest_of_a_step_without_iterations_is_held_back(stepper, fault, lengths):
    """A substep that was too fast to be kept is part of the rest; one with other faults is the last, not halved again."""
    setattr(stepper, fault, longer_than(STEP / 4))
    stepper.is_spent, stepper.converges = lambda: len(stepper.taken) > (fault != "left_path"), lambda time, dt: False
    stepper.hold_substep = lambda time, dt: stepper.set_state(time + dt, (time, dt)) or StageResult(0, 0, 0.0, False, False)
    substepping = Substepping(stepper)
    assert take(stepper, substepping)[0] == pytest.approx(lengths)
    assert len(stepper.taken) == len(lengths) and not substepping.may_retry


@pytest.mark.parametrize("attempts, faults", [(2, ["left_path", "has_new_contacts"]), (4, ["passes"])])
def test_a_substep_that_met_unknown_contacts_is_repeated_with_them(stepper, attempts, faults):
    for fault in faults:
        setattr(stepper, fault, lambda time, dt: len(stepper.taken) <= attempts)
    lengths, result = take(stepper)
    assert stepper.taken == [(0.0, STEP)] * (attempts + 1) and lengths == [STEP] and result.converged
    assert stepper.retry_starts == [(0.0, STEP)] * attempts  # each starts from the result before
    assert result.newton_iterations == 3 * (attempts + 1)


def test_longer_substeps_are_tried_ever_more_seldom():
    """The limit is half of a failed length, and doubles after as many substeps as its patience; a snapshot holds its state."""
    limit, waits = LengthLimit(), []
    limit.keep(0.5 * STEP, STEP)
    assert limit.longest == np.inf
    for _ in range(5):
        limit.undo(0.8 * STEP, again=False)
        waits.append(limit.patience)
        for _ in range(limit.patience):
            assert limit.longest == 0.4 * STEP
            kept, limit = limit.snapshot(), LengthLimit()
            limit.restore(kept)
            assert np.array_equal(limit.snapshot(), kept)
            limit.keep(0.4 * STEP, STEP)
        assert limit.is_trial and limit.longest == 0.8 * STEP
    assert waits == [2, 4, 8, 8, 8]
    patience = limit.patience
    limit.undo(0.8 * STEP, again=True)
    for _ in range(patience + 1):  # the last is half of the trial's length, which shows nothing
        limit.keep(0.4 * STEP, STEP)
    assert limit.is_trial and limit.patience == patience
    limit.keep(0.8 * STEP, STEP)
    assert not limit.is_trial and limit.patience == patience // 2
    limit.keep(STEP, STEP)
    assert limit.longest == np.inf and limit.patience == 1


def test_what_passes_in_spite_of_all_is_held_back_and_reported(stepper):
    stepper.passes = lambda time, dt: True
    _, result = take(stepper)
    assert stepper.held_back == stepper.kept and not result.converged
    assert len(stepper.taken) < 30 * len(stepper.kept)


def test_an_error_in_a_retry_keeps_the_first_result(stepper):
    def fails(time, dt):
        if dt < STEP and time > 0.0:
            raise SimulationError("not finite")
        return False

    stepper.converges = fails
    lengths, result = take(stepper)
    assert not result.converged and lengths == [STEP]
