"""Content of checkpoint files:

* a header with a missing or malformed part is refused, even if its checksum is right;
* pickled objects are refused, and never run;
* sizes are checked before memory is allocated;
* the previous checkpoint of the same run replaces one that cannot be read, with a warning;
* numbers that differ from the initial ones are refused by name and value, even if they are the present ones;
* scenes with other key frames, or with missing or renamed items, are refused.
"""

import json
import os
import pickle
import re
import tracemalloc
import zipfile

import numpy as np
import pytest

import taisoft as ts
from taisoft import checkpoint
from taisoft.output.files import CHECKPOINT_NAME, PREVIOUS_NAME, CheckpointWriter, read_last_good
from tests.dynamics.scenes import cube, driven_scene


def scene(height: float, obstacle: str = "wall:left") -> ts.Scene:
    made = driven_scene()
    frames = ts.KeyFrames([0.0, 1.0], [(0, 0, 0), (0, height, 0)])
    made.add_obstacle(ts.Sphere((0, 9, 0), 0.1), name=obstacle, path=frames)
    return made


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "a.npz"
    checkpoint.write_checkpoint(path, {}, scene(1.0), {}, {"x": np.arange(3.0)}, {"fps": 30.0})
    return path


@pytest.mark.parametrize("key", ["state", "settings", "notes", "start"])
@pytest.mark.parametrize("change", [{}, {"is": []}])
def test_a_malformed_header_is_refused(saved, key, change):
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files if name not in ("header", "sha256")}
        header = json.loads(file["header"].tobytes())
    wrong = {name: value for name, value in header.items() if name != key} | ({key: change["is"]} if change else {})
    text = np.frombuffer(json.dumps(wrong).encode(), dtype=np.uint8)
    np.savez(saved, header=text, sha256=checkpoint._checksum(text, arrays), **arrays)
    with pytest.raises(ts.SimulationError, match="a.npz is no checkpoint of taisoft, or damaged"):
        ts.Simulator.load_checkpoint(saved, scene(1.0))


def test_settings_of_another_version_are_refused(saved):
    with pytest.raises(ts.SimulationError, match="its settings are not those of this version"):
        ts.Simulator.load_checkpoint(saved, scene(1.0))


def test_scenes_are_compared(saved):
    read = checkpoint.read_checkpoint(saved)
    assert read.notes == {"fps": 30.0} and np.array_equal(read.state["x"], np.arange(3.0))
    checkpoint.check_scene(read, scene(1.0), {})
    for other in (scene(2.0), scene(1.0, "wall:right"), driven_scene()):
        with pytest.raises(ts.SceneError, match="is a checkpoint of another scene"):
            checkpoint.check_scene(read, other, {})


def with_numbers(gravity=-9.81, force=(1.0, 2.0, 3.0), friction=0.3, **material) -> ts.Scene:
    made = ts.Scene(gravity=(0, gravity, 0))
    body = made.add_body(cube(), ts.Material(**material), name="a/b")
    body.add_force([0, 1], [force, (4.0, 5.0, 6.0)])
    made.add_obstacle(ts.Sphere((0, 9, 0), 0.1), name="ball")
    made.set_contact("a/b", "ball", friction=friction)
    return made


