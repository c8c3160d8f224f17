"""The previous checkpoint of a run replaces one that cannot be read, with a warning; it is of the same run."""

import os
import re

import numpy as np
import pytest

import taisoft as ts
from taisoft.checkpoint import read_checkpoint, write_checkpoint
from taisoft.output.files import CHECKPOINT_NAME, PREVIOUS_NAME, CheckpointWriter, read_last_good
from tests.dynamics.scenes import block_scene


class Saved:
    """The part of a simulator that is saved, with a time."""

    def __init__(self, time):
        self.time = time

    def save_checkpoint(self, path, notes=None):
        write_checkpoint(path, {}, block_scene(), {}, {"time": self.time, "x": np.arange(3000.0)}, notes or {})


@pytest.fixture
def two(tmp_path):
    """The folder of a run with two checkpoints."""
    for name, time in ((PREVIOUS_NAME, 1.0), (CHECKPOINT_NAME, 2.0)):
        Saved(time).save_checkpoint(tmp_path / name)
    return tmp_path


@pytest.mark.parametrize("fraction", [0.01, 0.999])
def test_a_truncated_file_is_replaced_by_the_previous_one(two, fraction):
    path, previous = two / CHECKPOINT_NAME, two / PREVIOUS_NAME
    assert read_last_good(path).state["time"] == 2.0
    data = path.read_bytes()
    path.write_bytes(data[: int(fraction * len(data))])
    with pytest.warns(UserWarning, match=f"damaged.*; resuming from the previous checkpoint instead, {re.escape(str(previous))}"):
        found = read_last_good(path)
    assert found.state["time"] == 1.0 and found.path == previous
    previous.write_bytes(b"x")
    with pytest.raises(ts.SimulationError, match="damaged.*; nor can the previous one be used"):
        read_last_good(path)


def test_the_previous_checkpoint_is_of_the_same_run(two, monkeypatch):
    """Also on a file system without links. A run resumed from the previous checkpoint keeps it until there is another."""

    def check(writer, time, expected):
        writer.write(Saved(time))
        found = [read_checkpoint(two / name).state["time"] for name in (PREVIOUS_NAME, CHECKPOINT_NAME) if (two / name).exists()]
        assert found == expected

    def no_links(*_):
        raise PermissionError("no links here")

    writer = CheckpointWriter(two)  # the folder holds checkpoints of another run
    check(writer, 3.0, [3.0])
    check(writer, 4.0, [3.0, 4.0])
    check(CheckpointWriter(two, resumed=two / ".." / two.name / CHECKPOINT_NAME), 5.0, [4.0, 5.0])
    check(writer := CheckpointWriter(two, resumed=two / PREVIOUS_NAME), 6.0, [4.0, 6.0])
    monkeypatch.setattr(os, "link", no_links)
    check(writer, 7.0, [6.0, 7.0])
    assert sorted(os.listdir(two)) == [CHECKPOINT_NAME, PREVIOUS_NAME]
