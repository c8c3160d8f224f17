"""A projectile fired at a thin sheet is stopped or refused, and never passes through:

* after every step no triangles intersect; where paths are not checked, steps with fast projectiles are cut into substeps;
* what flies past a corner is not deflected, however long the step;
* a projectile too fast for that is refused with its speed, the sheet's thickness and a sufficient dt; the state is kept;
* a half-space stops bodies of any speed;
* penetrations are measured over the mean surface edge of the finer side;
* the distance of the surface from the searched paths is that by NumPy, by one thread and by many.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import contact_measures, contact_paths
from taisoft.dynamics.contact_measures import find_displacement
from taisoft.dynamics.contact_paths import ContactPaths
from taisoft.fem.state import DEVIATION
from tests.dynamics.contact_scenes import material

THICK = 0.01  # [m] of the sheet
SHOT = np.array([0.013, 0.1, 0.01])  # [m] its centre at the start
TARGET = np.array([5.0, 9.0, 0.0])


def scene() -> ts.Scene:
    """A projectile above a sheet that is fixed at two sides, off its centre to avoid symmetry; cubes above a plane."""
    made = ts.Scene(gravity=(0, 0, 0))
    rubber = material(young=1e6, friction=0.0)
    sheet = made.add_body(ts.box_mesh((4, 1, 4), (0.4, THICK, 0.4)), rubber, name="sheet")
    sheet.fix(lambda X: np.abs(X[:, 0]) > 0.19)
    for name, at in (("shot", SHOT), ("faller", (5.0, 2.0, 0.0))):
        made.add_body(ts.box_mesh((1, 1, 1), (0.05, 0.05, 0.05)), rubber, name=name, position=at)
    for name, at in (("target", TARGET), ("flyer", TARGET + (-0.3, -0.05, 0.0))):
        made.add_body(ts.box_mesh((2, 2, 2), (0.2, 0.2, 0.2)), material(friction=0.0), name=name, position=at)
    made.add_obstacle(ts.HalfSpace((5, -1, 0), (0, 1, 0)), name="plane")
    return made


@pytest.fixture(scope="module")
def shared_sim():
    with ts.Simulator(scene(), dt=1 / 60, integrator="implicit_euler", precision="f64") as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    for name in ("target", "flyer"):
        shared_sim.set_material(name, mass_damping=0.01)
    shared_sim.reset()
    return shared_sim


def shoot(sim, speed: float, body: str = "shot") -> None:
    sim.set_state(velocities=np.tile([0.0, -speed, 0.0], (8, 1)), body=body)


def fly(sim, steps: int) -> int:
    """Step and check that the projectile's centre stays above the sheet; return the number of steps with contact impulses."""
    hits = 0
    for _ in range(steps):
        sim.step()
        x, sheet = sim.positions("shot").mean(axis=0), sim.positions("sheet")
        near = np.argsort(np.linalg.norm(sheet[:, [0, 2]] - x[[0, 2]], axis=1))[:4]
        assert x[1] > sheet[near, 1].min() and sim.intersecting_triangles() == []
        hits += bool(np.abs(sim.contacts().impulse).max(initial=0.0) > 0)
    return hits


@pytest.mark.parametrize("speed, steps, hits", [(1.0, 10, 2), (20.0, 2, 1)])
def test_projectiles_are_stopped(sim, speed, steps, hits):
    """In steps of 1/60 s: 0.017 and 0.33 m a step, 3 and 67 times half the thickness."""
    shoot(sim, speed)
    assert fly(sim, steps) >= hits
    assert sim.velocities("shot")[:, 1].mean() > -0.8 * speed


def test_only_close_projectiles_take_substeps_where_paths_are_not_checked(sim, monkeypatch):
    """One up to the sheet, short ones for the impact, then longer ones again."""
    monkeypatch.setattr(ContactPaths, "none_cross", property(lambda self: False))
    shoot(sim, 20.0)
    substeps = [sim.step().substeps for _ in range(2)]
    assert 2 < max(substeps) < 20 < 20.0 * sim.dt / (0.5 * THICK)
    shoot(sim, 20.0)
    sim.set_state(positions=sim.positions("shot") + (0, 1.0, 0), body="shot")
    assert sim.step().substeps == 1


def test_what_flies_past_a_corner_is_not_deflected(sim):
    """A cube closes on another by more than their gap, but has moved aside by then. One that flies straight at it does hit."""
    for name in ("target", "flyer"):
        sim.set_material(name, mass_damping=0.0)
    x = sim.positions("flyer")
    for velocity, hits in (((9.0, 30.0, 0.0), False), ((-9.0, 30.0, 4.0), False), ((9.0, 2.0, 0.0), True)):
        sim.reset()
        sim.set_state(x + (0.6 * (velocity[0] < 0.0), 0.0, 0.0), np.tile(velocity, (len(x), 1)), body="flyer")
        reports = [sim.step() for _ in range(3)]
        assert hits or all(report.converged and report.substeps == 1 for report in reports)
        speed = np.abs(sim.velocities("target").mean(axis=0)).max()
        assert speed > 0.5 if hits else speed < 1e-9
        assert np.allclose(sim.velocities("flyer").mean(axis=0), velocity, atol=1e-9) != hits


