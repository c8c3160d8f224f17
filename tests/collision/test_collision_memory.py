"""No kernel of collision detection reads or writes out of bounds: tests of this folder with Taichi's checks on."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.long
def test_nothing_is_out_of_bounds():
    files = (f"tests/collision/test_{name}.py" for name in ("broad_phases", "detection"))
    command = [sys.executable, "-m", "pytest", "-q", *files]
    options = {"cwd": Path(__file__).parents[2], "env": os.environ | {"TI_DEBUG": "1"}, "capture_output": True, "text": True}
    done = subprocess.run(command, **options, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
