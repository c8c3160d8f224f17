"""A study's runs and what comes of them, on a pendulum made up in place of the simulator:

* errors against the reference fall with the integrator's order, and nothing below the reference's own error is told as fact;
* runs that fail, crash, or are left out stay in the table with their reason; a study without its reference says so;
* finished runs are kept whole, found again, and done anew where they are damaged; other settings, scenes or machines find none;
* the files hold what the records say, and the picture is one.
"""

import csv
import io
import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from study_places import Pendulum

from taisoft.errors import OutputError
from taisoft.machine import versions
from taisoft.study import Request, Setting, output
from taisoft.study.accuracy import pack, unpack
from taisoft.study.output import NoStore, Store, check_scene, write
from taisoft.study.results import csv_of, text_of
from taisoft.study.runner import Runner

DTS = (0.2, 0.1, 0.05)
ASK = Request("pendulum", repeats=3)


def plan(dts=DTS, integrators=("implicit_euler", "bdf2"), reference=0.0125, **more) -> dict:
    settings = [asdict(Setting(dt, name)) for name in integrators for dt in dts]
    refused = {"setting": asdict(Setting(0.4, "velocity_verlet")), "refused": "dt = 0.4 s is above the stability limit"}
    steps = round(0.2 / reference)
    setting = asdict(Setting(reference, "implicit_midpoint", precision="f64"))
    of = {"setting": setting, "kind": "", "order_in_time": 2, "steps": steps}
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
        "references": [of],
        "space": None,
        "notes": [],
    } | more


def run(place: Pendulum, store=None, request=ASK, machines=({"name": "here"},), requested=lambda: False, left=lambda: 1.0):
    told: list[str] = []
    runner = Runner(request, [place], list(machines), requested, left, told.append, store or NoStore(), planner=place)
    return None if (planned := runner.plan()) is None else runner.run(planned)


def rows_of(study, integrator: str) -> list:
    return [row for row in study.rows if row.setting["integrator"] == integrator and row.in_time is not None]


# --- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator, order", [("implicit_euler", 1), ("bdf2", 2)])
def test_errors_fall_with_the_order(integrator, order):
    study = run(Pendulum(plan()))
    rows = rows_of(study, integrator)
    for by in ("max", "rms"):
        errors = [row.resolved_error(by) for row in rows]
        orders = np.log2(np.divide(errors[:-1], errors[1:]))
        assert np.allclose(orders, order, atol=0.15), orders
    # to the exact cos t at 4 s, over the excursion of 2
    exact = abs(unpack(Pendulum(plan())._record(task(0.05, integrator))["path"])[-1, 1, 0] - np.cos(4.0)) / (1.0 - np.cos(np.pi))
    assert rows[-1].in_time.max >= exact - 2 * study.references[0].own_error.max


def task(dt: float, integrator: str) -> dict:
    return {"setting": asdict(Setting(dt, integrator)), "steps": round(0.2 / dt), "frames": 20, "repeats": 0}


def test_the_references_own_error_is_what_it_is_off():
    reference = run(Pendulum(plan())).references[0]
    exact = np.cos(np.arange(21) * 0.2)
    off = np.abs(reference.path[:, 1, 0] - exact).max() / reference.excursion
    assert reference.own_error.max == pytest.approx(off, rel=0.05)


def test_nothing_below_the_references_own_error_is_fact():
    study = run(Pendulum(plan(dts=(0.2, 0.025), reference=0.0125)))
    fine = rows_of(study, "bdf2")[1]
    fine.in_time = replace(fine.in_time, max=0.5 * study.references[0].own_error.max)
    assert fine.resolved_error("max") == study.references[0].own_error.max
    assert f"< {study.references[0].own_error.max:.2g}" in text_of(study)


def test_energy_drift_is_that_of_the_method():
    study = run(Pendulum(plan()))
    assert all(row.energy < 1e-12 for row in rows_of(study, "bdf2"))  # trapezes keep it
    drift = [row.energy for row in rows_of(study, "implicit_euler")]
    assert drift[0] > drift[1] > drift[2] > 0.05


# --- the answer -------------------------------------------------------------------------------------------------------


