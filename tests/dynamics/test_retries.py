"""Implicit steps that are done again, without and with contacts:

* a part of a step that does not converge, or whose way is not free, is halved, and prescribed nodes that it released are
  prescribed again; the result equals that many steps, and the report counts the iterations of all attempts;
* what a way meets becomes a contact, and the stage is solved on; what stays blocked is held back and reported;
* where a step fails, the state is that before it;
* where halving does not help, it ends, and is tried again once it may help (`PartLength`).
"""

from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import implicit_stages
from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.contact_measures import ContactMeasures
from taisoft.dynamics.contact_paths import ContactPaths
from taisoft.dynamics.contact_search import ContactSearch
from taisoft.dynamics.implicit import ImplicitStepper
from taisoft.dynamics.newton_budget import NewtonBudget
from taisoft.dynamics.part_check import BLOCKED, FREE, MAX_PASSAGES, MET, PartCheck
from taisoft.dynamics.part_length import PARTS, PartLength
from tests.dynamics.contact_scenes import ground, material
from tests.dynamics.scenes import dynamics

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
def shared_sim(request, taken_path):
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
    solve, results = implicit_stages.solve, []

    def first_unconverged(system, stage):
        results.append(solve(system, stage))
        # `unbalanced` of a discarded try must not reach the report
        bad = {"converged": False, "unbalanced": (0.5, "body 'bar'")} if len(results) == 1 else {}
        return replace(results[-1], **bad)

    check_retry(sim, lambda: monkeypatch.setattr(implicit_stages, "solve", first_unconverged))


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


def patch_ways(patch, ways: list[int]) -> list:
    """Let the next ways be these, and those after them free. Return the lengths of the parts whose ways are certified."""
    calls, certify = [], PartCheck.certify

    def patched(check, time, dt, start):
        calls.append(dt)
        certify(check, time, dt, start)
        return ways[len(calls) - 1] if len(calls) <= len(ways) else FREE

    patch.setattr(PartCheck, "certify", patched)

    return calls


@pytest.mark.gpu_path("contacts")
@by("contacts")
def test_a_step_whose_way_is_blocked_is_halved(sim, monkeypatch):
    calls = []
    check_retry(sim, lambda: calls.append(patch_ways(monkeypatch, [BLOCKED])))
    assert calls == [[DT, DT / 2, DT / 2]] and sim.contact_force("ground")[1] < 0.0


@by("contacts")
@pytest.mark.parametrize("measure, depth", [("relative_penetration", 1.0), ("crossing", 3e-3)])
def test_where_surfaces_cross_a_part_that_leads_deeper_is_halved(sim, monkeypatch, measure, depth):
    calls, end = [], PartCheck.end

    def too_deep_once(check, time, dt):
        calls.append((time, dt))
        end(check, time, dt)
        setattr(check, measure, depth if len(calls) == 1 else getattr(check, measure))

    def begin():
        monkeypatch.setattr(ContactPaths, "none_cross", property(lambda self: False))
        monkeypatch.setattr(PartCheck, "end", too_deep_once)

    check_retry(sim, begin)
    assert calls[0] == (DT, DT) and {dt for _, dt in calls[1:-1]} == {DT / 2} and calls[-1] == (DT, DT)


@by("contacts")
def test_where_surfaces_cross_unknown_contacts_are_met(sim, monkeypatch):
    """And a way that closes too fast even in the shortest part is refused."""
    monkeypatch.setattr(ContactPaths, "none_cross", property(lambda self: False))
    monkeypatch.setattr(ContactPaths, "leaves", lambda self, deviation: True)
    features, found = ContactSearch.found_features, []

    def unknown_at_first(search):
        found.append(features(search) | ({("unknown",)} if len(found) == 1 else set()))
        return found[-1]

    with monkeypatch.context() as patch:
        patch.setattr(ContactSearch, "found_features", unknown_at_first)
        report = sim.step()
    assert report.converged and report.substeps == 1 and len(found) == 4  # twice before and after the search of the way
    monkeypatch.setattr(PartCheck, "MAX_CLOSING_RATIO", -1.0)
    monkeypatch.setattr(ContactMeasures, "describe_fast_closing", lambda self, dt, parts: f"too fast for {dt} in {parts}")
    x = sim.positions()
    with pytest.raises(ts.SimulationError, match=f"^step 2: too fast for {DT} in {PARTS}$"):
        sim.step()
    assert np.array_equal(sim.positions(), x)


