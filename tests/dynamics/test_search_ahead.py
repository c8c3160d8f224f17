"""Explicit sub-steps that keep the contacts of one search.

* Trajectories, impulses and energies are those of a search in each sub-step, but for less than the error of the step;
* only meshes and half-spaces keep contacts;
* states and reports are the same bits however a run is cut, whatever is asked in between, and after checkpoints;
* nothing crosses where a corner slides fast over a surface, also where a batch has to leave a sub-step to the host.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.paths import gpu_path
from taisoft.collision.detector import Detection
from taisoft.dynamics import search_ahead
from taisoft.dynamics.explicit_batch import NOT_FREE, NOTHING, OUTDATED, Batch
from tests.dynamics.scenes import dynamics

DT, N, EDGE = 1 / 4000, 200, 0.05  # [s], sub-steps, edge of the lower cube [m]
INTEGRATORS = "symplectic_euler", "velocity_verlet"


def scene(speed: float = 0.5) -> ts.Scene:
    """A cube falls on the edge of another, which slides over the ground against a wall."""
    made, size = ts.Scene(gravity=(0.0, -9.81, 0.0)), (0.1,) * 3
    rubber = ts.Material(law="stable_neo_hookean", young=5e4, poisson=0.3, density=1000.0)
    made.add_body(ts.box_mesh((2, 2, 2), size), rubber, name="lower", position=(0.0, 0.0505, 0.0), velocity=(-0.2, 0.0, 0.0))
    x, y = 0.1 * ts.box_mesh((3, 3, 3), (1.0,) * 3).vertices[:, :2].T
    mesh = ts.box_mesh((3, 3, 3), size)
    tilted = np.column_stack([0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y, mesh.vertices[:, 2]])
    upper = ts.TetMesh(tilted, mesh.tets)
    made.add_body(upper, rubber, name="upper", position=(0.03, 0.18, 0.02), velocity=(speed, -1.0, 0.0))
    made.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.3)
    made.add_obstacle(ts.HalfSpace((-0.055, 0, 0), (1, 0, 0)), name="wall")
    return made


def record(sim: ts.Simulator, report) -> list:
    """What is known after sub-steps."""
    found = sim.contacts()
    state = sim.positions(), sim.velocities(), found.impulse, found.gap, found.slip, found.point
    numbers = report.n_contacts, report.max_penetration, report.contact_residual, found.found
    return [array.tobytes() for array in state] + [numbers]


@pytest.fixture
def searches(monkeypatch) -> list:
    """One entry for each search."""
    made, plain = [], Detection.find

    def find(self, *arguments, **others):
        made.append(1)
        return plain(self, *arguments, **others)

    monkeypatch.setattr(Detection, "find", find)
    return made


def paths(speed: float, integrator: str, part: int) -> tuple[np.ndarray, float]:
    """Positions (N / 10, ...) [m] of steps in so many parts, and the energy after them [J]."""
    with ts.Simulator(scene(speed), DT / part, integrator, precision="f64") as sim:
        rows = []
        for _ in range(N // 10):
            for _ in range(part):
                report = sim.advance(10)
                assert report.converged
            rows.append(np.concatenate([sim.positions("lower"), sim.positions("upper")]))
        assert report.n_contacts > 10
        return np.array(rows), report.kinetic + report.elastic


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_results_are_those_of_a_search_in_each_substep(integrator, searches, monkeypatch):
    kept, energy = paths(0.5, integrator, 1)
    few = len(searches)
    monkeypatch.setattr(search_ahead, "MOST", 1)
    plain, plain_energy = paths(0.5, integrator, 1)
    assert 3 * few < len(searches) - few
    assert np.abs(kept - plain).max() < 4e-3 * EDGE
    assert abs(energy / plain_energy - 1.0) < 1e-3


def test_beside_a_round_obstacle_each_substep_searches(searches):
    """A body can pass it as a whole, so that its nodes do not tell how far the contacts have moved."""
    made = scene()
    made.add_obstacle(ts.Sphere((0.0, -1.0, 0.0), 0.5), name="ball")
    with ts.Simulator(made, DT, "symplectic_euler") as sim:
        while sim.advance(10).n_contacts == 0:
            pass
        searches.clear()
        sim.advance(20)
    assert len(searches) >= 20


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_bits_depend_on_nothing_but_the_state(integrator, tmp_path):
    whole, cut, asked, resumed = [], [], [], []
    with ts.Simulator(scene(), DT, integrator) as sim:
        for _ in range(N // 20):
            whole.append(record(sim, sim.advance(20)))
        sim.reset()
        for k in range(N // 20):
            for n in (1, 6, 3, 2, 8) if k % 2 else (5, 15):
                report = sim.advance(n)
            cut.append(record(sim, report)[:-1])
        sim.reset()
        for _ in range(N // 20):
            for n in (7, 13):
                report = sim.advance(n)
                sim.detect_contacts(), sim.intersecting_triangles(), sim.contact_force("upper")
            asked.append(record(sim, report)[:-1])
        sim.reset()
        for k in range(N // 20):
            sim.advance(3 + k)
            sim.save_checkpoint(tmp_path / f"{k}")
            resumed.append(record(sim, sim.advance(17 - k))[:-1])
    assert [rows[:-1] for rows in whole] == cut == asked == resumed
    for k in range(0, N // 20, 3):
        with ts.Simulator.load_checkpoint(tmp_path / f"{k}", scene()) as sim:
            assert record(sim, sim.advance(17 - k))[:-1] == resumed[k]


@pytest.mark.parametrize("integrator, on_gpu_path", zip(INTEGRATORS, (False, True)))
def test_nothing_crosses_where_a_corner_slides_fast(integrator, on_gpu_path, monkeypatch):
    """Batches end where contacts have moved, and at paths that are not free: for a while these must keep a large distance."""
    events, plain = set(), Batch.run

    def watched(self, *arguments):
        plain(self, *arguments)
        events.add(self.event)

    monkeypatch.setattr(Batch, "run", watched)
    with gpu_path() if on_gpu_path else pytest.MonkeyPatch.context():
        with dynamics(scene(2.0), dt=DT, integrator=integrator, precision="f64") as sim:
            for k in range(N // 4):
                sim.detection.paths.floor = 3e-4 if k < 20 else 5e-7
                report = sim.advance(4)
                assert len(sim.find_contacts(DT).intersections()) == 0 and (
                    report.converged or (k < 20 and "held back" in report.problems[0])
                )
    assert events >= {NOTHING, OUTDATED, NOT_FREE}
