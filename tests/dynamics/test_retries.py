"""Implicit steps that are done again, without and with contacts:

* a step that does not converge, or ends too deep, is retried from its start with twice as many substeps, and prescribed nodes
  that it released are prescribed again; the result equals that many steps, and the report counts the iterations of all attempts;
* where a step fails, the state is that before it;
* an implicit substep that penetrates is searched again along its path;
* a run may end at the end of a path.
"""

from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import implicit
from taisoft.dynamics.contact import ContactStep
from tests.dynamics.contact_scenes import ground, material

DT, RELEASE, END = 0.02, 0.015, 0.08  # [s]


def bar_scene() -> ts.Scene:
    """A bar that is held at one end; the other is moved and released within the first step."""
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((4, 1, 1), (0.4, 0.1, 0.1)), material(young=2e4), name="bar")
    bar.fix(lambda X: X[:, 0] < -0.19)
    bar.move(lambda X: X[:, 0] > 0.19, lambda t: (0.0, -2.0 * t, 0.0) if t < RELEASE else None)
    return scene


def circle(t: float):
    """Pose of an obstacle out of reach [m]."""
    if t > END + 1e-9:
        raise ValueError("the path has ended")
    return (np.sin(t), 0.0, 0.0), np.eye(3)


def contact_scene() -> ts.Scene:
    """A cube that is pressed on the ground until its upper side is released, and a ball out of reach."""
    scene = ts.Scene()
    cube = scene.add_body(ts.box_mesh((1, 1, 1), (0.2, 0.2, 0.2)), material(), name="cube", position=(0, 0.101, 0))
    cube.move(lambda X: X[:, 1] > 0.09, lambda t: (0.0, -0.1 * t, 0.0) if t < RELEASE else None)
    scene.add_obstacle(ground(), name="ground", friction=0.3)
    scene.add_obstacle(ts.Sphere((0, 9, 0), 0.5), name="ball", path=circle)
    return scene


@pytest.fixture(scope="module", params=["implicit_euler", "bdf2", "implicit_midpoint"])
def bar_sim(request):
    with ts.Simulator(bar_scene(), dt=DT, integrator=request.param, precision="f64", newton_tolerance=1e-10) as sim:
        yield sim


@pytest.fixture
def bar(bar_sim):
    bar_sim.dt = DT
    bar_sim.reset()
    return bar_sim


def by(*integrators: str):
    """Run a test of the bar with these integrators only."""
    return pytest.mark.parametrize("bar_sim", integrators, indirect=True)


@pytest.fixture(scope="module")
def contact_sim():
    with ts.Simulator(contact_scene(), dt=DT, precision="f64", newton_tolerance=1e-11, contact_tolerance=1e-10) as sim:
        yield sim


@pytest.fixture
def sim(contact_sim):
    contact_sim.dt = DT
    contact_sim.reset()
    return contact_sim


def halves(sim) -> tuple[list[ts.StepReport], np.ndarray, np.ndarray]:
    """Reports, positions and velocities of two half steps from the start, which is restored."""
    sim.dt = DT / 2
    reports = [sim.step() for _ in range(2)]
    x, v = sim.positions(), sim.velocities()
    sim.dt = DT
    sim.reset()
    return reports, x, v


def check_start(sim, x: np.ndarray, v: np.ndarray) -> None:
    """A first step that failed left the state as it was, prescribed nodes too; the next step is that of a new simulator."""
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
    assert np.abs(sim.positions() - first).max() < 1e-9  # [m]


# --- steps that do not converge -----------------------------------------------------------------------------------------------


