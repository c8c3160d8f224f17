"""The examples of the manual run: `python -m pytest docs`.

Every page is a script, in a folder of its own. Blocks marked `python` run one after the other and share their names, and after a
line "Save this as `NAME`:" they are written to NAME, too; blocks marked `toml` are written to my_scene.toml and read; blocks
marked `sh` run in a shell. Lines that begin with `taisoft` in blocks marked `console` are not run, but their options must exist.
"""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from sybil import Sybil
from sybil.parsers.myst import CodeBlockParser, PythonCodeBlockParser

import taisoft as ts
from taisoft.cli import command_parser

BIN = Path(sys.executable).parent


def read_scene(example) -> None:
    Path("my_scene.toml").write_text(example.parsed)
    scene, _ = ts.read_scene("my_scene.toml")
    assert scene.bodies


class PythonBlocks(PythonCodeBlockParser):
    """Runs blocks, and writes those that the reader saves."""

    def __call__(self, document):
        for region in super().__call__(document):
            if saved := re.search(r"Save this as `([\w.]+)`:\n\n$", document.text[: region.start]):
                region.evaluator = save_before(saved[1], region.evaluator)
            yield region


def save_before(name: str, run):
    def evaluate(example):
        Path(name).write_text(example.parsed)
        return run(example)

    return evaluate


def run_shell(example) -> None:
    path = os.pathsep.join((str(BIN), os.environ["PATH"]))
    done = subprocess.run(["bash", "-euc", example.parsed], env=os.environ | {"PATH": path}, capture_output=True, text=True)
    assert done.returncode == 0, f"{example.parsed}\n{done.stdout}\n{done.stderr}"


def check_commands(block: str) -> None:
    for line in block.splitlines():
        line = line.removeprefix(".venv/bin/")
        if line.startswith("taisoft "):
            command_parser().parse_args(shlex.split(line, comments=True)[1:])


@pytest.fixture(scope="module")
def own_folder(tmp_path_factory):
    before = os.getcwd()
    os.chdir(tmp_path_factory.mktemp("page"))
    yield
    os.chdir(before)


SYBIL = Sybil(
    parsers=[
        PythonBlocks(),
        CodeBlockParser("toml", read_scene),
        CodeBlockParser("sh", run_shell),
        CodeBlockParser("console", lambda example: check_commands(example.parsed)),
    ],
    patterns=["*.md"],
    excludes=["results/*", "results/*/*"],
    fixtures=["own_folder"],
)
pytest_collect_file = SYBIL.pytest()
