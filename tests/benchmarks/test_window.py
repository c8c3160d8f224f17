"""`taisoft bench window`:

* every demo with contacts and few tets is measured; the table has its numbers, and a limit that is missed is an exit status of 1;
* a quick run on a virtual display.
"""

import json
import re

import pytest

from benchmarks import window
from tests.view.desktop import TOOLS
from tests.view.test_view import needs_vulkan

ROW = {"demo": "cube_on_box", "tets": 1215, "dt": 0.01, "step": 0.002, "longest_step": 0.02, "alone": 3.0, "speed": 1.0}
ROW |= {"intervals": [0.04, 0.04, 0.07], "latencies": [0.05, 0.06, 0.09]}


def test_demos_with_contacts():
    names = window.demos()
    assert {"cube_on_box", "cube_pile", "drop_everything", "gripper"} <= set(names)
    assert "hanging_beam" not in names, "nothing touches"


def measured(monkeypatch, **changes):
    monkeypatch.setattr(window, "VirtualDisplay", lambda: type("Display", (), {"close": lambda self: None})())
    monkeypatch.setattr(window, "measure", lambda name, display: ROW | {"demo": name} | changes)
    return window.main(["--only", "cube_on_box"])


@pytest.mark.parametrize(
    "changes, status",
    [
        ({}, 0),
        ({"intervals": [0.06]}, 1),
        ({"latencies": [0.12]}, 1),
        ({"latencies": [0.12], "speed": 0.4}, 0),
        ({"latencies": []}, 1),
    ],
)
def test_table_and_limits(monkeypatch, capsys, changes, status):
    assert measured(monkeypatch, **changes) == status
    page = re.sub(" +", " ", capsys.readouterr().out)
    if not changes:
        assert "| cube_on_box | 1,215 | 10 | 2 | 20 | 3.00 | 1.00 | 25 | 70 | 60 | 87 |" in page
    assert ("NOT met" in page) == bool(status)


@needs_vulkan
@pytest.mark.skipif(bool(TOOLS), reason="a virtual display needs Xvfb, xdotool and import")
def test_a_quick_run(tmp_path):
    out = tmp_path / "window.json"
    assert window.main(["--quick", "--out", str(out)]) == 0
    numbers = json.loads(out.read_text())
    (row,) = numbers["rows"]
    assert numbers["quick"] and row["tets"] == 215 and 0.0 < row["speed"] <= 1.05
    assert len(row["intervals"]) > 10 and len(row["latencies"]) > 10 and min(row["latencies"]) > 0.0
