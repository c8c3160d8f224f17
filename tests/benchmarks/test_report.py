"""The reproduction of the report:

* a verdict follows from its claims;
* the page has the results and pictures; what cannot be measured is reported, and sets the exit status;
* a second run is compared with the first, and a partial run writes only to a given folder.
"""

import json
from dataclasses import replace

import numpy as np

from benchmarks import document, report
from benchmarks.report_parts.page import AGREE, DISAGREE, MISSING, PARTLY, Claim, Part, small_png, verdict_of
from taisoft.machine import summarise


def test_a_verdict_follows_from_its_claims():
    assert [verdict_of(x) for x in ([True, True], [True, False], [False], [])] == [AGREE, PARTLY, DISAGREE, MISSING]
    part = Part("a", "A", "figure 1", "runs", [Claim("it is so.", True, "it is.")])
    assert part.verdict == AGREE and replace(part, failure="no memory").verdict == MISSING


def test_the_page_has_the_results(monkeypatch, tmp_path, capsys):
    """A second run is compared with the first; a partial one writes only to a folder that is given."""
    seconds, picture = [1.0], small_png(np.full((8, 12, 3), 200, dtype=np.uint8))

    def fake(extent) -> Part:
        claims = [Claim("it is so.", False, "it is not, by 3."), Claim("that too.", True, "it is.")]
        times = {"a step": summarise([k * seconds[0] for k in (0.98, 1.0, 1.02)])}
        return Part("bound", "A bound", "figure 99", "made up", claims, ["| a |"], {"b.png": picture}, times, ["no GPU."])

    def page(*options: str) -> str:
        assert report.main(["--out", str(tmp_path / "page"), *options]) == 0
        return (tmp_path / "page" / "README.md").read_text()

    monkeypatch.setattr(report, "PARTS", {"bound": fake})
    monkeypatch.setattr(document, "RESULTS", tmp_path / "results")
    text = page()
    for part in (
        f"**{PARTLY}**",
        "![b](b.png)",
        "1 of 2",
        "**Disagree**: it is not, by 3.",
        "* A bound: no GPU.",
        "no earlier run",
    ):
        assert part in text
    assert (tmp_path / "page" / "b.png").read_bytes() == picture
    assert json.loads((tmp_path / "page" / "report.json").read_text())["parts"][0]["verdict"] == PARTLY
    seconds[0] = 2.0
    assert "0 of 1 times agree" in page() and "another quick" in page("--quick")
    assert report.main(["--quick"]) == 0 and not (tmp_path / "results").exists() and report.main([]) == 0
    assert (next((tmp_path / "results").iterdir()) / "README.md").is_file()
    monkeypatch.setattr(report, "PARTS", {"bound": lambda extent: Part("bound", "", "", "", failure="no such thing")})
    assert report.main(["--quick"]) == 1 and "no such thing" in capsys.readouterr().out
