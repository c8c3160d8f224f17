"""The benchmark of contact problems. No test here checks speed:

* each solver has a row, with decreasing residuals and counted operations;
* verdicts on made-up rows: reference residuals kept or missed, the best solver within the cost or not, no solver that converges;
* missing problems are reported.
"""

from dataclasses import replace

import pytest

from benchmarks import contact_problems as bench
from benchmarks.contact_problems import Row
from taisoft.backend.runtime import open_runtime

PLAIN = Row("Rover1039", 4, bench.PLAIN, (2.8e-2, 5.9e-4, 1e-10), 430, 0.5, 0.4)
ROWS = [PLAIN, replace(PLAIN, solver="jacobi", iterations=None), replace(PLAIN, solver="hybrid", time=0.3, operations=0.2)]


@pytest.fixture(scope="module", autouse=True)
def runtime():
    made = open_runtime("cpu", "f64", "the test")
    yield made
    made.close()


def test_rows_of_all_solvers(shared):
    rows = list(bench.compute(("Rover1039",), repeats=1))
    assert [row.solver for row in rows] == [*bench.SWEEPERS, "augmented_lagrangian", "auto"]
    for row in rows:
        first, second, third = row.residuals
        assert row.iterations is not None and first >= second >= third < 1e-6
        assert row.time > 0.0 and 0.0 < row.operations < 2.0
        assert len(row.cells) == len(bench.HEADINGS) and row.cells[0] == row.problem and row.cells[3] == f"{first:.1e}"
    by_solver = {row.solver: row for row in rows}
    assert by_solver["gauss_seidel"].iterations < by_solver[bench.PLAIN].iterations
    assert by_solver["auto"].iterations >= by_solver["augmented_lagrangian"].iterations
    # counted by hand: 16 blocks and 4 proxes a sweep, and a residual every fifth sweep
    assert by_solver[bench.PLAIN].operations == pytest.approx(by_solver[bench.PLAIN].iterations * 1.2 / 1000)
    assert sum("best" in row.verdict for row in rows) == 1


def test_verdicts_follow_from_residuals_and_costs():
    verdicts = {row.solver: row.verdict for row in bench.with_verdicts(ROWS)}
    assert verdicts == {bench.PLAIN: "yardstick: pass", "jacobi": "", "hybrid": "best: pass"}
    slow = [replace(row, residuals=(1.0, 1.0, 1.0), time=5.0 + row.time) for row in ROWS]
    assert {row.solver: row.verdict for row in bench.with_verdicts(slow)} == {
        bench.PLAIN: "yardstick: FAIL",
        "jacobi": "",
        "hybrid": "best: FAIL",
    }
    unconverged = [replace(row, iterations=None) for row in ROWS]
    assert all("FAIL" in row.verdict for row in bench.with_verdicts(unconverged))
    assert unconverged[0].cells[6] == "-"


def test_summary_counts_solved_problems():
    lines = bench.summary(ROWS).splitlines()
    assert lines[1].startswith("* jacobi:") and "0 of 1" in lines[1]
    assert "1 of 1" in lines[2] and "operations 0.20, time 0.30" in lines[2]


def test_missing_problems_are_named(monkeypatch, tmp_path):
    monkeypatch.setattr(bench, "PROBLEMS", tmp_path)
    message = bench.missing()
    assert "contact problems are absent" in message and "Rover4396" in message
