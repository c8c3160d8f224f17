"""Checkpoint files: one that is foreign, damaged, newer, too large or of another scene is refused in one sentence; numbers are
all restored and compared with the initial ones by name; a file is complete or absent.
"""

import json
import os
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

import taisoft as ts
from taisoft.checkpoint import check_scene, read_checkpoint, restore_numbers, write_checkpoint
from taisoft.errors import OutputError, SceneError, SimulationError
from taisoft.scene.fingerprint import digest
from taisoft.scene.numbers import first_difference, scene_numbers
from tests.dynamics.scenes import cube, driven_scene, halved, rubber


def scene(height: float = 1.0) -> ts.Scene:
    """The driven scene, with an obstacle along key frames."""
    made = driven_scene()
    frames = ts.KeyFrames([0.0, 1.0], [(0, 0, 0), (0, height, 0)])
    made.add_obstacle(ts.Sphere((0, 9, 0), 0.1), name="wall:left", path=frames)
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
    assert "no checkpoint of taisoft, or damaged: Is a directory" in refusal(tmp_path)
    path = tmp_path / "file.npz"
    for content in (b"", b"PK\x03\x04 no zip", b"\x93NUMPY\x01\x00", b"\x93NUMPY\x01\x00\x08\x00declared"):
        path.write_bytes(content)
        assert "no checkpoint of taisoft, or damaged: expected arrays in a zip archive" in refusal(path)
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
    for length in (1, len(data) // 2, len(data) - 1):
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
        assert (content.settings, content.numbers) == (original.settings, original.numbers)
        assert np.array_equal(content.state["simulation"]["x"], original.state["simulation"]["x"])
    assert harmless < 70
    with np.load(saved) as file:
        np.savez(path, **dict(file) | {"simulation/x": file["simulation/x"] + 1e-12})
        assert "is damaged: its checksum" in refusal(path)
        for name in ("header", "simulation/x", "more"):  # pickled objects
            np.savez(path, **dict(file) | {name: np.array([Path("pickled")], dtype=object)})
            assert "part.npz is" in refusal(path)


def test_sizes_are_checked_before_allocation(tmp_path):
    """An array header that declares terabytes, and a compressed file."""
    path = tmp_path / "b.npz"
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({10**13},), }}".ljust(117) + "\n"
    huge = {"header": np.lib.format.magic(1, 0) + len(head).to_bytes(2, "little") + head.encode() + bytes(24)}
    zeros = {f"more{k}": bytes(50_000) for k in range(1000)}  # each smaller than the file
    for content, compression in ((huge, zipfile.ZIP_STORED), (zeros, zipfile.ZIP_DEFLATED)):
        with zipfile.ZipFile(path, "w", compression) as archive:
            for name, data in content.items():
                archive.writestr(f"{name}.npy", data)
        tracemalloc.start()
        try:
            with pytest.raises(ts.SimulationError, match="b.npz is no checkpoint of taisoft, or damaged: .*declared"):
                read_checkpoint(path)
            assert tracemalloc.get_traced_memory()[1] < 2_000_000
        finally:
            tracemalloc.stop()


def moved_vertex(mesh: ts.TetMesh) -> ts.TetMesh:
    vertices = mesh.vertices.copy()
    vertices[0, 0] += 1e-9
    return ts.TetMesh(vertices, mesh.tets)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda s: vars(s.body("flyer")).update(name="fly"), 'its bodies are ["beam", "flyer"], those here ["beam", "fly"]'),
        (lambda s: vars(s.body("flyer")).update(mesh=moved_vertex(s.body("flyer").mesh)), "in body 'flyer': mesh"),
        (lambda s: s.body("flyer").fix([0]), "in body 'flyer': constraints"),
        (lambda s: s.body("flyer").add_force([0], (1, 0, 0)), "in body 'flyer': loads"),
        (lambda s: s.add_obstacle(ts.Sphere((0, 0, 0), 1), name="ball"), 'its obstacles are ["wall:left"], those here'),
        (lambda s: setattr(s.body("flyer"), "material", rubber("corotational")), "order, quadrature, dilatation, law"),
    ],
)
def test_another_scene_is_refused(saved, change, message):
    given = scene()
    change(given)
    text = refusal(saved, given)
    assert "is a checkpoint of another scene" in text and message in text


def test_paths_are_compared_where_they_are_key_frames(saved):
    assert "is a checkpoint of another scene" in refusal(saved, scene(2.0))
    given = scene()
    beam = given.body("beam")
    held = beam.constraints[-1]
    beam.remove(held)
    beam.move(held.nodes, lambda t: (0, 0, 0), axes="z")  # functions of time cannot be compared
    with ts.Simulator.load_checkpoint(saved, given) as sim:
        assert sim.step_count == 0 and read_checkpoint(saved).notes == {"fps": 30.0}


def with_numbers(scale=1.0, gravity=-9.81, force=(1.0, 2.0, 3.0), friction=0.3, young=1e5) -> ts.Scene:
    """Numbers of every kind, also by tet and by region, and loads."""
    made = ts.Scene(gravity=(0, gravity * scale, 0))
    body = made.add_body(cube(), ts.Material(young=young * scale), name="a/b")
    body.add_force([0, 1], [np.multiply(force, scale), (4.0, 5.0, 6.0)])
    made.add_obstacle(ts.Sphere((0, 9, 0), 0.1), name="ball")
    made.set_contact("a/b", "ball", friction=friction * scale)
    made.add_body(cube(), rubber(), name="by tet", young=scale * np.linspace(1e5, 2e5, 5), position=(3, 0, 0))
    made.add_body(halved(cube()), {"left": rubber(), 7: rubber(density=900.0 * scale)}, name="two", position=(6, 0, 0))
    made.add_tendon([("two", 0), ("two", 1)], 5.0 * scale, name="rope")
    return made


def test_numbers_are_compared_with_the_initial_ones_and_restored(tmp_path):
    path, start, present = tmp_path / "a.npz", with_numbers(), with_numbers(2.0)  # changed during the run
    write_checkpoint(path, {}, present, {}, {}, {}, start)
    read = read_checkpoint(path)
    check_scene(read, start, {})
    for other, message in (
        (with_numbers(gravity=-1.0), "gravity is [0.0, -1.0, 0.0] in this scene and was [0.0, -9.81, 0.0] at the start"),
        (with_numbers(force=(1.0, 2.0, 3.5)), "a/b.force.0, row 0 is [1.0, 2.0, 3.5] in this scene and was [1.0, 2.0, 3.0]"),
        (with_numbers(friction=0.4), "contact.a/b.ball.friction is 0.4 in this scene and was 0.3 at the start"),
        (with_numbers(young=2e6), "a/b.young is 2000000.0 in this scene and was 100000.0 at the start"),
        (present, "gravity is"),
    ):
        with pytest.raises(ts.SceneError, match="is a checkpoint of another scene") as caught:
            check_scene(read, other, {})
        assert str(path) in str(caught.value) and message in str(caught.value)
    assert first_difference(scene_numbers(present), scene_numbers(start))
    restore_numbers(read, start)
    assert first_difference(scene_numbers(present), scene_numbers(start)) == ""


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
        sim.save_checkpoint(path)
        assert zipfile.is_zipfile(path) and os.listdir(tmp_path) == ["checkpoint.npz"]
