"""What a run reports: report.json (JSON without NaN), steps.csv, equal rows for pandas, and progress."""

import csv
import dataclasses
import io
import json
import math
import platform
import re
from pathlib import Path

import numpy as np
import pytest

from taisoft.output import report
from taisoft.output.report import Progress, write_report
from taisoft.records import RunReport, StepReport
from tests.view.fake_simulator import FakeSimulator, beam_scene

FIELDS = {field.name for field in dataclasses.fields(StepReport)} - {"details"}


@pytest.fixture
def written(tmp_path):
    steps = [
        StepReport(time=0.1, newton_iterations=3, residual=1e-9, kinetic=2.0),
        StepReport(time=0.2, newton_iterations=7, residual=math.nan, kinetic=math.inf, converged=False),
        StepReport(time=0.3, newton_iterations=5, residual=1e-7, kinetic=1.0, n_inverted=2, details={"force x [N]": -2.0}),
    ]
    steps[1].problems = ["slow, very", 'say "no"\nplease']
    result = RunReport(status="degraded", problems=["step 2 did not converge"], steps=3, sim_seconds=0.3, step_reports=steps)
    result.wall_seconds, result.compile_seconds = 1.25, 0.5
    settings = {"dt": np.float64(0.1), "gravity": np.array([0, -9.81, 0]), "out": Path("results"), "tolerance": None}
    settings["big"] = math.inf
    plan = [{"feature": "contact", "on": False, "why": "no obstacles"}]
    write_report(tmp_path, result, arch="cpu", precision="f32", settings=settings, plan=plan)
    record = json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)
    return tmp_path, result, record


def test_a_resumed_run_keeps_the_earlier_steps_up_to_its_checkpoint(written):
    folder, result, _ = written
    result.step_reports = [StepReport(time=0.25, details={"force y [N]": 3.0, "kinetic of a [J]": 1.0})]
    write_report(folder, result, resumed={"checkpoint": "checkpoint.npz", "time": 0.2})
    header, *rows = csv.reader(io.StringIO((folder / "steps.csv").read_text()))
    assert [row[0] for row in rows] == ["0.1", "0.2", "0.25"] and 'slow, very; say "no"\nplease' in rows[1]
    assert header[-3:] == ["force x [N]", "force y [N]", "kinetic of a [J]"]
    assert [row[-3:] for row in rows[1:]] == [["0.0", "0.0", ""], ["0.0", "3.0", "1.0"]], (
        "no force in a step, and an unknown energy"
    )
    (folder / "steps.csv").write_text("no steps")
    write_report(folder, result, resumed={"checkpoint": "checkpoint.npz", "time": 0.2})
    assert len((folder / "steps.csv").read_text().splitlines()) == 2


def test_the_report_holds_the_run(written):
    _, result, record = written
    for field in dataclasses.fields(RunReport):
        if field.name != "step_reports":
            assert record[field.name] == getattr(result, field.name)
    assert "step_reports" not in record and (record["arch"], record["precision"]) == ("cpu", "f32")
    assert record["settings"] == {"dt": 0.1, "gravity": [0, -9.81, 0], "out": "results", "tolerance": None, "big": None}
    assert record["plan"] == [{"feature": "contact", "on": False, "why": "no obstacles"}]
    extremes, keys = record["extremes"], ("not_finite", "min", "max", "time_of_min", "time_of_max")
    assert extremes["newton_iterations"] == dict(zip(keys, (0, 3, 7, 0.1, 0.2)))
    assert extremes["residual"] == dict(zip(keys, (1, 1e-9, 1e-7, 0.1, 0.3)))
    assert (extremes["kinetic"]["not_finite"], extremes["n_inverted"]["max"]) == (1, 2)
    assert (extremes["reports"], extremes["not_converged"]) == (3, 1)
    assert FIELDS - {"time", "converged", "problems", "contact_error"} <= set(extremes)
    assert (extremes["force x [N]"]["min"], extremes["force x [N]"]["max"]) == (-2.0, 0.0)
    assert record["versions"]["python"] == platform.python_version()
    assert all(record["versions"][package][0].isdigit() for package in ("taisoft", "taichi", "numpy", "scipy", "usd-core"))
    assert record["machine"]["cores"] >= 1 and record["machine"]["processor"] and record["machine"]["name"] == platform.node()
    assert 10e6 < record["peak_memory_bytes"] < 1e12  # a Python with NumPy: tens of megabytes at least


def test_the_step_table_holds_every_field_of_every_step(written):
    folder, result, _ = written
    with open(folder / "steps.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [set(row) for row in rows] == [FIELDS | {"force x [N]"}] * 3
    for row, step, given in zip(rows, result.step_reports, result.to_dicts()):
        assert row == {name: str(value) for name, value in ({"force x [N]": 0.0} | given).items()}
        assert given["problems"] == "; ".join(step.problems) and given["time"] == step.time


def test_details_that_a_resumed_run_does_not_ask_for_are_left_empty():
    """A pair that does not press in a step has zeros, in the earlier rows, too."""
    header = [*report.COLUMNS, "force x on a by b [N]", "kinetic of a [J]"]
    earlier = [str(k) for k in range(len(header))]
    steps = [StepReport(time=t, details={"kinetic of a [J]": t}) for t in (1.0, 2.0)]
    rows = list(csv.DictReader(io.StringIO(report.steps_csv(steps, (header, [earlier])))))
    assert [row["force x on a by b [N]"] for row in rows] == [earlier[-2], "", ""]
    steps[0].details = {"force x on a by c [N]": 3.0}
    rows = list(csv.DictReader(io.StringIO(report.steps_csv(steps, (header, [earlier])))))
    assert [row["force x on a by c [N]"] for row in rows] == ["0.0", "3.0", "0.0"]
    rows = RunReport(step_reports=steps).to_dicts()
    assert [(row["force x on a by c [N]"], row["kinetic of a [J]"]) for row in rows] == [(3.0, 0.0), (0.0, 2.0)]


@pytest.mark.parametrize(
    "terminal, compiling, shown",
    [(False, 0.0, "10 steps/s, 0:34 left"), (False, 3.0, "20 steps/s, 0:17 left"), (True, 0.0, "10 steps/s, 0:30 left")],
)
def test_progress(terminal, compiling, shown, monkeypatch):
    """Frames at 0, 2, ..., 10 s, each of 20 steps and 0.5 s simulated, then a long step; a line at the first one after 5 s."""
    times = iter(range(0, 1000, 2))
    monkeypatch.setattr(report.time, "perf_counter", lambda: float(next(times)))
    sim, stream = FakeSimulator(beam_scene()), io.StringIO()
    stream.isatty = lambda: terminal
    bar = Progress(10.0, "beam", stream)
    for index in range(6):
        bar.frame(sim, index)
        sim.time, sim.step_count, sim.compile_seconds = sim.time + 0.5, sim.step_count + 20, compiling
    bar.iteration(34)
    bar.close()
    bar.close()
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())
    assert (
        all(part in text for part in (*shown.split(", "), "2.500 of 10 s", "34 Newton iterations"))
        if terminal
        else re.fullmatch(
            rf"beam: 1.500 of 10 s, {shown}\nbeam: 2.500 of 10 s, .* left, a step with 34 Newton iterations so far\n", text
        )
    )
