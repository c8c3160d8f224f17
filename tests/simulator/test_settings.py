"""Settings of a simulator, and `rebuild` with others: bad ones are refused before a runtime is opened; a rebuilt simulator
keeps its state bit for bit, and its next step is that of a new simulator; what is modelled follows from the scene at the start.
"""

import dataclasses
import inspect
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.errors import SimulationError
from taisoft.settings import NAMES, Settings, check_dt
from tests.dynamics.scenes import RELEASE, block_scene, driven_scene
from tests.simulator.scenes import DT, pair, pressed, simulator

EXPLICIT_SOLVERS = "gauss_seidel or jacobi or hybrid or coloured_gauss_seidel"


def test_bad_settings_are_refused():
    for settings, message in (
        ({"dt": 0}, "^dt must be greater than 0 s, not 0$"),
        ({"dt": True}, "dt must be a number, not True"),
        ({"integrator": "simplectic_euler"}, "integrator must be one of .* 'simplectic_euler'; did you mean 'symplectic_euler'"),
        ({"precision": "f16"}, "precision must be one of f32, f64, not 'f16'"),
        ({"arch": "gpu"}, "arch must be one of cpu, cuda, not 'gpu'"),
        ({"newton_tolerance": 0.5}, "newton_tolerance must be below 0.1"),
        ({"tolerance": 1.0}, "tolerance must be below 1"),
        ({"budget": -1e-3}, "budget must be at least 0 s"),
        ({"budget": 0.01, "tolerance": 0.01}, "a budget ends steps at any error, and a tolerance bounds the error"),
        ({"allow_unstable": 1}, "allow_unstable must be True or False"),
        ({"contact_solver": "gauss_siedel"}, "contact_solver must be one of .*, not 'gauss_siedel'; did you mean 'gauss_seidel'"),
        ({"contact_solver": "gauss_seidel"}, "'gauss_seidel' does not fit implicit_euler: use 'auto' or augmented_lagrangian$"),
        ({"contact_solver": "augmented_lagrangian", "integrator": "symplectic_euler"}, f"use 'auto' or {EXPLICIT_SOLVERS}$"),
        ({"contact_solver": "jacobi", "integrator": "implicit_midpoint"}, "does not fit implicit_midpoint: use 'auto'$"),
        ({"integrator": "implicit_midpoint", "self_collision": True}, "midpoint does not support contacts: .* use bdf2, "),
    ):
        with pytest.raises(ts.SimulationError, match=message):
            ts.Simulator(block_scene(), **settings)
    for bad, message in ((ts.Scene(), "the scene holds no body"), ("beam.py", "scene must be a Scene, not str")):
        with pytest.raises(ts.SceneError, match=message):
            ts.Simulator(bad)
    scene = block_scene()
    scene.add_tendon([("block", 0), ("block", 1)], length=2.0, name="rope")
    message = "tendon 'rope' of given length without a stiffness needs integrator implicit_euler or bdf2"
    for settings in ({"dt": 1e-4, "integrator": "velocity_verlet"}, {"tolerance": 0.01}):
        with pytest.raises(ts.SimulationError, match=message):
            ts.Simulator(scene, **settings)
    assert runtime.open_kind() is None


def test_defaults_are_those_of_the_simulators_signature():
    parameters = inspect.signature(ts.Simulator).parameters
    assert {name: parameters[name].default for name in NAMES} == dataclasses.asdict(Settings())
    assert list(parameters) == ["scene", *NAMES] and type(check_dt(1)) is float
    with ts.Simulator(block_scene(), newton_tolerance=np.float32(1e-3), precision="f64") as sim:
        assert type(sim.settings.newton_tolerance) is float


def test_a_budget_is_assigned_and_kept(tmp_path):
    with ts.Simulator(block_scene(), precision="f64", budget=np.float32(0.5)) as sim:
        assert sim.budget == 0.5 and type(sim.budget) is float
        sim.budget = 2
        with pytest.raises(ts.SimulationError, match="budget must be at least 0 s, not -1"):
            sim.budget = -1
        sim.rebuild(newton_tolerance=1e-6)
        assert sim.budget == sim.settings.budget == 2.0
        sim.save_checkpoint(tmp_path / "checkpoint.npz")
        with pytest.raises(ts.SimulationError, match="take one of them"):
            sim.rebuild(tolerance=0.01)
        sim.budget = None
        assert sim.settings.budget is None
    with ts.Simulator.load_checkpoint(tmp_path / "checkpoint.npz", block_scene()) as sim:
        assert sim.budget == 2.0


def test_an_overlap_at_the_start_is_refused_and_leaves_nothing_open(monkeypatch):
    scene = block_scene(ground=True)
    found = SimpleNamespace(name_a="block", name_b="ground", depth=0.0123)
    monkeypatch.setattr(ts.Simulator, "deepest_overlap", lambda sim: found)
    with pytest.raises(ts.SceneError, match="'block' and 'ground' overlap at the start, 0.0123 m deep: move"):
        ts.Simulator(scene, precision="f64")
    assert runtime.open_kind() is None
    scene.allow_initial_overlap = True
    ts.Simulator(scene, precision="f64").close()


