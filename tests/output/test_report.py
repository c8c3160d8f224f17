"""report.json and steps.csv, read back:

* report.json is JSON without NaN and holds the run's results, extremes over its steps, settings, plan, versions and machine;
* steps.csv holds every field of every StepReport, also problems with commas, quotes and line breaks.
"""

import csv
import dataclasses
import json
import math
import platform
from pathlib import Path

import numpy as np
import pytest

from taisoft.output.report import write_report
from taisoft.records import RunReport, StepReport


def refuse_constant(name):
    raise AssertionError(f"{name} is not JSON")


@pytest.fixture
def written(tmp_path):
    steps = [
        StepReport(time=0.1, newton_iterations=3, residual=1e-9, min_volume_ratio=0.9, kinetic=2.0),
        StepReport(
            time=0.2,
            newton_iterations=7,
            residual=math.nan,
            min_volume_ratio=0.4,
            kinetic=math.inf,
            converged=False,
            problems=["slow, very", 'say "no"\nplease'],
        ),
        StepReport(time=0.3, newton_iterations=5, residual=1e-7, min_volume_ratio=0.5, kinetic=1.0, n_inverted=2),
    ]
    result = RunReport(
        status="degraded",
        problems=["step 2 did not converge"],
        steps=3,
        sim_seconds=0.3,
        wall_seconds=1.25,
        compile_seconds=0.5,
        step_reports=steps,
    )
    settings = {"dt": np.float64(0.1), "gravity": np.array([0, -9.81, 0]), "out": Path("results"), "tolerance": None}
    settings["big"] = math.inf
    plan = [{"feature": "contact", "on": False, "why": "no obstacles"}]
    write_report(tmp_path, result, arch="cpu", precision="f32", settings=settings, plan=plan)
    record = json.loads((tmp_path / "report.json").read_text(), parse_constant=refuse_constant)
    return tmp_path, result, record


def test_the_report_holds_the_run(written):
    _, result, record = written
    for field in dataclasses.fields(RunReport):
        if field.name != "step_reports":
            assert record[field.name] == getattr(result, field.name)
    assert "step_reports" not in record
    assert (record["arch"], record["precision"]) == ("cpu", "f32")
    assert record["settings"] == {"dt": 0.1, "gravity": [0, -9.81, 0], "out": "results", "tolerance": None, "big": None}
    assert record["plan"] == [{"feature": "contact", "on": False, "why": "no obstacles"}]


def test_the_report_holds_extremes_over_the_steps(written):
    extremes = written[2]["extremes"]
    keys = ("not_finite", "min", "max", "time_of_min", "time_of_max")
    assert extremes["newton_iterations"] == dict(zip(keys, (0, 3, 7, 0.1, 0.2)))
    assert extremes["residual"] == dict(zip(keys, (1, 1e-9, 1e-7, 0.1, 0.3)))
    assert extremes["kinetic"]["not_finite"] == 1
    assert (extremes["min_volume_ratio"]["min"], extremes["n_inverted"]["max"]) == (0.4, 2)
    assert (extremes["reports"], extremes["not_converged"]) == (3, 1)
    numeric = {f.name for f in dataclasses.fields(StepReport)} - {"time", "converged", "problems"}
    assert numeric <= set(extremes)


def test_the_report_names_versions_and_machine(written):
    record = written[2]
    assert record["versions"]["python"] == platform.python_version()
    for package in ("taisoft", "taichi", "numpy", "scipy", "usd-core"):
        assert record["versions"][package][0].isdigit()
    assert record["machine"]["cores"] >= 1
    assert record["machine"]["cpu"] and record["machine"]["name"] == platform.node()
    assert 10e6 < record["peak_memory_bytes"] < 1e12  # a Python with NumPy: tens of megabytes at least


def test_the_step_table_holds_every_field_of_every_step(written):
    folder, result, _ = written
    with open(folder / "steps.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [list(row) for row in rows] == [[f.name for f in dataclasses.fields(StepReport)]] * 3
    for row, step in zip(rows, result.step_reports):
        for field in dataclasses.fields(StepReport):
            value = getattr(step, field.name)
            if field.name == "problems":
                assert row["problems"] == "; ".join(value)
            elif field.name == "converged":
                assert row["converged"] == str(value)
            else:
                assert float(row[field.name]) == value or (math.isnan(value) and row[field.name] == "nan")


def test_a_run_without_steps_has_no_extremes(tmp_path):
    write_report(tmp_path, RunReport(), arch="cpu", precision="f64", settings={}, plan=[])
    assert json.loads((tmp_path / "report.json").read_text())["extremes"] == {}
    assert (tmp_path / "steps.csv").read_text().count("\n") == 1