def test_a_projectile_may_be_too_fast_only_where_paths_are_not_checked(sim, monkeypatch):
    """As where surfaces cross already. It would pass through the sheet within the shortest substep."""
    speed, near = 300.0 * THICK / sim.dt, sim.positions("shot") - (0, 0.1 - 0.025 - 0.5 * THICK - 0.015, 0)  # [m/s], [m]
    shoot(sim, speed)
    sim.set_state(positions=near, body="shot")
    fly(sim, 1)
    assert sim.velocities("shot")[:, 1].mean() > -0.1 * speed
    sim.reset()
    shoot(sim, speed)
    sim.set_state(positions=near, body="shot")
    monkeypatch.setattr(ContactPaths, "none_cross", property(lambda self: False))
    x, v = sim.positions(), sim.velocities()
    with pytest.raises(ts.SimulationError) as closing:
        sim.step()
    found = re.fullmatch(
        "step 1: 'sheet' and 'shot' close at N m/s, N m in a step of N s, and the thinner of them is N m thick, so even in 256 "
        "substeps they could pass each other unseen: take dt <= N s".replace("N ", r"([0-9.e+-]+) "),
        str(closing.value),
    )
    closing_speed, distance, dt, thickness, max_dt = map(float, found.groups())
    assert closing_speed == pytest.approx(speed, rel=1e-2) and distance == pytest.approx(speed * sim.dt, rel=1e-2)
    assert dt == pytest.approx(sim.dt, rel=1e-2) and thickness >= THICK
    assert max_dt == pytest.approx(256 * 0.5 * thickness / speed, rel=2e-2)
    assert np.array_equal(sim.positions(), x) and np.array_equal(sim.velocities(), v)
    assert sim.step_count == 0 and sim.time == 0.0


def test_a_plane_stops_bodies_of_any_speed(sim):
    speed = 60.0  # [m/s], 1 m a step; the cube is 0.05 m long
    shoot(sim, speed, "faller")
    force, lowest = [], np.inf
    for _ in range(5):
        assert sim.step().problems == []
        lowest = min(lowest, sim.positions("faller")[:, 1].min())
        force.append(sim.contact_force("plane")[1])
    assert min(force) < -400.0 and -1.0 < lowest < -0.99  # [N]; 450 N stop the cube within a step


def test_penetration_over_the_edge_of_the_finer_side(sim, monkeypatch):
    original, found = contact_measures.measure_closing, []

    def compare(s, o, contacts, kept, n, dt, closing_data):
        gap, at = contacts.gap.to_numpy(), kept.to_numpy()[:n]
        contacts.gap.from_numpy(gap - 1e-3 * np.arange(len(gap)))
        original(s, o, contacts, kept, n, dt, closing_data)
        measured = closing_data.to_numpy()
        depth, edges = -contacts.gap.to_numpy()[at], s.edge.to_numpy()[contacts.body.to_numpy()[at]]
        contacts.gap.from_numpy(gap)
        expected = depth.max(initial=0.0), (depth / edges.min(axis=1)).max(initial=0.0)
        assert measured[[contact_measures.DEPTH, contact_measures.RELATIVE_PENETRATION]] == pytest.approx(expected, rel=1e-9)
        found.append(depth.max(initial=0.0) * np.ptp(edges[depth > 0], axis=1).max(initial=0.0))
        original(s, o, contacts, kept, n, dt, closing_data)

    monkeypatch.setattr(contact_measures, "measure_closing", compare)
    shoot(sim, 1.0)
    for _ in range(10):
        sim.step()
    assert max(found) > 0.0


def test_distance_from_the_searched_paths(sim, monkeypatch):
    found = []

    def compare(m, s, x_start, displacement):
        moved, node, searched = m.state.x.to_numpy() - x_start.to_numpy(), s.node.to_numpy(), s.move.to_numpy()
        soft = node >= 0
        moved, searched = moved[node[soft]], searched[soft]
        square = (searched * searched).sum(axis=1)
        along = (moved * searched).sum(axis=1) / np.where(square > 0.0, square, 1.0)
        expected = np.linalg.norm(moved - np.clip(along, 0.0, 1.0)[:, None] * searched, axis=1).max()
        for model in (replace(m, on_cpu=False, serial=False), m):
            m.state.scalars[DEVIATION] = -1.0
            find_displacement(model, s, x_start, displacement)
            assert m.state.scalars[DEVIATION] == pytest.approx(expected, rel=1e-9, abs=1e-15)
        found.append(expected)

    monkeypatch.setattr(contact_paths, "find_displacement", compare)
    shoot(sim, 3.0)
    for _ in range(3):
        sim.step()
    assert max(found) > 1e-6  # [m]
