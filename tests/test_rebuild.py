"""`Simulator.rebuild` continues with other settings:

* positions, velocities, time, steps, changed numbers and released nodes are kept bit for bit, and the next step is that of a new
  simulator with those settings and that state;
* settings that cannot be met are refused with a new simulator's message, and nothing changes;
* the memory of the previous settings is released.
"""

import gc

import numpy as np
import pytest
from checkpoint_scenes import cubes
from fake_simulator import beam_scene
from scenes import RELEASE, driven_scene

import taisoft as ts
from taisoft.backend import runtime
from taisoft.backend.arrays import LanePool
from taisoft.errors import SimulationError


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
