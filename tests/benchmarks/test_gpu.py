"""`bench gpu` on a machine without one: parts that fail or are late leave what they have, and the page is written after each."""

import json
from contextlib import contextmanager

import pytest

from benchmarks import document, gpu
from benchmarks.suite import CRASHED, LEFT_OUT, UNFINISHED, Runs
from taisoft.many.store import Store

COUNTED = {"of": "a sub-step", "launches": 9.0, "launches at most": 8, "accesses": 0.0, "accesses at most": 0}
RERUN = {"integrator": "bdf2", "runs": 3, "same bits": "yes"}
RECORDS = {
    "micro": {LEFT_OUT: "its process ended by signal SIGKILL", CRASHED: True},
    "explicit": {LEFT_OUT: "the budget was spent while it ran", CRASHED: False, UNFINISHED: {"rows": [RERUN, {"tets": 12345}]}},
    "counts": {"rows": [COUNTED], "seconds": 1.0},
}


@pytest.mark.parametrize("arch", ["cpu", "cuda"])
def test_every_part_leaves_what_it_has(tmp_path, monkeypatch, capsys, arch):
    pages, limits = [], []

    class Scripted(Runs):
        def _run(self, key, request, seconds):
            limits.append(seconds)
            pages.append(out.with_suffix(".md").read_text() if out.with_suffix(".md").exists() else "")
            return RECORDS[request["part"]]

    @contextmanager
    def runs_of(name, options, *files):
        yield Scripted((), [], Store(None), None, gpu.time.monotonic() + options.budget)

    out = tmp_path / "gpu.json"
    monkeypatch.setattr(gpu, "runs_of", runs_of)
    assert gpu.main(["--arch", arch, "--only", *RECORDS, "--out", str(out)]) == 1
    text, numbers = out.with_suffix(".md").read_text(), json.loads(out.read_text())
    assert [part["part"] for part in numbers["parts"]] == list(RECORDS) and numbers["parts"][1]["rows"] == [
        RERUN,
        {"tets": 12345},
    ]
    assert pages[0] == "" and "SIGKILL" in pages[1] and "12,345" not in pages[1] and "12,345" in pages[2]
    assert "| a sub-step |" in text and "NOT met" in text and "launches, a sub-step" in text
    assert ("Not run on a device" in text) == (arch == "cpu") and text.strip() in capsys.readouterr().out
    assert min(limits) > 80.0 and limits[0] > gpu.PARTS["micro"].seconds  # what others do not need


def test_the_newest_results_are_those_of_an_arch(tmp_path):
    for name, arch, date in (("a", "cuda", "2026-01-01"), ("b", "cpu", "2026-02-01")):
        (tmp_path / f"gpu-{name}.json").write_text(json.dumps({"name": name, "arch": arch, "date": date}))
    assert [document.newest(tmp_path, "gpu", arch)["name"] for arch in ("cuda", "cpu", "")] == ["a", "b", "b"]
