"""Scene files and calls that the tests of the command line share."""

import json
import os
import subprocess
import sys
from pathlib import Path

from taisoft.cli import main

ROOT = Path(__file__).resolve().parents[2]

BEAM = '''"""A beam."""
import taisoft as ts

solver = {"dt": 1 / 240, "integrator": "symplectic_euler", "seconds": 0.1, "fps": 30}


def build():
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((4, 1, 1), (4, 2, 2)), ts.Material(young=1e5), name="beam")
    body.fix(lambda X: X[:, 0] < -1.99)
    return scene
'''
# The path is called as the run goes on, which puts what it does inside the run.
LED = BEAM.replace(
    "    return scene", "    body.move(lambda X: X[:, 0] > 1.99, path)\n    return scene\n\n\ndef path(t):\n    {body}\n"
)
SHORT_OUTPUT = ("--no-usd", "--no-frames")


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def run(*arguments) -> int:
    return main(["run", "--headless", *map(str, arguments)])


def report(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


def child(*arguments, **keywords) -> subprocess.Popen:
    """The command in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "taisoft", *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **keywords)
