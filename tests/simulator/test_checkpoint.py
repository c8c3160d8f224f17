"""A loaded simulator continues bitwise, with its results, numbers and settings:

* with prescribed nodes before and after their release, contacts, a moving obstacle and changed numbers;
* also in another process, which takes the same steps from the start, too;
* every stored part of the state matters: a wrong value changes the steps.
"""

import copy
import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import taisoft as ts
from taisoft.checkpoint import read_checkpoint
from tests.cli.command import ROOT
from tests.dynamics.scenes import RELEASE, driven_scene
from tests.simulator import scenes
from tests.simulator.scenes import AFTER, BEFORE, follow, press, pressed

long = pytest.mark.long


def assert_same(a: list, b: list) -> None:
    """Compare two runs bitwise."""
    assert len(a) == len(b)
    for k, (one, other) in enumerate(zip(a, b)):
        assert one[0] == other[0], f"time of step {k}"
        assert np.array_equal(one[1], other[1]), f"positions after step {k} differ by {np.abs(one[1] - other[1]).max():g} m"
        assert np.array_equal(one[2], other[2]), f"velocities after step {k}"
        assert one[3] == other[3], f"report of step {k}"


def assert_state_matters(path: Path, scene: ts.Scene, changes: dict, expected: list) -> None:
    """Steps from a checkpoint are the expected ones, unless a part of its state changes.

    changes: names of parts, joined by slashes -> function of the saved value.
    """
    saved = read_checkpoint(path)
    for name, change in changes.items():
        state = copy.deepcopy(saved.state)
        *folders, last = name.split("/")
        table = state
        for folder in folders:
            table = table[folder]
        table[last] = change(table[last])
        with ts.Simulator.from_checkpoint(dataclasses.replace(saved, state=state), scene) as sim:
            found = follow(sim, len(expected))
        assert any(not np.array_equal(a[1], b[1]) for a, b in zip(found, expected)), f"{name} has no effect"


IN_FLIGHT = {"simulation/v": lambda v: 0.5 * v, "time_base": lambda t: t + 1e-3}
ACCELERATION, PAST = {"stepper/acceleration": lambda a: 0 * a}, {"stepper/x_now": lambda x: 0 * x, "stepper/past": lambda n: 0}


@pytest.mark.parametrize(
    "integrator, changes",
    [
        ("velocity_verlet", ACCELERATION),
        pytest.param("bdf2", PAST, marks=long),
        *(pytest.param(name, {}, marks=long) for name in ("symplectic_euler", "implicit_euler", "linearly_implicit_euler")),
    ],
)
def test_continuing_without_contacts(tmp_path, integrator, changes):
    """Nodes are released at RELEASE, between the two checkpoints."""
    scene, dt = driven_scene(mass_damping=0.5, stiffness_damping=1e-4), RELEASE / 19
    early, late = tmp_path / "early.npz", tmp_path / "late.npz"
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64") as sim:
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
    with ts.Simulator.load_checkpoint(early, scene) as loaded:
        assert loaded.settings == sim.settings and loaded.dt == sim.dt and loaded.step_count == 10
        assert np.array_equal(loaded.scene.gravity, (0.0, -5.0, 1.0)) and not np.array_equal(scene.gravity, (0.0, -5.0, 1.0))
        assert loaded.scene.body("flyer").material == sim.scene.body("flyer").material != scene.body("flyer").material
        assert np.array_equal(loaded.reactions(), reactions)
        assert_same(follow(loaded, 35), expected)
    assert_state_matters(early, scene, IN_FLIGHT | changes, expected[:8])
    # for other integrators a second release has no effect
    assert_state_matters(late, scene, {"simulation/released": lambda r: [False] * len(r)} if changes else {}, expected[30:])


@pytest.mark.parametrize(
    "integrator, dt, before, after",
    [("bdf2", 2e-3, BEFORE, AFTER), pytest.param("symplectic_euler", 2e-4, 60, 60, marks=long)]
    + [pytest.param(name, 2e-3, 15, 15, marks=long) for name in ("implicit_euler", "linearly_implicit_euler")],
)
def test_continuing_with_contacts(tmp_path, integrator, dt, before, after):
    """A cube is pressed on a moving floor. At rest the two overlap, which must not matter later."""
    path = tmp_path / "checkpoint.npz"
    with pressed(dt=dt, integrator=integrator) as sim:
        follow(sim, before)
        sim.set_contact("cube", "floor", friction=0.1)
        sim.save_checkpoint(path)
        contacts, force, reactions = sim.contacts(), sim.contact_force("floor"), sim.reactions()
        pair_force = sim.contact_force("cube", "floor")
        expected = follow(sim, after)
    assert contacts.impulse.any() and set(contacts.body_b) == {"floor"} and expected[-1][3].n_contacts
    scene = press().snapshot()
    scene.allow_initial_overlap = False
    with ts.Simulator.load_checkpoint(path, scene) as loaded:
        assert not loaded.scene.allow_initial_overlap and loaded.scene.contact_numbers("cube", "floor")[0] == 0.1
        found = loaded.contacts()
        for name in ("point", "normal", "gap", "impulse", "nodes", "weights"):
            assert np.array_equal(getattr(found, name), getattr(contacts, name)), name
        assert found.duration == contacts.duration and np.array_equal(loaded.contact_force("cube", "floor"), pair_force)
        assert np.array_equal(loaded.contact_force("floor"), force) and np.array_equal(loaded.reactions(), reactions)
        assert_same(follow(loaded, after), expected)
    # explicit steps of so few contacts converge wherever they start
    changes = {} if integrator == "symplectic_euler" else {"stepper/contact/rows/r": lambda r: 0 * r}
    assert_state_matters(path, scene, changes, expected[:3])


def test_another_process_takes_the_same_steps(tmp_path):
    """From the start and from a checkpoint."""
    path, result = tmp_path / "checkpoint.npz", tmp_path / "result.npz"
    with scenes.driven(BEFORE) as sim:
        sim.save_checkpoint(path)
        late = follow(sim, AFTER)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, scenes.__file__, path, result], env=environment, check=True)
    with np.load(result) as other:
        for k in range(3):
            assert np.array_equal(other[f"late{k}"], [one[k] for one in late])
            assert np.array_equal(other[f"whole{k}"][BEFORE:], other[f"late{k}"])
