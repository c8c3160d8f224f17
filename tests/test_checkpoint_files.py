"""What a checkpoint's file tells of the scene, and what it lacks:

* a header without a part, or with one of another form, is told, though its checksum is right;
* nothing in a file is run: pickled objects are refused;
* key frames are compared, and what is left out of a scene or called otherwise, whatever characters its name has.
"""

import json
import pickle

import numpy as np
import pytest
from scenes import driven_scene

import taisoft as ts
from taisoft import checkpoint


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


@pytest.mark.parametrize("key", ["state", "settings", "notes"])
@pytest.mark.parametrize("change", [{}, {"is": []}])
def test_what_a_header_lacks_is_told(saved, key, change):
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files if name not in ("header", "sha256")}
        header = json.loads(file["header"].tobytes())
    wrong = {name: value for name, value in header.items() if name != key} | ({key: change["is"]} if change else {})
    text = np.frombuffer(json.dumps(wrong).encode(), dtype=np.uint8)
    np.savez(saved, header=text, sha256=checkpoint._checksum(text, arrays), **arrays)
    with pytest.raises(ts.SimulationError, match="a.npz is no checkpoint of taisoft, or damaged"):
        ts.Simulator.load_checkpoint(saved, scene(1.0))


def test_settings_of_another_version_are_told(saved):
    with pytest.raises(ts.SimulationError, match="its settings are not those of this version"):
        ts.Simulator.load_checkpoint(saved, scene(1.0))


def test_scenes_are_compared(saved):
    read = checkpoint.read_checkpoint(saved)
    assert read.notes == {"fps": 30.0} and np.array_equal(read.state["x"], np.arange(3.0))
    checkpoint.check_scene(read, scene(1.0), {})
    for other in (scene(2.0), scene(1.0, "wall:right"), driven_scene()):
        with pytest.raises(ts.SceneError, match="is a checkpoint of another scene"):
            checkpoint.check_scene(read, other, {})


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
