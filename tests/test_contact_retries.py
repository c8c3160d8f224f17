"""Steps with contacts that are done again, and paths that end:

* a step that ended too deep starts again from its own start in twice as many parts, led nodes that it had let go included; the
  result is that of so many steps, its iterations are those of all tries;
* where a try fails, the state is that before the step;
* a run whose paths end with it ends as any other, and its end is judged.
"""

import numpy as np
import pytest

import taisoft as ts

DT, RELEASE, END = 0.02, 0.015, 0.08  # [s]


def sink(t: float):
    """Of the led nodes [m]."""
    return (0.0, -0.1 * t, 0.0) if t < RELEASE else None


def circle(t: float):
    """Of an obstacle that nothing meets [m]."""
    if t > END + 1e-9:
        raise ValueError("the path has ended")
    return (np.sin(t), 0.0, 0.0), np.eye(3)


@pytest.fixture(scope="module")
def shared_sim():
    scene = ts.Scene()
    cube = scene.add_body(ts.box_mesh((1, 1, 1), (0.2, 0.2, 0.2)), ts.Material(young=1e5), name="cube", position=(0, 0.101, 0))
    cube.move(lambda X: X[:, 1] > 0.09, sink)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.3)
    scene.add_obstacle(ts.Sphere((0, 9, 0), 0.5), name="ball", path=circle)
    with ts.Simulator(scene, dt=DT, precision="f64", newton_tolerance=1e-11, contact_tolerance=1e-10) as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    shared_sim.dt = DT
    shared_sim.reset()
    return shared_sim


def patch_end(sim, monkeypatch, events: dict) -> list:
    """events: by the number of the call of the step's look at its end, an exception or how deep it tells, in edges."""
    calls, end = [], sim._contact.end

    def told(time, dt):
        depth = end(time, dt)
        calls.append((time, dt))
        event = events.get(len(calls))
        if isinstance(event, Exception):
            raise event
        if event is not None:
            sim._contact.sinking = event
        return depth

    monkeypatch.setattr(sim._contact, "end", told)
    return calls


def test_a_step_that_ended_too_deep_is_done_again(sim, monkeypatch):
    sim.dt = DT / 2
    halves = [sim.step() for _ in range(2)]
    wanted = sim.positions(), sim.velocities(), sim.contact_force("ground")
    assert np.abs(wanted[0] - sim.scene.body("cube").rest_positions).max() > 1e-4 and wanted[2][1] < -1.0  # it moves and presses
    sim.dt = DT
    sim.reset()
    whole = sim.step()
    coarse = sim.positions()
    assert np.abs(coarse - wanted[0]).max() > 1e-6  # [m]
    sim.reset()
    calls = patch_end(sim, monkeypatch, {1: 1.0})
    report = sim.step()
    assert calls == [(DT, DT), (DT / 2, DT / 2), (DT, DT)] and report.max_penetration < 1e-9
    assert np.abs(sim.positions() - wanted[0]).max() < 1e-8 and np.abs(sim.velocities() - wanted[1]).max() < 1e-6
    work = [r.newton_iterations for r in (report, whole, *halves)]
    assert whole.newton_iterations < report.newton_iterations and work[0] > max(work[1:])
    assert report.converged and sim.step_count == 1 and sim.time == DT


def test_a_try_that_fails_leaves_the_state_before_the_step(sim, monkeypatch):
    before = sim.positions(), sim.velocities()
    patch_end(sim, monkeypatch, {1: 1.0, 3: ts.SimulationError("no room")})
    with pytest.raises(ts.SimulationError, match="no room"):
        sim.step()
    assert np.array_equal(sim.positions(), before[0]) and np.array_equal(sim.velocities(), before[1])
    assert sim.time == 0.0 and not any(sim._world.motion.released())
    monkeypatch.undo()
    sim.step()
    first = sim.positions()
    sim.reset()
    sim.step()
    assert np.abs(sim.positions() - first).max() < 1e-9  # [m]


def test_a_path_that_ends_with_the_run(sim):
    result = sim.run(END, fps=None)
    assert (result.status, result.problems, result.steps) == ("ok", [], 4)
    assert sim.deepest_overlap() is None and sim.intersecting_triangles() == []
    with pytest.raises(ts.SimulationError, match="the path has ended"):
        sim.detect_contacts()  # of a step beyond the path


def test_the_end_of_a_run_is_judged(sim):
    """What the search for contacts does not reach any more."""
    x = sim.positions()

    def throw(sim, frame, report):
        if frame == 1:
            sim.set_state(positions=x - (0, 0.5, 0), velocities=np.zeros_like(x))

    result = sim.run(DT, throw, fps=50)
    assert result.status == "degraded"
    assert any("at the end 'cube' and 'ground' overlap by 0.499 m" in text for text in result.problems)
