"""The benchmark of hard cases:

* the data are complete: every case of the catalogue, criteria, a required end with its reason;
* a variant is solved if it ended as required and kept all limits; it is wrong if it hid a cause or its answer is off;
* how a failed or degraded run ended, and why;
* stored results are judged anew; what was not run counts as unsolved.
"""

import json
import math
from types import SimpleNamespace

import pytest

from benchmarks import hard, manual
from benchmarks.document import RESULTS
from benchmarks.hard_cases import CASES
from benchmarks.hard_cases import case as hard_case
from benchmarks.hard_cases.case import DEGRADED, INVERTED, OK, OVERLAP, PROPOSED, REFUSED, STOPPED, UNCONVERGED, Criterion, Must
from benchmarks.hard_runs import COLUMNS, NOT_RUN, WRONG, Row, stored
from benchmarks.hard_table import ASKED, SOLVED, tally
from taisoft.records import RunReport, StepReport

ANSWER, COST = Criterion("off by", 1.0, PROPOSED, note="a note"), Criterion("seconds", 1.0, PROPOSED, cost=True)
RATE = Criterion("rate", 2.0, PROPOSED, at_least=True, of={"fast": True})
SLOWLY = Criterion("rate", 99.0, PROPOSED, at_least=True, of={"fast": False})
PLAIN, INSIDE_OUT, ALWAYS = Must(OK, "why"), Must(OK, "why", (INVERTED,)), Must(DEGRADED, "why", (INVERTED,))
REFUSES, STOPS = Must(REFUSED, "why"), Must(STOPPED, "why", (INVERTED,))
KEPT = {"off by": 0.5, "seconds": 0.5, "rate": 2.0}
OFF, SLOW = KEPT | {"off by": 2.0}, KEPT | {"seconds": 2.0}
BOTH = [INVERTED, UNCONVERGED]


def one_case(run=None, must: Must = PLAIN) -> tuple[hard_case.Case, hard_case.Variant]:
    variant = hard_case.Variant("first", {"dt": 0.1}, {"fast": True}, must)
    return hard_case.Case("Z1", "a case", run, (variant,), (ANSWER, COST, RATE, SLOWLY)), variant


def row_of(must: Must, status: str | None, causes=(), numbers=KEPT) -> Row:
    record = {"status": status, "causes": list(causes), "numbers": numbers, "problems": []}
    return Row(*one_case(None, must), record if status else None)


def test_data_are_complete(shared):
    catalogue = json.loads((shared / "hard_cases" / "catalogue.json").read_text())["hard_cases"]
    assert [case.id for case in CASES] == [case["id"] for case in catalogue]
    for case in CASES:
        names = [variant.name for variant in case.variants]
        assert len(set(names)) == len(names) and set(case.quick) <= set(names) and case.size > 0.0
        criteria, shortfalls = ([of(variant) for variant in case.variants] for of in (case.criteria_of, case.shortfalls_of))
        assert any(criteria) and {id(c) for own in criteria for c in own} == set(map(id, case.criteria))
        assert all(len({c.quantity for c in own}) == len(own) for own in criteria)
        assert {id(s) for own in shortfalls for s in own} == set(map(id, case.shortfalls))
        for must in {variant.must for variant in case.variants}:
            assert must.end in (OK, DEGRADED, REFUSED, STOPPED) and (must.causes or must.end != DEGRADED)
            assert len(must.reason) > 20 and "\n" not in must.reason


