"""`taisoft bench startup`, and what it measures:

* a first simulator compiles, a second one and one of another size compile nothing, nor does a process with another mesh size;
* the page tells waiting, counts and limits; a child that fails is named;
* a first run on a machine says so once; `taisoft warm` leaves kernels in the cache.
"""

import json
from pathlib import Path

import pytest

from benchmarks import startup
from taisoft.errors import SimulationError

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def version(tmp_path_factory):
    return startup.Version(ROOT, tmp_path_factory.mktemp("cache"))


@pytest.mark.parametrize("name, cells, other", [("beam", 1, 2), ("cube", 1, 2)])
def test_nothing_compiles_twice(version, name, cells, other):
    found, times = version.run("again", name, cells, other)
    assert found["first"]["compiled"] > 0 and found["second"]["compiled"] == found["other size"]["compiled"] == 0
    assert times["wall"] > found["first"]["wall"] > found["second"]["wall"]
    before = version.files()
    version.run("first", name, other + 1)
    assert before and version.files() == before


def test_a_child_that_fails(version):
    with pytest.raises(SimulationError, match="task first nobody 1 ended with status 1: KeyError: 'nobody'"):
        version.run("first", "nobody", 1)


def numbers(seconds: float, compiled: int) -> dict:
    times = {"wall": seconds, "cpu": seconds, "compiled": compiled}
    one = {
        "cold": times, "warm": times, "warm, other size": times, "new files": 0, "memory": {"start": 300.0, "end": 301.0},
        "one process": {"first": times, "second": times, "other size": times},
    }  # fmt: skip
    return {
        "beam": one, "cube": one, "statics": {str(k): times for k in range(3)}, "identify": times,
        "settings": {"reset": 1e-3 * seconds},
    }  # fmt: skip


def test_the_page(monkeypatch, tmp_path, capsys):
    found = {ROOT: numbers(0.5, 0), tmp_path: numbers(10.0, 3)}
    monkeypatch.setattr(startup, "measure", lambda version, quick: found[version.folder])
    monkeypatch.setattr(
        startup, "measure_speed", lambda versions, quick: [dict.fromkeys(startup.SLOWER, [1e-3, 1.1e-3, 2e-3])] * len(versions)
    )
    out = tmp_path / "page.json"
    assert startup.main(["--baseline", str(tmp_path), "--out", str(out)]) == 0
    page = out.with_suffix(".md").read_text()
    assert "| beam, cold " in page and "10 (10)" in page and "0.5 (0.5)" in page and "NOT met" not in page
    assert len(json.loads(out.read_text())["limits"]) == 18 and page.strip() in capsys.readouterr().out
    found[ROOT] = numbers(2.0, 1)
    assert startup.main(["--baseline", str(tmp_path)]) == 1
    assert "NOT met" in capsys.readouterr().out
    assert startup.main(["--quick"]) == 0
    assert "## Limits" not in capsys.readouterr().out
