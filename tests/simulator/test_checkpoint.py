"""A loaded simulator continues bitwise, with its results, numbers and settings;
forces and torques of contacts are sums over the contacts.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem.reference import gravity_mass
from tests.dynamics.scenes import RELEASE, driven_scene
from tests.simulator.scenes import AFTER, BEFORE, follow, press, pressed


def assert_same(found: list, expected: list) -> None:
    """Compare times, positions, velocities and reports of two runs bitwise."""
    assert len(found) == len(expected)
    for k, (one, other) in enumerate(zip(found, expected)):
        same = [np.array_equal(a, b) for a, b in zip(one, other)]
        assert all(same), f"time, positions, velocities, report of step {k}: {same}"


def test_continuing_without_contacts(tmp_path):
    """Nodes are released at RELEASE, between the two checkpoints."""
    scene, dt = driven_scene(mass_damping=0.5, stiffness_damping=1e-4), RELEASE / 19
    early, late = tmp_path / "early.npz", tmp_path / "late.npz"
    with ts.Simulator(scene, dt=dt, integrator="velocity_verlet", precision="f64") as sim:
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
    with ts.Simulator.load_checkpoint(late, scene) as loaded:
        assert_same(follow(loaded, 5), expected[30:])


@pytest.mark.gpu_path
def test_continuing_with_contacts(tmp_path):
    """A cube is pressed on a moving floor. At rest the two overlap, which must not matter later."""
    path = tmp_path / "checkpoint.npz"
    with pressed() as sim:
        follow(sim, BEFORE)
        sim.set_contact("cube", "floor", friction=0.1)
        sim.save_checkpoint(path)
        contacts, force, reactions = sim.contacts(), sim.contact_force("floor"), sim.reactions()
        pair_force = sim.contact_force("cube", "floor")
        expected = follow(sim, AFTER)
    assert contacts.impulse.any() and set(contacts.body_b) == {"floor"} and expected[-1][3].n_contacts
    scene = press().snapshot()
    scene.allow_initial_overlap = False
    with ts.Simulator.load_checkpoint(path, scene) as loaded:
        assert not loaded.scene.allow_initial_overlap and loaded.scene.contact_numbers("cube", "floor")[0] == 0.1
        found = loaded.contacts()
        for name in ("point", "normal", "gap", "impulse", "nodes", "weights", "found", "unmapped"):
            assert np.array_equal(getattr(found, name), getattr(contacts, name)), name
        assert found.duration == contacts.duration and np.array_equal(loaded.contact_force("cube", "floor"), pair_force)
        assert np.array_equal(loaded.contact_force("floor"), force) and np.array_equal(loaded.reactions(), reactions)
        assert_same(follow(loaded, AFTER), expected)


def test_contact_forces_and_torques_are_sums_over_contacts():
    """Of a step that was not cut; about the centre of mass of a body and the pivot of an obstacle."""
    with pressed() as sim:
        follow(sim, AFTER)
        c, x = sim.contacts(), sim.positions()
        assert c.duration == sim.dt and c.impulse.any() and set(c.body_a) == {"cube"}
        force, own = c.impulse / sim.dt, c.weights[:, :3]
        arms = np.einsum("ck,cki->ci", own, x[c.nodes[:, :3]]) / own.sum(axis=1, keepdims=True)
        centre = np.average(x, axis=0, weights=gravity_mass(sim.scene.body("cube")))
        floor = (0.3 * sim.time, 0.05 * sim.time, 0.0)
        for name, sign, arm in (("cube", 1.0, arms - centre), ("floor", -1.0, c.point - floor)):
            assert np.allclose(sim.contact_force(name), sign * force.sum(axis=0), rtol=1e-9)
            torque = sign * np.cross(arm, force).sum(axis=0)
            assert np.abs(sim.contact_torque(name) - torque).max() < 1e-9 * np.abs(torque).max()
        assert np.array_equal(sim.contact_force("floor", "cube"), -sim.contact_force("cube", "floor"))
        assert np.allclose(sim.momentum(), gravity_mass(sim.scene.body("cube")) @ sim.velocities())
        found = sim.detect_contacts()
        assert len(found) and not found.impulse.any() and sim.contacts().found == c.found >= len(c)
        with pytest.raises(ts.SceneError, match="exerts no net force on itself"):
            sim.contact_force("cube", "cube")