def test_the_cheapest_within_the_tolerance_is_named():
    study = run(Pendulum(plan()))
    errors = {(row.setting["integrator"], row.setting["dt"]): row.resolved_error("max") for row in study.comparable_rows()}
    assert errors["bdf2", 0.2] > 0.003 > errors["bdf2", 0.1]
    study.request = replace(ASK, tolerance=0.003)
    assert (study.cheapest().setting["integrator"], study.cheapest().setting["dt"]) == ("bdf2", 0.1)
    assert "Cheapest within 0.003 (max error): bdf2, dt = 0.1 s, f32, 1.1 s" in text_of(study)
    study.request = replace(ASK, tolerance=1e-9)
    assert "No setting is within 1e-09 (max error); the nearest: bdf2, dt = 0.05 s" in text_of(study)
    assert "are not resolved; --reference-dt" in text_of(study)


def test_what_fails_or_crashes_stays_with_its_reason():
    study = run(Pendulum(plan(), failing={0.1: "step 7: not finite"}, crashing={0.05: "its process ended by signal SIGSEGV"}))
    by_dt = {(row.setting["integrator"], row.setting["dt"]): row for row in study.rows}
    assert (by_dt["bdf2", 0.1].status, by_dt["bdf2", 0.1].reason) == ("failed", "step 7: not finite")
    assert by_dt["bdf2", 0.05].status == "failed" and "SIGSEGV" in by_dt["bdf2", 0.05].reason
    assert by_dt["bdf2", 0.2].status == "ok" and by_dt["velocity_verlet", 0.4].status == "refused"
    text = text_of(study)
    for told in ("step 7: not finite", "SIGSEGV", "above the stability limit"):
        assert told in text
    assert len(list(csv.DictReader(io.StringIO(csv_of(study))))) == len(study.rows) == 7


@pytest.mark.parametrize("how", ["failing", "crashing"])
def test_without_its_reference_a_study_has_times_but_no_errors(how):
    study = run(Pendulum(plan(), **{how: {0.0125: "it is too small"}}))
    assert not study.comparable_rows() and all(row.seconds for row in study.rows if row.status == "ok")
    assert "it is too small; runs that need it have no error" in text_of(study)
    assert "No setting has both a time and an error" in text_of(study)


def test_refused_combinations_are_told_as_a_product_where_they_are_one():
    def refused(*settings) -> str:
        cases = [{"setting": asdict(one), "refused": "it does not fit"} for one in settings]
        made = plan()
        return text_of(run(Pendulum(made | {"cases": [*made["cases"], *cases]})))

    whole = [Setting(dt, "bdf2", precision=p) for dt in (0.2, 0.1) for p in ("f32", "f64")]
    assert "* bdf2, dt 0.2 | 0.1, precision f32 | f64: it does not fit" in refused(*whole)
    assert "* bdf2, dt = 0.2 s, f32; bdf2, dt = 0.2 s, f64; bdf2, dt = 0.1 s, f32: it does not fit" in refused(*whole[:3])


@pytest.mark.parametrize("kept, told", [(True, "The same command continues it."), (False, "Without --out nothing is kept.")])
def test_a_spent_budget_leaves_runs_out_and_says_so(tmp_path, kept, told):
    place = Pendulum(plan())
    # planning is one of the requests, and not of the budget
    study = run(place, Store(tmp_path) if kept else None, left=lambda: 4.0 - len(place.requests))
    left_out = [row for row in study.rows if row.status == "left out"]
    assert left_out[0].reason == "the budget was spent while it ran"
    assert len(left_out) > 1 and all(row.reason == "the budget was spent" for row in left_out[1:])
    text = text_of(study)
    assert f"Not complete: the budget was spent. {told} Cut: implicit_euler, dt = 0.2 s, f32; if it takes longer than" in text


# --- finished runs ----------------------------------------------------------------------------------------------------


def test_finished_runs_are_found_again(tmp_path):
    first = run(Pendulum(plan()), Store(tmp_path))
    place = Pendulum(plan())
    again = run(place, Store(tmp_path))
    assert [request["action"] for request in place.requests] == ["plan"]
    assert text_of(again) == text_of(first)
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize(
    "other",
    [
        {"machines": [{"name": "there"}]},
        {"request": replace(ASK, repeats=4)},
        {"scenes": {"refine 0": "another scene"}},
        {"code": "edited"},
        {"sources": {"scene.py": "text", "helper.py": "text"}},
    ],
)
def test_other_machines_settings_scenes_and_code_find_none(tmp_path, other):
    run(Pendulum(plan()), Store(tmp_path))
    changed = {key: other.pop(key) for key in ("scenes", "sources", "code") if key in other}
    place = Pendulum(plan(**changed))
    run(place, Store(tmp_path), **other)
    assert len(place.requests) == 1 + (6 if "request" in other else 8)  # references are not repeated


