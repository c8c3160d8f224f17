"""The manual's measured tables:

* they agree exactly with benchmarks/results, and each is on one page;
* a number changed in the results or on a page is noticed, and updated;
* the newest full results are used; missing, unknown and unpaired tables are refused.
"""

import json
import shutil

import pytest

from benchmarks import manual
from benchmarks.manual import BLOCK, RESULTS, TABLES, filled, newest, pages
from taisoft.errors import OutputError

TEXT = "before\n<!-- begin fake -->\nold\n<!-- end fake -->\nafter\n"


@pytest.fixture
def fake(monkeypatch):
    """A table that exists only here."""
    monkeypatch.setitem(TABLES, "fake", lambda results: f"made of {results}")


def texts() -> list[str]:
    return [page.read_text(encoding="utf-8") for page in pages()]


def test_the_manual_agrees_with_the_results():
    for text in texts():
        assert {name for _, name, _ in BLOCK.findall(text)} <= set(TABLES) and BLOCK.search(text)
        assert filled(text) == text, "`taisoft bench manual` updates it"


def test_every_table_is_in_the_manual():
    assert sorted(name for text in texts() for _, name, _ in BLOCK.findall(text)) == sorted(TABLES)


def test_a_changed_number_is_noticed(tmp_path):
    shutil.copytree(RESULTS, tmp_path / "results")
    path = next((tmp_path / "results").glob("order-*.json"))
    numbers = json.loads(path.read_text())
    row = next(r for r in numbers["rows"] if r["case"] == manual.HANGING and r["order"] == 2)
    row["measured"][0] *= 1.001
    path.write_text(json.dumps(numbers))
    assert [filled(text, tmp_path / "results") != text for text in texts()].count(True) == 1


def test_marked_parts_are_replaced_and_the_rest_stays(fake):
    made = filled(TEXT, "here")
    assert made == "before\n<!-- begin fake -->\n\nmade of here\n\n<!-- end fake -->\nafter\n" and filled(made, "here") == made


@pytest.mark.parametrize(
    "text, words",
    [
        (TEXT.replace("fake", "nothing"), "'nothing' is unknown"),
        (TEXT.replace("<!-- end fake -->\n", ""), "'fake' needs"),
        (TEXT.replace("begin", "end"), "'fake' needs"),
        (TEXT.replace("end fake", "end other"), "needs one begin and one end"),
    ],
)
def test_wrong_markers_are_refused(text, words, fake):
    with pytest.raises(OutputError, match=words):
        filled(text)


def test_the_newest_full_results_are_used(tmp_path):
    with pytest.raises(OutputError, match="no results of `taisoft bench order`"):
        newest(tmp_path, "order")
    for name, date, quick in (("a", "2026-01-02", False), ("b", "2026-01-01", False), ("c", "2026-01-03", True)):
        (tmp_path / f"order-{name}.json").write_text(json.dumps({"date": date, "quick": quick, "name": name}))
    assert newest(tmp_path, "order")["name"] == "a"
    (tmp_path / "order-d.json").write_text("{")
    with pytest.raises(OutputError, match="order-d.json"):
        newest(tmp_path, "order")


def test_command_updates_or_checks_the_pages(fake, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(manual, "DOCS", tmp_path)
    page = tmp_path / "page.md"
    page.write_text("no table")
    with pytest.raises(OutputError, match="no page with tables"):
        manual.main([])
    page.write_text(TEXT)
    assert manual.main(["--check"]) == 1 and page.read_text() == TEXT
    assert manual.main([]) == 0 and "made of" in page.read_text()
    assert manual.main(["--check"]) == 0 and "agrees with the results" in capsys.readouterr().out
