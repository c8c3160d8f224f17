"""Nothing crosses: every state of a run is judged by ipctk.

* boxes that fall on each other at an angle, by all implicit integrators, at coarse and fine steps; by explicit sub-steps, fast;
* a thin sheet thrown at itself; a cube pushed by a moving obstacle;
* a start that crosses a little is resolved, of one that is stuck no other pair crosses;
* two runs are the same to the last bit, and a checkpoint taken while passages are held continues so;
* without impulses, bodies are held back and the step says so; what moves as prescribed and leaves no room is refused.
"""

from functools import partial

import numpy as np
import pytest

import taisoft as ts
from taisoft.checkpoint import read_checkpoint
from taisoft.dynamics.contact_search import ContactSearch
from taisoft.dynamics.newton_budget import NewtonBudget
from tests.collision.detection_scenes import folded
from tests.collision.rotations import rotation

pytest.importorskip("ipctk")
from benchmarks.judge import Judge

DAMPED = ts.Material(young=1e5, mass_damping=0.01)  # as in the demos with implicit steps, which share kernels with it
UNDAMPED = ts.Material(young=1e5)
FLOOR = ts.Box((0.0, -0.5, 0.0), (9.0, 0.5, 9.0))
long = partial(pytest.param, marks=pytest.mark.long)


def turned_box(cells, size, axis=(1, 2, 3), angle: float = 0.7) -> ts.TetMesh:
    """A box turned about an axis."""
    mesh = ts.box_mesh(cells, size)
    return ts.TetMesh(mesh.vertices @ rotation(axis, angle).T, mesh.tets)


def boxes(speed: float = 3.0, material: ts.Material = DAMPED) -> ts.Scene:
    """Two boxes of 0.2 m at an angle; one falls on the edges of the other at a speed [m/s], over a floor."""
    scene = ts.Scene()
    for k, (axis, v) in enumerate((((1, 2, 3), 0.0), ((-1, 1, 1), -speed))):
        mesh = turned_box((2, 2, 2), (0.2, 0.2, 0.2), axis)
        scene.add_body(mesh, material, name=f"box {k}", position=(0.03 * k, 0.17 + 0.36 * k, 0), velocity=(0, v, 0))
    scene.add_obstacle(FLOOR if material is DAMPED else ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="floor")
    return scene


def judged(sim: ts.Simulator, steps: int, self_collision: bool = False) -> list:
    """Take steps, and check that nothing crosses after any; return their reports."""
    judge, reports = Judge(sim, self_collision), []
    assert judge.crossings() == 0
    for _ in range(steps):
        reports.append(sim.step())
        found = judge.find()
        assert found.count == 0, f"step {sim.step_count}: {found}"
    return reports


@pytest.mark.parametrize("dt, seconds, limit", [(1 / 30, 0.3, None), (1 / 30, 0.3, 6), long(1 / 240, 0.15, None)])
@pytest.mark.parametrize("integrator", ["implicit_euler", long("bdf2"), long("linearly_implicit_euler")])
def test_boxes_at_an_angle(integrator, dt, seconds, limit, monkeypatch):
    """limit: of the Newton iterations in a step, too small for impacts."""
    monkeypatch.setattr(NewtonBudget, "limit", limit or NewtonBudget.limit)
    with ts.Simulator(boxes(), dt=dt, integrator=integrator) as sim:
        reports = judged(sim, round(seconds / dt))
        assert max(r.n_contacts for r in reports) > 3 and all(r.newton_iterations <= NewtonBudget.limit for r in reports)
        if limit:
            assert not all(r.converged for r in reports) and max(r.n_inverted for r in reports) == 0
        else:
            assert sim.velocities("box 1")[:, 1].mean() > -1.0


def test_fast_explicit_substeps():
    with ts.Simulator(boxes(5.0, UNDAMPED), dt=1e-4, integrator="velocity_verlet") as sim:
        sim.dt = 0.5 * sim.stable_dt
        reports = judged(sim, 80)
        assert max(r.n_contacts for r in reports) > 3 and sim.velocities("box 1")[:, 1].mean() > -4.0


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_thin_sheet_thrown_at_itself():
    scene = ts.Scene(gravity=(0, 0, 0))
    mesh = ts.sheet_mesh((16, 3), (2.0, 0.02, 0.5))
    x, far = folded(mesh.vertices, 0.1)
    v = np.zeros_like(x)
    v[far, 1] = -20.0 - 2.0 * x[far, 2]
    scene.add_body(ts.TetMesh(x, mesh.tets), DAMPED, name="sheet", velocity=v)
    with ts.Simulator(scene, dt=1 / 30, self_collision=True) as sim:
        reports = judged(sim, 20, self_collision=True)
        assert max(r.n_contacts for r in reports) > 10


