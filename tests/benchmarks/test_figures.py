"""`taisoft bench figures`, and the output options that benchmarks share:

* every benchmark runs with files of its own, even after a failure, and the manual is made from full results only;
* output that cannot be written is refused before anything is measured.
"""

import importlib
import subprocess
from types import SimpleNamespace

import pytest

from benchmarks import figures
from taisoft.cli.scene_file import shipped_files
from taisoft.errors import OutputError


@pytest.fixture
def commands(monkeypatch):
    """The commands run; `collision` fails."""
    found = []

    def run(command, **_):
        found.append(command)
        return SimpleNamespace(returncode=1 if "collision" in command else 0)

    monkeypatch.setattr(subprocess, "run", run)
    return found


def test_all_benchmarks_run_after_a_failure(commands, tmp_path, capsys):
    assert figures.main(["--results", str(tmp_path), "--logs", str(tmp_path / "logs")]) == 1
    assert [command[4] for command in commands] == list(figures.WRITES)
    assert all(command[5] == "--out" and command[6].startswith(str(tmp_path / command[4])) for command in commands)
    files = [part for command in commands for part in command if part.startswith(str(tmp_path))]
    assert len(set(files)) == len(files)
    assert "| collision  |           1 |" in capsys.readouterr().out


def test_manual_is_made_from_full_results_only(commands, tmp_path):
    assert figures.main(["--only", "order", "--logs", str(tmp_path)]) == 0
    assert [command[4] for command in commands] == ["order", "manual"]
    with pytest.raises(SystemExit):
        figures.main(["--quick"])
    commands.clear()
    assert figures.main(["--quick", "--only", "references", "--only", "order", "--results", str(tmp_path)]) == 0
    assert [("--quick" in command) for command in commands] == [False, True]


def test_every_name_is_a_benchmark():
    assert set(figures.WRITES) <= set(shipped_files("benchmarks"))


@pytest.mark.parametrize(
    "option, suffix, names", [("--out", ".json", ("collision", "contact", "elasticity", "order")), ("--plot", ".png", ("order",))]
)
def test_bad_output_is_refused_before_measuring(option, suffix, names, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    for name in names:
        module = importlib.import_module(f"benchmarks.{name}")
        monkeypatch.setattr(module, "measure", lambda *arguments: pytest.fail("it measured"))
        for path, message in (
            (tmp_path / "a.txt", rf"the name must end in \{suffix}"),
            (tmp_path / "file" / f"a{suffix}", "a file has that"),
        ):
            with pytest.raises(OutputError, match=message):
                module.main([option, str(path)])
