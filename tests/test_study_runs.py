"""A study's real runs of small scenes, most of them in this process:

* the order of convergence that a study sees is that of the integrator;
* errors in space fall with refinement; energy and momentum are kept where they should be;
* a run that fails is a record with its reason; timed runs are on the cores and threads that were theirs.
"""

import os
import sys
from contextlib import nullcontext

import numpy as np
import pytest
from command import write
from study_places import InProcess

from taisoft.errors import SceneError
from taisoft.machine import usable_cores
from taisoft.simulator import Simulator
from taisoft.study import Request, measure
from taisoft.study.runner import Runner, tasks_of
from taisoft.study.workers import LocalPlace, carry_out, local_places

SCENE = '''"""A bar that swings: held at one end, or free and thrown."""
import taisoft as ts

solver = {"dt": 0.01, "integrator": "INTEGRATOR", "seconds": 0.4, "fps": 50}


def build():
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((2, 1, 1), (2.0, 1.0, 1.0)), ts.Material(young=1e5), name="bar")
    HOLD
    return scene
'''
HELD, FREE = "bar.fix(lambda X: X[:, 0] < -0.99)", "bar.velocity[:] = (1.0, 5.0, 0.0)"


@pytest.fixture
def lent(monkeypatch):
    """Runs that differ in dt alone get one simulator, from its start: compiling takes most of the time."""
    made: dict[tuple, Simulator] = {}

    def lend(scene, *, dt, **settings):
        key = (scene.bodies[0].n_nodes, *settings.items())
        if key not in made:
            made[key] = Simulator(scene, dt=dt, **settings)
        made[key].dt = dt
        made[key].reset()
        return nullcontext(made[key])

    monkeypatch.setattr(measure, "Simulator", lend)
    yield
    for sim in made.values():
        sim.close()


def study_of(tmp_path, hold: str = HELD, **request):
    path = write(tmp_path / "bar.py", SCENE.replace("HOLD", hold))
    place = InProcess()
    return run(place, Request(str(path), repeats=1, **request))


def run(place: InProcess, request: Request):
    runner = Runner(request, [place], [{"name": "here"}], lambda: False, lambda: 1.0, lambda _: None, planner=place)
    return runner.run(runner.plan())


@pytest.mark.parametrize(
    "integrator, order",
    [("velocity_verlet", 2), ("symplectic_euler", 1), ("implicit_euler", 1), ("bdf2", 2), ("implicit_midpoint", 2)],
)
def test_the_order_of_convergence_is_the_integrators(tmp_path, lent, integrator, order):
    axes = {"dt": [0.01, 0.005, 0.0025], "integrator": [integrator], "precision": ["f64"]}
    study = study_of(tmp_path, axes=axes, reference_integrator="velocity_verlet")
    rows = study.comparable_rows()
    assert [row.setting["dt"] for row in rows] == axes["dt"] and study.references[0].setting["integrator"] == "velocity_verlet"
    errors = np.array([row.in_time.rms for row in rows])
    assert np.allclose(np.log2(errors[:-1] / errors[1:]), order, atol=0.25), errors
    assert (errors > 10 * study.references[0].own_error.rms).all()  # so that they are facts
    assert all(row.status == "ok" and row.unconverged == 0 and row.energy_kept for row in rows)


def test_refinement_and_what_is_kept_in_flight(tmp_path, lent):
    axes = {"dt": [0.005], "integrator": ["velocity_verlet"], "precision": ["f64"], "refine": [0, 1]}
    study = study_of(tmp_path, FREE, axes=axes, reference_refine=0)
    coarse, fine = study.rows
    assert fine.nodes > coarse.nodes and fine.tets == 8 * coarse.tets
    for row in study.rows:  # nothing deforms: both meshes fly alike, and exactly
        assert row.in_time.max < 1e-9 and row.in_space.max < 1e-9 and row.energy < 1e-9 and row.momentum < 1e-9


def test_a_run_that_fails_is_a_record_with_its_reason(tmp_path):
    path = write(
        tmp_path / "bar.py",
        SCENE.replace("HOLD", "bar.move(lambda X: X[:, 0] < -0.99, path)")
        + ("\n\ndef path(t):\n    return (0, 0, 0) if t < 0.2 else 1 / 0\n"),
    )
    place = InProcess()
    request = Request(str(path), {"dt": [0.01], "integrator": ["velocity_verlet"], "precision": ["f64"]}, repeats=1)
    study = run(place, request)
    assert study.rows[0].status == "failed" and "ZeroDivisionError" in study.rows[0].reason
    assert "ZeroDivisionError" in study.notes[0]


