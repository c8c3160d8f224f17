"""Runs of a study and their results, with an oscillator in place of the simulator:

* errors fall with the integrator's order, and errors below the reference's own error are reported as unresolved;
* runs that fail, crash or are left out stay in the table with the reason; without its reference a study has times but no errors;
* finished runs are stored and reused, unless they are damaged or belong to other settings, scenes, code or machines;
* the files agree with the records.
"""

import csv
import io
import json
import threading
from dataclasses import asdict, replace

import numpy as np
import pytest

from taisoft.errors import OutputError
from taisoft.machine import versions
from taisoft.many import store as stores
from taisoft.many.store import Store
from taisoft.study import Request, Setting
from taisoft.study.pages import check_scene, write
from taisoft.study.results import csv_of, text_of
from taisoft.study.runner import Runner
from tests.study.study_places import Pendulum

DTS = (0.2, 0.1, 0.05)
REQUEST = Request("pendulum", repeats=3)


def plan(dts=DTS, integrators=("implicit_euler", "bdf2"), reference_dt=0.0125, **changes) -> dict:
    settings = [asdict(Setting(dt, name)) for name in integrators for dt in dts]
    refused = {"setting": asdict(Setting(0.4, "velocity_verlet")), "refused": "dt = 0.4 s is above the stability limit"}
    steps = round(0.2 / reference_dt)
    setting = asdict(Setting(reference_dt, "implicit_midpoint", precision="f64"))
    reference = {"setting": setting, "kind": "", "order_in_time": 2, "steps": steps}
    return {
        "scenes": {"refine 0": "scene"},
        "sources": {"scene.py": "text"},
        "code": "code",
        "fixed": {},
        "frame": 0.2,
        "frames": 20,
        "seconds": 4.0,
        "touching": False,
        "names": ["mass"],
        "cases": [refused, *({"setting": s, "refused": ""} for s in settings)],
        "references": [reference],
        "space": None,
        "notes": [],
    } | changes


def run(place: Pendulum, store=None, request=REQUEST, machines=({"name": "here"},), requested=lambda: False, left=lambda: 1.0):
    runner = Runner(request, [place], list(machines), requested, left, lambda line: None, store or Store(), planner=place)
    return None if (planned := runner.plan()) is None else runner.run(planned)


def rows_of(study, integrator: str) -> list:
    return [row for row in study.rows if row.setting["integrator"] == integrator and row.in_time is not None]


@pytest.mark.parametrize("integrator, order", [("implicit_euler", 1), ("bdf2", 2)])
def test_errors_fall_with_the_integrators_order(integrator, order):
    """And the estimated error of the reference is its true error."""
    study = run(Pendulum(plan()))
    rows, reference = rows_of(study, integrator), study.references[0]
    for by in ("max", "rms"):
        errors = [row.resolved_error(by) for row in rows]
        assert np.allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.15), errors
    true_error = np.abs(reference.path[:, 1, 0] - np.cos(np.arange(21) * 0.2)).max() / reference.excursion
    assert reference.own_error.max == pytest.approx(true_error, rel=0.05)


def test_errors_below_the_references_own_error_are_unresolved_and_energy_drifts():
    study = run(Pendulum(plan(dts=(0.2, 0.025))))
    fine = rows_of(study, "bdf2")[1]
    fine.in_time = replace(fine.in_time, max=0.5 * study.references[0].own_error.max)
    assert fine.resolved_error("max") == study.references[0].own_error.max
    assert f"< {study.references[0].own_error.max:.2g}" in text_of(study)
    assert all(row.numbers["energy"] < 1e-12 for row in rows_of(study, "bdf2"))  # the trapezoidal rule conserves it
    drift = [row.numbers["energy"] for row in rows_of(study, "implicit_euler")]
    assert drift[0] > drift[1] > 0.02


def test_cheapest_setting_within_the_tolerance_is_reported():
    study = run(Pendulum(plan()))
    errors = {(row.setting["integrator"], row.setting["dt"]): row.resolved_error("max") for row in study.comparable_rows()}
    assert errors["bdf2", 0.2] > 0.003 > errors["bdf2", 0.1]
    study.request = replace(REQUEST, tolerance=0.003)
    assert (study.cheapest().setting["integrator"], study.cheapest().setting["dt"]) == ("bdf2", 0.1)
    assert "Cheapest within 0.003 (max error): bdf2, dt = 0.1 s, f32, 1.1 s" in text_of(study)
    study.request = replace(REQUEST, tolerance=1e-9)
    assert "No setting is within 1e-09 (max error); the nearest: bdf2, dt = 0.05 s" in text_of(study)
    assert "are not resolved; --reference-dt" in text_of(study)


def test_failed_and_crashed_runs_stay_with_their_reason():
    study = run(Pendulum(plan(), failing={0.1: "step 7: not finite"}, crashing={0.05: "its process ended by signal SIGSEGV"}))
    by_dt = {(row.setting["integrator"], row.setting["dt"]): (row.status, row.reason) for row in study.rows}
    assert by_dt["bdf2", 0.1] == ("failed", "step 7: not finite") and by_dt["bdf2", 0.2] == ("ok", "")
    assert by_dt["bdf2", 0.05][0] == "failed" and "SIGSEGV" in by_dt["bdf2", 0.05][1]
    assert by_dt["velocity_verlet", 0.4][0] == "refused"
    text = text_of(study)
    assert all(reason in text for reason in ("step 7: not finite", "SIGSEGV", "above the stability limit"))
    assert len(list(csv.DictReader(io.StringIO(csv_of(study))))) == len(study.rows) == 7


