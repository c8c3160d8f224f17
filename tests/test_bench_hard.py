"""The benchmark of hard cases:

* the data are whole: all cases of the catalogue, every criterion asked of some variant, every variant asked something;
* a run is judged by its end and its numbers; what is absent or not finite never passes;
* the meshes are what the catalogue says, and shapes are compared up to rigid motions, reflections excluded;
* cheap variants meet their limits, and a path is held against its reference;
* the table and the exit status tell what was not met or not run; finished runs are kept and taken again.
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import hard, hard_runs
from benchmarks.hard_cases import CASES, geometry, shapes, time_step
from benchmarks.hard_cases.record import DEGRADED, FAILED, OK, PROPOSED, Case, Criterion, Variant, judge
from benchmarks.hard_cases.session import Session
from benchmarks.hard_runs import Row, find
from taisoft.errors import SimulationError
from taisoft.study.store import pack

CATALOGUE = Path(__file__).resolve().parents[2] / "shared" / "hard_cases" / "catalogue.json"
CHEAP = ("M1", "M2", "T1", "G1")  # whose quick variants have no contacts and take explicit steps: little to compile
SMALL, LARGE = Criterion("small", 1.0, PROPOSED, note="a note"), Criterion("large", 2.0, PROPOSED, at_least=True, of={"dt": 0.1})


def one_case(run, ends=(OK,)) -> tuple[Case, Variant]:
    variant = Variant("first", {"dt": 0.1}, ends=ends)
    return Case("Z1", "a case", run, (variant,), (SMALL, LARGE), size=1.0, shortfall="the next idea"), variant


@pytest.mark.skipif(not CATALOGUE.exists(), reason="the catalogue lies beside the repository")
def test_every_case_of_the_catalogue_is_there():
    assert [case.id for case in CASES] == [case["id"] for case in json.loads(CATALOGUE.read_text())["hard_cases"]]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_data(case):
    names = [variant.name for variant in case.variants]
    assert len(set(names)) == len(names) and set(case.quick) <= set(names) and case.size > 0.0
    asked = [case.criteria_of(variant) for variant in case.variants]
    assert any(asked) and {c for some in asked for c in map(id, some)} == set(map(id, case.criteria))
    for some in asked:
        assert len({c.quantity for c in some}) == len(some)
    assert all(c.note for c in case.criteria if c.asked is not None)


@pytest.mark.parametrize(
    "numbers, status, passed",
    [
        ({"small": 1.0, "large": 2.0, "told": 9.0}, OK, [True, True, True, None]),
        ({"small": 1.1, "large": 1.9}, OK, [True, False, False]),
        ({"small": None}, DEGRADED, [False, False, False]),
        ({"small": math.inf, "large": math.nan}, FAILED, [False, False, False]),
    ],
)
def test_judgement(numbers, status, passed):
    case, variant = one_case(None)
    verdicts = judge(case, variant, {"status": status, "numbers": numbers})
    assert [verdict.passed for verdict in verdicts] == passed
    assert Row(case, variant, {"status": status}, verdicts=verdicts).passed == (False not in passed)


def test_a_run_that_cannot_be_made():
    def run(session):
        raise SimulationError("lost")

    case, variant = one_case(run, ends=(FAILED,))
    record = Session(case, variant, "cpu").record()
    assert (record["status"], record["problems"], record["numbers"]) == (FAILED, ["lost"], {})
    assert [verdict.passed for verdict in judge(case, variant, record)] == [True, False, False]


@pytest.mark.filterwarnings("ignore:.*nearly flat")
def test_shapes():
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
def test_quick_variants_meet_their_limits(case, name):
    case, variant = find(case, name)
    record = hard_runs.run(case, variant, "cpu")
    failed = [verdict for verdict in judge(case, variant, record) if verdict.passed is False]
    assert not failed and record["peak_memory_bytes"] > 0 and (record["steps"] > 0) == (record["step_seconds"] is not None)


def test_a_reference_is_finer():
    case, variant = find("T1", "corotational, dt 0.002 s")
    steps = []

    def follow(session, law):
        scene = geometry.sliver_scene(law, 1.0)
        with session.simulator(scene) as sim:
            result = session.go(sim, 40, every=10)
            steps.append((result.steps, sim.dt, sim.settings.precision, len(session.path)))
        return {}

    short = Case("Z2", "", follow, (variant,), (), size=0.5)
    small = Variant("small", variant.settings | {"dt": 2e-4}, variant.parameters)
    own, finer = (hard_runs.run(short, small, "cpu", share) for share in (1, 8))
    assert steps == [(40, 2e-4, "f32", 5), (320, 2.5e-5, "f64", 5)]
    error = Row(short, small, own, finer).error
    assert 1e-9 < error < 1e-2 and Row(short, small, own, finer | {"status": FAILED}).error is None


def test_the_table_tells_what_failed(monkeypatch, capsys):
    case, variant = one_case(None)
    monkeypatch.setattr(hard, "CASES", (case,))

    def fill(rows, *_):
        for row, record in zip(rows, records):
            row.record, row.left_out = record, "" if record else "the budget was spent"
            row.verdicts = judge(row.case, row.variant, record) if record else []

    monkeypatch.setattr(hard, "measure", fill)
    cost = {"problems": ["deep"], "steps": 3, "seconds": 1.0, "step_seconds": 0.5, "peak_memory_bytes": 10**6}
    cost["points"] = pack(np.zeros((0, 3)))
    records = [cost | {"status": OK, "numbers": {"small": 0.5, "large": 3.0}}]
    assert hard.main([]) == 0 and "1 of 1 variants meet all their limits" in capsys.readouterr().out
    records = [cost | {"status": OK, "numbers": {"small": 1.5, "large": 3.0}}]
    assert hard.main([]) == 1
    told = capsys.readouterr().out
    assert told.count("FAIL") == 1 and "the next idea" in told and "a note" in told and "first: deep" in told
    records = [None]
    assert hard.main([]) == 1
    told = capsys.readouterr().out
    assert "the budget was spent" in told and "not run: Z1 first" in told


def test_finished_runs_are_kept(tmp_path, monkeypatch, capsys):
    out = tmp_path / "hard.json"
    command = ["--case", "G1", "--quick", "--keep", str(tmp_path / "kept"), "--out", str(out)]
    assert hard.main(command) == 0
    first = json.loads(out.read_text())["rows"]
    assert len(first) == 1 and first[0]["passed"] and first[0]["run"]["peak_memory_bytes"] > 0
    assert (tmp_path / "hard.md").read_text().startswith("# Hard cases")

    def start(*_):
        raise AssertionError("a run that was kept is run again")

    monkeypatch.setattr(hard_runs.LocalPlace, "start", start)
    assert hard.main(command) == 0 and json.loads(out.read_text())["rows"] == first
