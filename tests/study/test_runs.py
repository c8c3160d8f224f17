"""Real runs of a study of small scenes, most of them in this process:

* the measured order of convergence is the integrator's;
* a failed run is recorded with the reason; timed runs are pinned to separate cores, also on a cluster, and do not outlive the
  study; the run of a lost place moves to another one.
"""

import os
from types import SimpleNamespace

import numpy as np
import pytest

from taisoft.cli.study import local_places
from taisoft.errors import SceneError
from taisoft.machine import usable_cores
from taisoft.many.cluster import cluster_places
from taisoft.many.places import LocalPlace, carry_out
from taisoft.processes import Child
from taisoft.study import Request
from taisoft.study.runner import CHILD, Runner, tasks_of
from tests.cli.command import write
from tests.study.study_places import InProcess

SCENE = '''"""A bar: fixed at one end, or in free flight."""
import taisoft as ts

solver = {"dt": 0.01, "integrator": "INTEGRATOR", "seconds": 0.4, "fps": 50}


def build():
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((2, 1, 1), (2.0, 1.0, 1.0)), ts.Material(young=1e5), name="bar")
    HOLD
    return scene
'''
FIXED = "bar.fix(lambda X: X[:, 0] < -0.99)"


def run(place: InProcess, request: Request):
    runner = Runner(request, [place], [{"name": "here"}], lambda: False, lambda: 1.0, lambda _: None, planner=place)
    return runner.run(runner.plan())


def test_measured_order_of_convergence_is_the_integrators(tmp_path):
    """Of symplectic Euler, 1."""
    axes = {"dt": [0.01, 0.005, 0.0025], "integrator": ["symplectic_euler"], "precision": ["f64"]}
    path = write(tmp_path / "bar.py", SCENE.replace("HOLD", FIXED))
    study = run(InProcess(), Request(str(path), repeats=1, axes=axes, reference_integrator="velocity_verlet"))
    rows = study.comparable_rows()
    assert [row.setting["dt"] for row in rows] == axes["dt"] and study.references[0].setting["integrator"] == "velocity_verlet"
    errors = np.array([row.in_time.rms for row in rows])
    assert np.allclose(np.log2(errors[:-1] / errors[1:]), 1, atol=0.25), errors
    assert (errors > 10 * study.references[0].own_error.rms).all()  # errors are resolved
    assert all(row.status == "ok" and row.numbers["unconverged"] == 0 and row.numbers["energy_kept"] for row in rows)


def test_a_failed_run_is_recorded_with_the_reason(tmp_path):
    text = SCENE.replace("HOLD", "bar.move(lambda X: X[:, 0] < -0.99, path)")
    path = write(tmp_path / "bar.py", text + "\n\ndef path(t):\n    return (0, 0, 0) if t < 0.2 else 1 / 0\n")
    axes = {"dt": [0.01], "integrator": ["symplectic_euler"], "precision": ["f64"]}
    study = run(InProcess(), Request(str(path), axes, repeats=1))
    assert study.rows[0].status == "failed" and "ZeroDivisionError" in study.rows[0].reason
    assert "ZeroDivisionError" in study.notes[0]


def test_invalid_solver_dict_is_rejected(tmp_path):
    path = write(tmp_path / "bar.py", SCENE.replace("HOLD", FIXED) + '\n\nsolver = {"dtt": 0.1}\n')
    with pytest.raises(SceneError, match="solver dict: no setting is called 'dtt' .did you mean dt"):
        run(InProcess(), Request(str(path)))


