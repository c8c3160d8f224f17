"""The scoreboard of the hard cases:

* a variant is solved if it ended as required and kept all limits;
* it is wrong if it ended ok although it must not, hid a cause, or missed a limit on its answer (not only on its cost);
* the headline is the sum over groups and over cases; variants that were not run count as unsolved;
* stored results are evaluated by the present criteria: verdicts, page and the manual's table; every unsolved variant has a cause.
"""

import json

import pytest

from benchmarks import hard, manual
from benchmarks.document import RESULTS
from benchmarks.hard_cases import CASES, GROUPS
from benchmarks.hard_cases.case import (
    DEGRADED,
    INVERTED,
    OK,
    PROPOSED,
    REFUSED,
    STOPPED,
    UNCONVERGED,
    Case,
    Criterion,
    Must,
    Variant,
)
from benchmarks.hard_runs import COLUMNS, NOT_RUN, WRONG, Row, stored
from benchmarks.hard_table import ASKED, SOLVED, headline, scoreboard, tally
from taisoft.errors import OutputError

ANSWER, COST = Criterion("off by", 1.0, PROPOSED), Criterion("seconds", 1.0, PROPOSED, cost=True)
PLAIN, INSIDE_OUT, ALWAYS = Must(OK, "why"), Must(OK, "why", (INVERTED,)), Must(DEGRADED, "why", (INVERTED,))
REFUSES, STOPS = Must(REFUSED, "why"), Must(STOPPED, "why", (INVERTED,))
KEPT, OFF, SLOW = {"off by": 0.5, "seconds": 0.5}, {"off by": 2.0, "seconds": 0.5}, {"off by": 0.5, "seconds": 2.0}
BOTH = [INVERTED, UNCONVERGED]


def row_of(must: Must, status: str | None, causes=(), numbers=KEPT) -> Row:
    variant = Variant("first", {}, {}, must)
    record = {"status": status, "causes": list(causes), "numbers": numbers, "problems": []}
    row = Row(Case("Z1", "", None, (variant,), (ANSWER, COST), size=1.0), variant, record if status else None)
    row.judge()
    return row


@pytest.mark.parametrize(
    "must, status, causes, numbers, column, faults",
    [
        (PLAIN, OK, [], KEPT, OK, []),
        (PLAIN, DEGRADED, [UNCONVERGED], KEPT, DEGRADED, [UNCONVERGED]),  # although all limits are kept
        (PLAIN, DEGRADED, [INVERTED], KEPT, DEGRADED, [INVERTED]),
        (PLAIN, DEGRADED, [], KEPT, DEGRADED, ["degraded, must be ok"]),
        (PLAIN, REFUSED, [], KEPT, REFUSED, ["refused, must be ok"]),
        (PLAIN, STOPPED, [], KEPT, STOPPED, ["stopped, must be ok"]),
        (PLAIN, STOPPED, [INVERTED], {}, STOPPED, ["stopped, must be ok", "off by", "seconds"]),
        (PLAIN, None, [], {}, NOT_RUN, [NOT_RUN]),
        (PLAIN, OK, [], OFF, WRONG, ["off by"]),
        (PLAIN, OK, [], {}, WRONG, ["off by", "seconds"]),
        (PLAIN, OK, [], SLOW, OK, ["seconds"]),  # its answer is right
        (PLAIN, OK, [UNCONVERGED], KEPT, WRONG, [UNCONVERGED]),  # hidden
        (INSIDE_OUT, OK, [], KEPT, OK, []),
        (INSIDE_OUT, OK, [INVERTED], KEPT, WRONG, ["ok, must be ok, or degraded by inverted tets"]),
        (INSIDE_OUT, DEGRADED, [INVERTED], KEPT, DEGRADED, []),
        (INSIDE_OUT, DEGRADED, [INVERTED], OFF, DEGRADED, ["off by"]),
        (INSIDE_OUT, DEGRADED, BOTH, KEPT, DEGRADED, [UNCONVERGED]),  # not explained by the start
        (INSIDE_OUT, STOPPED, [INVERTED], KEPT, STOPPED, ["stopped, must be ok, or degraded by inverted tets"]),
        (ALWAYS, DEGRADED, [INVERTED], KEPT, DEGRADED, []),
        (ALWAYS, OK, [], KEPT, WRONG, ["ok, must be degraded by inverted tets"]),
        (REFUSES, REFUSED, [], KEPT, REFUSED, []),
        (REFUSES, STOPPED, [], KEPT, STOPPED, ["stopped, must be refused"]),
        (REFUSES, OK, [], KEPT, WRONG, ["ok, must be refused"]),
        (REFUSES, REFUSED, [UNCONVERGED], KEPT, REFUSED, [UNCONVERGED]),
        (STOPS, STOPPED, [INVERTED], KEPT, STOPPED, []),
        (STOPS, STOPPED, [], OFF, STOPPED, ["off by"]),
        (STOPS, DEGRADED, [INVERTED], KEPT, DEGRADED, ["degraded, must be stopped"]),
        (STOPS, OK, [], KEPT, WRONG, ["ok, must be stopped"]),
    ],
)
def test_columns_and_faults(must, status, causes, numbers, column, faults):
    row = row_of(must, status, causes, numbers)
    assert (row.column, row.faults) == (column, faults)
    assert row.data()["solved"] == (not faults) and row.data()["column"] == column


