"""The benchmark of tolerances:

* times are compared with the fastest fixed setting that meets the tolerance, where there is one;
* the command measures a scene, and writes its rows and its grid;
* references and errors of fixed settings are kept from one run of it to the next, until the code changes.
"""

import json
import math

import numpy as np

from benchmarks import stored_runs, tolerance
from benchmarks.document import Limit
from benchmarks.error_cases import CASES
from benchmarks.stored_runs import StoredRuns
from benchmarks.tolerance import Fixed, Row, find_limits, fps_of, row_table
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT


def row(tolerance=0.01, true=1e-3, best=1.0, **more) -> Row:
    """A row with made-up numbers: it takes 1.2 s."""
    fixed = None if best is None else Fixed("bdf2", 4, true, best)
    numbers = {"name": "made up", "integrator": "bdf2", "steps": 4, "status": "ok", "estimated": 1e-3, "own": 1e-5}
    return Row(tolerance=tolerance, true=true, best=fixed, **{"seconds": 1.2, "pilots": 0.2, "observed": 1.5} | numbers | more)


def met(limits: list[Limit]) -> list[bool]:
    return [limit.met for limit in limits]


def test_rows_set_the_limits():
    assert row().met and row().ratio == 1.2 and math.isnan(row(best=None).ratio)
    assert met(find_limits([row(), row(0.1)])) == [True] * 4
    assert met(find_limits([row(), row(0.1, true=0.2)])) == [False, True, True, True]
    assert met(find_limits([row(best=0.5), row(), row()])) == [True, True, False]
    assert met(find_limits([row(best=1.0, seconds=1.4)])) == [True, False, True]


def test_the_table_shows_what_was_not_met():
    text = row_table([row(true=0.1, status="degraded", best=None), row(true=0.1), row(estimated=None)])
    assert "no, but reported" in text and "none" in text and "unknown" in text


def test_frames_of_every_scene_are_whole():
    for case in CASES:
        frames = case.seconds * fps_of(case)
        assert abs(frames - round(frames)) < 1e-9 and frames > 20


def test_the_command_measures_a_scene(tmp_path, capsys, monkeypatch):
    out, runs, path = tmp_path / "tolerance.json", [], tolerance.Scene.path

    def counted(scene, *steps, **settings):
        runs.append((steps, settings))
        return path(scene, *steps, **settings)

    monkeypatch.setattr(tolerance.Scene, "path", counted)
    monkeypatch.setattr(tolerance, "STEPS", (1, 2))
    monkeypatch.setattr(tolerance, "StoredRuns", lambda: StoredRuns(tmp_path / "stored"))
    tolerance.main(["--scene", "hanging beam", "--out", str(out)])  # 1 where it is slower than its limit
    found = json.loads(out.read_text())
    grid = found["grids"]["hanging beam"]
    assert {one["integrator"] for one in grid} == {*EXPLICIT, *IMPLICIT} and len(grid) <= 2 * 4 + 4 * 2
    assert [one["tolerance"] for one in found["rows"]] == [0.1, 0.01, 0.001]
    assert all(one["true"] <= one["tolerance"] and one["own"] < 1e-4 for one in found["rows"])
    assert "| hanging beam " in capsys.readouterr().out
    first, runs[:] = [*runs], []
    tolerance.main(["--scene", "hanging beam", "--wish", "1", "--out", str(out)])
    assert first and not [one for one in runs if one in first]  # measured times may take a grid further than the first one
    again = json.loads(out.read_text())["rows"]
    assert [(one["tolerance"], one["true"]) for one in again] == [(0.01, found["rows"][1]["true"])]


def test_arrays_are_stored_until_the_code_changes(tmp_path, monkeypatch):
    def get(value: float, request: int = 1) -> float:
        return float(StoredRuns(tmp_path).get(["request", request], lambda: np.array(value)))

    assert [get(1.0), get(2.0), get(3.0, request=2)] == [1.0, 1.0, 3.0]
    for file in tmp_path.iterdir():
        file.write_bytes(b"damaged")
    assert [get(4.0), get(5.0)] == [4.0, 4.0]
    monkeypatch.setattr(stored_runs, "code_digest", lambda _: "other")
    assert get(6.0) == 6.0
    (tmp_path / "file").touch()
    assert float(StoredRuns(tmp_path / "file").get([], lambda: np.array(7.0))) == 7.0