def test_changed_import_or_refined_mesh_makes_another_run(tmp_path):
    write(tmp_path / "module_of_a_study.py", "YOUNG = 1e5")
    text = SCENE.replace("def build():", "def build(refine=0):\n    import module_of_a_study as numbers")
    text = text.replace("1e5", "numbers.YOUNG")
    length = write(tmp_path / "length.txt", "2")
    text = text.replace("(2, 1, 1), (2.0", "(2, 1, 1), (float(open(LENGTH).read()) if refine else 2.0")
    path = write(tmp_path / "bar.py", text.replace("HOLD", FIXED).replace("LENGTH", repr(str(length))))
    axes = {"dt": [0.01], "integrator": ["velocity_verlet"], "refine": [0, 1]}
    place = InProcess()
    runner = Runner(Request(str(path), axes), [place], [{"name": "here"}], bool, lambda: 1.0, str, planner=place)
    first = runner.plan()
    assert set(first["scenes"]) == {"refine 0", "refine 1"} and set(first["sources"]) == {"bar.py", "module_of_a_study.py"}
    assert runner.plan() == first

    length.write_text("2.5")
    other = runner.plan()
    changed = [runner.key(first, task) != runner.key(other, task) for task in sum(tasks_of(first), [])]
    assert changed == [bool(task.setting["refine"]) for task in sum(tasks_of(first), [])] and any(changed)

    (tmp_path / "module_of_a_study.py").write_text("YOUNG = 1e6")
    edited = runner.run(other)  # refused before anything is run
    assert all("it was changed meanwhile" in row.reason for row in edited.rows)
    third = runner.plan()
    assert all(runner.key(other, task) != runner.key(third, task) for task in sum(tasks_of(other), []))


PINNED = "import os\nraise ValueError(f'cores {sorted(os.sched_getaffinity(0))}')\n"


def answers_of(requests: list, places: list) -> dict:
    answers: dict = {}
    assert carry_out(requests, places, answers.__setitem__) == {}
    return answers


def request(path) -> dict:
    return {"action": "plan", "scene": str(path), "allow_outside": False, "request": {}}


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system pins no process")
def test_workers_are_pinned_to_separate_cores(tmp_path):
    path = write(tmp_path / "pinned.py", PINNED)
    cores = usable_cores()
    number = min(2, len(cores))
    places = local_places(number)
    core_sets = [set(place.cores) for place in places]
    assert len(core_sets) == number and len(set.union(*core_sets)) == sum(map(len, core_sets)) <= len(cores)
    answers = answers_of([(str(k), request(path)) for k in range(number)], places)
    reported = {answer["error"].partition("ValueError: ")[2] for answer in answers.values()}
    assert reported == {f"cores {sorted(cores)}" for cores in core_sets}


def test_processes_that_exit_early_are_reported(tmp_path):
    """Without an answer, and without reading the request."""
    path = write(tmp_path / "dead.py", "import os, sys\nprint('hello', file=sys.stderr, flush=True)\nos._exit(7)\n")
    answers = answers_of([("a", request(path))], [LocalPlace(usable_cores(), CHILD)])
    assert answers["a"] == {"crash": "its process ended with exit status 7 without an answer: hello"}
    child = ("-c", "import os; os._exit(3)")
    large = {"text": "x" * 1_000_000}  # more than a link holds
    answers = answers_of([("a", large)], [LocalPlace(usable_cores(), child)])
    assert answers["a"] == {"crash": "its process ended with exit status 3 without an answer"}


def test_a_run_ends_with_its_study(tmp_path):
    """Its process ends when its link is closed."""
    child = Child(*CHILD)
    child.link.send(request(write(tmp_path / "slow.py", "import time\ntime.sleep(100)\n")))
    child.link.close()
    assert child.how_it_ended() == "its process ended by signal SIGKILL"


def test_workers_of_a_cluster_use_separate_cores_and_may_be_lost():
    def places(*infos):
        table = {f"tcp://{k}": {"machine": {"name": name}, "cores": cores} for k, (name, cores) in enumerate(infos)}
        return cluster_places(SimpleNamespace(run=lambda function: table), CHILD)

    found, machines = places(("a", [0, 1, 2, 3, 4]), ("a", [0, 1, 2, 3, 4]), ("b", [0, 1, 2]))
    assert [place.cores for place in found] == [[0, 1], [2, 3], [0, 1]] and machines == [{"name": "a"}, {"name": "b"}]
    with pytest.raises(SceneError, match="2 workers on a share 1 cores"):
        places(("a", [0]), ("a", [0]))

    class Place(InProcess):
        def execute(self, request):
            self.requests.append(request)
            return {"lost": "it is gone"} if self.is_lost else {"answer": request}

    lost, kept = Place(), Place()
    lost.is_lost, kept.is_lost = True, False
    assert answers_of([("a", {"n": 1}), ("b", {"n": 2})], [lost, kept]) == {"a": {"answer": {"n": 1}}, "b": {"answer": {"n": 2}}}
    assert len(lost.requests) == 1
    left = carry_out([("a", {})], [lost], print)
    assert left == {"a": "it is gone"}