def test_study_without_its_reference_has_times_but_no_errors(tmp_path):
    study = run(Pendulum(plan(), failing={0.0125: "it is too small"}))
    assert not study.comparable_rows() and all(row.seconds for row in study.rows if row.status == "ok")
    assert "it is too small; runs that need it have no error" in text_of(study)
    assert "No setting has both a time and an error" in text_of(study)
    (tmp_path / "study.png").write_bytes(b"of an earlier study")
    assert "no setting has both a time and an error" in write(study, tmp_path) and not (tmp_path / "study.png").exists()


class Endless(Pendulum):
    """Its third run, after the request for a plan, takes until it is stopped."""

    def __init__(self):
        super().__init__(plan())
        self.stopped = threading.Event()

    def execute(self, request):
        answer = super().execute(request)
        if len(self.requests) == 4:
            self.stopped.wait()
        return answer

    def stop(self):
        if len(self.requests) == 4:
            self.stopped.set()


def test_runs_beyond_the_budget_are_left_out(tmp_path):
    place = Endless()
    study = run(place, Store(tmp_path), left=lambda: 4.0 - len(place.requests))
    left_out = [row for row in study.rows if row.status == "left out"]
    assert left_out[0].reason == "the budget was spent while it ran"
    assert len(left_out) > 1 and all(row.reason == "the budget was spent" for row in left_out[1:])
    cut = "The same command continues it. Cut: implicit_euler, dt = 0.2 s, f32; if it takes longer than"
    assert f"Not complete: the budget was spent. {cut}" in text_of(study)


def test_finished_runs_are_reused(tmp_path):
    """In whatever order machines are."""
    machines = [{"name": "here"}, {"name": "there"}]
    first, place = run(Pendulum(plan()), Store(tmp_path), machines=machines), Pendulum(plan())
    again = run(place, Store(tmp_path), machines=machines[::-1])
    assert [request["action"] for request in place.requests] == ["plan"]
    assert text_of(again).splitlines()[5:] == text_of(first).splitlines()[5:] and not list(tmp_path.rglob("*.part"))


def test_runs_of_other_machines_settings_scenes_and_code_are_not_reused(tmp_path):
    for k, (of_plan, of_run) in enumerate(
        (
            ({}, {"machines": [{"name": "there"}]}),
            ({}, {"request": replace(REQUEST, repeats=4)}),
            ({"scenes": {"refine 0": "another scene"}}, {}),
            ({"code": "edited"}, {}),
            ({"sources": {"scene.py": "text", "helper.py": "text"}}, {}),
        )
    ):
        folder, place = tmp_path / str(k), Pendulum(plan(**of_plan))
        folder.mkdir()
        run(Pendulum(plan()), Store(folder))
        run(place, Store(folder), **of_run)
        assert len(place.requests) == 1 + (6 if "request" in of_run else 8)  # more repeats do not repeat the references


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_damaged_records_are_reported_and_repeated(tmp_path, damage):
    first = run(Pendulum(plan()), Store(tmp_path))
    path = sorted((tmp_path / "runs").iterdir())[3]
    text = path.read_text()
    k = text.index("zlib, base64") + 40
    path.write_text(text[:-100] if damage == "cut" else text[:k] + ("A" if text[k] != "A" else "B") + text[k + 1 :])
    place, store = Pendulum(plan()), Store(tmp_path)
    again = run(place, store)
    assert len(place.requests) == 2
    assert len(store.damaged) == 1 and f"{path} is damaged and its run is repeated: " in text_of(again)
    assert [row.in_time for row in again.rows] == [row.in_time for row in first.rows]
    assert Store(tmp_path).read(path.stem) is not None


def test_interrupted_study_keeps_finished_runs(tmp_path):
    place = Pendulum(plan())
    study = run(place, Store(tmp_path), requested=lambda: len(place.requests) >= 5)
    assert study.ended == "it was interrupted" and len(list((tmp_path / "runs").iterdir())) == 4
    assert run(Pendulum(plan()), requested=lambda: True) is None


def test_files_agree_with_the_records(tmp_path):
    study = run(Pendulum(plan(), failing={0.1: "step 7"}))
    assert write(study, tmp_path) == ""
    assert (tmp_path / "study.md").read_text() == text_of(study)
    record = json.loads((tmp_path / "study.json").read_text())
    front = [row for row in record["rows"] if row["on_front"]]
    assert [row["dt"] for row in front] == [row.setting["dt"] for row in study.front()]
    assert record["cheapest"] == study.cheapest().setting
    table = list(csv.DictReader((tmp_path / "study.csv").open()))
    for line, row in zip(table, study.rows):
        assert (line["dt"], line["status"], line["reason"]) == (str(row.setting["dt"]), row.status, row.reason)
        assert line["error_in_time_max"] == ("" if row.in_time is None else str(row.in_time.max))
        assert line["seconds_per_simulated_second"] == ("" if not row.seconds else str(row.timing.median))
    assert (tmp_path / "study.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_folder_of_another_scenes_study_is_rejected(tmp_path):
    check_scene(tmp_path, "scene")
    write(run(Pendulum(plan())), tmp_path)
    check_scene(tmp_path, "scene")
    with pytest.raises(OutputError, match="holds a study of another scene .pendulum"):
        check_scene(tmp_path, "another")
    (tmp_path / "study.json").write_text("[]")
    with pytest.raises(OutputError, match="holds a study.json not written by this version"):
        check_scene(tmp_path, "scene")


def test_code_digest_depends_on_package_versions(monkeypatch):
    installed = stores.code_digest()
    assert stores.code_digest() == installed
    for changed in ({"taichi": "9.9"}, {"numpy": "9.9"}):
        monkeypatch.setattr(stores, "versions", lambda *names, changed=changed: versions(*names) | changed)
        assert stores.code_digest() != installed