def test_a_capsule_is_shot_at_a_sheet():
    scene = ts.Scene(gravity=(0, 0, 0))
    sheet = scene.add_body(ts.box_mesh((1, 8, 8), (0.02, 0.6, 0.6)), DAMPED, name="sheet")
    sheet.fix(lambda x: abs(x[:, 1]) > 0.29)
    rod = ts.Capsule((-0.06, 0, -0.2), (-0.06, 0, 0.2), 0.02)
    scene.add_obstacle(rod, name="rod", path=ts.KeyFrames([0.0, 0.025], [(0, 0, 0), (0.25, 0, 0)]))
    with ts.Simulator(scene, dt=1 / 120) as sim:
        assert max(r.max_penetration for r in judged(sim, 3)) < 1e-6 and sim.positions("sheet")[:, 0].max() > 0.2


def test_a_moving_obstacle_pushes_a_cube():
    """A wall that moves and turns, and then stops and turns faster."""
    scene = ts.Scene()
    scene.add_body(turned_box((2, 2, 2), (0.2, 0.2, 0.2)), DAMPED, name="cube", position=(0.3, 0.18, 0.05))
    scene.add_obstacle(FLOOR, name="floor", friction=0.5)
    push = ts.KeyFrames([0.0, 0.3, 0.6], [(0, 0, 0), (0.9, 0, 0), (0.9, 0, 0)], [(0, 0, 0), (0, 0.5, 0.3), (0, 2.5, 0.3)])
    wall = ts.box_mesh((1, 1, 1), (0.05, 0.4, 0.5))
    scene.add_obstacle(ts.MeshObstacle(wall.vertices + (-0.1, 0.3, 0), wall.surface), name="wall", path=push)
    with ts.Simulator(scene, dt=1 / 30) as sim:
        reports = judged(sim, 18)
        assert max(r.n_contacts for r in reports) > 3 and sim.positions("cube")[:, 0].mean() > 0.5


def crossing_boxes() -> ts.Scene:
    """Two boxes of 0.2 m with a corner of one a little in the other."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.allow_initial_overlap = True
    for k, (axis, angle) in enumerate((((1, 2, 3), 0.1), ((3, 1, 2), 0.2))):
        mesh = turned_box((2, 2, 2), (0.2, 0.2, 0.2), axis, angle)
        scene.add_body(mesh, DAMPED, name=f"box {k}", position=(0.03 * k, 0.214 * k, 0.02 * k))
    return scene


def test_a_start_that_crosses_a_little_is_resolved(tmp_path):
    """Also from a checkpoint of a state that crosses, and to the same bits."""
    steps = 20
    with ts.Simulator(crossing_boxes(), dt=0.01) as sim:
        judge, positions = Judge(sim, False), []
        counts = [judge.crossings()]
        for k in range(steps):
            sim.step()
            counts.append(judge.crossings())
            positions.append(sim.positions())
            if k == 1:
                sim.save_checkpoint(tmp_path / "crossing.npz")
                assert counts[-1] > 0
        assert counts[0] == max(counts) and counts[-1] == 0
        resolved = np.flatnonzero(np.array(counts) == 0)[0]
        assert not any(counts[resolved:])
    with ts.Simulator.load_checkpoint(tmp_path / "crossing.npz", crossing_boxes()) as sim:
        for k in range(2, steps):
            sim.step()
            assert np.array_equal(sim.positions(), positions[k])


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_of_a_start_that_is_stuck_nothing_else_crosses():
    """Two plates cross in their middle, and a third one falls on them."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.allow_initial_overlap = True
    for k, (axis, angle) in enumerate((((1, 0, 0), 0.0), ((1, 0, 0), 1.5), ((0, 1, 0), 0.4))):
        mesh = turned_box((4, 1, 4), (0.4, 0.04, 0.4), axis, angle)
        thrown = {"position": (0.0, 0.3, 0.0), "velocity": (0.0, -2.0, 0.0)} if k == 2 else {}
        scene.add_body(mesh, DAMPED, name=f"plate {k}", **thrown)
    with ts.Simulator(scene, dt=0.01) as sim:
        judge, touched = Judge(sim, False), set()
        for _ in range(15):
            report = sim.step()
            assert set(judge.find().names) == {("plate 0", "plate 1")}
            assert report.deep and report.crossings and "pairs of surface triangles cross" in " ".join(report.problems)
            c = sim.contacts()
            touched |= set(c.body_b[c.impulse.any(axis=1)])
        assert "plate 2" in touched


