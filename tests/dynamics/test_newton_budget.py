"""A budget of wall time for implicit steps, with a clock that counts how often it is looked at:

* a step ends at its budget, after one Newton iteration at least, says so and reports residual and last correction; one that needs
  less is that without a budget, bit by bit; time that kernels compile does not count;
* nothing is tried again then: the rest of a step is one part; frictional problems end within their linear solves;
* with any budget nothing crosses, tets do not invert, no energy appears; with some, things come to rest where they would;
* a run with such steps is degraded, and its reports count them.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import implicit_stages, newton_budget
from taisoft.dynamics.friction import Friction
from taisoft.dynamics.newton_budget import NewtonBudget
from taisoft.output.report import extremes
from tests.dynamics.contact_scenes import SIDE, cube, ground, material

DT, LOOKS = 0.01, (0, 3, 10)  # [s]; of the budgets


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """A clock that goes on by 1 s at each look."""
    looks = itertools.count()
    monkeypatch.setattr(NewtonBudget, "clock", lambda _self: next(looks))


def pile() -> ts.Scene:
    """Two cubes, one above the other, that fall on the ground obliquely."""
    scene = ts.Scene()
    for k, velocity in enumerate(((1.0, -2.0, 0.0), (0.0, -4.0, 1.0))):
        place = (0.02 * k, 0.01 + 1.2 * SIDE * k, 0.01 * k)
        scene.add_body(cube(2, seed=k), material(), name=f"cube {k}", position=place, velocity=velocity)
    scene.add_obstacle(ground(), name="ground", friction=0.5)
    return scene


@pytest.fixture(scope="module")
def shared_sim():
    with ts.Simulator(pile(), DT, precision="f64") as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    shared_sim.budget, shared_sim.dt = None, DT
    shared_sim.reset()
    return shared_sim


def test_a_step_ends_at_its_budget_and_says_so(sim):
    sim.run(0.03, fps=None)
    x, v = sim.positions(), sim.velocities()
    exact = sim.step()
    end = sim.positions()
    assert exact.newton_iterations > 3 and exact.converged and (exact.on_budget, exact.last_correction) == (0, 0.0)
    errors = []
    for looks in (0, 2):
        sim.budget = looks
        sim.set_state(x, v)
        report = sim.step()
        errors.append(np.linalg.norm(sim.positions() - end, axis=1).max())
        assert report.on_budget == 1 and not report.converged and "on budget" in repr(report)
        assert 1 <= report.newton_iterations < exact.newton_iterations and report.residual > 1e-8
        assert f"on budget: Newton stopped after {report.newton_iterations} iterations" in report.problems[0]
        assert f"relative residual of {report.residual:.2e}" in report.problems[0]
        assert 0.1 * errors[-1] < report.last_correction < SIDE, "it shows the size of the error"
    assert errors[1] <= errors[0]


def test_a_budget_that_suffices_changes_nothing(sim):
    found = []
    for sim.budget in (None, 1e6):
        sim.reset()
        report = sim.run(0.05, fps=None)
        assert report.status == "ok" and not any(step.on_budget for step in report.step_reports)
        found.append(sim.positions())
    assert np.array_equal(*found)


def test_compiling_takes_none_of_it(monkeypatch):
    monkeypatch.setattr(newton_budget, "compile_clock", lambda: 7.0)
    monkeypatch.setattr("time.perf_counter", lambda: 10.0)
    assert newton_budget.computing_time() == 3.0


@pytest.mark.parametrize("looks", LOOKS)
def test_nothing_crosses_inverts_or_gains_energy(sim, looks):
    sim.run(0.5, fps=None)
    kinetic, height = sim.energies().kinetic, sim.positions()[:, 1].mean()
    sim.reset()
    total, sim.budget, n = sim.energies().total, looks, 0
    while sim.time < 0.5:
        report = sim.step()
        n += report.on_budget
        assert report.n_inverted == 0 and len(sim.intersecting_triangles()) == 0
        assert sim.positions()[:, 1].min() > -1e-3 * SIDE
        assert (now := report.kinetic + report.elastic + report.gravity) <= total + 1e-3, "[J], of about 10"
        total = now
    assert n > 5 and report.kinetic < kinetic + 1e-2
    assert looks == 0 or abs(sim.positions()[:, 1].mean() - height) < 0.2 * SIDE, "without any time a cube may slide off"


def test_the_rest_of_a_step_is_one_part(sim, monkeypatch):
    """The first try fails, so it is halved; then time is out, and the second half is not halved, though it fails, too."""
    solve, late = implicit_stages.solve, []

    def failing(system, stage):
        late.append(stage.dt)
        return replace(solve(system, stage), converged=False)

    monkeypatch.setattr(implicit_stages, "solve", failing)
    monkeypatch.setattr(NewtonBudget, "clock", lambda _self: 2.0 * (len(late) > 1))
    sim.budget = 1.0
    report = sim.step()
    assert late[0] == DT and set(late[1:]) == {0.5 * DT} and report.substeps == 2 and report.on_budget and sim.time == DT


def test_frictional_problems_end_within_their_solves(sim):
    sim.run(0.1, fps=None)
    x, v = sim.positions(), sim.velocities()
    counts = []
    for sim.budget in (None, 0):
        sim.set_state(x, v)
        report = sim.step()
        counts.append(report.linear_iterations / report.newton_iterations)
    assert counts[1] < counts[0] or report.newton_iterations == 1
    assert report.contact_iterations <= Friction.LEAST_SOLVES * 2


@pytest.mark.parametrize("integrator", ["linearly_implicit_euler", "bdf2"])
def test_other_integrators(integrator):
    scene = pile()
    with ts.Simulator(scene, DT, integrator, precision="f64", budget=1) as sim:
        report = sim.run(0.3, fps=None)
        assert np.isfinite(sim.positions()).all() and len(sim.intersecting_triangles()) == 0
        assert sum(step.on_budget for step in report.step_reports) > 3
        assert max(step.kinetic for step in report.step_reports) < 1.1 * report.step_reports[0].kinetic + 1.0


def test_a_run_counts_the_steps_that_ended_on_budget(sim):
    sim.budget = 1
    report = sim.run(0.1, fps=None)
    cut = [step for step in report.step_reports if step.on_budget]
    (text,) = [problem for problem in report.problems if "on budget" in problem]
    assert report.status == "degraded" and cut and not any("did not converge" in problem for problem in report.problems)
    assert text.startswith(f"{len(cut)} of {report.steps} steps ended on budget; the worst, at t = ")
    assert f"relative residual of {max(step.residual for step in cut):.2e}" in text
    assert f"up to {max(step.last_correction for step in cut):.2g} m" in text
    assert f"{sum(step.last_correction for step in cut):.2g} m together" in text
    found = extremes(report.step_reports)
    assert found["ended_on_budget"] == len(cut) and found["last_correction"]["max"] == max(step.last_correction for step in cut)
    assert {"on_budget", "last_correction"} <= report.to_dicts()[0].keys()
