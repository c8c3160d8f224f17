"""`run_many` with processes:

* values are the same bits in another process, whatever ran in it before, and on any number of threads;
* a row whose process ends is named, and the others go on; one that only fails after other rows is run again;
* Ctrl-C keeps what is done, processes end with their caller however that ends, and the same call goes on.
"""

import csv
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import taisoft as ts
from taisoft.machine import usable_cores
from taisoft.many.cluster import cluster_places, stop_on_worker
from taisoft.many.make import make_of
from taisoft.many.places import LocalPlace, carry_out
from taisoft.many.runs import CHILD
from tests.cli.command import ROOT
from tests.many import makes


def test_same_bits_whatever_ran_before_and_on_any_number_of_threads(monkeypatch):
    """Here in one process; then backwards, with another precision between, and after a simulator that is left open."""
    rows = [{"young": young} for young in (1e5, 2e5, 4e5)]
    here = [makes.beam(**row) for row in rows]
    monkeypatch.setenv("TAISOFT_THREADS", "2")
    between = [{"young": 1e5, "precision": "f64"}, {"young": 1e5, "precision": "f64", "closes": False}]
    there = ts.run_many(makes.beam, [*rows[:0:-1], *between, rows[0]], workers=1, progress=False)
    assert set(there["status"]) == {"ok"} and set(there["threads"]) == {2}, repr(there)
    assert there[2].values == there[3].values != there[4].values
    for one, row in zip(here, (there[4], there[1], there[0])):
        assert row.values["low"] == one["low"] and np.array_equal(row.arrays["x"], one["x"])


def test_a_row_whose_process_ends_is_named():
    rows = [{"a": 1}, {"a": 2, "how": "once"}, {"a": 3, "how": "die"}, {"a": 4}]
    results = ts.run_many(makes.add, rows, workers=1, progress=False)
    assert results["status"].tolist() == ["ok", "ok", "failed", "ok"] and "by signal SIGKILL" in results["problem"][2]


def test_rows_leave_no_state_to_others():
    for workers in (1, 2):
        assert len(set(ts.run_many(makes.leaves, [{"a": k} for k in range(4)], workers, progress=False)["before"])) == 1


def test_what_a_row_has_started_ends_with_it(tmp_path):
    place = LocalPlace(usable_cores(), CHILD, 1)
    request = make_of(makes.waits).request() | {"parameters": {"path": str(tmp_path / "pid")}}
    executing = threading.Thread(target=place.execute, args=[request])
    executing.start()
    wait_until(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    pid = int((tmp_path / "pid").read_text())
    place.stop()
    executing.join()
    wait_until(lambda: not Path(f"/proc/{pid}").exists() or "Z" in Path(f"/proc/{pid}/stat").read_text().split()[2])


def test_a_print_when_python_starts_disturbs_nothing(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text("print('hello')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (row,) = ts.run_many(makes.slow, [{"a": 1}], progress=False)
    assert row.status == "ok"


def rows_in(folder: Path) -> int:
    return len(list((folder / "runs").glob("*.json")))


def start(folder: Path, done: int) -> tuple[subprocess.Popen, list[int]]:
    """A script that runs `slow` into a folder, once some rows are done, and its processes."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, makes.__file__, folder], env=environment, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: rows_in(folder) >= done)
    children = Path(f"/proc/{process.pid}/task").glob("*/children")
    return process, [int(word) for path in children for word in path.read_text().split()]


def wait_until(happened) -> None:
    end = time.monotonic() + 30.0
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_interrupted_and_killed_runs_go_on(tmp_path):
    process, children = start(tmp_path, 3)
    assert len(children) == 2
    os.kill(process.pid, signal.SIGINT)
    assert "KeyboardInterrupt" in process.communicate(timeout=30)[1] and process.returncode
    rows = list(csv.DictReader((tmp_path / "table.csv").open()))
    first = [row for row in rows if row["status"] == "ok"]
    assert len(rows) == 12 and 3 <= len(first) == rows_in(tmp_path) < 12
    assert {row["problem"] for row in rows if row["status"] == "left out"} == {"it was interrupted"}

    process, more = start(tmp_path, len(first) + 2)
    process.kill()
    process.communicate()
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children + more))

    process, _ = start(tmp_path, 12)
    assert "of them already done" in process.communicate(timeout=30)[1] and process.returncode == 0
    rows = list(csv.DictReader((tmp_path / "table.csv").open()))
    assert [float(row["twice"]) for row in rows] == [2.0 * a for a in range(12)]
    assert sum(int(row["pid"]) in children for row in rows) == len(first)
    assert not list(tmp_path.rglob("*.part"))


def test_a_place_on_a_cluster_keeps_its_process_until_it_is_stopped():
    """With a client that executes in this process."""
    stopped = []

    def submit(function, *arguments, **_):
        answer = function(*arguments)
        return SimpleNamespace(done=lambda: True, status="finished", result=lambda: answer)

    def run(function, *arguments, **_):
        if function is stop_on_worker:
            stopped.append(function(*arguments))
        return {f"tcp://{k}": {"machine": {"name": "a"}, "cores": [0, 1]} for k in range(3)}

    places, _ = cluster_places(SimpleNamespace(submit=submit, run=run), CHILD, timed=False)
    assert [(place.cores, place.threads) for place in places] == [([0], 1)] * 3
    assert cluster_places(SimpleNamespace(submit=submit, run=run), CHILD, False, threads=5)[0][0].threads == 5
    request = make_of(makes.slow).request()
    answers: dict = {}
    carry_out([(k, request | {"parameters": {"a": k}}) for k in "ab"], places[:1], answers.__setitem__)
    pids = {answer["answer"]["values"]["pid"] for answer in answers.values()}
    assert len(answers) == 2 and len(pids) == 1 and len(stopped) == 1
