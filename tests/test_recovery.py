"""Implicit steps that do not converge:

* one that does in two parts is that of two half steps, and says in how many parts it was taken and what all tries cost;
* one that does in none is done anew as it was, and told as not converged; the next ones are not tried in parts before one
  converges;
* nodes that it let go hold on again for the next try; a try in parts that fails is one that does not help; where the step fails,
  the state is that before it.
"""

import dataclasses

import numpy as np
import pytest
from retries import assert_is_before_first_step, assert_steps_as_new, state_of

import taisoft as ts
from taisoft.dynamics import implicit, substepping

DT = 0.05  # [s]
LEAD = 0.04  # [s]


@pytest.fixture(scope="module", params=["implicit_euler", "bdf2", "implicit_midpoint"])
def shared_sim(request):
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((4, 1, 1), (0.4, 0.1, 0.1)), ts.Material(young=2e4), name="bar")
    bar.fix(lambda X: X[:, 0] < -0.19)
    bar.move(lambda X: X[:, 0] > 0.19, lambda t: (0.0, -2.0 * t, 0.0) if t < LEAD else None)
    with ts.Simulator(scene, dt=DT, integrator=request.param, precision="f64", newton_tolerance=1e-10) as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    shared_sim.dt = DT
    shared_sim.reset()
    return shared_sim


def test_a_step_that_does_not_converge_is_taken_in_parts(sim, monkeypatch):
    sim.dt = DT / 2
    halves = [sim.step() for _ in range(2)]
    wanted = sim.positions(), sim.velocities()
    sim.dt = DT
    sim.reset()
    whole = sim.step()
    assert whole.substeps == 1 and np.abs(sim.positions() - wanted[0]).max() > 1e-3  # [m]
    sim.reset()
    solve, results = implicit.solve, []

    def stopping(*arguments, **named):
        results.append(solve(*arguments, **named))
        bad = {"converged": False, "unbalanced": (0.5, "body 'bar'")} if len(results) == 1 else {}  # of a try that does not count
        return dataclasses.replace(results[-1], **bad)

    monkeypatch.setattr(implicit, "solve", stopping)
    report = sim.step()
    assert report.converged and report.substeps == 2 and sim.step_count == 1 and sim.time == DT
    assert report.newton_iterations == sum(r.newton_iterations for r in (whole, *halves))
    close = 1e-9 * np.abs(wanted[1]).max()
    assert np.abs(sim.positions() - wanted[0]).max() < close * DT and np.abs(sim.velocities() - wanted[1]).max() < close


def test_one_that_never_does_is_told(sim, monkeypatch):
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    result = sim.run(DT, fps=None)
    report = result.step_reports[-1]
    assert not report.converged and report.substeps == 1 and result.status == "degraded"
    assert report.newton_iterations == 2 * (1 + 2 + 4 + 1) and sim.step_count == 1  # in 1, 2 and 4 parts, and again in one
    x = sim.positions()
    assert sim.step().newton_iterations == 2  # parts did not help in the step before
    monkeypatch.undo()
    assert sim.step().converged
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    assert sim.step().newton_iterations == 16
    sim.reset()
    monkeypatch.setattr(substepping, "RETRIES", 1)
    sim.step()
    assert np.abs(sim.positions() - x).max() < 1e-12  # [m], as if there had been no other try


def failing_at(monkeypatch, call: int, error: BaseException):
    """Have the solver raise at its call of that number."""
    solve, calls = implicit.solve, []

    def failing(*arguments, **named):
        calls.append(arguments)
        if len(calls) == call:
            raise error
        return solve(*arguments, **named)

    monkeypatch.setattr(implicit, "solve", failing)


@pytest.mark.parametrize("call, error", [(1, ts.SimulationError("no room")), (3, KeyboardInterrupt())])
def test_where_a_step_fails_the_state_is_that_before_it(sim, monkeypatch, call, error):
    """The first try, after nodes were let go, and Ctrl-C in the second part of the second one."""
    before = state_of(sim)
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    failing_at(monkeypatch, call, error)
    with pytest.raises(type(error)):
        sim.step()
    assert_is_before_first_step(sim, before)
    monkeypatch.undo()
    assert_steps_as_new(sim, 1e-12)


def test_where_a_try_in_parts_fails_the_step_is_told_as_not_converged(sim, monkeypatch):
    monkeypatch.setattr(implicit, "MAX_NEWTON", 2)
    monkeypatch.setattr(substepping, "RETRIES", 1)
    sim.step()
    wanted = sim.positions()
    sim.reset()
    monkeypatch.setattr(substepping, "RETRIES", 2)
    failing_at(monkeypatch, 3, ts.SimulationError("spoilt"))
    report = sim.step()
    assert not report.converged and report.substeps == 1 and np.abs(sim.positions() - wanted).max() < 1e-12  # [m]
    assert any(sim._dynamics.state.dirichlet.released())
