"""Steps with contacts that are done again, and paths that end:

* a step that ended too deep starts again from its own start in twice as many parts, led nodes that it had let go included; the
  result is that of so many steps, its iterations are those of all tries;
* an implicit part that ended in something is looked at along its way, and edges that come to cross within a step are met;
* where a try fails, the state is that before the step;
* a run whose paths end with it ends as any other, and its end is judged.
"""

import numpy as np
import pytest
from retries import assert_is_before_first_step, assert_steps_as_new, state_of

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


def patch_end(sim, monkeypatch, events: dict, tells: str = "relative_penetration") -> list:
    """events: by the number of the call of the step's look at its end, an exception or how deep it tells, in edges."""
    calls, end = [], sim._dynamics.contact.end

    def told(time, dt):
        depth = end(time, dt)
        calls.append((time, dt))
        event = events.get(len(calls))
        if isinstance(event, Exception):
            raise event
        if event is not None:
            setattr(sim._dynamics.contact, tells, event)
        return depth

    monkeypatch.setattr(sim._dynamics.contact, "end", told)
    return calls


@pytest.mark.parametrize("tells, depth", [("relative_penetration", 1.0), ("crossing", 3e-3)])
def test_a_step_that_ended_too_deep_is_done_again(sim, monkeypatch, tells, depth):
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
    calls = patch_end(sim, monkeypatch, {1: depth}, tells)
    report = sim.step()
    assert calls == [(DT, DT), (DT / 2, DT / 2), (DT, DT)] and report.max_penetration < 1e-9
    assert np.abs(sim.positions() - wanted[0]).max() < 1e-8 and np.abs(sim.velocities() - wanted[1]).max() < 1e-6
    work = [r.newton_iterations for r in (report, whole, *halves)]
    assert whole.newton_iterations < report.newton_iterations and work[0] > max(work[1:])
    assert report.converged and report.substeps == 2 and sim.step_count == 1 and sim.time == DT


def test_a_try_that_fails_leaves_the_state_before_the_step(sim, monkeypatch):
    before = state_of(sim)
    patch_end(sim, monkeypatch, {1: 1.0, 3: ts.SimulationError("no room")})
    with pytest.raises(ts.SimulationError, match="no room"):
        sim.step()
    assert_is_before_first_step(sim, before)
    monkeypatch.undo()
    assert_steps_as_new(sim, 1e-9)


def test_a_part_that_sank_is_looked_at_along_its_way(sim, monkeypatch):
    """Nothing is there that was not known: the part stays what it was."""
    first = sim.step()
    wanted, searched, search = sim.positions(), [], sim._dynamics.contact.search_along_path
    sim.reset()
    monkeypatch.setattr(sim._dynamics.contact, "penetrates_deeper", lambda time, dt, before: True)
    monkeypatch.setattr(sim._dynamics.contact, "search_along_path", lambda *at: searched.append((at, search(*at))))
    report = sim.step()
    assert searched == [((0.0, DT), False)] and report.newton_iterations == first.newton_iterations
    assert np.array_equal(sim.positions(), wanted) and report.max_penetration == first.max_penetration


def test_edges_that_come_to_cross_are_met():
    """An edge falls past the end of a ridge's cross-section, over which it does not lie at the start of the step."""
    mesh, r = ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1)), np.sqrt(0.5)
    scene = ts.Scene(gravity=(0, 0, 0))
    for name, turn, at, v in (
        ("ridge", [[r, -r, 0], [r, r, 0], [0, 0, 1]], (0, -0.1 * r, 0), (0, 0, 0)),
        ("edge", [[1, 0, 0], [0, r, -r], [0, r, r]], (0.051, 0.1 * r + 0.002, 0), (-2, -3, 0)),
    ):
        turned = ts.TetMesh(mesh.vertices @ np.transpose(turn), mesh.tets)
        scene.add_body(turned, ts.Material(young=1e5), name=name, position=at, velocity=v)
    with ts.Simulator(scene, dt=1e-3, precision="f64") as sim:
        c = sim.detect_contacts()
        edges = c.kind == "edge_edge"
        assert edges.sum() == 1 and c.gap[edges] == pytest.approx(0.002) and abs(c.normal[edges][0, 1]) == pytest.approx(1.0)
        sim.set_state(velocities=np.tile([0.5, -3.0, 0.0], (8, 1)), body="edge")  # it moves away from the ridge
        assert not (sim.detect_contacts().kind == "edge_edge").any()


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
