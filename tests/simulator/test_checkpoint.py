"""Checkpoints:

* a loaded simulator continues bitwise: with prescribed nodes before and after their release, contacts, a moving obstacle, and
  changed dt, gravity, material and friction; also in another process, and from a scene that overlaps at rest;
* its results of the last step, its numbers and its settings are those of the saved one;
* every stored part of the state matters: a wrong value changes the steps;
* a file that is foreign, damaged, newer, or of another scene is refused in one sentence that names it;
* a file is complete or absent, and is replaced only by a complete one.
"""

import copy
import dataclasses
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.checkpoint import read_checkpoint
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.errors import OutputError, SceneError, SimulationError
from tests.cli.command import ROOT
from tests.dynamics.scenes import RELEASE, driven_scene
from tests.simulator.checkpoint_scenes import CUBES, OVERLAP, cubes, follow, press


def assert_same(a: list, b: list) -> None:
    """Compare two runs bitwise."""
    assert len(a) == len(b)
    for k, (one, other) in enumerate(zip(a, b)):
        assert one[0] == other[0], f"time of step {k}"
        assert np.array_equal(one[1], other[1]), f"positions after step {k} differ by {np.abs(one[1] - other[1]).max():g} m"
        assert np.array_equal(one[2], other[2]), f"velocities after step {k}"
        assert one[3] == other[3], f"report of step {k}"


def differ(a: list, b: list) -> bool:
    return any(not np.array_equal(one[1], other[1]) for one, other in zip(a, b))


def assert_state_matters(path: Path, scene: ts.Scene, changes: dict, expected: list) -> None:
    """Steps from a checkpoint are the expected ones, unless a part of its state changes.

    changes: names of parts, joined by slashes -> function of the saved value.
    """
    saved = read_checkpoint(path)
    with ts.Simulator.from_checkpoint(saved, scene) as sim:
        assert_same(follow(sim, len(expected)), expected)
    for name, change in changes.items():
        state = copy.deepcopy(saved.state)
        *folders, last = name.split("/")
        table = state
        for folder in folders:
            table = table[folder]
        table[last] = change(table[last])
        with ts.Simulator.from_checkpoint(dataclasses.replace(saved, state=state), scene) as sim:
            assert differ(follow(sim, len(expected)), expected), f"{name} has no effect"


def restart_taichi() -> None:
    """Let Taichi start again, as in another process. Kernels of the same scene are then found on disk."""
    assert runtime.open_kind() is None
    runtime._kind = None


# --- continuing -------------------------------------------------------------------------------------------------------

CHANGES = {
    "velocity_verlet": {"stepper/acceleration": lambda a: 0 * a},
    "bdf2": {"stepper/x_now": lambda x: 0 * x, "stepper/past": lambda n: 0},
}
# for the other integrators a second release has no effect
LATE_CHANGES = {name: {"simulation/released": lambda r: [False] * len(r)} for name in CHANGES}


@pytest.mark.parametrize(
    "integrator, precision",
    [
        ("bdf2", "f64"),
        ("velocity_verlet", "f32"),
        ("bdf2", "f32"),
        ("velocity_verlet", "f64"),
        ("symplectic_euler", "f64"),
        ("implicit_euler", "f32"),
        ("implicit_midpoint", "f64"),
        ("linearly_implicit_euler", "f32"),
    ],
)
def test_continuing_without_contacts(tmp_path, integrator, precision):
    """Nodes are released at RELEASE, between the two checkpoints."""
    scene, dt = driven_scene(mass_damping=0.5, stiffness_damping=1e-4), RELEASE / 19
    early, late = tmp_path / "early.npz", tmp_path / "late.npz"
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision=precision) as sim:
        follow(sim, 4)
        sim.dt = 0.7 * dt
        sim.set_gravity((0.0, -5.0, 1.0))
        sim.set_material("flyer", young=5e4, density=900.0)
        follow(sim, 6)
        sim.save_checkpoint(early)
        reactions, expected = sim.reactions(), follow(sim, 30)
        sim.save_checkpoint(late)
        expected += follow(sim, 5)
        assert sim.time > RELEASE > 10 * dt
    restart_taichi()
    with ts.Simulator.load_checkpoint(early, scene) as loaded:
        assert loaded.settings == sim.settings and loaded.dt == sim.dt and loaded.step_count == 10
        assert np.array_equal(loaded.scene.gravity, (0.0, -5.0, 1.0))
        assert loaded.scene.body("flyer").material == sim.scene.body("flyer").material != scene.body("flyer").material
        assert np.array_equal(loaded.reactions(), reactions)
        assert_same(follow(loaded, 35), expected)
    changes = {"simulation/v": lambda v: 0.5 * v, "time_base": lambda t: t + 1e-3, **CHANGES.get(integrator, {})}
    assert_state_matters(early, scene, changes, expected[:8])
    assert_state_matters(late, scene, LATE_CHANGES.get(integrator, {}), expected[30:])


