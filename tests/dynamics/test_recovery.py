"""Implicit steps that do not converge:

* a step that converges in two substeps equals two half steps; its report counts substeps and the iterations of all tries;
* a step that never converges is repeated whole and reported as not converged; the following steps are not cut until one
  converges;
* nodes released by a failed try are prescribed again in the next one; a failed retry only ends the retries; if the step itself
  fails, the state is the one before it.
"""

import dataclasses

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import implicit, substepping
from tests.dynamics.retries import assert_is_before_first_step, assert_steps_as_new, state_of

DT = 0.05  # [s]
RELEASE = 0.04  # [s]


@pytest.fixture(scope="module", params=["implicit_euler", "bdf2", "implicit_midpoint"])
def shared_sim(request):
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((4, 1, 1), (0.4, 0.1, 0.1)), ts.Material(young=2e4), name="bar")
    bar.fix(lambda X: X[:, 0] < -0.19)
    bar.move(lambda X: X[:, 0] > 0.19, lambda t: (0.0, -2.0 * t, 0.0) if t < RELEASE else None)
    with ts.Simulator(scene, dt=DT, integrator=request.param, precision="f64", newton_tolerance=1e-10) as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    shared_sim.dt = DT
    shared_sim.reset()
    return shared_sim


def test_a_step_that_does_not_converge_is_cut_into_substeps(sim, monkeypatch):
    sim.dt = DT / 2
    halves = [sim.step() for _ in range(2)]
    expected = sim.positions(), sim.velocities()
    sim.dt = DT
    sim.reset()
    whole = sim.step()
    assert whole.substeps == 1 and np.abs(sim.positions() - expected[0]).max() > 1e-3  # [m]
    sim.reset()
    solve, results = implicit.solve, []

    def first_unconverged(*arguments, **named):
        results.append(solve(*arguments, **named))
        # `unbalanced` of a discarded try must not reach the report
        bad = {"converged": False, "unbalanced": (0.5, "body 'bar'")} if len(results) == 1 else {}
        return dataclasses.replace(results[-1], **bad)

    monkeypatch.setattr(implicit, "solve", first_unconverged)
    report = sim.step()
    assert report.converged and report.substeps == 2 and sim.step_count == 1 and sim.time == DT
    assert report.newton_iterations == sum(r.newton_iterations for r in (whole, *halves))
    close = 1e-9 * np.abs(expected[1]).max()
    assert np.abs(sim.positions() - expected[0]).max() < close * DT and np.abs(sim.velocities() - expected[1]).max() < close


def test_a_step_that_never_converges_is_reported(sim, monkeypatch):
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    result = sim.run(DT, fps=None)
    report = result.step_reports[-1]
    assert not report.converged and report.substeps == 1 and result.status == "degraded"
    assert report.newton_iterations == 2 * (1 + 2 + 4 + 1) and sim.step_count == 1  # 1, 2 and 4 substeps, then whole again
    x = sim.positions()
    assert sim.step().newton_iterations == 2  # not cut, since substeps did not help in the step before
    monkeypatch.undo()
    assert sim.step().converged
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    assert sim.step().newton_iterations == 16
    sim.reset()
    monkeypatch.setattr(substepping, "RETRIES", 1)
    sim.step()
    assert np.abs(sim.positions() - x).max() < 1e-12  # [m], as without retries


def fail_at(monkeypatch, call: int, error: BaseException):
    """Make the solver raise at its call of that number."""
    solve, calls = implicit.solve, []

    def failing(*arguments, **named):
        calls.append(arguments)
        if len(calls) == call:
            raise error
        return solve(*arguments, **named)

    monkeypatch.setattr(implicit, "solve", failing)


@pytest.mark.parametrize("call, error", [(1, ts.SimulationError("no room")), (3, KeyboardInterrupt())])
def test_a_failed_step_leaves_the_state_before_it(sim, monkeypatch, call, error):
    """A failure in the first try, after the release, and Ctrl-C in the second substep of the second try."""
    before = state_of(sim)
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    fail_at(monkeypatch, call, error)
    with pytest.raises(type(error)):
        sim.step()
    assert_is_before_first_step(sim, before)
    monkeypatch.undo()
    assert_steps_as_new(sim, 1e-12)


def test_a_step_whose_retry_fails_is_reported_as_not_converged(sim, monkeypatch):
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    monkeypatch.setattr(substepping, "RETRIES", 1)
    sim.step()
    expected = sim.positions()
    sim.reset()
    monkeypatch.setattr(substepping, "RETRIES", 2)
    fail_at(monkeypatch, 3, ts.SimulationError("no room"))
    report = sim.step()
    assert not report.converged and report.substeps == 1 and np.abs(sim.positions() - expected).max() < 1e-12  # [m]
    sim.set_state(velocities=np.ones_like(expected))  # stays 0 on constrained axes
    assert sim.velocities()[sim.scene.body("bar").rest_positions[:, 0] > 0.19].all(), "the right end is released"