def table_numbers(text: str, heading: str) -> list[int]:
    """Return a column of the only Markdown table in a text."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    place = lines[0].index(heading)
    return [int(line[place] or 0) for line in lines[2:]]


@pytest.fixture(scope="module")
def results() -> dict:
    """The stored results of the manual's table."""
    return manual.newest(RESULTS, "hard")


def test_the_headline_is_the_sum(results):
    rows = stored(results)
    counts = tally(rows)
    assert counts[ASKED] == len(rows) == sum(len(case.variants) for case in CASES) == sum(counts[name] for name in COLUMNS)
    assert counts[SOLVED] == sum(row["solved"] for row in results["rows"]) and str(counts[SOLVED]) in headline(rows)
    assert [case for cases in GROUPS.values() for case in cases] == list(CASES)
    for text in (scoreboard(rows), manual.hard(RESULTS)):
        assert headline(rows) in text and (NOT_RUN in text) == bool(counts[NOT_RUN])
        for name in (ASKED, SOLVED, *COLUMNS[:-1]):
            *lines, last = table_numbers(text, name)
            assert sum(lines) == last == counts[name]


def test_variants_not_run_count_as_unsolved(results):
    before = tally(stored(results))
    dropped = next(row for row in results["rows"] if row["solved"])
    rows = stored(results | {"rows": [row for row in results["rows"] if row is not dropped]})
    assert tally(rows) == before | {SOLVED: before[SOLVED] - 1, NOT_RUN: 1, dropped["column"]: before[dropped["column"]] - 1}
    assert NOT_RUN in scoreboard(rows)


def test_every_unsolved_variant_has_a_cause(results):
    unexplained = [row for row in stored(results) if row.faults and row.record and not row.case.shortfalls_of(row.variant)]
    assert [(row.case.id, row.variant.name) for row in unexplained] == []


def test_stored_results_are_evaluated_again(results, tmp_path, capsys):
    page = next(path for path in RESULTS.glob("hard-*.md") if results["date"] in path.read_text(encoding="utf-8"))
    again = tmp_path / "hard.json"
    again.write_text(json.dumps(results | {"rows": [row | {"solved": None} for row in results["rows"]]}))
    solved = all(not row.faults for row in stored(results))
    assert hard.main(["--judge", str(again)]) == (0 if solved else 1)
    hint = f"`taisoft bench hard --judge {page.with_suffix('.json')}` updates it"
    same_rows = json.loads(again.read_text())["rows"] == results["rows"]
    assert same_rows, hint
    same_page = again.with_suffix(".md").read_text(encoding="utf-8") == page.read_text(encoding="utf-8")
    assert same_page, hint
    capsys.readouterr()
    again.write_text("{")
    with pytest.raises(OutputError, match="hard.json cannot be read"):
        hard.main(["--judge", str(again)])
    with pytest.raises(SystemExit):
        hard.main(["--judge", str(again), "--quick"])
    assert "--judge goes alone" in capsys.readouterr().err
