"""The message on stderr that kernels are being compiled:

* a first run prints it once, on its own line, on a terminal before the progress bar; a second run does not;
* loading a kernel prints nothing, however slow; long compiling prints a line every few seconds;
* without stderr, or with a closed one, nothing happens.
"""

import io
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from taisoft import compile_message
from taisoft.compile_message import LINE_EVERY, MESSAGE
from tests.cli.command import ROOT, SHORT_OUTPUT


def terminal_of_run(scene: Path, environment: dict) -> str:
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "taisoft", "run", scene, "--headless", *SHORT_OUTPUT]
    process = subprocess.Popen(command, env=environment, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    parts = []
    try:
        while part := os.read(ours, 4096):
            parts.append(part)
    except OSError:  # end of a terminal on Linux
        pass
    finally:
        os.close(ours)
    assert process.wait() == 0
    return b"".join(parts).decode()


def test_only_the_first_run_prints_the_message(beam, tmp_path):
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT), "TI_ADVANCED_OPTIMIZATION": "1"}
    first, second = (terminal_of_run(beam, environment) for _ in range(2))
    lines = [line.removeprefix("\x1b[2K") for line in first.splitlines()]  # a bar may have been drawn there before
    assert [line for line in lines if "compiling" in line] == [MESSAGE]
    assert "taisoft:" not in second and "beam" in first  # the bar


@pytest.fixture
def fresh(monkeypatch) -> None:
    """As in a process that has not printed the message yet."""
    monkeypatch.setattr(compile_message, "last_line", None)
    monkeypatch.setattr(compile_message, "is_silent", False)


def test_when_lines_are_printed(fresh, monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(compile_message.time, "perf_counter", lambda: clock[0])
    compile_message.show(compiler=0.02, launch=0.1, n_compiled=1)  # loaded
    compile_message.show(compiler=0.3, launch=2.0, n_compiled=2)  # loaded on a slow machine
    assert capsys.readouterr().err == ""
    for n, now in ((3, 0.0), (4, 0.9 * LINE_EVERY), (5, 1.1 * LINE_EVERY), (6, 1.2 * LINE_EVERY)):
        clock[0] = now
        compile_message.show(compiler=0.5, launch=0.6, n_compiled=n)
    assert capsys.readouterr().err == f"{MESSAGE}\ntaisoft: 5 kernels so far\n"


def test_silenced(fresh, capsys):
    with compile_message.silenced():
        with compile_message.silenced():
            pass
        compile_message.show(compiler=0.5, launch=0.6, n_compiled=1)
    assert capsys.readouterr().err == ""
    compile_message.show(compiler=0.5, launch=0.6, n_compiled=2)
    assert capsys.readouterr().err == f"{MESSAGE}\n"


def test_no_stderr(fresh, monkeypatch):
    closed = io.StringIO()
    closed.close()
    for stderr in (closed, None):
        monkeypatch.setattr(compile_message, "last_line", None)
        monkeypatch.setattr(sys, "stderr", stderr)
        compile_message.show(compiler=0.5, launch=0.6, n_compiled=1)