@pytest.mark.parametrize(
    "must, status, causes, numbers, column, faults",
    [
        (PLAIN, OK, [], KEPT, OK, []),
        (PLAIN, DEGRADED, [UNCONVERGED], KEPT, DEGRADED, [UNCONVERGED]),  # although all limits are kept
        (PLAIN, STOPPED, [INVERTED], {}, STOPPED, ["stopped, must be ok", "off by", "seconds", "rate"]),
        (PLAIN, None, [], {}, NOT_RUN, [NOT_RUN]),
        (PLAIN, OK, [], OFF, WRONG, ["off by"]),
        (PLAIN, OK, [], {"off by": math.nan, "seconds": None}, WRONG, ["off by", "seconds", "rate"]),
        (PLAIN, OK, [], SLOW, OK, ["seconds"]),  # its answer is right
        (PLAIN, OK, [UNCONVERGED], KEPT, WRONG, [UNCONVERGED]),  # hidden
        (INSIDE_OUT, OK, [INVERTED], KEPT, WRONG, ["ok, must be ok, or degraded by inverted tets"]),
        (INSIDE_OUT, DEGRADED, [INVERTED], KEPT, DEGRADED, []),
        (INSIDE_OUT, DEGRADED, BOTH, KEPT, DEGRADED, [UNCONVERGED]),  # not explained by the start
        (ALWAYS, OK, [], KEPT, WRONG, ["ok, must be degraded by inverted tets"]),
        (REFUSES, STOPPED, [], KEPT, STOPPED, ["stopped, must be refused"]),
        (STOPS, DEGRADED, [INVERTED], KEPT, DEGRADED, ["degraded, must be stopped"]),
    ],
)
def test_columns_and_faults(must, status, causes, numbers, column, faults):
    row = row_of(must, status, causes, numbers)
    assert (row.column, row.faults) == (column, faults)
    assert row.data()["solved"] == (not faults) and row.data()["column"] == column


@pytest.mark.parametrize(
    "result, done, overlaps, status, causes",
    [
        (RunReport(), 2, [], OK, []),
        (RunReport("failed", ["step 1: too fast"]), 0, [], REFUSED, []),
        (RunReport("failed", ["step 3: too fast"], step_reports=[StepReport(0.1, n_inverted=2)]), 2, [], STOPPED, [INVERTED]),
        (RunReport("degraded", step_reports=[StepReport(0.1), StepReport(0.2, converged=False)]), 2, [], DEGRADED, [UNCONVERGED]),
        (RunReport("degraded"), 2, [SimpleNamespace(depth=2.0, name_a="a", name_b="b")], DEGRADED, [OVERLAP]),
    ],
)
def test_end_and_causes_of_a_run(result, done, overlaps, status, causes):
    sim = SimpleNamespace(dt=0.1, step_count=done, touches=True, run=lambda *_, **__: result, overlaps=lambda: overlaps)
    sim.contact_limit = lambda a, b: 1.0

    def run(session, fast):
        session.run_steps(sim, 2, follow=False)
        return {}

    record = hard_case.Session(*one_case(run), "cpu").record()
    assert (record["status"], record["causes"], record["problems"]) == (status, causes, result.problems)


def test_stored_results_are_judged_again(tmp_path):
    results = manual.newest(RESULTS, "hard")
    solved = next(row for row in results["rows"] if row["solved"])
    counts = tally(stored(results))
    fewer = tally(stored(results | {"rows": [row for row in results["rows"] if row is not solved]}))
    assert counts[ASKED] == sum(len(case.variants) for case in CASES) == sum(counts[name] for name in COLUMNS)
    assert fewer == counts | {
        SOLVED: counts[SOLVED] - 1,
        NOT_RUN: counts[NOT_RUN] + 1,
        solved["column"]: counts[solved["column"]] - 1,
    }
    page = next(path for path in RESULTS.glob("hard-*.md") if results["date"] in path.read_text(encoding="utf-8"))
    again = tmp_path / "hard.json"
    again.write_text(json.dumps(results | {"rows": [row | {"solved": None} for row in results["rows"]]}))
    assert hard.main(["--judge", str(again)]) == (0 if all(not row.faults for row in stored(results)) else 1)
    same = json.loads(again.read_text())["rows"] == results["rows"] and again.with_suffix(".md").read_text() == page.read_text()
    assert same, f"`taisoft bench hard --judge {page.with_suffix('.json')}` updates it"