def test_the_order_in_which_machines_are_told_does_not_count(tmp_path):
    machines = [{"name": "here"}, {"name": "there"}]
    run(Pendulum(plan()), Store(tmp_path), machines=machines)
    place = Pendulum(plan())
    run(place, Store(tmp_path), machines=machines[::-1])
    assert [request["action"] for request in place.requests] == ["plan"]


@pytest.mark.parametrize("damage", ["cut", "flipped", "other", "empty"])
def test_a_damaged_record_is_done_anew_and_told(tmp_path, damage):
    first = run(Pendulum(plan()), Store(tmp_path))
    path = sorted((tmp_path / "runs").iterdir())[3]
    text = path.read_text()
    if damage == "flipped":
        at = text.index("zlib_base64") + 40
        path.write_text(text[:at] + ("A" if text[at] != "A" else "B") + text[at + 1 :])
    else:
        path.write_text({"cut": text[:-100], "other": json.dumps({"kind": "something"}), "empty": ""}[damage])
    place, store = Pendulum(plan()), Store(tmp_path)
    again = run(place, store)
    assert len(place.requests) == 2
    assert len(store.damaged) == 1 and f"{path} is damaged and its run is repeated: " in text_of(again)
    assert [row.in_time for row in again.rows] == [row.in_time for row in first.rows]
    assert Store(tmp_path).read(path.stem) is not None


def test_an_interrupted_study_keeps_what_is_done(tmp_path):
    place = Pendulum(plan())
    study = run(place, Store(tmp_path), requested=lambda: len(place.requests) >= 5)
    assert study.ended == "the study was interrupted" and len(list((tmp_path / "runs").iterdir())) == 3
    assert run(Pendulum(plan()), requested=lambda: True) is None


def test_arrays_come_back_bit_by_bit():
    values = np.random.default_rng(0).normal(size=(3, 4, 3)) * 10.0 ** np.arange(-300, 300, 200)
    assert np.array_equal(unpack(json.loads(json.dumps(pack(values)))), values)
    with pytest.raises(ValueError):
        unpack({"shape": [1], "zlib_base64": "AAAA"})


# --- files ------------------------------------------------------------------------------------------------------------


def test_the_files_hold_what_the_records_say(tmp_path):
    study = run(Pendulum(plan(), failing={0.1: "step 7"}))
    assert write(study, tmp_path) == ""
    assert (tmp_path / "study.md").read_text() == text_of(study)
    record = json.loads((tmp_path / "study.json").read_text())
    front = [row for row in record["rows"] if row["on_front"]]
    assert [row["setting"] for row in front] == [row.setting for row in study.front()]
    assert record["cheapest"] == study.cheapest().setting
    table = list(csv.DictReader((tmp_path / "study.csv").open()))
    for line, row in zip(table, study.rows):
        assert (line["dt"], line["status"], line["reason"]) == (str(row.setting["dt"]), row.status, row.reason)
        assert line["error_in_time_max"] == ("" if row.in_time is None else str(row.in_time.max))
        assert line["seconds_per_simulated_second"] == ("" if not row.seconds else str(row.timing.median))
    assert (tmp_path / "study.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_picture_of_an_earlier_study_does_not_stay(tmp_path):
    (tmp_path / "study.png").write_bytes(b"old")
    told = write(run(Pendulum(plan(), failing={0.0125: "no"})), tmp_path)
    assert "no setting has both a time and an error" in told and not (tmp_path / "study.png").exists()


def test_a_folder_takes_a_study_of_its_own_scene_alone(tmp_path):
    check_scene(tmp_path, "scene")
    write(run(Pendulum(plan())), tmp_path)
    check_scene(tmp_path, "scene")
    with pytest.raises(OutputError, match="holds a study of another scene .pendulum"):
        check_scene(tmp_path, "another")
    (tmp_path / "study.json").write_text("[]")
    with pytest.raises(OutputError, match="holds a study.json not written by this version"):
        check_scene(tmp_path, "scene")


def test_code_is_of_the_packages_that_compute_too(monkeypatch):
    own = output.code_digest()
    assert output.code_digest() == own
    for other in ({"taichi": "9.9"}, {"numpy": "9.9"}):
        monkeypatch.setattr(output, "versions", lambda *names, other=other: versions(*names) | other)
        assert output.code_digest() != own
