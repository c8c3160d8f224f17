"""The command `taisoft study`:

* invalid input is rejected with exit status 2 before any run;
* an interrupted study exits within seconds with status 130; the same command continues it, also after a kill, and no child
  process outlives the command.
"""

import json
import signal
import subprocess
import time
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace

import pytest

from taisoft.cli import main
from taisoft.cli import study as study_command
from taisoft.cli.study import check_device
from taisoft.errors import SceneError
from taisoft.machine import usable_cores
from taisoft.study import workers
from tests.cli.command import BEAM, child, write
from tests.study.study_places import wait_until_ended


def study(*arguments) -> int:
    return main(["study", *map(str, arguments)])


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--workers", len(usable_cores()) + 1], f"it must be between 1 and {len(usable_cores())}, the number of cores"),
        (["--workers", 0], "--workers 0: it must be between 1 and"),
        (["--workers", 1, "--scheduler", "tcp://127.0.0.1:1"], "give one of them"),
        (["--dt", "0.01,fast"], "dt must be a number, not 'fast'"),
        (["--budget", 0], "--budget must be greater than 0"),
        (["--repeats", 0], "--repeats must be 1 or 2"),
        (["--tolerance", "nan"], "--tolerance must be finite"),
        (
            ["--dt", "10", "--integrator", "symplectic_euler"],
            "no combination of the grid can be run: dt = 10 s is above the stab",
        ),
    ],
)
def test_invalid_arguments_are_rejected(beam, tmp_path, capsys, arguments, message):
    assert study(beam, "--out", tmp_path / "out", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_unknown_scenes_and_used_folders_are_refused(beam, tmp_path, capsys):
    assert study("no_such_demo") == 2
    assert "neither a demo nor a .toml or .py file" in capsys.readouterr().err
    (tmp_path / "report.json").write_text("{}")
    assert study(beam, "--out", tmp_path) == 3
    assert "already holds results (report.json)" in capsys.readouterr().err


def test_unreachable_scheduler_is_rejected(beam, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECT_SECONDS", 0.3)
    assert study(beam, "--scheduler", "tcp://127.0.0.1:9") == 2
    assert "no Dask scheduler answers there" in capsys.readouterr().err


def test_workers_cannot_share_a_gpu():
    def plan(refused: str) -> dict:
        return {"cases": [{"setting": {"arch": "cpu"}, "refused": ""}, {"setting": {"arch": "cuda"}, "refused": refused}]}

    check_device(plan(""), 1)
    check_device(plan("no GPU"), 2)
    with pytest.raises(SceneError, match="cannot be used with arch cuda"):
        check_device(plan(""), 2)


@pytest.mark.parametrize(
    "rows, ended, signal_number, status", [(1, "", 2, 0), (1, "it was interrupted", 2, 130), (0, "the budget was spent", None, 1)]
)
def test_exit_status(monkeypatch, rows, ended, signal_number, status):
    monkeypatch.setattr(study_command, "text_of", lambda study: "")
    study = SimpleNamespace(comparable_rows=lambda: [object()] * rows, ended=ended)
    assert study_command.report_study(study, Namespace(out=None), SimpleNamespace(number=signal_number)) == status


# --- interrupted ------------------------------------------------------------------------------------------------------


def records(out: Path) -> dict[str, int]:
    """Finished runs: name -> time of change."""
    return {path.name: path.stat().st_mtime_ns for path in (out / "runs").glob("*.json")} if out.exists() else {}


def children_of(pid: int) -> list[int]:
    return [int(child_pid) for child_pid in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="there is no /proc to find children in")
@pytest.mark.long
def test_interrupted_and_killed_studies_are_continued(tmp_path):
    out, path = tmp_path / "out", write(tmp_path / "beam.py", BEAM)
    arguments = (path, "--out", out, "--repeats", "1", "--dt", "0.00625,0.003125", "--integrator", "symplectic_euler")

    def begin(condition) -> subprocess.Popen:
        """A study that has reached a condition."""
        process, deadline = child("study", *arguments), time.monotonic() + 120
        while not condition(process):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        return process

    process = begin(lambda process: records(out))
    process.send_signal(signal.SIGINT)
    printed, errors = process.communicate(timeout=120)
    assert process.returncode == 130 and "ending; runs that are finished are kept" in errors
    assert "Not complete: the study was interrupted. The same command continues it." in printed
    first = records(out)
    assert 1 <= len(first) < 4 and (out / "study.md").exists()
    process = begin(lambda process: len(records(out)) > len(first) and children_of(process.pid))
    running = children_of(process.pid)
    process.kill()
    process.communicate()
    wait_until_ended(running)
    second = records(out)
    _, errors = begin(lambda process: True).communicate(timeout=200)
    assert f"{len(second)} of them already done" in errors and len(last := records(out)) == 4
    assert second.items() <= last.items() and first.items() <= second.items()
    record = json.loads((out / "study.json").read_text())
    assert not record["ended"] and [row["status"] for row in record["rows"]] == ["ok", "ok"]
    assert not list(out.rglob("*.part"))
