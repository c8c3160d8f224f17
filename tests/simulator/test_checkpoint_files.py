"""Checkpoint files:

* one that is foreign, damaged, newer, too large or of another scene is refused in one sentence; no pickled object runs;
* numbers are all restored, and compared with the initial ones by name; key frames are compared, functions of time are not;
* a file is complete or absent.
"""

import dataclasses
import json
import os
import pickle
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

import taisoft as ts
from taisoft.checkpoint import check_scene, load_values, read_checkpoint, restore_numbers, write_checkpoint
from taisoft.errors import OutputError, SceneError, SimulationError
from taisoft.scene.fingerprint import digest
from taisoft.scene.plan import first_difference, scene_numbers
from tests.dynamics.scenes import cube, driven_scene, halved, rubber


def scene(height: float = 1.0, obstacle: str = "wall:left") -> ts.Scene:
    """The driven scene, with an obstacle along key frames."""
    made = driven_scene()
    frames = ts.KeyFrames([0.0, 1.0], [(0, 0, 0), (0, height, 0)])
    made.add_obstacle(ts.Sphere((0, 9, 0), 0.1), name=obstacle, path=frames)
    return made


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """A checkpoint of that scene at its start."""
    path = tmp_path_factory.mktemp("saved") / "checkpoint.npz"
    with ts.Simulator(scene(), dt=1e-4, integrator="velocity_verlet", precision="f64") as sim:
        sim.save_checkpoint(path, {"fps": 30.0})
    return path


def refusal(path: Path, given: ts.Scene | None = None) -> str:
    """Return the message that refuses a file."""
    with pytest.raises((SimulationError, SceneError)) as caught:
        ts.Simulator.load_checkpoint(path, given or scene())
    text = str(caught.value)
    assert str(path) in text and "\n" not in text
    return text


def rewritten(saved: Path, path: Path, arrays: dict | None = None, **header) -> Path:
    """Write the checkpoint with other arrays or entries of its header, without those that are ..., and a right checksum."""
    with np.load(saved) as file:
        content = {name: file[name] for name in file.files if name not in ("header", "sha256")} | (arrays or {})
        entries = json.loads(file["header"].tobytes()) | header
    text = json.dumps({name: value for name, value in entries.items() if value is not ...}).encode()
    text = np.frombuffer(text, dtype=np.uint8)
    sha = digest([text, *(x for name in sorted(content) for x in (name, content[name]))])
    np.savez(path, header=text, sha256=np.frombuffer(bytes.fromhex(sha), dtype=np.uint8), **content)
    return path


def test_foreign_and_malformed_files_are_refused(saved, tmp_path):
    assert "no such checkpoint" in refusal(tmp_path / "absent.npz")
    assert "no checkpoint" in refusal(tmp_path)
    path = tmp_path / "file.npz"
    for content in (b"", b"no checkpoint", b"PK\x03\x04 no zip", b"\x93NUMPY\x01\x00"):
        path.write_bytes(content)
        assert "no checkpoint" in refusal(path)
    for content in ({"x": np.zeros(3)}, {"header": np.zeros(3, dtype=np.uint8)}):
        np.savez(path, **content)
        assert "no checkpoint" in refusal(path)
    with open(path, "wb") as file:
        np.save(file, np.zeros(3))
    assert "no checkpoint of taisoft, or damaged: it holds one array" in refusal(path)
    assert "its kind is 'another'" in refusal(rewritten(saved, path, kind="another"))
    for part in ("state", "settings", "notes", "start"):
        for wrong in (..., []):
            assert "its header has another structure" in refusal(rewritten(saved, path, **{part: wrong}))
    assert "no checkpoint" in refusal(rewritten(saved, path, state={"x": {"array of this file": "none"}}))
    assert "its settings are not those of this version" in refusal(rewritten(saved, path, settings={}))
    assert "holds no state of this scene" in refusal(rewritten(saved, path, state={"dt": 1e-4, "loads": {}}))
    for version, number in (("0.0", 6), ("9.1", 99)):
        text = refusal(rewritten(saved, path, format=number, taisoft=version))
        assert f"written by taisoft {version} in format {number}, and taisoft {ts.__version__} reads format" in text


def test_damaged_files_are_refused(saved, tmp_path):
    """Where a file is cut, and where a byte is changed, except for redundant and unused bytes of the zip format."""
    data, path, harmless = saved.read_bytes(), tmp_path / "part.npz", 0
    for length in (1, 100, len(data) // 2, len(data) - 100, len(data) - 1):
        path.write_bytes(data[:length])
        refusal(path)
    original = read_checkpoint(saved)
    for at in np.random.default_rng(1).choice(len(data), 200, replace=False):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x11]) + data[at + 1 :])
        try:
            content = read_checkpoint(path)
        except SimulationError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            continue
        harmless += 1
        assert (content.settings, content.numbers, content.fingerprint) == (
            original.settings,
            original.numbers,
            original.fingerprint,
        )
        assert np.array_equal(content.state["simulation"]["x"], original.state["simulation"]["x"])
    assert harmless < 70
    with np.load(saved) as file:
        np.savez(path, **dict(file) | {"simulation/x": file["simulation/x"] + 1e-12})
    assert "is damaged: its checksum" in refusal(path)


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
    for name in ("header", "simulation/x", "more"):
        np.savez(wrong, **content | {name: np.array([Canary(str(canary))], dtype=object)})
        assert "b.npz is" in refusal(wrong)
    assert not canary.exists()


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
    assert_refused_within(path, 2_000_000)