@by("contacts")
def test_what_a_way_meets_becomes_a_contact_of_the_same_part(sim, monkeypatch):
    """Each time the stage is solved on from the velocities reached, at most MAX_PASSAGES times; then it is halved."""
    first, begun = sim.step().newton_iterations, []
    x = sim.positions()
    sim.reset()
    begin = ImplicitStepper.solve_stage
    monkeypatch.setattr(ImplicitStepper, "solve_stage", lambda self, *given: begun.append(given[2]) or begin(self, *given))
    with monkeypatch.context() as patch:
        calls = patch_ways(patch, [MET] * 2)
        report = sim.step()
    assert calls == [DT] * 3 and report.converged and report.substeps == 1
    assert [start is None for start in begun] == [True, False, False] and report.newton_iterations < 3 * first
    assert np.abs(sim.positions() - x).max() < 1e-9
    sim.reset()
    calls = patch_ways(monkeypatch, [MET] * (MAX_PASSAGES + 1))
    assert sim.step().substeps == 2 and calls == [DT] * (MAX_PASSAGES + 1) + [DT / 2] * 2


@by("contacts")
def test_what_stays_blocked_is_held_back_and_reported(sim, monkeypatch):
    held = []
    monkeypatch.setattr(ContactPaths, "hold_back", lambda self, x_start: held.append(sim.time) or True)
    monkeypatch.setattr(PartCheck, "certify", lambda *_: BLOCKED)
    report = sim.step()
    assert not report.converged and report.substeps == len(held) == PARTS


@by("implicit_euler", "contacts")
@pytest.mark.parametrize("call, error", [(1, ts.SimulationError("no room")), (3, KeyboardInterrupt())])
def test_a_failed_step_leaves_the_state_before_it(sim, monkeypatch, call, error):
    """In the first try, after the release, and Ctrl-C in the second substep of the second try; prescribed nodes, too."""
    x, v, solve, calls = sim.positions(), sim.velocities(), implicit_stages.solve, []

    def failing(system, stage):
        calls.append(stage)
        if len(calls) == call:
            raise error
        return replace(solve(system, stage), converged=False)

    with monkeypatch.context() as patch:
        patch.setattr(implicit_stages, "solve", failing)
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


@pytest.mark.parametrize("ways, has_impact, n_previous", [([], True, 0), ([MET], True, 0), ([MET], False, 1)])
def test_an_impact_of_the_first_attempt_counts(monkeypatch, ways, has_impact, n_previous):
    """Those that are solved on from it have impulses from the start, but a multistep scheme must begin anew after the step."""
    with dynamics(pressed(), dt=DT, integrator="bdf2", **TIGHT) as made:
        calls = patch_ways(monkeypatch, ways)
        had_impact = property(lambda self: has_impact and not calls, lambda self, value: None)
        monkeypatch.setattr(ContactStep, "had_impact", had_impact, raising=False)
        made.advance(1)
        assert made.stepper.n_previous == n_previous and len(calls) == len(ways) + 1


def test_linearly_implicit_steps_are_not_halved_for_convergence(monkeypatch):
    solve = implicit_stages.solve
    monkeypatch.setattr(implicit_stages, "solve", lambda *given: replace(solve(*given), converged=False))
    with ts.Simulator(bar(), DT, "linearly_implicit_euler", precision="f64") as sim:
        assert [(report.substeps, report.converged) for report in (sim.step(), sim.step())] == [(1, False)] * 2