@pytest.mark.parametrize(
    "integrator, precision, settings",
    [
        ("symplectic_euler", "f32", {}),
        ("velocity_verlet", "f64", {"self_collision": True}),
        ("symplectic_euler", "f64", {"contact_solver": "coloured_gauss_seidel"}),
        ("bdf2", "f32", {"self_collision": True}),
        ("linearly_implicit_euler", "f64", {}),
        ("implicit_euler", "f32", {}),
    ],
)
def test_continuing_with_contacts(tmp_path, integrator, precision, settings):
    """A plate presses a cube and is released after the checkpoint; a ball moves into the cube.

    At rest the plate overlaps the cube. That must not matter once it has moved away.
    """
    dt, before, after = (2e-4, 60, 60) if integrator in EXPLICIT else (2e-3, 15, 15)
    scene, path = press(1.5 * before * dt), tmp_path / "checkpoint.npz"
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision=precision, **settings) as sim:
        sim.set_state(positions=sim.positions("plate") + (0, OVERLAP, 0), body="plate")
        follow(sim, before)
        sim.set_contact("cube", "floor", friction=0.1)
        sim.save_checkpoint(path)
        contacts, force, reactions = sim.contacts(), sim.contact_force("floor"), sim.reactions()
        pair_force = sim.contact_force("cube", "floor")
        expected = follow(sim, after)
    assert contacts.impulse.any() and set(contacts.body_b) == {"plate", "floor", "ball"} and expected[-1][3].n_contacts
    restart_taichi()
    scene = scene.snapshot()
    scene.allow_initial_overlap = False
    with ts.Simulator.load_checkpoint(path, scene) as loaded:
        assert not loaded.scene.allow_initial_overlap
        assert loaded.scene.contact_numbers("cube", "floor")[0] == 0.1
        found = loaded.contacts()
        for name in ("point", "normal", "gap", "impulse", "nodes", "weights"):
            assert np.array_equal(getattr(found, name), getattr(contacts, name)), name
        assert found.duration == contacts.duration and np.array_equal(loaded.contact_force("cube", "floor"), pair_force)
        assert np.array_equal(loaded.contact_force("floor"), force) and np.array_equal(loaded.reactions(), reactions)
        assert_same(follow(loaded, after), expected)
    assert_state_matters(path, scene, {"stepper/contact/rows/r": lambda r: 0 * r}, expected[:3])


@pytest.mark.parametrize("steps", [5, 100])
def test_cubes_continue_in_another_process(steps, tmp_path):
    """Case L3: bodies lie on a floor and on each other; 100 steps before a checkpoint, and some after it."""
    path, result = tmp_path / "checkpoint.npz", tmp_path / "result.npz"
    with ts.Simulator(cubes(), **CUBES) as sim:
        follow(sim, 60)
        sim.set_material("top", density=1500.0)
        follow(sim, 40)
        sim.save_checkpoint(path)
        contacts = sim.contacts()
        active = contacts.impulse.any(axis=1)
        assert {"floor", "top"} <= set(contacts.body_b[active]) | set(contacts.body_a[active])
        expected = follow(sim, steps)
    changes = {"stepper/contact/rows/r": lambda r: 0 * r, "stepper/contact/last_time": lambda t: 2 * t}
    assert_state_matters(path, cubes(), changes, expected[:3])
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    script = Path(__file__).with_name("checkpoint_scenes.py")
    subprocess.run([sys.executable, script, path, str(steps), result], env=environment, check=True)
    with np.load(result) as other:
        assert np.array_equal(other["time"], [t for t, *_ in expected])
        assert np.array_equal(other["x"], [x for _, x, *_ in expected])
        assert np.array_equal(other["v"], [v for _, _, v, _ in expected])


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """A checkpoint of the driven scene."""
    path = tmp_path_factory.mktemp("saved") / "checkpoint.npz"
    with ts.Simulator(driven_scene(), dt=1e-4, integrator="symplectic_euler") as sim:
        sim.step()
        sim.save_checkpoint(path)
    return path


def refusal(path: Path, scene: ts.Scene | None = None) -> str:
    """Return the message that refuses a file."""
    with pytest.raises((SimulationError, SceneError)) as caught:
        ts.Simulator.load_checkpoint(path, scene or driven_scene())
    text = str(caught.value)
    assert str(path) in text and "\n" not in text
    return text


def test_other_files_are_refused(tmp_path):
    assert "no such checkpoint" in refusal(tmp_path / "absent.npz")
    assert "no checkpoint" in refusal(tmp_path)
    path = tmp_path / "file.npz"
    for content in (b"", b"no checkpoint", b"PK\x03\x04 no zip", b"\x93NUMPY\x01\x00"):
        path.write_bytes(content)
        assert "no checkpoint" in refusal(path)
    for content in ({"x": np.zeros(3)}, {"header": np.array([{}], dtype=object)}, {"header": np.zeros(3, dtype=np.uint8)}):
        np.savez(path, **content)
        assert "no checkpoint" in refusal(path)
    with open(path, "wb") as file:
        np.save(file, np.zeros(3))
    assert "no checkpoint" in refusal(path)