NUMBERS = {
    "gravity": (-1.0, "gravity is [0.0, -1.0, 0.0] in this scene and was [0.0, -9.81, 0.0] at the start"),
    "force": ((1.0, 2.0, 3.5), "body 'a/b': force 0, row 0 is [1.0, 2.0, 3.5] in this scene and was [1.0, 2.0, 3.0] at"),
    "friction": (0.4, "contact of 'a/b' and 'ball': friction is 0.4 in this scene and was 0.3 at the start"),
    "young": (2e6, "body 'a/b': young is 2000000.0 in this scene and was 1000000.0 at the start"),
    "poisson": (0.2, "body 'a/b': poisson is 0.2 in this scene and was 0.3 at the start"),
    "density": (999.0, "body 'a/b': density is 999.0 in this scene and was 1000.0 at the start"),
    "stiffness_damping": (0.1, "body 'a/b': stiffness_damping is 0.1 in this scene and was 0.0 at the start"),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_are_compared_with_the_initial_ones(tmp_path, name):
    path, (value, message) = tmp_path / "a.npz", NUMBERS[name]
    present = with_numbers(gravity=-5.0, young=3e6)  # changed during the run
    checkpoint.write_checkpoint(path, {}, present, {}, {"x": np.zeros(3)}, {}, with_numbers())
    read = checkpoint.read_checkpoint(path)
    checkpoint.check_scene(read, with_numbers(), {})
    for other in (with_numbers(**{name: value}), present):
        with pytest.raises(ts.SceneError, match="is a checkpoint of another scene") as caught:
            checkpoint.check_scene(read, other, {})
        assert str(path) in str(caught.value) and (other is present or message in str(caught.value))


class Canary:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def test_pickled_objects_are_refused(saved, tmp_path):
    canary, wrong = tmp_path / "canary", tmp_path / "b.npz"
    assert pickle.loads(pickle.dumps(Canary(str(tmp_path / "works")))) and (tmp_path / "works").exists()
    with np.load(saved) as file:
        content = {name: file[name] for name in file.files}
    for name in ("header", "x", "more"):
        np.savez(wrong, **content | {name: np.array([Canary(str(canary))], dtype=object)})
        with pytest.raises(ts.SimulationError, match="b.npz is"):
            ts.Simulator.load_checkpoint(wrong, scene(1.0))
    np.save(tmp_path / "one.npy", np.array([Canary(str(canary))], dtype=object))
    with pytest.raises(ts.SimulationError, match="one.npy is no checkpoint"):
        ts.Simulator.load_checkpoint(tmp_path / "one.npy", scene(1.0))
    assert not canary.exists()


# --- previous checkpoint ----------------------------------------------------------------------------------------------


@pytest.fixture
def two(saved, tmp_path):
    """The folder of a run with two checkpoints."""
    folder = tmp_path / "out"
    folder.mkdir()
    for name, time in ((PREVIOUS_NAME, 1.0), (CHECKPOINT_NAME, 2.0)):
        checkpoint.write_checkpoint(folder / name, {}, scene(1.0), {}, {"time": time, "x": np.arange(3000.0)}, {})
    return folder


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.5, 0.999])
def test_a_truncated_file_is_replaced_by_the_previous_one(two, fraction):
    path, previous = two / CHECKPOINT_NAME, two / PREVIOUS_NAME
    assert read_last_good(path).state["time"] == 2.0
    data = path.read_bytes()
    path.write_bytes(data[: int(fraction * len(data))])
    name, other = re.escape(str(path)), re.escape(str(previous))
    message = rf"^{name} is (no checkpoint of taisoft, or )?damaged.*; resuming from the previous checkpoint instead, {other}$"
    with pytest.warns(UserWarning, match=message):
        found = read_last_good(path)
    assert found.state["time"] == 1.0 and found.path == previous
    previous.write_bytes(b"x")
    with pytest.raises(ts.SimulationError, match=rf"^{name} .*damaged.*; nor can the previous one be used: {other} is no"):
        read_last_good(path)
    previous.unlink()
    with pytest.raises(ts.SimulationError, match=rf"^{name} is .*damaged"):
        read_last_good(path)


class FakeSimulator:
    """A stand-in for a simulator, with a time."""

    def __init__(self, time):
        self.time = time

    def save_checkpoint(self, path, notes):
        checkpoint.write_checkpoint(path, {}, scene(1.0), {}, {"time": self.time}, notes)


def times(folder):
    names = [name for name in (PREVIOUS_NAME, CHECKPOINT_NAME) if (folder / name).exists()]
    return [checkpoint.read_checkpoint(folder / name).state["time"] for name in names]


def test_the_previous_checkpoint_is_of_the_same_run(two, monkeypatch):
    """Also on a file system without links. A run resumed from the previous checkpoint keeps it until there is another."""
    writer = CheckpointWriter(two)  # the folder holds checkpoints of another run
    writer.write(FakeSimulator(3.0))
    assert times(two) == [3.0]
    writer.write(FakeSimulator(4.0))
    assert times(two) == [3.0, 4.0]
    CheckpointWriter(two, resumed=two / ".." / "out" / CHECKPOINT_NAME).write(FakeSimulator(5.0))
    assert times(two) == [4.0, 5.0]
    writer = CheckpointWriter(two, resumed=two / PREVIOUS_NAME)
    writer.write(FakeSimulator(6.0))
    assert times(two) == [4.0, 6.0]

    def no_links(*_):
        raise PermissionError("no links here")

    monkeypatch.setattr(os, "link", no_links)
    writer.write(FakeSimulator(7.0))
    assert times(two) == [6.0, 7.0] and sorted(os.listdir(two)) == [CHECKPOINT_NAME, PREVIOUS_NAME]


def test_sizes_are_checked_before_allocation(saved, tmp_path):
    """Array headers that declare terabytes or more than the zip holds, and a compressed file."""
    path = tmp_path / "b.npz"
    magic = np.lib.format.magic(1, 0)
    for shape in (f"({10**13},)", f"({10**7},)"):
        head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("header.npy", magic + len(head).to_bytes(2, "little") + head.encode() + bytes(24))
        assert_refused_within(path, 2_000_000)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, zipfile.ZipFile(saved) as source:
        for name in source.namelist():
            archive.writestr(name, source.read(name))
        for k in range(1000):  # each smaller than the file
            archive.writestr(f"more{k}.npy", bytes(50_000))
    assert 50_000 < path.stat().st_size < 300_000 and saved.stat().st_size < 60_000
    assert_refused_within(path, 2_000_000)


def assert_refused_within(path, n_bytes):
    tracemalloc.start()
    try:
        with pytest.raises(ts.SimulationError, match="b.npz is no checkpoint of taisoft, or damaged: .*declared"):
            checkpoint.read_checkpoint(path)
        assert tracemalloc.get_traced_memory()[1] < n_bytes
    finally:
        tracemalloc.stop()
