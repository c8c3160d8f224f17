"""All figures in one go: every benchmark with its own files, past one that fails, and the manual only from whole results."""

import subprocess
from types import SimpleNamespace

import pytest

from benchmarks import figures
from taisoft.cli.scene_file import shipped_files


@pytest.fixture
def ran(monkeypatch):
    """The commands that were run; `collision` fails."""
    commands = []

    def run(command, **_):
        commands.append(command)
        return SimpleNamespace(returncode=1 if "collision" in command else 0)

    monkeypatch.setattr(subprocess, "run", run)
    return commands


def test_all_in_turn_past_a_failure(ran, tmp_path, capsys):
    assert figures.main(["--results", str(tmp_path), "--logs", str(tmp_path / "logs")]) == 1
    assert [command[4] for command in ran] == list(figures.WRITES)
    assert all(command[5] == "--out" and command[6].startswith(str(tmp_path / command[4])) for command in ran)
    files = [part for command in ran for part in command if part.startswith(str(tmp_path))]
    assert len(set(files)) == len(files)
    assert "| collision  |           1 |" in capsys.readouterr().out


def test_manual_is_made_from_whole_results_only(ran, tmp_path):
    assert figures.main(["--only", "order", "--logs", str(tmp_path)]) == 0
    assert [command[4] for command in ran] == ["order", "manual"]
    with pytest.raises(SystemExit):
        figures.main(["--quick"])
    ran.clear()
    assert figures.main(["--quick", "--only", "references", "--only", "order", "--results", str(tmp_path)]) == 0
    assert [("--quick" in command) for command in ran] == [False, True]


def test_every_name_is_a_benchmark():
    assert set(figures.WRITES) <= set(shipped_files("benchmarks"))
