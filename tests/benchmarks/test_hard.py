"""The benchmark of hard cases (for the scoreboard see test_bench_hard_score.py):

* the data are complete: all cases of the catalogue; every criterion applies to a variant, and every case has criteria;
* every variant states its required end and the reason; missing and non-finite numbers never pass a criterion;
* meshes agree with the catalogue, and shapes are compared up to rigid motions, without reflections;
* a failed run was refused or stopped, and a degraded one has causes;
* cheap variants are solved, and a path is compared with its reference;
* the page and the exit status show what is not solved or not run; finished runs are stored and reused.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import hard, hard_runs
from benchmarks.hard_cases import CASES, geometry, shapes, time_step
from benchmarks.hard_cases.case import (
    DEGRADED,
    DROPPED,
    INTERRUPTED,
    INVERTED,
    OK,
    OVERLAP,
    PENETRATION,
    PROPOSED,
    REFUSED,
    STOPPED,
    UNCONVERGED,
    Case,
    Criterion,
    Must,
    Session,
    Shortfall,
    Variant,
    judge,
)
from benchmarks.hard_runs import Row, find
from taisoft.errors import SimulationError
from taisoft.records import RunReport, StepReport
from taisoft.study.accuracy import pack

CATALOGUE = Path(__file__).resolve().parents[3] / "shared" / "hard_cases" / "catalogue.json"
CHEAP = ("M1", "M2", "T1", "G1")  # whose quick variants have no contacts and take explicit steps: little to compile
SMALL, LARGE = Criterion("small", 1.0, PROPOSED, note="a note"), Criterion("large", 2.0, PROPOSED, at_least=True, of={"dt": 0.1})


CAUSES = {UNCONVERGED, INVERTED, DROPPED, PENETRATION, OVERLAP, INTERRUPTED}


def one_case(run, end=OK) -> tuple[Case, Variant]:
    variant = Variant("first", {"dt": 0.1}, {}, Must(end, "a reason"))
    shortfall = Shortfall("what it is", "the next idea", of={"dt": 0.1})
    return Case("Z1", "a case", run, (variant,), (SMALL, LARGE), size=1.0, shortfalls=(shortfall,)), variant


@pytest.mark.skipif(not CATALOGUE.exists(), reason="the catalogue lies beside the repository")
def test_every_case_of_the_catalogue_is_there():
    assert [case.id for case in CASES] == [case["id"] for case in json.loads(CATALOGUE.read_text())["hard_cases"]]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_data_are_complete(case):
    names = [variant.name for variant in case.variants]
    assert len(set(names)) == len(names) and set(case.quick) <= set(names) and case.size > 0.0
    criteria = [case.criteria_of(variant) for variant in case.variants]
    assert any(criteria) and {c for own in criteria for c in map(id, own)} == set(map(id, case.criteria))
    for own in criteria:
        assert len({c.quantity for c in own}) == len(own)
    assert all(c.note for c in case.criteria if c.asked is not None)
    shortfalls = [case.shortfalls_of(variant) for variant in case.variants]
    assert {s for own in shortfalls for s in map(id, own)} == set(map(id, case.shortfalls))
    assert all(s.cause and s.next_idea for s in case.shortfalls) and all(len(own) <= 1 for own in shortfalls)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_every_variant_has_a_required_end_and_a_reason(case):
    for must in {variant.must for variant in case.variants}:
        assert must.end in (OK, DEGRADED, REFUSED, STOPPED) and set(must.causes) <= CAUSES
        assert len(must.reason) > 20 and not must.reason.endswith(".") and "\n" not in must.reason
        assert must.causes or must.end != DEGRADED


@pytest.mark.parametrize(
    "numbers, status, passed",
    [
        ({"small": 1.0, "large": 2.0, "other": 9.0}, OK, [True, True, True, None]),
        ({"small": 1.1, "large": 1.9}, OK, [True, False, False]),
        ({"small": None}, DEGRADED, [False, False, False]),
        ({"small": math.inf, "large": math.nan}, STOPPED, [False, False, False]),
    ],
)
def test_criteria_pass_or_fail(numbers, status, passed):
    case, variant = one_case(None)
    record = {"status": status, "causes": [], "numbers": numbers}
    row = Row(case, variant, record)
    row.judge()
    assert [verdict.passed for verdict in row.verdicts] == passed and len(row.faults) == passed.count(False)


def test_an_error_before_the_first_step_is_a_refusal():
    def run(session):
        raise SimulationError("lost")

    case, variant = one_case(run, REFUSED)
    record = Session(case, variant, "cpu").record()
    assert (record["status"], record["problems"], record["numbers"]) == (REFUSED, ["lost"], {})
    assert [verdict.passed for verdict in judge(case, variant, record)] == [True, False, False]


DEEP = SimpleNamespace(depth=2.0, name_a="a", name_b="b")


@pytest.mark.parametrize(
    "result, done, overlaps, status, causes",
    [
        (RunReport(), 2, [], OK, []),
        (RunReport("failed", ["step 1: too fast"]), 0, [], REFUSED, []),
        (RunReport("failed", ["step 3: too fast"], step_reports=[StepReport(0.1, n_inverted=2)]), 2, [], STOPPED, [INVERTED]),
        (RunReport("degraded", step_reports=[StepReport(0.1), StepReport(0.2, converged=False)]), 2, [], DEGRADED, [UNCONVERGED]),
        (
            RunReport("degraded", step_reports=[StepReport(0.1, deep=1, dropped_contacts=1)], interrupted=True),
            1,
            [],
            DEGRADED,
            [DROPPED, INTERRUPTED, PENETRATION],
        ),
        (RunReport("degraded"), 2, [DEEP], DEGRADED, [OVERLAP]),
    ],
)
def test_end_and_causes_of_a_run(result, done, overlaps, status, causes):
    sim = SimpleNamespace(
        dt=0.1,
        step_count=done,
        touches=True,
        run=lambda *_, **__: result,
        overlaps=lambda: overlaps,
        contact_limit=lambda a, b: 1.0,
    )

    def run(session):
        session.run_steps(sim, 2, follow=False)
        return {}

    record = Session(*one_case(run), "cpu").record()
    assert (record["status"], record["causes"], record["problems"]) == (status, causes, result.problems)


def test_the_worst_end_counts():
    reports = [RunReport("failed"), RunReport("degraded", step_reports=[StepReport(0.1, n_inverted=1)]), RunReport()]
    session = Session(*one_case(None), "cpu")
    for result in reports:
        session.run_steps(SimpleNamespace(dt=0.1, step_count=0, touches=False, run=lambda *_, r=result, **__: r), 1, follow=False)
    assert session.status == REFUSED and session.causes == {INVERTED}


@pytest.mark.filterwarnings("ignore:.*nearly flat")
def test_meshes_and_shape_errors_agree_with_formulas():
    ball = time_step.ball()
    assert ball.n_tets == 6 * round(ball.volumes.sum() / 0.004**3) and ball.n_tets == 3312
    assert geometry.sliver_mesh(1e-4).volumes.min() == pytest.approx(1e-4 * geometry.sliver_mesh(1.0).volumes.mean(), rel=1e-6)
    X = np.random.default_rng(0).standard_normal((20, 3))
    moved = X @ (shapes.turn_about(0, 1.0) @ shapes.turn_about(2, 2.0)) + [1.0, 2.0, 3.0]
    assert shapes.shape_error(X, moved, 1.0) < 1e-12 and shapes.shape_error(X, moved * (-1, 1, 1), 1.0) > 0.1
    edge = np.array([[0.1, 1e-3, 0.0], [0.1, -1e-3, 0.0], [0.1005, -0.05, 0.0]])
    depths = [geometry.depth_in_knife(points, 0.1) for points in (edge[:1], edge[1:2], edge)]
    assert depths == pytest.approx([0.0, 2e-5, 0.5e-3], rel=1e-2) and geometry.depth_in_knife(edge, 0.2) == 0.0


QUICK = [(case.id, name) for case in CASES for name in case.quick]


@pytest.mark.parametrize("case, name", QUICK, ids=[f"{'cheap' if case in CHEAP else 'dear'}-{case}-{n}" for case, n in QUICK])
def test_quick_variants_are_solved(case, name):
    row = Row(*find(case, name))
    record = row.record = hard_runs.run(row.case, row.variant, "cpu")
    row.judge()
    assert not row.faults and record["peak_memory_bytes"] > 0 and (record["steps"] > 0) == (record["step_seconds"] is not None)


def test_a_reference_has_smaller_steps_and_double_precision():
    case, variant = find("T1", "corotational, dt 0.002 s")
    steps = []

    def follow(session, law):
        scene = geometry.sliver_scene(law, 1.0)
        with session.simulator(scene) as sim:
            result = session.run_steps(sim, 40, every=10)
            steps.append((result.steps, sim.dt, sim.settings.precision, len(session.path)))
        return {}

    short = Case("Z2", "", follow, (variant,), (), size=0.5)
    small = replace(variant, name="small", settings=variant.settings | {"dt": 2e-4})
    own, finer = (hard_runs.run(short, small, "cpu", n) for n in (1, 8))
    assert steps == [(40, 2e-4, "f32", 5), (320, 2.5e-5, "f64", 5)]
    row, without = Row(short, small, own, finer), Row(short, small, own, finer | {"status": STOPPED})
    row.compare(), without.compare()
    assert 1e-9 < row.error < 1e-2 and without.error is None


def test_the_page_shows_what_is_not_solved(monkeypatch, capsys):
    case, variant = one_case(None)
    monkeypatch.setattr(hard, "CASES", (case,))

    def fill(self, rows, references):
        for row, record in zip(rows, records):
            row.record, row.left_out = record, "" if record else "the budget was spent"
            row.judge()

    monkeypatch.setattr(hard.Runner, "measure", fill)
    cost = {"causes": [], "problems": ["deep"], "steps": 3, "seconds": 1.0, "step_seconds": 0.5, "peak_memory_bytes": 10**6}
    cost["points"] = pack(np.zeros((0, 3)))
    records = [cost | {"status": OK, "numbers": {"small": 0.5, "large": 3.0}}]
    assert hard.main([]) == 0 and "**1 of 1 variants are solved.**" in capsys.readouterr().out
    records = [cost | {"status": OK, "numbers": {"small": 1.5, "large": 3.0}}]
    assert hard.main([]) == 1
    text = capsys.readouterr().out
    assert "**0 of 1 variants are solved.**" in text and text.count("FAIL") == 1 and "a note" in text and "first: deep" in text
    assert "* first: small. Cause: what it is. Next: the next idea." in text and "* Z1: ok: a reason." in text
    records = [None]
    assert hard.main([]) == 1
    text = capsys.readouterr().out
    assert "the budget was spent" in text and "* first: not run." in text and "the next idea" not in text


def test_finished_runs_are_reused(tmp_path, monkeypatch, capsys):
    out = tmp_path / "hard.json"
    command = ["--case", "G1", "--quick", "--keep", str(tmp_path / "kept"), "--out", str(out)]
    assert hard.main(command) == 0
    first = json.loads(out.read_text())["rows"]
    assert len(first) == 1 and first[0]["solved"] and first[0]["column"] == REFUSED and first[0]["run"]["peak_memory_bytes"] > 0
    assert (tmp_path / "hard.md").read_text().startswith("# Hard cases")

    def start(*_):
        raise AssertionError("a stored run was repeated")

    monkeypatch.setattr(hard_runs.LocalPlace, "start", start)
    assert hard.main(command) == 0 and json.loads(out.read_text())["rows"] == first