@pytest.mark.parametrize(
    "solver, told",
    [
        ('{"dtt": 0.1}', "solver dict: no setting is called 'dtt' (did you mean dt?)"),
        ('{"dt": "a"}', "the scene's solver dict: dt must be a number, not 'a'"),
    ],
)
def test_a_bad_solver_dict_is_told(tmp_path, solver, told):
    path = write(tmp_path / "bar.py", SCENE.replace("HOLD", HELD) + f"\n\nsolver = {solver}\n")
    with pytest.raises(SceneError) as error:
        run(InProcess(), Request(str(path)))
    assert told in str(error.value)


def test_a_change_of_a_neighbour_or_of_a_refined_mesh_is_another_run(tmp_path):
    write(tmp_path / "neighbour_of_a_study.py", "YOUNG = 1e5")
    text = SCENE.replace("def build():", "def build(refine=0):\n    import neighbour_of_a_study as own")
    text = text.replace("1e5", "own.YOUNG")
    length = write(tmp_path / "length.txt", "2")
    text = text.replace("(2, 1, 1), (2.0", "(2, 1, 1), (float(open(LENGTH).read()) if refine else 2.0")
    path = write(tmp_path / "bar.py", text.replace("HOLD", HELD).replace("LENGTH", repr(str(length))))
    axes = {"dt": [0.01], "integrator": ["velocity_verlet"], "refine": [0, 1]}
    place = InProcess()
    runner = Runner(Request(str(path), axes), [place], [{"name": "here"}], bool, lambda: 1.0, str, planner=place)
    first = runner.plan()
    assert set(first["scenes"]) == {"refine 0", "refine 1"} and set(first["sources"]) == {"bar.py", "neighbour_of_a_study.py"}
    assert runner.plan() == first

    length.write_text("2.5")
    other = runner.plan()
    changed = [runner._key(first, task) != runner._key(other, task) for task in sum(tasks_of(first), [])]
    assert changed == [bool(task.setting["refine"]) for task in sum(tasks_of(first), [])] and any(changed)

    (tmp_path / "neighbour_of_a_study.py").write_text("YOUNG = 1e6")
    edited = runner.run(other)  # refused before anything is run
    assert all("it was changed meanwhile" in row.reason for row in edited.rows)
    third = runner.plan()
    assert all(runner._key(other, task) != runner._key(third, task) for task in sum(tasks_of(other), []))


# --- processes --------------------------------------------------------------------------------------------------------

PINNED = '''"""Tells its cores, as a scene that fails."""
import os


def build():
    import taichi, threading
    raise ValueError(f"cores {sorted(os.sched_getaffinity(0))}")
'''


def answers_of(requests: list, places: list) -> dict:
    answers: dict = {}
    assert carry_out(requests, places, answers.__setitem__, seconds_left=lambda: 1.0, stop_requested=lambda: False) == {}
    return answers


def request(path) -> dict:
    return {"action": "plan", "scene": str(path), "allow_outside": False, "request": {}}


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system pins no process")
def test_workers_are_pinned_to_cores_of_their_own(tmp_path):
    path = write(tmp_path / "pinned.py", PINNED)
    cores = usable_cores()
    number = min(2, len(cores))
    places = local_places(number)
    own = [set(place.cores) for place in places]
    assert len(own) == number and len(set.union(*own)) == sum(map(len, own)) <= len(cores)
    answers = answers_of([(str(k), request(path)) for k in range(number)], places)
    told = {answer["error"].partition("ValueError: ")[2] for answer in answers.values()}
    assert told == {f"cores {sorted(cores)}" for cores in own}


def test_a_process_that_ends_without_an_answer_is_told(tmp_path):
    path = write(tmp_path / "dead.py", "import os, sys\nprint('hello', file=sys.stderr, flush=True)\nos._exit(7)\n")
    answers = answers_of([("a", request(path))], [LocalPlace(usable_cores())])
    assert answers["a"] == {"crash": "its process ended with exit status 7 without an answer: hello"}


def test_a_process_that_reads_nothing_is_told():
    child = (sys.executable, "-c", "import os; os._exit(3)")
    large = {"text": "x" * 1_000_000}  # more than a pipe holds
    answers = answers_of([("a", large)], [LocalPlace(usable_cores(), child)])
    assert answers["a"] == {"crash": "its process ended with exit status 3 without an answer"}
    place = LocalPlace(usable_cores(), child)
    place.start(large)
    place.stop()