def test_an_error_in_a_part_halved_for_convergence_keeps_the_whole_step(monkeypatch):
    step = ImplicitStepper.solve_stage

    def fails(self, time, dt, start):
        if dt < 0.9 * DT and time > 0.0:
            raise ts.SimulationError("no motion was found")
        return replace(step(self, time, dt, start), converged=dt < 0.9 * DT)

    monkeypatch.setattr(ImplicitStepper, "solve_stage", fails)
    with ts.Simulator(bar(), DT, **TIGHT) as sim:
        report = sim.step()
        assert not report.converged and report.substeps == 1 and sim.time == DT


def take(length: PartLength, dt: float, free=lambda units: True, converged=lambda units: True) -> tuple[list[int], list[int]]:
    """Take a step of dt. Return the lengths of all parts that are tried and of those that are kept, in units of dt / PARTS."""
    tried, kept, left = [], [], PARTS
    while left:
        units = min(left, length.units(dt))
        tried.append(units)
        if length.should_halve(free(units), converged(units), units):
            length.halve(units, dt)
        else:
            length.keep(units, converged(units))
            kept.append(units)
            left -= units
    return tried, kept


def test_parts_that_fail_are_halved_until_that_does_not_help():
    """Then the rest is tried at once, and nothing is tried again until a part converges."""
    length, least = PartLength(), PartLength.LEAST_UNCONVERGED
    tried, kept = take(length, DT, converged=lambda units: units <= PARTS // 2)
    assert tried == [PARTS, PARTS // 2, PARTS // 2] and kept == tried[1:] and length.helps
    tried, kept = take(length, DT, converged=lambda units: False)
    assert kept == [least, PARTS - least] and len(tried) <= 2 + np.log2(PARTS / least) and not length.helps
    assert take(length, DT, converged=lambda units: False)[0] == [PARTS]
    assert take(length, DT)[0] == [PARTS] and length.helps


@pytest.mark.parametrize("most", [PARTS // 2, PARTS // 16, 1, 0])
def test_parts_whose_way_is_not_free_are_halved(most):
    """Down to the shortest, which is kept in any case. Longer ones are tried ever more seldom, whole steps again in the end."""
    length = PartLength()
    for _ in range(3):
        tried, kept = take(length, DT, free=lambda units: units <= most)
        assert sum(kept) == PARTS and max(kept) <= max(most, 1) and len(tried) - len(kept) <= 8 + len(kept) / 2
        again = PartLength()
        again.restore(length.snapshot())
        assert again == length
    while length.longest < np.inf:
        assert take(length, DT)[1] != []
    assert take(length, 2.0 * DT)[0] == [PARTS]
    length.halve(PARTS, DT)
    assert length.units(DT) == PARTS // 2 and length.units(100.0 * DT) == 1 and length.units(0.1 * DT) == PARTS


def test_what_is_not_finite_is_halved_without_its_impulses(monkeypatch):
    with dynamics(pressed(), dt=DT, **TIGHT) as made:
        step, problem = ImplicitStepper.solve_stage, made.contact.problem

        def broken(self, time, dt, start):
            result = step(self, time, dt, start)
            if dt == DT:
                problem.r.fill(np.nan)
                result = replace(result, residual=np.nan, converged=False, free=False)
            return result

        monkeypatch.setattr(ImplicitStepper, "solve_stage", broken)
        report = made.advance(1)
        assert report.converged and report.substeps == 2 and report.n_contacts > 0


def test_what_is_not_finite_is_halved_and_then_refused(monkeypatch):
    with ts.Simulator(bar(), DT, **TIGHT) as sim:
        x, step = sim.positions(), ImplicitStepper.solve_stage
        lengths = []

        def broken(self, time, dt, start):
            lengths.append(dt)
            result = step(self, time, dt, start)
            return replace(result, residual=np.nan, converged=False, free=False, imbalance="a node") if dt > limit else result

        monkeypatch.setattr(ImplicitStepper, "solve_stage", broken)
        limit = 0.3 * DT
        assert sim.step().converged and lengths[:3] == [DT, DT / 2, DT / 4]
        sim.reset()
        limit = 0.0
        with pytest.raises(ts.SimulationError, match="^step 1: a node$"):
            sim.step()
        assert lengths[-1] == DT / PARTS and np.array_equal(sim.positions(), x)
