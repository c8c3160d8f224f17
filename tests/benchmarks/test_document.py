"""What benchmarks share: pages, limits, options, stopwatches, stored runs, the collection of figures and the manual's tables:

* a limit is met or not, nan never meets it, and a distance within the spread is marked; exponents and crossovers are exact;
* output that cannot be written and unknown names are refused by every benchmark before anything is measured;
* stored arrays are used until code or file change; `bench figures` runs every benchmark with files of its own;
* the page of `bench report` shows the verdicts that follow from claims;
* the manual's tables are those of the newest full results, and a changed number is noticed.
"""

import importlib
import json
import math
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import document, figures, manual, report, tolerance
from benchmarks.document import Limit, crossovers, exponent
from benchmarks.manual import BLOCK, TABLES, filled, newest, pages
from benchmarks.report_parts.page import AGREE, DISAGREE, MISSING, PARTLY, Claim, Part, small_png, verdict_of
from taisoft.cli.scene_file import shipped_files
from taisoft.errors import OutputError

WRITING = (  # benchmarks with --out FILE.json; those without have no file of that name to refuse
    "collision contact crossings elasticity error gpu hard ipc launches order peers pictures references scaling startup "
    "tolerance window"
).split()
TEXT = "before\n<!-- begin fake -->\nold\n<!-- end fake -->\nafter\n"


def test_limits_are_met_or_not():
    for limit, met, close in (
        (Limit("a", 3.0, 3.0, at_least=True), True, False),
        (Limit("a", 2.9, 3.0, 0.01, at_least=True), False, False),
        (Limit("a", 2.9, 3.0, 0.1, at_least=True), False, True),
        (Limit("a", 2.9, 3.0, 0.1), True, True),
        (Limit("a", math.nan, 3.0), False, False),
    ):
        assert (limit.met, limit.close) == (met, close)
        assert ("NOT met" in limit.row()[-1]) != met and ("within the spread" in limit.row()[-1]) == close


def test_exponents_and_crossovers():
    x = np.array([1.0, 3.0, 10.0, 50.0])
    p, off = exponent(x, 7.0 * x**-0.5)
    assert p == pytest.approx(-0.5, abs=1e-12) and off < 1e-12
    p, off = exponent(x, x**2 * [1.0, 1.1, 1.0, 1.0])
    assert 1.9 < p < 2.1 and 0.05 < off < 0.1
    assert math.isnan(exponent([1, 1], [1.0, 2.0])[0]) and math.isnan(exponent([1, 2], [0.0, 1.0])[0])
    tets = [100, 1000, 10000]
    assert crossovers(tets, [2.0, 2.0, 2.0], [1.0, 1.0, 1.0]) == []
    assert crossovers(tets, [2.0, 1.0, 1.0], [1.0, 2.0, 4.0]) == [pytest.approx(10**2.5)]
    assert len(crossovers(tets, [2.0, 1.0, 2.0], [1.0, 2.0, 1.0])) == 2


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_bad_options_are_refused_before_measuring(tmp_path, capsys):
    """By every benchmark; a page would be printed as soon as it begins."""
    pytest.importorskip("ipctk")
    (tmp_path / "file").touch()
    wrong = []
    for name in WRITING:
        main = importlib.import_module(f"benchmarks.{name}").main
        for path, message in ((tmp_path / "a.txt", "must end in .json"), (tmp_path / "file" / "a.json", "file has that")):
            try:
                main(["--out", str(path)])
                wrong.append(f"{name} wrote {path}")
            except OutputError as error:
                wrong += [] if message in str(error) else [f"{name}: {error}"]
    for name in set(WRITING) | {"regression", "report", "gpu", "figures", "manual"}:
        with pytest.raises(SystemExit):
            importlib.import_module(f"benchmarks.{name}").main(["--nothing"])
    with pytest.raises(OutputError, match=r"must end in \.png"):
        importlib.import_module("benchmarks.order").main(["--plot", str(tmp_path / "a.txt")])
    assert wrong == [] and capsys.readouterr().out == ""


def test_arrays_are_stored_until_the_code_changes(tmp_path, monkeypatch):
    def get(value: float, request: int = 1) -> float:
        return float(tolerance.stored(["request", request], lambda: np.array(value)))

    monkeypatch.setattr(tolerance, "cache_folders", lambda: iter([folder]))
    folder = tmp_path
    assert [get(1.0), get(2.0), get(3.0, request=2)] == [1.0, 1.0, 3.0]
    for file in tmp_path.rglob("*.json"):
        file.write_bytes(b"damaged")
    assert [get(4.0), get(5.0)] == [4.0, 4.0]
    monkeypatch.setattr(tolerance, "code_digest", lambda _: "other")
    assert get(6.0) == 6.0
    (tmp_path / "file").touch()
    folder = tmp_path / "file"
    assert get(7.0, request=3) == 7.0