def assert_refused_within(path, n_bytes):
    tracemalloc.start()
    try:
        with pytest.raises(ts.SimulationError, match="b.npz is no checkpoint of taisoft, or damaged: .*declared"):
            read_checkpoint(path)
        assert tracemalloc.get_traced_memory()[1] < n_bytes
    finally:
        tracemalloc.stop()


# --- scenes -----------------------------------------------------------------------------------------------------------


def moved_vertex(mesh: ts.TetMesh) -> ts.TetMesh:
    vertices = mesh.vertices.copy()
    vertices[0, 0] += 1e-9
    return ts.TetMesh(vertices, mesh.tets)


def with_material(scene, **numbers):
    scene.body("flyer").material = dataclasses.replace(scene.body("flyer").material, **numbers)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda s: vars(s.body("flyer")).update(name="fly"), 'its bodies are ["beam", "flyer"], those here ["beam", "fly"]'),
        (lambda s: s.bodies.reverse(), 'those here ["flyer", "beam"]'),
        (lambda s: vars(s.body("flyer")).update(mesh=moved_vertex(s.body("flyer").mesh)), "in body 'flyer': mesh"),
        (lambda s: s.body("flyer").fix([0]), "in body 'flyer': constraints"),
        (lambda s: s.body("flyer").add_force([0], (1, 0, 0)), "in body 'flyer': loads"),
        (
            lambda s: s.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="floor"),
            'its obstacles are ["wall:left"], those here',
        ),
        (lambda s: with_material(s, law="corotational"), "in body 'flyer': order, quadrature, dilatation, law"),
        (lambda s: with_material(s, mass_damping=0.1), "flyer': mass_damping is 0.1 in this scene and was 0.0 at the start"),
    ],
)
def test_another_scene_is_refused(saved, change, message):
    given = scene()
    change(given)
    text = refusal(saved, given)
    assert "is a checkpoint of another scene" in text and message in text


def test_paths_are_compared_where_they_are_key_frames(saved):
    for other in (scene(2.0), scene(1.0, "wall:right")):
        assert "is a checkpoint of another scene" in refusal(saved, other)
    given = scene()
    beam = given.body("beam")
    beam.move(beam.constraints.pop().nodes, lambda t: (0, 0, 0), axes="z")  # functions of time cannot be compared
    with ts.Simulator.load_checkpoint(saved, given) as sim:
        assert sim.step_count == 0 and read_checkpoint(saved).notes == {"fps": 30.0}
    with pytest.raises(SceneError, match="scene must be a Scene, not str"):
        ts.Simulator.load_checkpoint(saved, "beam.py")


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
}


def test_numbers_are_compared_with_the_initial_ones(tmp_path):
    path, present = tmp_path / "a.npz", with_numbers(gravity=-5.0, young=3e6)  # changed during the run
    write_checkpoint(path, {}, present, {}, {"x": np.zeros(3)}, {}, with_numbers())
    read = read_checkpoint(path)
    check_scene(read, with_numbers(), {})
    for name, (value, message) in NUMBERS.items():
        for other in (with_numbers(**{name: value}), present):
            with pytest.raises(ts.SceneError, match="is a checkpoint of another scene") as caught:
                check_scene(read, other, {})
            assert str(path) in str(caught.value) and (other is present or message in str(caught.value))


def test_all_numbers_are_restored(tmp_path):
    """Also those by tet and by region, and loads."""

    def build(scale: float) -> ts.Scene:
        made = with_numbers(gravity=-scale, force=(scale, 2.0, 3.0), friction=0.1 * scale, young=1e5 * scale)
        made.add_body(cube(), rubber(), name="by tet", young=scale * np.linspace(1e5, 2e5, 5), position=(3, 0, 0))
        made.add_body(halved(cube()), {"left": rubber(), 7: rubber(density=900.0 * scale)}, name="two", position=(6, 0, 0))
        made.add_tendon([("two", 0), ("two", 1)], 5.0 * scale, name="rope")
        return made

    start, present, path = build(1.0), build(2.0), tmp_path / "a.npz"
    write_checkpoint(path, {}, present, {}, {"loads": load_values(present)}, {}, start)
    restore_numbers(read_checkpoint(path), start)
    assert first_difference(scene_numbers(present), scene_numbers(start)) == ""
    assert first_difference(scene_numbers(present), scene_numbers(build(1.0)))


# --- complete files ---------------------------------------------------------------------------------


def test_a_file_is_complete_or_absent(saved, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.npz"
    path.write_bytes(b"the earlier one")

    def full(file, **arrays):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    with ts.Simulator.load_checkpoint(saved, scene()) as sim:
        monkeypatch.setattr(np, "savez", full)
        with pytest.raises(OutputError, match="checkpoint.npz: No space left"):
            sim.save_checkpoint(path)
        assert path.read_bytes() == b"the earlier one" and os.listdir(tmp_path) == ["checkpoint.npz"]
        monkeypatch.undo()
        with pytest.raises(OutputError, match="absent"):
            sim.save_checkpoint(tmp_path / "absent" / "checkpoint.npz")
        sim.save_checkpoint(path)
        assert zipfile.is_zipfile(path) and os.listdir(tmp_path) == ["checkpoint.npz"]
