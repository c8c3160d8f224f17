"""The scenes of incremental potential contact:

* every scene in small size takes a few steps without crossings, and in full size has about the published number of nodes;
* without the shared meshes equivalent ones are used, or the case is skipped with a sentence;
* runs stop at their budget, at a crossing and by an error, and records survive JSON;
* friction's work is the energy it takes, and what sticks does not creep, on moving obstacles too;
* the command prints and writes the table.
"""

import importlib.util
import json
import math

import numpy as np
import pytest

import taisoft as ts
from benchmarks import ipc, ipc_runs
from benchmarks.ipc_cases import CASES, EXTRA, find, meshes
from benchmarks.ipc_cases.case import FULL, SMALL
from benchmarks.ipc_friction import STEPS, TOLERANCES, FrictionMeter
from benchmarks.ipc_runs import DEGRADED, OK, SKIPPED, STOPPED, Job, Record, run
from taisoft.errors import MeshError, SimulationError
from taisoft.output.report import json_text

judged = pytest.mark.skipif(not importlib.util.find_spec("ipctk"), reason="ipctk is not installed")
ALONE = ("masonry_arch",)  # small scenes that need shared meshes


def built(name: str, size: str) -> ts.Scene:
    """A scene; skips the test if its meshes are absent."""
    try:
        with ipc_runs.without_warnings():
            return find(name).build(size)
    except MeshError as error:
        pytest.skip(str(error))


def record(**more) -> Record:
    """A record with made-up numbers of two steps."""
    numbers = {
        "nodes": 800,
        "tets": 1805,
        "wanted_steps": 625,
        "time": 0.08,
        "newton": [3, 4],
        "cg": [10, 30],
        "substeps": [1, 2],
    }
    return Record(Job("twisted_mat", SMALL, 10.0), **numbers | {"seconds": [0.5, 0.25], "compile_seconds": 7.0} | more)


@judged
@pytest.mark.parametrize("name", [case.name for case in CASES])
def test_small_scenes_take_steps_without_crossings(name):
    built(name, SMALL)
    steps = 1 if name == "house_of_cards" else 2  # its second step takes 200 Newton iterations
    found = run(Job(name, SMALL, 60.0, steps=steps))
    assert (found.status, found.reason, found.steps, found.crossed) == (OK, "", steps, 0)
    assert found.time == pytest.approx(steps * find(name).dt) and found.nodes < 4000 and min(found.newton) >= 1


@pytest.mark.parametrize("case", [*CASES, *EXTRA], ids=lambda case: case.name)
def test_full_scenes_have_the_published_number_of_nodes(case):
    nodes = sum(body.n_nodes for body in built(case.name, FULL).bodies)
    assert nodes == pytest.approx(case.published_nodes, rel=0.16)


@pytest.mark.parametrize("size", [SMALL, FULL])
def test_absent_meshes_are_replaced(size, monkeypatch, tmp_path):
    own = [meshes.mat(size), meshes.ball(size)]
    monkeypatch.setattr(meshes, "SHARED", tmp_path)
    for mesh, other in zip(own, (meshes.mat(size), meshes.ball(size))):
        assert other.n_verts == pytest.approx(mesh.n_verts, rel=0.25)
        assert np.abs(np.ptp(other.vertices, axis=0) - np.ptp(mesh.vertices, axis=0)).max() < 5e-3
    found = run(Job("masonry_arch", size, 1.0))
    assert found.status == SKIPPED and "arch/01.msh is not in" in found.reason and not found.steps
    text = ipc.scene_table([found])
    assert "* masonry arch: skipped, arch/01.msh is not in" in text and "| masonry arch" not in text


def test_surfaces_of_obstacles_are_closed_and_point_outwards():
    vertices, triangles = meshes.joined(meshes.cylinder(2.0, 0.2, sides=64), meshes.hull(np.eye(4, 3) + 5.0)).surface()
    found = ts.SurfaceMesh(vertices, triangles)
    expected = 2.0 * 32.0 * math.sin(2.0 * math.pi / 64) * 0.2**2 + 1.0 / 6.0
    assert found.closed and found.volume == pytest.approx(expected)
    for case in CASES:
        for obstacle in built(case.name, SMALL).obstacles if case.name not in ALONE else ():
            if isinstance(obstacle.shape, ts.MeshObstacle):
                surface = ts.SurfaceMesh(*obstacle.shape.surface())
                assert surface.closed and surface.volume > 0.0


# --- runs -------------------------------------------------------------------------------------------------------------


@judged
def test_runs_stop_at_the_budget_a_crossing_and_an_error(monkeypatch):
    found = run(Job("twisted_mat", SMALL, 0.0))
    assert (found.status, found.reason, found.steps, found.failed) == (STOPPED, "budget of 0 s", 1, False)
    monkeypatch.setattr("benchmarks.judge.Judge.crossings", lambda self: 3)
    found = run(Job("twisted_mat", SMALL, 60.0))
    assert (found.status, found.steps, found.crossed) == (STOPPED, 1, 1) and ipc.failed(found)
    assert found.reason == "surfaces cross at t = 0.04 s; 1 step crossed" and found.first_crossed == pytest.approx(0.04)

    def fail(self):
        raise SimulationError("too fast")

    monkeypatch.setattr("taisoft.simulator.Simulator.step", fail)
    found = run(Job("twisted_mat", SMALL, 60.0))
    assert (found.status, found.reason, found.steps) == (STOPPED, "too fast", 0) and ipc.failed(found)


