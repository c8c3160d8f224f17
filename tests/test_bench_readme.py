"""The README's measured tables:

* README.md is what the results in benchmarks/results say, to the letter;
* a number changed in the results or in README.md is seen, and written anew;
* the newest whole results count, and what is missing, unknown or unpaired is told in a sentence.
"""

import json
import shutil

import pytest

from benchmarks import readme
from benchmarks.readme import BLOCK, README, RESULTS, TABLES, filled, newest
from taisoft.errors import OutputError

TEXT = "before\n<!-- begin fake -->\nold\n<!-- end fake -->\nafter\n"


@pytest.fixture
def fake(monkeypatch):
    """A table of its own."""
    monkeypatch.setitem(TABLES, "fake", lambda results: f"made of {results}")


def test_readme_is_what_the_results_say():
    text = README.read_text(encoding="utf-8")
    assert {name for _, name, _ in BLOCK.findall(text)} <= set(TABLES) and BLOCK.search(text)
    assert filled(text) == text, "`taisoft bench readme` writes it anew"


def test_every_table_is_in_the_readme():
    assert sorted(name for _, name, _ in BLOCK.findall(README.read_text(encoding="utf-8"))) == sorted(TABLES)


def test_a_changed_number_is_seen(tmp_path):
    shutil.copytree(RESULTS, tmp_path / "results")
    path = next((tmp_path / "results").glob("order-*.json"))
    numbers = json.loads(path.read_text())
    row = next(r for r in numbers["rows"] if r["case"] == readme.HANGING and r["order"] == 2)
    row["measured"][0] *= 1.001
    path.write_text(json.dumps(numbers))
    text = README.read_text(encoding="utf-8")
    assert filled(text, tmp_path / "results") != text


def test_marked_parts_are_made_anew_and_the_rest_stays(fake):
    made = filled(TEXT, "here")
    assert made == "before\n<!-- begin fake -->\n\nmade of here\n\n<!-- end fake -->\nafter\n" and filled(made, "here") == made


@pytest.mark.parametrize(
    "text, words",
    [
        (TEXT.replace("fake", "nothing"), "'nothing' is unknown"), (TEXT.replace("<!-- end fake -->\n", ""), "'fake' needs"),
        (TEXT.replace("begin", "end"), "'fake' needs"), (TEXT.replace("end fake", "end other"), "needs one begin and one end"),
    ],
)  # fmt: skip
def test_wrong_markers_are_refused(text, words, fake):
    with pytest.raises(OutputError, match=words):
        filled(text)


def test_the_newest_whole_results_count(tmp_path):
    with pytest.raises(OutputError, match="no results of `taisoft bench order`"):
        newest(tmp_path, "order")
    for name, date, quick in (("a", "2026-01-02", False), ("b", "2026-01-01", False), ("c", "2026-01-03", True)):
        (tmp_path / f"order-{name}.json").write_text(json.dumps({"date": date, "quick": quick, "name": name}))
    assert newest(tmp_path, "order")["name"] == "a"
    (tmp_path / "order-d.json").write_text("{")
    with pytest.raises(OutputError, match="order-d.json"):
        newest(tmp_path, "order")


def test_writes_or_tells(fake, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(readme, "README", tmp_path / "README.md")
    with pytest.raises(OutputError, match="README.md"):
        readme.main([])
    readme.README.write_text(TEXT)
    assert readme.main(["--check"]) == 1 and readme.README.read_text() == TEXT
    assert readme.main([]) == 0 and "made of" in readme.README.read_text()
    assert readme.main(["--check"]) == 0 and "is what the results say" in capsys.readouterr().out
