"""The table of `run_many`:

* columns have the type of what they hold, and nan or None where a row has nothing;
* the digest depends on every bit but wall times, and not on the order;
* the CSV file and the records agree.
"""

import csv
from dataclasses import replace

import numpy as np
import pytest

from taisoft.errors import SceneError
from taisoft.many.results import Results, Row

ROWS = (
    Row({"young": 1e5, "law": "svk"}, "ok", [], {"tip": 0.5, "n": 3, "note": "a"}, {"x": np.arange(3.0)}, 1.0),
    Row({"young": 1e6}, "degraded", ["late", "warning: thin"], {"tip": 0.25, "n": 4, "note": None}, {"x": np.zeros(2)}, 2.0),
    Row({"young": 1e7, "law": "svk"}, "failed", ["ValueError: no"]),
)


def test_columns():
    results = Results(ROWS)
    assert results.names == ["young", "law", "status", "wall_seconds", "tip", "n", "note", "problem"]
    assert results["young"].tolist() == [1e5, 1e6, 1e7] and results["status"].tolist() == ["ok", "degraded", "failed"]
    assert np.array_equal(results["tip"], [0.5, 0.25, np.nan], equal_nan=True) and Results(ROWS[:2])["n"].dtype.kind == "i"
    assert results["note"].tolist() == ["a", None, None] and results["problem"][1] == "late; warning: thin"
    assert [None if x is None else len(x) for x in results.arrays("x")] == [3, 2, None]
    assert len(results) == 3 and results[1] is ROWS[1] and list(results) == list(ROWS) and results[1:] == ROWS[1:]
    for call, message in (
        (lambda: results["tipp"], "no column is called 'tipp'.*did you mean tip"),
        (lambda: results["x"], r"results.arrays\('x'\) returns its arrays"),
        (lambda: results.arrays("tip"), "no row has an array called 'tip'; there are x"),
    ):
        with pytest.raises(SceneError, match=message):
            call()
    text = repr(results)
    assert text.startswith("Results of 3 runs: 1 ok, 1 degraded, 1 failed") and "ValueError: no" in text
    assert "and 26 more rows" in (text := repr(Results(ROWS * 20))) and text.count("ValueError") == 20  # of 60, all that failed


def test_large_integers_and_odd_texts_are_kept(tmp_path):
    results = Results([Row({"a": "f\udcff"}, "ok", values={"n": 2**60 + 1}), Row({"a": "b"}, "failed")])
    assert results["n"].tolist() == [2**60 + 1, None]
    results.write(tmp_path / "t.csv")
    assert "f\\udcff" in (tmp_path / "t.csv").read_text()


def test_the_digest_depends_on_every_bit_and_not_on_order_or_time():
    first, digest = ROWS[0], Results(ROWS).digest()
    assert Results(ROWS[::-1]).digest() == Results([replace(first, wall_seconds=9.0), *ROWS[1:]]).digest() == digest
    x = first.arrays["x"].copy()
    x[1] = np.nextafter(x[1], 2.0)
    for change in (
        {"arrays": {"x": x}},
        {"arrays": {"x": first.arrays["x"].astype(np.float32)}},
        {"values": first.values | {"tip": np.nextafter(0.5, 1.0)}},
        {"status": "degraded"},
        {"parameters": {"young": 1e5}},
    ):
        assert Results([replace(first, **change), *ROWS[1:]]).digest() != digest


def test_the_file_agrees_with_the_records(tmp_path):
    results = Results(ROWS)
    results.write(tmp_path / "table.csv")
    lines = list(csv.DictReader((tmp_path / "table.csv").open()))
    assert list(lines[0]) == results.names
    for line, row in zip(lines, results.to_dicts()):
        assert line == {name: "" if value is None else str(value) for name, value in row.items()}
