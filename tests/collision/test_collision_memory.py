"""No kernel of collision detection reads or writes out of bounds: tests of this folder with Taichi's checks on.

They are chosen when it starts, so that these tests run in a process of their own.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel

HERE = Path(__file__).parent


@pytest.mark.long
def test_nothing_is_out_of_bounds():
    files = [str(HERE / f"test_{name}.py") for name in ("collision_memory", "broad_phases", "detection")]
    command = [sys.executable, "-m", "pytest", "-q", *files, "-k", "not out_of_bounds", "-rs"]
    environment = os.environ | {"TI_DEBUG": "1"}
    done = subprocess.run(command, cwd=HERE.parents[1], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "skipped" not in done.stdout, done.stdout[-3000:]


@kernel
def write_beyond(x: ti.template(), i: ti.i32):
    x[i] = 1


@pytest.mark.skipif("TI_DEBUG" not in os.environ, reason="Taichi's checks are off")
def test_the_checks_work():
    with pytest.raises(AssertionError, match="Out of bound access to ndarray at arg 0 with indices .8."):
        write_beyond(FieldArena().field("x", ti.i32, 8), 8)
