"""Retries of steps with contacts, and paths that end:

* a step that ends too deep is retried from its start with twice as many substeps, and prescribed nodes that it released are
  prescribed again; the result equals that many steps, and the report counts the iterations of all attempts;
* an implicit substep that penetrates is searched again along its path; edges that come to cross within a step are found;
* where an attempt fails, the state is that before the step;
* a run may end at the end of a path; its final state is checked for overlaps.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.contact import ContactStep
from tests.dynamics.retries import assert_is_before_first_step, assert_steps_as_new, state_of

DT, RELEASE, END = 0.02, 0.015, 0.08  # [s]


def sink(t: float):
    """Displacement of the prescribed nodes [m]."""
    return (0.0, -0.1 * t, 0.0) if t < RELEASE else None


def circle(t: float):
    """Pose of an obstacle out of reach [m]."""
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
    sim.dt = DT / 2
    halves = [sim.step() for _ in range(2)]
    x, v, force = sim.positions(), sim.velocities(), sim.contact_force("ground")
    assert np.abs(x - sim.scene.body("cube").rest_positions).max() > 1e-4 and force[1] < -1.0  # it moves and presses
    sim.dt = DT
    sim.reset()
    whole = sim.step()
    coarse = sim.positions()
    assert np.abs(coarse - x).max() > 1e-6  # [m]
    sim.reset()
    calls = patch_end(monkeypatch, {1: depth}, measure)
    report = sim.step()
    assert calls == [(DT, DT), (DT / 2, DT / 2), (DT, DT)] and report.max_penetration < 1e-9
    assert np.abs(sim.positions() - x).max() < 1e-8 and np.abs(sim.velocities() - v).max() < 1e-6
    work = [r.newton_iterations for r in (report, whole, *halves)]
    assert whole.newton_iterations < report.newton_iterations and work[0] > max(work[1:])
    assert report.converged and report.substeps == 2 and sim.step_count == 1 and sim.time == DT


def test_a_failed_retry_leaves_the_state_before_the_step(sim, monkeypatch):
    before = state_of(sim)
    patch_end(monkeypatch, {1: 1.0, 3: ts.SimulationError("no room")})
    with pytest.raises(ts.SimulationError, match="no room"):
        sim.step()
    assert_is_before_first_step(sim, before)
    monkeypatch.undo()
    assert_steps_as_new(sim, 1e-9)


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


def test_edges_that_come_to_cross_are_found():
    """A falling edge moves over the end of a ridge within the step; at its start it does not lie over the ridge."""
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
        sim.detect_contacts()  # swept by a step beyond the path


def test_the_final_state_of_a_run_is_checked_for_overlaps(sim):
    """Also for those deeper than contact detection reaches."""
    x = sim.positions()

    def move_down(sim, frame, report):
        if frame == 1:
            sim.set_state(positions=x - (0, 0.5, 0), velocities=np.zeros_like(x))

    result = sim.run(DT, move_down, fps=50)
    assert result.status == "degraded"
    assert any("at the end 'cube' and 'ground' overlap by 0.499 m" in text for text in result.problems)
