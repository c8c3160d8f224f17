"""`run_many` without processes: rows are executed in this one.

* every row has its status: of a report, of an exception, which does not stop the others, or of what must not be returned;
* rows in a folder are not run again unless they raised, are damaged or of another source; new ones are added;
* what no other process could import or receive, and folders of other results are refused in a sentence;
* the plan says how workers and threads fit the machine.
"""

import json
import sys
from contextlib import closing
from functools import partial
from importlib import import_module

import numpy as np
import pytest

import taisoft as ts
from taisoft import processes
from taisoft.errors import OutputError, SceneError, SimulationError
from taisoft.machine import thread_count
from taisoft.many import make, runs
from taisoft.many.results import Results
from taisoft.nested import from_json
from taisoft.output.folder import FolderLock
from tests.many import makes
from tests.many.stand_in import InProcess


def named(status: int) -> dict:
    """Its argument has the name of a column."""
    return {}


ROWS = [{"a": 1}, {"a": 2, "b": 0.5}, {"a": 3, "how": "degraded"}]


@pytest.fixture(autouse=True)
def requests(monkeypatch) -> list[dict]:
    """What was executed."""
    monkeypatch.setattr(InProcess, "requests", [])
    monkeypatch.setattr(runs, "LocalPlace", InProcess)
    state = np.random.get_state()
    yield InProcess.requests
    np.random.set_state(state)


def test_rows_and_their_status(capsys):
    results = ts.run_many(makes.add, [*ROWS, {"a": 1, "how": "raise"}, {"a": 1, "how": "exit"}, {"a": 1, "how": "warn"}])
    assert results["status"].tolist() == ["ok", "ok", "degraded", "failed", "failed", "ok"]
    assert np.array_equal(results["sum"], [2.0, 2.5, 4.0, np.nan, np.nan, 2.0], equal_nan=True)
    assert [row.problems for row in results[2:]][::3] == [["two steps did not converge"], ["warning: thin"]]
    line = 1 + next(k for k, text in enumerate(open(makes.__file__)) if "no\\nsuch" in text)
    assert results[3].problems == [f"ValueError: no such thing (makes.py, line {line})"]
    assert results[4].problems[0].startswith("SystemExit: 3")
    assert results[0].values == {"sum": 2.0, "is_big": False, "name": "<1>", "nothing": None, "noise": results[0].values["noise"]}
    assert results.arrays("path")[2].tolist() == [0, 1, 2] and (results["wall_seconds"] >= 0).all()
    error = capsys.readouterr().err
    assert error.startswith("taisoft: 6 runs, ") and "failed: a=1, how='raise': ValueError: no such thing" in error


def test_random_numbers_depend_on_the_parameters_alone():
    first, second = (ts.run_many(makes.add, rows, progress=False) for rows in (ROWS, ROWS[::-1]))
    assert first.digest() == second.digest() and len(set(first["noise"])) == 3


@pytest.mark.parametrize(
    "kind, message",
    [
        ("list", "must return a mapping from names to values, not"),
        ("word", "the name 'two words': it must be a word"),
        ("parameter", "the name 'kind', which is a parameter's"),
        ("column", "a RunReport sets the status"),
        ("object", "it must be a number, a text, None or an array of numbers"),
    ],
)
def test_other_results_fail(kind, message):
    (row,) = ts.run_many(makes.returned, [{"kind": kind}], progress=False)
    assert row.status == "failed" and message in row.problems[0]


def test_finished_rows_are_not_run_again(tmp_path, requests):
    run = partial(ts.run_many, makes.add, workers=1, out=tmp_path / "out", progress=False)
    failing = {"a": 5, "how": "raise"}
    first = run([*ROWS, ROWS[0], failing])
    assert requests == [*ROWS, failing] and first[3] is first[0]
    requests.clear()
    again = run([{"a": 9}, failing, *ROWS])
    assert requests == [{"a": 9}, failing] and Results(again[2:]).digest() == Results(first[:3]).digest()
    assert [row.wall_seconds for row in again[2:]] == [row.wall_seconds for row in first[:3]]
    report = json.loads((tmp_path / "out" / "many.json").read_text())
    assert report["make"] == "tests.many.makes:add" and report["digest"] == again.digest()
    assert [line.split(",")[0] for line in (tmp_path / "out" / "table.csv").read_text().splitlines()] == list("a95123")