def kept_values(sim) -> tuple:
    """Everything that `rebuild` keeps."""
    return sim.positions(), sim.velocities(), sim.time, sim.step_count, sim.energies()


def assert_same(a: tuple, b: tuple) -> None:
    assert np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1]) and a[2:] == b[2:]


def test_state_is_kept_and_the_next_step_is_that_of_a_new_simulator():
    scene = pair()
    with ts.Simulator(scene, DT, "velocity_verlet", precision="f64") as sim:
        sim.advance(20)
        sim.set_gravity((0.0, -5.0, 1.0))
        sim.set_material("beam", young=2e4)
        before = kept_values(sim)
        sim.rebuild(integrator="implicit_euler", dt=0.01)
        assert_same(kept_values(sim), before)
        with ts.Simulator(sim.scene.snapshot(), 0.01, precision="f64") as other:
            other.set_state(positions=before[0], velocities=before[1])
            other.step()
            expected = other.positions(), other.velocities()
        report = sim.step()
        assert np.array_equal(sim.positions(), expected[0]) and np.array_equal(sim.velocities(), expected[1])
        assert sim.time == before[2] + 0.01 and sim.step_count == 21 and report.newton_iterations > 0
        sim.reset()
        assert sim.time == 0.0 and np.array_equal(sim.positions("beam"), scene.bodies[0].rest_positions + (1, 2, 0))


def test_released_nodes_stay_free(tmp_path):
    """Numbers of the start decide what is modelled, and loads changed to values and damping changed to 0 stay modelled."""
    scene = driven_scene(mass_damping=0.5, stiffness_damping=1e-4)
    with ts.Simulator(scene, 2e-4, "velocity_verlet", precision="f64") as sim:
        while sim.time < RELEASE + 0.002:
            sim.advance(10)
        sim.set_material("beam", mass_damping=0.0)
        sim.set_force("beam", 0, (1.0, 2.0, 3.0))
        before, features = kept_values(sim), sim.plan.on
        sim.rebuild(self_collision=False, dt=1e-4)
        assert_same(kept_values(sim), before)
        assert sim.plan.on == features and features["mass_damping"]
        sim.set_material("beam", mass_damping=1.0)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.advance(5)
        after = kept_values(sim)
    assert np.abs(after[0][8:10] - before[0][8:10]).max() > 1e-6
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene) as sim:
        assert sim.dt == 1e-4
        sim.advance(5)
        assert_same(kept_values(sim), after)


@pytest.mark.parametrize("integrator", ["implicit_euler", "symplectic_euler"])
def test_contacts_can_be_turned_on(integrator):
    """In a scene where nothing could touch before."""
    with ts.Simulator(block_scene(), 1e-3, integrator) as sim:
        sim.advance(3)
        before = kept_values(sim)
        sim.rebuild(self_collision=True)
        assert_same(kept_values(sim), before)
        assert sim.step().n_contacts == 0


def test_refused_settings_change_nothing():
    with pressed() as sim:
        before, settings, scene, sizes = kept_values(sim), sim.settings, sim.scene, sim.field_bytes
        for changes, message in (
            ({"integrator": "implicit_midpoint"}, "implicit_midpoint does not support contacts"),
            ({"integrator": "symplectic_euler", "dt": 0.1}, "above the estimated stability limit"),
            ({"contact_solver": "jacobi"}, "does not fit bdf2"),
            ({"precision": "f32"}, "is open"),
            ({"dt": -1.0}, "dt must be greater than 0 s"),
        ):
            with pytest.raises(SimulationError, match=message):
                sim.rebuild(**changes)
            assert_same(kept_values(sim), before)
        assert sim.settings is settings and sim.scene is scene and sim.field_bytes == sizes


@pytest.mark.parametrize("young, dt", [(1e3, 0.02), (1e7, 1e-4)])
def test_a_checkpoint_needs_a_stable_step_only_for_the_present_numbers(tmp_path, young, dt):
    """A softened body takes steps that it could not take at the start; a stiffened one no longer takes those of the start."""
    with simulator("velocity_verlet") as sim:
        sim.dt = min(dt, sim.dt)
        for body in sim.scene.bodies:
            sim.set_material(body.name, young=young)
        sim.dt = dt
        sim.rebuild(draggable=False)
        started_with = sim.settings.dt
        sim.advance(3)
        sim.save_checkpoint(tmp_path / "c.npz")
        wanted, limit, scene = kept_values(sim), sim.stable_dt, pair("st_venant_kirchhoff", 0.5)
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene) as sim:
        assert_same(kept_values(sim), wanted)
        assert sim.dt == dt and sim.settings.dt == started_with and sim.stable_dt == limit
