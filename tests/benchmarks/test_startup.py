"""`taisoft bench startup`:

* the first simulator compiles; another one, of any size and also in another process, compiles nothing;
* a larger surface compiles nothing, unless detection switches to parallel kernels; memory is measured over many simulators;
* versions are measured alternately, at another mesh size each round; timed calls have the names of the limits;
* the page has times, counts and limits; a child process that fails is named.
"""

import json
from pathlib import Path

import pytest

from benchmarks import startup, startup_child
from benchmarks.runner import Version
from taisoft.errors import SimulationError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def version(tmp_path_factory):
    return Version(ROOT, tmp_path_factory.mktemp("cache"))


@pytest.mark.parametrize("name, cells, other", [("beam", 1, 2), ("cube", 1, 2)])
def test_only_the_first_simulator_compiles(version, name, cells, other):
    found, times = startup.run_child(version, "again", name, cells, other)
    assert found["first"]["compiled"] > 0 and found["second"]["compiled"] == found["other size"]["compiled"] == 0
    assert times["wall"] > found["first"]["wall"] > found["second"]["wall"]
    before = version.files()
    startup.run_child(version, "first", name, other + 1)
    assert before and version.files() == before


@pytest.mark.filterwarnings("ignore:body")  # few tets through the thickness
def test_walk_takes_the_given_steps():
    with startup_child.ts.Simulator(startup_child.cube(1), **startup_child.SCENES["cube"][1]) as sim:
        startup_child.walk(sim, 3)
        assert sim.step_count == 3


def test_a_larger_surface_compiles_only_parallel_detection(version):
    first, second, crossing, last = startup.run_child(version, "surfaces", *startup.TASKS["surfaces"][0])[0].items()
    assert (first[0], crossing[0]) == ("224 triangles", startup.CROSSING)
    assert first[1] > crossing[1] > 0 == second[1] == last[1]


def test_memory_of_simulators_is_measured(version):
    for task in (("grow", "cube", 1, 1), ("keep", 1, 1)):
        found = startup.run_child(version, *task)[0]
        assert found["times"] == 1 and 0 < found["start"] < 2 * found["end"]


def test_speed_has_the_names_of_the_limits(version, monkeypatch):
    monkeypatch.setattr(startup, "SPEED_SHEETS", (2, 3))
    labels = {f"{what}, {startup_child.triangles(n)}" for what in ("search", "contact step") for n in (2, 3)}
    names = {name for name in startup.SLOWER if "triangles" not in name} | labels
    monkeypatch.setattr(startup, "SLOWER", names)
    (found,) = startup.measure_speed([version], quick=True)
    assert found.keys() == names and all(len(seconds) == 1 and seconds[0] > 0 for seconds in found.values())


@pytest.mark.filterwarnings("ignore:body")  # few tets through the thickness
def test_sheets_have_the_sizes_of_the_limits():
    for cells in startup.SPEED_SHEETS:
        assert f"search, {startup_child.triangles(cells)}" in startup.SLOWER
        scene = startup_child.sheet(cells)
        assert startup_child.triangles(cells) == f"{sum(len(body.nodes.surface) for body in scene.bodies):,} triangles"


class Recorded:
    """A version that records its tasks; each takes twice the time of the one before."""

    def __init__(self, name: str, tasks: list):
        self.name, self.tasks = name, tasks

    def ask(self, *task):
        self.tasks.append((self.name, *task))
        return {}, {"wall": 2.0 ** len(self.tasks), "cpu": 1.0}

    def files(self):
        return {len(self.tasks)} if self.name == "old" else set()


def test_versions_are_measured_alternately(monkeypatch):
    tasks: list = []
    monkeypatch.setattr(startup, "run_child", lambda version, *task: version.ask(*task))
    new, old = startup.measure_waiting([Recorded("new", tasks), Recorded("old", tasks)], "cube", quick=False)
    firsts = [(task[0], task[3]) for task in tasks if task[1] == "first"]
    assert firsts == [(name, n) for n in (4, 4, 5, 4, 6, 4, 7) for name in ("new", "old")]
    assert new["new files"] == [0, 0, 0] and old["new files"] == [1, 1, 1]
    assert startup.ratio(*(one[startup.OTHER]["walls"] for one in (new, old))) == 0.5


def test_a_failing_child_is_named(version):
    with pytest.raises(SimulationError, match="task first nobody 1 ended with status 1: KeyError: 'nobody'"):
        startup.run_child(version, "first", "nobody", 1)


def numbers(seconds: float, compiled: int) -> dict:
    times = {"wall": seconds, "cpu": seconds, "walls": [seconds] * 3, "compiled": compiled}
    memory = {"start": 300.0, "end": 301.0, "times": 4}
    one = {
        "cold": times,
        "warm": times,
        "warm, other size": times,
        "new files": [0, compiled],
        "memory": memory,
        "one process": {"first": times, "second": times, "other size": times},
    }
    return {
        "beam": one,
        "cube": one,
        "statics": {str(k): times for k in range(3)},
        "identify": times,
        "settings": {"reset": 1e-3 * seconds},
        "surfaces": {"224 triangles": 9, "284 triangles": compiled},
        "keep": memory,
        "speed": dict.fromkeys(startup.SLOWER, [1e-3, 1.1e-3, 2e-3]),
    }


def test_page_and_exit_status(monkeypatch, tmp_path, capsys):
    found = {ROOT: numbers(0.5, 0), tmp_path: numbers(10.0, 3)}
    monkeypatch.setattr(startup, "measure", lambda versions, quick: [found[version.folder] for version in versions])
    out = tmp_path / "page.json"
    assert startup.main(["--baseline", str(tmp_path), "--out", str(out)]) == 0
    page = out.with_suffix(".md").read_text()
    assert "| beam, cold " in page and "10 (10)" in page and "0.5 (0.5)" in page and "NOT met" not in page
    assert "over 4 simulators" in page and page.strip() in capsys.readouterr().out
    assert len(json.loads(out.read_text())["limits"]) == 25
    found[ROOT] = numbers(2.0, 1)
    assert startup.main(["--baseline", str(tmp_path)]) == 1
    assert "NOT met" in capsys.readouterr().out
    assert startup.main(["--quick"]) == 0
    assert "## Limits" not in capsys.readouterr().out