def test_damaged_rows_and_those_of_another_source_or_taisoft_are_run_again(tmp_path, requests, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    source, text = tmp_path / "many_made.py", "def double(a):\n    return {'b': 2 * a, 'nan': float('nan'), 'x': [a, 0.1]}\n"
    source.write_text(text)
    run = partial(ts.run_many, import_module("many_made").double, out=tmp_path / "out", progress=False)
    first = run([{"a": 1}, {"a": 2}])
    path = sorted((tmp_path / "out" / "runs").iterdir())[1]
    assert from_json(path.read_bytes())["record"]["arrays"]["x"].tolist() in ([1.0, 0.1], [2.0, 0.1])
    path.write_bytes(path.read_bytes()[:-40])
    requests.clear()
    again = run([{"a": 1}, {"a": 2}])
    assert len(requests) == 1 and f"{path} is damaged and its run is repeated" in repr(again)
    assert again.digest() == first.digest()

    requests.clear()
    source.write_text(text + "# edited\n")
    assert "2 rows were done by another version of many_made.py" in repr(run([{"a": 1}, {"a": 2}]))
    assert len(requests) == 2
    source.write_text(text)
    request = make.Make.request
    monkeypatch.setattr(make.Make, "request", lambda self: request(self) | {"code": "edited"})
    with pytest.raises(SceneError, match="taisoft, Taichi or NumPy of the other process differs"):
        run([{"a": 1}, {"a": 2}])


def test_modules_reached_through_a_link_count_as_source(tmp_path, requests, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    monkeypatch.syspath_prepend(tmp_path / "link")
    helper = tmp_path / "real" / "many_helper.py"
    helper.write_text("K = 1\n")
    (tmp_path / "real" / "many_linked.py").write_text("import many_helper\ndef k(a):\n    return {'k': many_helper.K}\n")
    run = partial(ts.run_many, import_module("many_linked").k, [{"a": 1}], out=tmp_path / "out", progress=False)
    run()
    helper.write_text("K = 7\n")
    requests.clear()
    assert "1 rows were done by another version" in repr(run()) and len(requests) == 1


def test_a_module_that_hides_the_functions_own_is_refused(tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    for folder, value in ((tmp_path, 1), (tmp_path / "own", 2)):
        (folder / "many_shadow.py").write_text(f"def f(a):\n    return {{'y': {value}}}\n")
    monkeypatch.syspath_prepend(tmp_path / "own")
    module = import_module("many_shadow")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "many_shadow")
    made = make.Make("many_shadow", str(tmp_path / "own" / "many_shadow.py"), "f", str(tmp_path / "own"))
    with pytest.raises(ImportError, match="by this name, not .*own/many_shadow.py: give the file another name"):
        made.load()
    assert module.f(0) == {"y": 2}


def test_ended_processes_are_failed_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(InProcess, "crash", "its process ended by signal SIGSEGV without an answer")
    results = ts.run_many(makes.add, ROWS, out=tmp_path, progress=False)
    assert set(results["status"]) == {"failed"} and "SIGSEGV" in results["problem"][2]
    assert list((tmp_path / "runs").iterdir()) == []


def test_what_cannot_be_run_is_refused(tmp_path, requests, monkeypatch):
    def local(a):
        return {}

    for function, parameters, message in (
        (lambda a: {}, ROWS, "top level of a module or script, which other processes can import, not <function"),
        (local, ROWS, "top level of a module"),
        (partial(makes.add, b=2), ROWS, "top level of a module"),
        (makes.add, {"a": [1, 2]}, "must be a list of mappings, such as"),
        (makes.add, [{"a": 1}, 2], r"parameters\[1\] must be a mapping"),
        (makes.add, [{"a": 1}, {"b": 2}], r"parameters\[1\] do not fit add\(.*missing a required argument: 'a'"),
        (makes.returned, [{"status": 1}], r"parameters\[0\] do not fit"),
        (named, [{"status": 1}], r"parameters\[0\]: 'status' is a column of every table"),
        (makes.add, [{"a": [1, object()]}], r"parameters\[0\]\['a'\]\[1\] must be a number, a text"),
    ):
        with pytest.raises(SceneError, match=message):
            ts.run_many(function, parameters, out=tmp_path / "out")
    for values, message in (({"workers": 0}, "workers must be"), ({"workers": 1, "cluster": "tcp://a:1"}, "give one of them")):
        with pytest.raises(SceneError, match=message):
            ts.run_many(makes.add, ROWS, out=tmp_path / "out", **values)
    monkeypatch.delattr(makes, "__file__")
    with pytest.raises(SceneError, match="add, is defined in a notebook or console.*%%writefile my_runs.py"):
        ts.run_many(makes.add, ROWS)
    monkeypatch.setattr(processes, "serving", True)
    with pytest.raises(SceneError, match="if __name__ == '__main__'"):
        ts.run_many(makes.add, ROWS)
    assert not (tmp_path / "out").exists() and requests == []


def test_folders_of_other_results_are_refused(tmp_path):
    run = partial(ts.run_many, progress=False)
    run(makes.add, ROWS, out=tmp_path / "add")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "report.json").write_text("{}")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "many.json").write_text("[]")
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "study.json").write_text("{}")
    for folder, message in (
        ("study", "holds a study"),
        ("add", "holds runs of tests.many.makes:add, not of tests.many.makes:slow"),
        ("run", "already holds results"),
        ("odd", "was not written by run_many"),
    ):
        with pytest.raises(OutputError, match=message):
            run(makes.slow, ROWS[:1], out=tmp_path / folder)
    with closing(FolderLock(tmp_path / "add")), pytest.raises(OutputError, match="is writing to the output folder"):
        run(makes.add, ROWS, out=tmp_path / "add")


def test_workers_and_threads_fit_the_machine(monkeypatch, capsys):
    monkeypatch.setattr(runs, "usable_cores", lambda: list(range(8)))
    for threads, workers, n, plan in (
        ("", None, 20, "8 workers with 1 thread each"),
        ("", None, 2, "2 workers with 4 threads each"),
        ("", 3, 20, "3 workers with 2 threads each"),
        ("", 9, 20, "9 workers with 1 thread each"),
        ("4", None, 20, "2 workers with 4 threads each"),
        ("2", 8, 20, "8 workers with 2 threads each"),
    ):
        monkeypatch.setenv("TAISOFT_THREADS", threads)
        ts.run_many(makes.returned, [{"kind": "list"}] + [{"kind": str(k)} for k in range(1, n)], workers)
        assert capsys.readouterr().err.splitlines()[0] == f"taisoft: {n} runs, {plan}"
    assert thread_count(3) == 2
    for wrong in ("0", "two", "-1", "1.5", "9999"):
        monkeypatch.setenv("TAISOFT_THREADS", wrong)
        with pytest.raises(SimulationError, match=f"a whole number from 1 to 1024, not '{wrong}'"):
            ts.run_many(makes.add, ROWS)
