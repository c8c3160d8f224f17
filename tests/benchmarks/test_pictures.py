"""`taisoft bench pictures`:

* both ways draw the same picture, but for shadows; runs write all their pictures and are the same without them;
* tables have medians, ranges and ratios; pictures that are not cheap enough are an exit status of 1.
"""

import json
import re

import numpy as np
import pytest

from benchmarks import pictures
from taisoft.view.offscreen import Offscreen
from tests.view.fake_simulator import FakeSimulator, beam_scene


def test_both_ways_draw_the_same_picture():
    scene = beam_scene(("one", "two"))
    sim = FakeSimulator(scene)
    layers = ("wires", "fixed_nodes")
    new, old = (way(scene, (320, 180), layers=layers).image(sim).astype(int) for way in (Offscreen, pictures.NumpyOffscreen))
    difference = np.abs(new - old).max(axis=2)
    assert (difference > 1).mean() < 0.003 and np.abs(old - old[0, 0]).max() > 50


@pytest.mark.filterwarnings("ignore:body")  # few tets through the thickness
def test_a_quick_run(tmp_path, capsys):
    out = tmp_path / "pictures.json"
    assert pictures.main(["--quick", "--out", str(out)]) == 0
    page, numbers = out.with_suffix(".md").read_text(), json.loads(out.read_text())
    assert page.strip() in capsys.readouterr().out and "## Limits" not in page
    assert "| kernels" in page and "| PNG" in page and "| cube_on_box" in page
    (run,) = numbers["runs"].values()
    for where in ("with", "between"):
        assert 0 < run[where]["drawing"][0] < run[where]["wall"][0] and run["without"]["cpu"][0] > 0
    assert len(numbers["picture"]["kernels"]["wall"]) == pictures.QUICK_ROUNDS and numbers["picture"]["bytes"] > 1000


def both(*seconds):
    """Wall and CPU times that are the same."""
    return {"wall": list(seconds), "cpu": list(seconds)}


@pytest.mark.parametrize("faster, status", [(9.0, 0), (7.0, 1)])
def test_tables_and_exit_status(faster, status, monkeypatch, capsys):
    one = {"triangles": 100, "first": 1.0, "bytes": 5000, "NumPy": both(0.1 * faster, 0.2 * faster, 0.3 * faster)}
    one |= {"kernels": both(0.1, 0.2, 0.3), "PNG": both(0.05, 0.05, 0.05)}
    run = {"without": both(1.0, 2.0, 3.0), "with": both(1.5, 2.4, 3.3) | {"drawing": [0.1, 0.2, 0.3]}}
    run["between"] = both(2.0, 4.0, 9.0)
    monkeypatch.setattr(pictures, "measure_picture", lambda quick: one)
    monkeypatch.setattr(pictures, "measure_run", lambda *arguments: run)
    assert pictures.main([]) == status
    page = re.sub(" +", " ", capsys.readouterr().out)
    assert f"| kernels | 200.0 | 100.0 to 300.0 | 200.0 | {faster:.1f} |" in page
    row = "| 2.00 | 2.40 | 0.20 | 1.20 (1.10 to 1.50) | 2.00 (2.00 to 3.00) | 2.00 | 2.40 | 1.20 |"
    assert page.count(row) == len(pictures.DEMOS)
    assert ("NOT met" in page) == bool(status)
