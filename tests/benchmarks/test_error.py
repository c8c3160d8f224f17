"""The benchmark of estimated errors:

* every scene can be built, refined twice, and simulated with its settings;
* ratios and limits follow the rows; unknown estimates are shown as such;
* the command measures a scene, and writes its rows.
"""

import json
import math
import warnings

import pytest

from benchmarks import error
from benchmarks.document import Limit
from benchmarks.error import Row, find_limits, fps_of, row_table
from benchmarks.error_cases import CASES, CONTACT, SMOOTH
from taisoft.scene.refine import refined
from taisoft.settings import check_settings


def row(kind=SMOOTH, time=1e-3, **more) -> Row:
    """A row with made-up numbers: the error in time is 1e-3."""
    estimated = {"time": time, "space": 0.1, "solver": 0.0}
    numbers = {"name": "made up", "integrator": "bdf2", "tets": 5, "steps": 9, "status": "ok", "order": 1.5, "twins": 2.0}
    return Row(kind=kind, estimated=estimated, true={"time": 1e-3, "space": 0.1, "solver": 0.0}, **numbers | more)


def met(limits: list[Limit]) -> list[bool]:
    return [limit.met for limit in limits]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_scene_can_be_run_and_refined(case):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # thin beams of few linear tets
        scene = case.build()
        fine = refined(refined(scene))
    check_settings(scene, dt=case.dt or 1e-3, integrator=case.integrator)
    assert sum(b.mesh.n_tets for b in fine.bodies) == 64 * sum(b.mesh.n_tets for b in scene.bodies)
    assert (scene.pushes(False) or case.kind == SMOOTH) and case.seconds * fps_of(case) > 20


def test_ratios_set_the_limits():
    assert row(time=2e-3).ratio("time") == 2.0 and math.isnan(row().ratio("solver")) and math.isnan(row(time=None).ratio("time"))
    assert met(find_limits([row(), row(CONTACT)])) == [True] * 4
    assert met(find_limits([row(time=3e-3), row(CONTACT, time=3e-3)])) == [False, True, True, True]
    assert met(find_limits([row(time=1e-4), row(CONTACT)])) == [False, True, True, False]
    assert met(find_limits([row(time=None), row(CONTACT)])) == [False, True, True, True]


def test_the_table_shows_unknown_errors():
    text = row_table([row(time=None, order=None, notes=["paths part"])])
    assert "unknown" in text and "* made up: paths part" in text


def test_the_command_measures_a_scene(tmp_path, capsys):
    out = tmp_path / "error.json"
    assert error.main(["--scene", "hanging beam", "--out", str(out)]) == 0
    (found,) = json.loads(out.read_text())["rows"]
    assert 0.5 < found["estimated"]["time"] / found["true"]["time"] < 2.0 and found["twins"] > 0.0
    assert "hanging beam" in out.with_suffix(".md").read_text()