def test_a_child_that_ends_without_a_record_is_an_error():
    found = ipc_runs.run_child(Job("no such scene", SMALL, 60.0))
    assert found.status == STOPPED and found.failed and "its process ended with status 1: StopIteration" in found.reason


@pytest.mark.parametrize("least", [math.inf, 1e-4])
def test_records_survive_json(least):
    made = record(least_distance=least, creep=0.5, crossed=1, first_crossed=0.04)
    made.end()
    assert Record.read(json.loads(json_text(made.data()))) == made
    assert made.status == DEGRADED and made.reason == "1 step crossed"


def test_tables():
    made = [record(), record(unconverged=1, inverted=2, least_distance=1.25e-4, creep=0.125, friction_work=-2.5, cut=1)]
    for one in made:
        one.end()
    lines = ipc.scene_table(made).splitlines()
    cells = [" ".join(line.split()) for line in lines]
    start = "| twisted mat | 800 | 1,805 | 0.04 | 0.08 of 25 (2) | 3.5 | 20 | 1.5 | 0.375, 0.375, 0.5 | 7 |"
    assert cells[2] == f"{start} - | 0 | 0 | 0 | 776 | ok |" and cells[3] == f"{start} 0.000125 | 0 | 1 | 2 | 776 | degraded |"
    assert lines[-1] == "* twisted mat: degraded, 1 not converged; at most 2 inverted tets"
    cells = [" ".join(line.split()) for line in ipc.friction_table(made).splitlines()]
    assert cells[3] == "| twisted mat | 1e-04 | 0.08 of 25 (2) | 3.5 | 20 | 0.375, 0.375, 0.5 | 0.125 | -2.5 | 1 | 0 | degraded |"


# --- friction ---------------------------------------------------------------------------------------------------------


def measured(gravity, velocity=(0.0, 0.0, 0.0), friction=0.3, path=None, steps=20, substeps=1) -> tuple[FrictionMeter, float]:
    """The meter after steps of a stiff cube of 1 kg on a floor, and the change of its kinetic energy [J]."""
    scene = ts.Scene(gravity=gravity)
    stuff = ts.Material(young=1e5, poisson=0.3, density=1000.0, friction=friction)
    scene.add_body(ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1), (0.0, 0.05, 0.0)), stuff, velocity=velocity)
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), friction=friction, path=path)
    with ts.Simulator(scene, dt=0.01, precision="f64", contact_tolerance=1e-6) as sim:
        meter, before = FrictionMeter(sim), sim.energies().kinetic
        for _ in range(steps):
            assert sim.step().substeps == 1
            meter.add(substeps)
        return meter, sim.energies().kinetic - before


def test_friction_takes_the_energy_of_a_sliding_cube():
    meter, change = measured((0.0, -9.81, 0.0), velocity=(2.0, 0.0, 0.0))
    assert change < -0.8 and meter.work == pytest.approx(change, rel=0.06)


def test_what_sticks_does_not_creep():
    meter, _ = measured((1.0, -9.81, 0.0))
    assert meter.creep < 1e-3 and abs(meter.work) < 1e-3
    path = ts.KeyFrames([0.0, 1.0], translations=[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    meter, change = measured((0.0, -9.81, 0.0), velocity=(1.0, 0.0, 0.0), path=path)
    assert meter.creep < 1e-3 and abs(change) < 1e-2
    meter, _ = measured((0.0, -9.81, 0.0), path=path, steps=10)  # the floor slides below the cube and draws it along
    assert meter.work < -0.1


def test_work_of_cut_steps_is_estimated():
    whole, _ = measured((0.0, -9.81, 0.0), velocity=(2.0, 0.0, 0.0))
    cut, _ = measured((0.0, -9.81, 0.0), velocity=(2.0, 0.0, 0.0), substeps=3)
    assert whole.cut == 0 and cut.cut == 20 and cut.work == pytest.approx(3.0 * whole.work)


def test_jobs_of_the_table_of_friction():
    options = ipc.parser().parse_args(["--friction"])
    found = ipc.jobs(options)
    assert len(found) == len(STEPS) * len(TOLERANCES) and all(job.friction and job.size == FULL for job in found)
    assert {job.steps for job in found if job.case == "masonry_arch"} == {200}
    assert [job.steps for job in ipc.jobs(ipc.parser().parse_args(["--quick"]))] == [ipc.QUICK_STEPS] * len(CASES)


# --- the command ------------------------------------------------------------------------------------------------------


@judged
def test_command_prints_and_writes(tmp_path, capsys):
    path = tmp_path / "ipc.json"
    assert ipc.main(["--quick", "--scene", "twisted_rods", "--steps", "1", "--out", str(path)]) == 0
    numbers = json.loads(path.read_text())
    (one,) = (Record.read(data) for data in numbers["runs"])
    assert numbers["quick"] and one.job == Job("twisted_rods", SMALL, ipc.QUICK_BUDGET, steps=1) and one.status == OK
    assert one.steps == one.wanted_steps == 1 and one.nodes == 1600
    text = path.with_suffix(".md").read_text()
    assert "| twisted rods | 1,600 |" in text and "| twisted rods | 1,600 |" in capsys.readouterr().out