def test_figures_come_from_every_benchmark(tmp_path, monkeypatch, capsys):
    """Also after a failure."""
    commands = []

    def run(command, **_):
        commands.append(command)
        return SimpleNamespace(returncode=1 if "collision" in command else 0)

    monkeypatch.setattr(subprocess, "run", run)
    folders = ["--results", str(tmp_path), "--logs", str(tmp_path / "logs")]
    assert figures.main(folders) == 1
    assert [command[4] for command in commands] == list(figures.BENCHMARKS)
    assert set(figures.BENCHMARKS) <= set(shipped_files("benchmarks"))
    files = [part for command in commands for part in command if part.startswith(str(tmp_path))]
    assert len(set(files)) == len(files) >= len(commands) and "| collision  |           1 |" in capsys.readouterr().out
    commands.clear()
    assert figures.main(["--quick", "--only", "references", "--only", "order", *folders]) == 0
    assert ["--quick" in command for command in commands] == [False, True]  # the references have no small form
    with pytest.raises(SystemExit):
        figures.main(["--quick"])  # the manual is made from full results only


def texts() -> list[str]:
    return [page.read_text(encoding="utf-8") for page in pages()]


def test_the_manual_agrees_with_the_results(capsys):
    assert manual.main(["--check"]) == 0, "`taisoft bench manual` updates it"
    assert sorted(name for text in texts() for _, name, _ in BLOCK.findall(text)) == sorted(TABLES)


def test_the_newest_full_results_are_used(tmp_path):
    with pytest.raises(OutputError, match="no results of `taisoft bench order`"):
        newest(tmp_path, "order")
    for name, date, quick in (("a", "2026-01-02", False), ("b", "2026-01-01", False), ("c", "2026-01-03", True)):
        (tmp_path / f"order-{name}.json").write_text(json.dumps({"date": date, "quick": quick, "name": name}))
    assert newest(tmp_path, "order")["name"] == "a"
    (tmp_path / "order-d.json").write_text("{")
    with pytest.raises(OutputError, match="order-d.json"):
        newest(tmp_path, "order")


def test_marked_parts_of_pages_are_replaced(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(TABLES, "fake", ("", lambda _: "made"))
    monkeypatch.setattr(manual, "DOCS", tmp_path)
    page = tmp_path / "page.md"
    page.write_text("no table")
    with pytest.raises(OutputError, match="no page with tables"):
        manual.main([])
    for bad, words in (
        (TEXT.replace("fake", "nothing"), "'nothing' is unknown"),
        (TEXT.replace("end fake", "end"), "'fake' needs"),
    ):
        with pytest.raises(OutputError, match=words):
            filled(bad)
    page.write_text(TEXT)
    assert manual.main(["--check"]) == 1 and page.read_text() == TEXT
    assert manual.main([]) == 0
    assert page.read_text() == "before\n<!-- begin fake -->\n\nmade\n\n<!-- end fake -->\nafter\n"
    assert manual.main(["--check"]) == 0 and "agrees with the results" in capsys.readouterr().out


def test_the_report_has_its_results(monkeypatch, tmp_path, capsys):
    """A partial run writes only to a folder that is given; what cannot be measured sets the exit status."""
    assert [verdict_of(x) for x in ([True, True], [True, False], [False], [])] == [AGREE, PARTLY, DISAGREE, MISSING]
    picture, folder = small_png(np.full((8, 12, 3), 200, dtype=np.uint8)), tmp_path / "page"

    def fake(extent) -> Part:
        claims = [Claim("it is so.", False, "it is not, by 3.", "Why."), Claim("that too.", True, "it is.", "Because.")]
        return Part("bound", "A bound", "figure 99", "made up", claims, ["| a |"], {"b.png": picture}, ["no GPU."])

    monkeypatch.setattr(report, "PARTS", {"bound": fake})
    monkeypatch.setattr(document, "RESULTS", tmp_path / "results")
    assert report.main(["--out", str(folder)]) == 0
    text = (folder / "README.md").read_text()
    for part in (
        f"**{PARTLY}**",
        "![b](b.png)",
        "**Disagree**: it is not, by 3. Why.",
        "**Agree**: it is.\n",
        "* A bound: no GPU.",
    ):
        assert part in text
    assert (folder / "b.png").read_bytes() == picture and json.loads((folder / "report.json").read_text())["parts"]
    assert report.main(["--quick"]) == 0 and not (tmp_path / "results").exists()
    monkeypatch.setattr(report, "PARTS", {"bound": lambda extent: Part("bound", "", "", "", failure="no such thing")})
    assert report.main(["--quick"]) == 1 and "no such thing" in capsys.readouterr().out