def test_a_step_that_does_not_converge_is_cut_into_substeps(bar, monkeypatch):
    reports, x, v = halves(bar)
    whole = bar.step()
    assert whole.substeps == 1 and np.abs(bar.positions() - x).max() > 1e-4  # [m]
    bar.reset()
    solve, results = implicit.solve, []

    def first_unconverged(system, stage):
        results.append(solve(system, stage))
        # `unbalanced` of a discarded try must not reach the report
        bad = {"converged": False, "unbalanced": (0.5, "body 'bar'")} if len(results) == 1 else {}
        return replace(results[-1], **bad)

    monkeypatch.setattr(implicit, "solve", first_unconverged)
    report = bar.step()
    assert report.converged and report.substeps == 2 and bar.step_count == 1 and bar.time == DT
    assert report.newton_iterations == sum(r.newton_iterations for r in (whole, *reports))
    close = 1e-9 * np.abs(v).max()
    assert np.abs(bar.positions() - x).max() < close * DT and np.abs(bar.velocities() - v).max() < close


@by("implicit_euler")
@pytest.mark.parametrize("call, error", [(1, ts.SimulationError("no room")), (3, KeyboardInterrupt())])
def test_a_failed_step_leaves_the_state_before_it(bar, monkeypatch, call, error):
    """A failure in the first try, after the release, and Ctrl-C in the second substep of the second try."""
    before, solve, calls = (bar.positions(), bar.velocities()), implicit.solve, []

    def failing(system, stage):
        calls.append(stage)
        if len(calls) == call:
            raise error
        return replace(solve(system, stage), converged=False)

    with monkeypatch.context() as patch:
        patch.setattr(implicit, "solve", failing)
        with pytest.raises(type(error)):
            bar.step()
    check_start(bar, *before)


# --- steps with contacts ------------------------------------------------------------------------------------------------------


def patch_end(monkeypatch, events: dict, measure: str = "relative_penetration") -> list:
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

    monkeypatch.setattr(ContactStep, "end", patched)
    return calls


@pytest.mark.parametrize("measure, depth", [("relative_penetration", 1.0), ("crossing", 3e-3)])
def test_a_step_that_ends_too_deep_is_retried(sim, monkeypatch, measure, depth):
    reports, x, v = halves(sim)
    whole = sim.step()
    assert np.abs(sim.positions() - x).max() > 1e-6 and sim.contact_force("ground")[1] < -1.0  # it presses
    sim.reset()
    calls = patch_end(monkeypatch, {1: depth}, measure)
    report = sim.step()
    assert calls == [(DT, DT), (DT / 2, DT / 2), (DT, DT)] and report.max_penetration < 1e-9
    assert np.abs(sim.positions() - x).max() < 1e-8 and np.abs(sim.velocities() - v).max() < 1e-6
    work = [r.newton_iterations for r in (report, whole, *reports)]
    assert work[0] > max(work[1:])
    assert report.converged and report.substeps == 2 and sim.step_count == 1 and sim.time == DT


def test_a_failed_retry_leaves_the_state_before_the_step(sim, monkeypatch):
    before = sim.positions(), sim.velocities()
    with monkeypatch.context() as patch:
        patch_end(patch, {1: 1.0, 3: ts.SimulationError("no room")})
        with pytest.raises(ts.SimulationError, match="no room"):
            sim.step()
    check_start(sim, *before)


def test_a_penetrating_substep_is_searched_along_its_path(sim, monkeypatch):
    """The search finds no other contacts, so the substep is kept."""
    first = sim.step()
    expected, searched, search = sim.positions(), [], ContactStep.search_along_path
    sim.reset()
    monkeypatch.setattr(ContactStep, "penetrates_deeper", lambda contact, time, dt, before: True)
    monkeypatch.setattr(ContactStep, "search_along_path", lambda contact, *at: searched.append((at, search(contact, *at))))
    report = sim.step()
    assert searched == [((0.0, DT), False)] and report.newton_iterations == first.newton_iterations
    assert np.array_equal(sim.positions(), expected) and report.max_penetration == first.max_penetration


def test_a_path_that_ends_with_the_run(sim):
    result = sim.run(END, fps=None)
    assert (result.status, result.problems, result.steps) == ("ok", [], 4)
    assert sim.deepest_overlap() is None and sim.intersecting_triangles() == []
    with pytest.raises(ts.SimulationError, match="the path has ended"):
        sim.detect_contacts()  # swept by a step beyond the path
