"""Short cases against their stored results in benchmarks/data/regression.json:

* a number that changes by more than its margin is reported, also if it improves; changes within the margin are not;
* stored entries are read back, beside other cases and archs; damaged files are refused;
* the benchmark prints differences, stores them with --update, and returns an exit status.
"""

import json
from dataclasses import replace

import pytest

from benchmarks import regression
from benchmarks.regression import STORE, Entry, baseline, differences, load, make_entry, store
from benchmarks.regression_cases import CASES, Found
from taisoft.errors import OutputError

NAMES = [case.name for case in CASES]
ENTRY = Entry([1.0, -2.0], 0.01, {"newton": 100, "contacts": 9}, "ok", 1_000_000, 3.5)
CASE = CASES[0]


@pytest.mark.long
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_results_are_as_stored(case):
    """In turn with the precision of the case; a search is among the runs of test_all.py."""
    stored = load("cpu", STORE)[case.name]
    assert differences(case, make_entry(case.run("cpu"), stored.reference, 1.0), stored) == []


def test_every_case_is_stored():
    stored = load("cpu", STORE)
    assert list(stored) == NAMES and len(set(NAMES)) == len(NAMES)
    assert all(entry.status == "ok" and entry.error < 0.2 for entry in stored.values()) and 1e-4 < baseline() < 60.0


@pytest.mark.parametrize(
    "start, changes",
    [
        ("error 0.0107", {"error": 0.0107}),
        ("error 0.009", {"error": 0.009}),
        ("error nan", {"error": float("nan")}),
        ("status 'degraded'", {"status": "degraded"}),
        ("field bytes 1002000", {"field_bytes": 1_002_000}),
        ("newton 106", {"counts": {"newton": 106, "contacts": 9}}),
        ("contacts 0", {"counts": {"newton": 100}}),
        ("sweeps 3", {"counts": {"newton": 100, "contacts": 9, "sweeps": 3}}),
        (None, {"error": 0.0104, "time": 99.0, "field_bytes": 1_000_500, "counts": {"newton": 105, "contacts": 11}}),
    ],
)
def test_changes_beyond_the_margin_are_reported(start, changes):
    found = differences(CASE, replace(ENTRY, **changes), ENTRY)
    assert found == [] if start is None else len(found) == 1 and found[0].startswith(f"{start}, stored ")
    tiny = replace(ENTRY, error=1e-7)  # errors below the slack are not compared
    assert [differences(CASE, replace(tiny, error=k * CASE.slack), tiny) == [] for k in (0.9, 2.0)] == [True, False]


def test_stored_entries_are_read_back(tmp_path):
    path = tmp_path / "stored.json"
    assert load("cpu", path) == {}
    store({NAMES[1]: ENTRY, NAMES[0]: ENTRY}, "cpu", path)
    store({NAMES[2]: replace(ENTRY, error=0.5)}, "cuda", path)
    store({NAMES[1]: replace(ENTRY, time=1.0)}, "cpu", path)
    assert load("cpu", path) == {NAMES[0]: ENTRY, NAMES[1]: replace(ENTRY, time=1.0)} and list(load("cpu", path)) == NAMES[:2]
    assert load("cuda", path) == {NAMES[2]: replace(ENTRY, error=0.5)}
    stored = json.loads(path.read_text())
    stored["cpu"]["cases"]["a removed case"] = stored["cpu"]["cases"][NAMES[0]]
    path.write_text(json.dumps(stored))
    store({}, "cpu", path)
    assert list(load("cpu", path)) == NAMES[:2]
    for text in ("{", "[]", '{"cpu": {"cases": {"a": {"error": 1}}}}'):
        path.write_text(text)
        with pytest.raises(OutputError, match="stored.json"):
            load("cpu", path)


def test_the_benchmark_prints_and_stores_differences(monkeypatch, tmp_path, capsys):
    newton = [100]

    def run(arch):
        return Found([1.0, -2.02], {"newton": newton[0]}, "ok", 1000, 1.0)

    fake = replace(CASE, name="fake", what="made up", run=run, reference=lambda arch: [1.0, -2.0])
    monkeypatch.setattr(regression, "CASES", (fake,))
    monkeypatch.setattr(regression, "STORE", tmp_path / "stored.json")
    monkeypatch.setattr(regression, "baseline", lambda: 0.5)
    assert regression.main([]) == 2 and "--update" in capsys.readouterr().out
    assert regression.main(["--update"]) == 0
    assert load("cpu", regression.STORE)["fake"] == Entry([1.0, -2.0], pytest.approx(0.01), {"newton": 100}, "ok", 1000, 2.0)
    assert regression.main([]) == 0 and "nothing has changed" in capsys.readouterr().out
    newton[0] = 120
    assert regression.main([]) == 1
    printed = capsys.readouterr().out
    assert "CHANGED" in printed and "* fake: newton 120, stored 100 (made up)" in printed
    assert regression.main(["--update", "--only", "fa"]) == 0 and regression.main([]) == 0
