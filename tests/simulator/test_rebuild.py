"""`Simulator.rebuild` continues with other settings:

* positions, velocities, time, steps, changed numbers and released nodes are kept bit for bit, and the next step is that of a new
  simulator with those settings and that state;
* what is modelled, and what a checkpoint needs, follows from the scene at the start, whatever numbers changed;
* settings that cannot be met are refused with a new simulator's message, and nothing changes;
* the memory of the previous settings is released.
"""

import gc

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.backend.arrays import LanePool
from taisoft.errors import SimulationError
from tests.dynamics.scenes import RELEASE, cube, driven_scene, rubber
from tests.simulator.checkpoint_scenes import cubes
from tests.view.fake_simulator import beam_scene


def kept_values(sim) -> tuple:
    """Everything that `rebuild` keeps."""
    return sim.positions(), sim.velocities(), sim.time, sim.step_count, sim.energies()


def assert_same(a: tuple, b: tuple) -> None:
    assert np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1]) and a[2:] == b[2:]


def test_state_is_kept_and_the_next_step_is_that_of_a_new_simulator():
    scene = beam_scene(cells=(3, 1, 1))
    with ts.Simulator(scene, dt=0.004, integrator="symplectic_euler") as sim:
        buffers = len(LanePool.current._taken)
        sim.advance(20)
        sim.set_gravity((0.0, -5.0, 1.0))
        sim.set_material("beam", young=2e4)
        before = kept_values(sim)
        sim.rebuild(integrator="bdf2", dt=0.01)
        assert_same(kept_values(sim), before)
        assert sim.settings.integrator == "bdf2" and sim.dt == 0.01
        gc.collect()
        assert len(LanePool.current._taken) == buffers + 1  # forces as before, and the stiffness of implicit steps
        same = scene.snapshot()
        same.gravity, same.bodies[0].material = sim.scene.gravity, sim.scene.bodies[0].material
        with ts.Simulator(same, dt=0.01, integrator="bdf2") as other:
            other.set_state(positions=before[0], velocities=before[1])
            other.step()
            expected = other.positions(), other.velocities()
        report = sim.step()
        assert np.array_equal(sim.positions(), expected[0]) and np.array_equal(sim.velocities(), expected[1])
        assert sim.time == before[2] + 0.01 and sim.step_count == 21 and report.newton_iterations > 0
        sim.reset()
        assert sim.time == 0.0 and np.array_equal(sim.positions(), scene.bodies[0].rest_positions)
    assert runtime.open_kind() is None


def test_released_nodes_stay_free(tmp_path):
    with ts.Simulator(driven_scene(), dt=2e-4, integrator="symplectic_euler", precision="f64") as sim:
        while sim.time < RELEASE + 0.002:
            sim.advance(10)
        before = kept_values(sim)
        sim.rebuild(integrator="velocity_verlet")
        assert_same(kept_values(sim), before)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.advance(5)
        after = kept_values(sim)
    assert np.abs(after[0][8:10] - before[0][8:10]).max() > 1e-5
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", driven_scene()) as sim:
        assert sim.settings.integrator == "velocity_verlet"
        sim.advance(5)
        assert_same(kept_values(sim), after)


def test_refused_settings_change_nothing():
    with ts.Simulator(cubes(), dt=0.01) as sim:
        before, settings, scene, sizes = kept_values(sim), sim.settings, sim.scene, sim.field_bytes
        for changes, message in (
            ({"integrator": "implicit_midpoint"}, "implicit_midpoint does not support contacts"),
            ({"integrator": "symplectic_euler"}, "above the estimated stability limit"),
            ({"contact_solver": "jacobi"}, "does not fit implicit_euler"),
            ({"precision": "f64"}, "is open"),
            ({"dt": -1.0}, "dt must be greater than 0 s"),
        ):
            with pytest.raises(SimulationError, match=message):
                sim.rebuild(**changes)
            assert_same(kept_values(sim), before)
        assert sim.settings is settings and sim.scene is scene and sim.field_bytes == sizes
        assert sim.settings.integrator == "implicit_euler" and not sim.scene.allow_initial_overlap
    assert runtime.open_kind() is None


def test_another_contact_solver_continues_with_bodies_in_contact():
    with ts.Simulator(cubes(), dt=5e-4, integrator="symplectic_euler", contact_solver="gauss_seidel") as sim:
        sim.advance(200)
        before = kept_values(sim)
        assert len(sim.contacts().gap) > 0
        sim.rebuild(contact_solver="jacobi")
        assert_same(kept_values(sim), before)
        report = sim.advance(20)
        assert report.n_contacts > 0 and report.converged and report.max_penetration < 1e-3


def varied_scene() -> ts.Scene:
    """A free cube with everything that a change can make superfluous: damping, moduli by tet, a load along a path."""
    scene = ts.Scene()
    body = scene.add_body(cube(), rubber(mass_damping=2.0, stiffness_damping=1e-4), name="cube", young=np.linspace(1e5, 2e5, 5))
    body.add_force([0, 3], lambda t: (30.0 * t, 1.0, 0.0))
    return scene


CHANGES = {
    "force": lambda sim: sim.set_force("cube", 0, (1.0, 2.0, 3.0)),
    "mass_damping": lambda sim: sim.set_material("cube", mass_damping=0.0),
    "stiffness_damping": lambda sim: sim.set_material("cube", stiffness_damping=0.0),
    "young": lambda sim: sim.set_material("cube", young=1e5),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_changed_numbers_neither_end_a_feature_nor_a_checkpoint(tmp_path, change):
    """What is modelled follows from the scene as it was at the start."""
    with ts.Simulator(varied_scene(), dt=1e-3, integrator="implicit_euler", precision="f64") as sim:
        sim.step()
        change(sim)
        features = sim.plan.on
        sim.rebuild(integrator="velocity_verlet", dt=1e-4)
        assert sim.plan.on == features | {"assembled_stiffness": False, "inversion_handling": False}
        sim.set_material("cube", young=np.linspace(1e5, 3e5, 5), mass_damping=1.0, stiffness_damping=1e-4)
        change(sim)
        sim.advance(5)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.advance(5)
        wanted = kept_values(sim)
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", varied_scene()) as sim:
        sim.advance(5)
        assert_same(kept_values(sim), wanted)
        sim.set_material("cube", young=np.linspace(1e5, 3e5, 5), mass_damping=1.0, stiffness_damping=1e-4)


@pytest.mark.parametrize("rebuilt", [False, True])
def test_a_checkpoint_needs_a_stable_step_only_for_the_present_numbers(tmp_path, rebuilt):
    """A softened body takes steps that it could not take at the start; a stiffened one no longer takes those of the start."""
    for young, dt in ((1e3, 0.2), (1e9, 1e-4)):
        scene = beam_scene(cells=(3, 1, 1))
        with ts.Simulator(scene, dt=0.02, integrator="velocity_verlet") as sim:
            if young > 1e5:
                sim.dt = dt
            sim.set_material("beam", young=young)
            sim.dt = dt
            if rebuilt:
                sim.rebuild(self_collision=True)
            started_with = sim.settings.dt
            sim.advance(3)
            sim.save_checkpoint(tmp_path / "c.npz")
            wanted, limit = kept_values(sim), sim.stable_dt
        with ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam_scene(cells=(3, 1, 1))) as sim:
            assert_same(kept_values(sim), wanted)
            assert sim.dt == dt and sim.settings.dt == started_with and sim.stable_dt == limit
