"""The scenes of incremental potential contact:

* runs stop at their budget, at a crossing and by an error; records survive JSON;
* friction's work and creep are those of a count contact by contact, moving obstacles included.
"""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from benchmarks import ipc, ipc_runs
from benchmarks.ipc_cases import find
from benchmarks.ipc_cases.case import SMALL
from benchmarks.ipc_friction import FrictionMeter
from benchmarks.ipc_runs import DEGRADED, OK, STOPPED, Job, Record, run
from taisoft.collision.contacts import no_contacts
from taisoft.errors import SimulationError
from taisoft.mesh.quality import mean_surface_edge
from taisoft.output.report import json_text
from tests.benchmarks.stand_ins import ModelSimulator
from tests.benchmarks.stand_ins import ipc_record as record


def test_runs_end_at_their_steps_budget_a_crossing_and_an_error(monkeypatch):
    judging = pytest.importorskip("benchmarks.judge")
    monkeypatch.setattr(ts, "Simulator", ModelSimulator)
    monkeypatch.setattr(judging.Judge, "crossings", lambda self: 3 if crossing else 0)
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0)), ts.Material())
    case, crossing = replace(find("twisted_mat"), build=lambda size: scene), False
    monkeypatch.setattr(ipc_runs, "find", lambda name: case)
    found = run(Job("twisted_mat", SMALL, 60.0, steps=3))
    assert (found.status, found.steps, found.crossed) == (OK, 3, 0) and found.time == pytest.approx(3 * case.dt)
    found = run(Job("twisted_mat", SMALL, 0.0))
    assert (found.status, found.reason, found.steps, found.failed) == (STOPPED, "budget of 0 s", 1, False)
    crossing = True
    found = run(Job("twisted_mat", SMALL, 60.0))
    assert (found.status, found.steps, found.crossed) == (STOPPED, 1, 1) and ipc.failed(found)
    assert found.reason == "surfaces cross at t = 0.04 s; 1 step crossed" and found.first_crossed == pytest.approx(0.04)

    def fail(self):
        raise SimulationError("too fast")

    monkeypatch.setattr(ModelSimulator, "step", fail)
    found = run(Job("twisted_mat", SMALL, 60.0))
    assert (found.status, found.reason, found.steps) == (STOPPED, "too fast", 0) and ipc.failed(found)


def test_records_survive_json_and_tell_what_degrades_a_run():
    for least in (None, 1e-4):
        made = record(least_distance=least, creep=0.5, crossed=1, first_crossed=0.04)
        assert Record.read(json.loads(json_text(asdict(made)))) == made
        assert made.status == DEGRADED and made.reason == "1 step crossed"
    assert record().status == OK and record(unconverged=1).status == DEGRADED


@pytest.mark.parametrize("substeps", [1, 3])
def test_work_and_creep_of_friction(substeps):
    """A node that sticks to a floor that moves, and triangles that slide on each other; cut steps count several times."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0)), ts.Material())
    floor, dt = ts.HalfSpace((0.0, -0.5, 0.0), (0.0, 1.0, 0.0)), 0.01 / substeps
    scene.add_obstacle(floor, name="floor", path=lambda t: (np.array([t * t, 0.0, 0.0]), np.eye(3)))
    v = np.random.default_rng(0).standard_normal((8, 3))
    normal, mu = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), 0.5
    pressing, tangential = np.array([2.0, 3.0]), np.array([[0.4, 0.0, 0.8], [0.9, 1.2, 0.0]])  # |p_t| / mu p_n: 0.89, 1
    contacts = replace(
        no_contacts(scene),
        point=np.array([[0.3, -0.5, 0.2], [0.0, 0.5, 0.0]]),
        normal=normal,
        gap=np.zeros(2),
        impulse=pressing[:, None] * normal + tangential,
        body_b=np.array(["floor", "cube"], dtype=object),
        nodes=np.array([[0, -1, -1, -1, -1, -1], [1, 2, 3, 4, 5, 6]]),
        weights=np.array([[1.0, 0, 0, 0, 0, 0], [0.2, 0.3, 0.5, 0.6, 0.3, 0.1]]),
        friction=np.full(2, mu),
    )
    sim = SimpleNamespace(scene=scene, time=0.5, dt=0.01, contacts=lambda: contacts, velocities=lambda: v)
    meter = FrictionMeter(sim)
    assert meter.creep is None
    for _ in range(2):
        meter.add(substeps)
    u = np.array([v[0] - [1.0 - dt, 0.0, 0.0], contacts.weights[1, :3] @ v[1:4] - contacts.weights[1, 3:] @ v[4:7]])
    across = u - (u * normal).sum(axis=1)[:, None] * normal
    assert meter.work == pytest.approx(2 * substeps * (tangential * across).sum()) and meter.cut == (0 if substeps == 1 else 2)
    edge = mean_surface_edge([(body.rest_positions, body.nodes.surface)])
    assert meter.creep == pytest.approx(np.linalg.norm(across[0]) / edge)
