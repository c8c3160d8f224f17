"""The command `taisoft study`: invalid input is rejected with exit status 2 before any run; the exit status of others."""

import re
from argparse import Namespace
from types import SimpleNamespace

import pytest

from taisoft.cli import main
from taisoft.cli import study as study_command
from taisoft.cli.study import check_device
from taisoft.errors import SceneError
from taisoft.machine import usable_cores
from taisoft.many import cluster


def study(*arguments) -> int:
    return main(["study", *map(str, arguments)])


def test_invalid_arguments_are_rejected(beam, tmp_path, capsys):
    for arguments, message in (
        (["--workers", len(usable_cores()) + 1], f"it must be between 1 and {len(usable_cores())}, the number of cores"),
        (["--workers", 1, "--scheduler", "tcp://127.0.0.1:1"], "give one of them"),
        (["--dt", "0.01,fast"], "dt must be a number, not 'fast'"),
        (["--budget", 0], "--budget must be greater than 0"),
        (["--repeats", 0], "--repeats must be 1 or 2"),
        (["--tolerance", "nan"], "--tolerance must be finite"),
        (["--dt", "10", "--integrator", "symplectic_euler"], "no combination of the grid can be run: dt = 10 s is above"),
    ):
        assert study(beam, "--out", tmp_path / "out", *arguments) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
        assert not (tmp_path / "out").exists()


def test_unknown_scenes_schedulers_and_used_folders_are_refused(beam, tmp_path, capsys, monkeypatch):
    assert study("no_such_demo") == 2
    assert "neither a demo nor a .toml or .py file" in capsys.readouterr().err
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.3)
    assert study(beam, "--scheduler", "tcp://127.0.0.1:9") == 2
    assert re.search("no Dask scheduler answers there|needs the package distributed", capsys.readouterr().err)
    (tmp_path / "report.json").write_text("{}")
    assert study(beam, "--out", tmp_path) == 3
    assert "already holds results (report.json)" in capsys.readouterr().err


def test_workers_cannot_share_a_gpu():
    def plan(refused: str) -> dict:
        return {"cases": [{"setting": {"arch": "cpu"}, "refused": ""}, {"setting": {"arch": "cuda"}, "refused": refused}]}

    check_device(plan(""), 1)
    check_device(plan("no GPU"), 2)
    with pytest.raises(SceneError, match="cannot be used with arch cuda"):
        check_device(plan(""), 2)


def test_exit_status(monkeypatch):
    monkeypatch.setattr(study_command, "text_of", lambda study: "")
    for rows, ended, number, status in ((1, "", 2, 0), (1, "it was interrupted", 2, 130), (0, "the budget was spent", None, 1)):
        study = SimpleNamespace(comparable_rows=lambda n=rows: [object()] * n, ended=ended)
        assert study_command.report_study(study, Namespace(out=None), SimpleNamespace(number=number)) == status