def test_truncated_files_are_refused(saved, tmp_path):
    data, path = saved.read_bytes(), tmp_path / "part.npz"
    for length in {0, 1, 100, len(data) // 2, len(data) - 100, len(data) - 1}:
        path.write_bytes(data[:length])
        refusal(path)


def test_a_changed_byte_is_found(saved, tmp_path):
    """Anywhere, except for redundant and unused bytes of the zip format."""
    data, path, harmless = saved.read_bytes(), tmp_path / "changed.npz", 0
    for at in np.random.default_rng(1).choice(len(data), 300, replace=False):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x11]) + data[at + 1 :])
        try:
            content = read_checkpoint(path)
        except SimulationError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            continue
        harmless += 1
        original = read_checkpoint(saved)
        assert (content.settings, content.numbers, content.fingerprint) == (
            original.settings,
            original.numbers,
            original.fingerprint,
        )
        assert np.array_equal(content.state["simulation"]["x"], original.state["simulation"]["x"])
    assert harmless < 100


def changed(saved: Path, path: Path, member: str, change) -> Path:
    """Write the checkpoint with one array changed, in an intact zip file."""
    with np.load(saved) as file:
        arrays = dict(file)
    arrays[member] = change(arrays[member])
    np.savez(path, **arrays)
    return path


def test_a_changed_number_is_found(saved, tmp_path):
    path = changed(saved, tmp_path / "changed.npz", "simulation/x", lambda x: x + 1e-12)
    assert "is damaged: its checksum" in refusal(path)


@pytest.mark.parametrize("version, format_version", [("0.0", 6), ("9.1", 99)])
def test_other_formats_are_refused_with_their_version(saved, tmp_path, version, format_version):
    def change(text):
        header = json.loads(text.tobytes()) | {"format": format_version, "taisoft": version}
        return np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)

    text = refusal(changed(saved, tmp_path / "changed.npz", "header", change))
    assert f"written by taisoft {version} in format {format_version}, and taisoft" in text and "reads format 15" in text


def set_read_only(scene, name: str, value):
    """Bypass the read-only attributes of a body."""
    vars(scene.body("flyer"))[name] = value


def with_other_mesh(scene):
    mesh = scene.body("flyer").mesh
    vertices = mesh.vertices.copy()
    vertices[0, 0] += 1e-9
    set_read_only(scene, "mesh", ts.TetMesh(vertices, mesh.tets))


def with_material(scene, **numbers):
    body = scene.body("flyer")
    body.material = dataclasses.replace(body.material, **numbers)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda scene: set_read_only(scene, "name", "fly"), 'its bodies are ["beam", "flyer"], those here ["beam", "fly"]'),
        (lambda scene: scene.bodies.reverse(), 'those here ["flyer", "beam"]'),
        (with_other_mesh, "in body 'flyer': mesh"),
        (lambda scene: scene.body("flyer").fix([0]), "in body 'flyer': constraints"),
        (lambda scene: scene.body("flyer").add_force([0], (1, 0, 0)), "in body 'flyer': loads"),
        (
            lambda scene: scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="floor"),
            'its obstacles are [], those here ["floor"]',
        ),
        (lambda scene: with_material(scene, law="corotational"), "in body 'flyer': order, quadrature, dilatation, law"),
        (
            lambda scene: with_material(scene, mass_damping=0.1),
            "body 'flyer': mass_damping is 0.1 in this scene and was 0.0 at the start",
        ),
    ],
)
def test_another_scene_is_refused(saved, change, message):
    scene = driven_scene()
    change(scene)
    text = refusal(saved, scene)
    assert "is a checkpoint of another scene" in text and message in text


def test_another_path_is_accepted(saved):
    """Functions of time cannot be compared."""
    scene = driven_scene()
    beam = scene.body("beam")
    removed = beam.constraints.pop()
    beam.move(removed.nodes, lambda t: (0, 0, 0), axes="z")
    with ts.Simulator.load_checkpoint(saved, scene) as sim:
        assert sim.step_count == 1


def test_a_file_is_complete_or_absent(saved, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.npz"
    path.write_bytes(b"the earlier one")

    def full(file, **arrays):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    with ts.Simulator.load_checkpoint(saved, driven_scene()) as sim:
        monkeypatch.setattr(np, "savez", full)
        with pytest.raises(OutputError, match="checkpoint.npz: No space left"):
            sim.save_checkpoint(path)
        assert path.read_bytes() == b"the earlier one" and os.listdir(tmp_path) == ["checkpoint.npz"]
        monkeypatch.undo()
        with pytest.raises(OutputError, match="absent"):
            sim.save_checkpoint(tmp_path / "absent" / "checkpoint.npz")
        sim.save_checkpoint(path)
        assert zipfile.is_zipfile(path) and os.listdir(tmp_path) == ["checkpoint.npz"]