@pytest.mark.parametrize("integrator, steps", [("implicit_euler", 9), ("velocity_verlet", 60)])
def test_runs_are_the_same_and_continue_bitwise_while_passages_are_held(tmp_path, integrator, steps):
    implicit = integrator == "implicit_euler"
    make = partial(boxes, 3.0, DAMPED) if implicit else partial(boxes, 5.0, UNDAMPED)
    settings = {"dt": 1 / 30 if implicit else 2.6e-3, "integrator": integrator}
    with ts.Simulator(make(), **settings) as sim:
        states = [(sim.step(), sim.positions(), sim.velocities())[1:] for _ in range(steps)]
    held = []
    with ts.Simulator(make(), **settings) as sim:
        for k in range(steps):
            sim.step()
            assert all(np.array_equal(*pair) for pair in zip(states[k], (sim.positions(), sim.velocities())))
            if k >= 0.5 * steps or implicit:
                file = tmp_path / f"{k}.npz"
                sim.save_checkpoint(file)
                held += [(k, file)] if len(read_checkpoint(file).state["simulation"]["held"]) else []
        sim.reset()
        for k in range(6):
            sim.step()
            assert np.array_equal(sim.positions(), states[k][0])
    first, file = held[0]
    assert first < steps - 2
    with ts.Simulator.load_checkpoint(file, make()) as sim:
        for state in states[first + 1 :]:
            sim.step()
            assert all(np.array_equal(*pair) for pair in zip(state, (sim.positions(), sim.velocities())))


def test_bodies_without_impulses_are_held_back(monkeypatch):
    """No contact has an effect; the step says so. With contacts, the next steps part the bodies."""
    find, steps = ContactSearch.find, 4
    with ts.Simulator(boxes(), dt=1 / 60) as sim:
        with monkeypatch.context() as without:
            without.setattr(ContactSearch, "find", lambda search, *at: 0 * find(search, *at))
            reports = judged(sim, steps)
        assert len(reports) == sim.step_count == steps and np.isfinite(sim.velocities()).all()
        texts = [" ".join(r.problems) for r in reports]
        held = ["held back 'box 0', 'box 1', which would have passed through another surface" in text for text in texts]
        assert any(held) and not any(r.converged for r, is_held in zip(reports, held) if is_held)
        assert all(r.n_contacts == 0 for r in reports)
        after = judged(sim, steps)
        assert max(r.n_contacts for r in after) > 3
        assert not any("held back" in text for r in after for text in r.problems)


@pytest.mark.parametrize("hammer, integrator, dt", [("mesh", "implicit_euler", 1 / 60), ("sphere", "velocity_verlet", 1e-3)])
def test_what_leaves_no_room_is_refused(hammer, integrator, dt):
    """A cube fixed in place, and an obstacle that moves into it."""
    scene = ts.Scene()
    material = DAMPED if hammer == "mesh" else UNDAMPED
    cube = scene.add_body(turned_box((1, 1, 1), (0.2, 0.2, 0.2)), material, name="cube")
    cube.fix(np.arange(8))
    box = ts.box_mesh((1, 1, 1), (0.4, 0.4, 0.4), (0, 0.5, 0))
    shape = ts.Sphere((0, 0.5, 0), 0.2) if hammer == "sphere" else ts.MeshObstacle(box.vertices, box.surface)
    scene.add_obstacle(shape, name="hammer", path=lambda t: ((0, -2.0 * t, 0), np.eye(3)))
    with ts.Simulator(scene, dt=dt, integrator=integrator) as sim:
        with pytest.raises(ts.SimulationError, match="'cube' and 'hammer' from passing through each other") as error:
            while sim.time < 0.3:
                before = sim.positions(), sim.velocities(), sim.time, sim.step_count
                judged(sim, 1)
        now = sim.positions(), sim.velocities(), sim.time, sim.step_count
        assert all(np.array_equal(*pair) for pair in zip(before, now)) and sim.step_count > 2
        assert str(error.value).startswith(f"step {sim.step_count + 1}: ") and Judge(sim, False).crossings() == 0


def test_prescribed_nodes_that_leave_no_room_are_refused():
    """A cube fixed in place, and another one all of whose nodes are prescribed to move into it."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, name in enumerate(("fixed", "prescribed")):
        cube = scene.add_body(turned_box((1, 1, 1), (0.2, 0.2, 0.2)), DAMPED, name=name, position=(0, 0.5 * k, 0))
        cube.move(np.arange(8), lambda t, speed=2.0 * k: (0, -speed * t, 0))
    with ts.Simulator(scene, dt=1 / 60) as sim:
        start = sim.positions("prescribed")
        with pytest.raises(ts.SimulationError, match="'fixed' and 'prescribed' from passing through each other"):
            while sim.time < 0.3:
                judged(sim, 1)
                assert np.abs(sim.positions("prescribed") - start + (0, 2.0 * sim.time, 0)).max() < 1e-6


def test_a_clamped_body_that_touches_an_obstacle_converges():
    """Its lowest nodes are fixed at a gap of 0, so that no impulse can open it."""
    scene = ts.Scene()
    block = scene.add_body(ts.box_mesh((2, 2, 2), (0.2, 0.2, 0.2)), DAMPED, name="block", position=(0.0, 0.1, 0.0))
    block.fix(lambda X: X[:, 1] < 1e-9)
    scene.add_obstacle(FLOOR, name="floor")
    with ts.Simulator(scene, dt=0.01) as sim:
        reports = [sim.step() for _ in range(5)]
    assert all(report.converged for report in reports) and max(report.newton_iterations for report in reports) <= 10
