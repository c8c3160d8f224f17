"""Every argument of a Simulator is checked before a runtime is opened; the message names the argument and the rule."""

import dataclasses
import inspect

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.settings import NAMES, Settings, check_dt
from tests.dynamics.scenes import block_scene, dynamics


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"dt": 0}, "^dt must be greater than 0 s, not 0$"),
        ({"dt": np.nan}, "dt must be finite, not nan"),
        ({"dt": np.inf}, "dt must be finite, not inf"),
        ({"dt": "0.01"}, "dt must be a number, not '0.01'"),
        ({"dt": True}, "dt must be a number, not True"),
        ({"integrator": "simplectic_euler"}, "integrator 'simplectic_euler' is unknown .*did you mean 'symplectic_euler'"),
        ({"integrator": None}, "integrator must be a text, not None"),
        ({"precision": "f16"}, "precision must be one of f32, f64, not 'f16'"),
        ({"arch": "gpu"}, "arch must be one of cpu, cuda, not 'gpu'"),
        ({"newton_tolerance": 0}, "newton_tolerance must be greater than 0, not 0"),
        ({"newton_tolerance": 0.5}, "newton_tolerance must be below 0.1"),
        ({"linear_tolerance": -1e-3}, "linear_tolerance must be greater than 0, not -0.001"),
        ({"linear_tolerance": np.nan}, "linear_tolerance must be finite"),
        ({"allow_unstable": 1}, "allow_unstable must be True or False"),
        ({"contact_solver": "gauss_siedel"}, "contact_solver 'gauss_siedel' is unknown .*did you mean 'gauss_seidel'"),
        ({"contact_solver": None}, "contact_solver must be a text, not None"),
        ({"contact_solver": "gauss_seidel"}, "'gauss_seidel' does not fit implicit_euler: use 'auto' or augmented_lagrangian$"),
        (
            {"contact_solver": "augmented_lagrangian", "integrator": "symplectic_euler"},
            "does not fit symplectic_euler: use 'auto' or gauss_seidel or jacobi or hybrid or coloured_gauss_seidel$",
        ),
        (
            {"contact_solver": "augmented_lagrangian", "integrator": "implicit_midpoint"},
            "does not fit implicit_midpoint: use 'auto'$",
        ),
        ({"integrator": "implicit_midpoint", "self_collision": True}, "midpoint does not support contacts: .* use bdf2, "),
        ({"self_collision": 1}, "self_collision must be True or False"),
        ({"contact_tolerance": 0.0}, "contact_tolerance must be greater than 0"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ts.SimulationError, match=message):
        ts.Simulator(block_scene(), **settings)
    assert runtime.open_kind() is None


@pytest.mark.parametrize("bad, message", [(ts.Scene(), "the scene holds no body"), ("beam.py", "scene must be a Scene, not str")])
def test_bad_scenes_are_refused(bad, message):
    with pytest.raises(ts.SceneError, match=message):
        ts.Simulator(bad)
    assert runtime.open_kind() is None


def test_defaults_are_those_of_the_simulators_signature():
    parameters = inspect.signature(ts.Simulator).parameters
    assert {name: parameters[name].default for name in NAMES} == dataclasses.asdict(Settings())
    assert list(parameters) == ["scene", *NAMES]


def test_dt_becomes_a_float():
    assert type(check_dt(1)) is float and check_dt(np.float64(0.25)) == 0.25


def test_an_integrator_without_contacts_is_refused_if_something_can_touch():
    with pytest.raises(ts.SimulationError, match="implicit_midpoint does not support contacts: its stage lies in the middle"):
        ts.Simulator(block_scene(ground=True), integrator="implicit_midpoint")
    assert runtime.open_kind() is None
    ts.Simulator(block_scene(), dt=1e-3, integrator="implicit_midpoint").close()


@pytest.mark.parametrize("integrator, solver", [("symplectic_euler", "jacobi"), ("bdf2", "augmented_lagrangian")])
def test_valid_contact_settings_are_used(integrator, solver):
    """They are accepted by a scene without contacts, too."""
    settings = {"dt": 1e-3, "integrator": integrator, "contact_solver": solver, "contact_tolerance": 1e-3}
    with ts.Simulator(block_scene(), **settings) as sim:
        assert sim.settings.contact_solver == solver and sim.settings.contact_tolerance == 1e-3
    with dynamics(block_scene(ground=True), **settings) as made:
        assert made.stepper.contact_tolerance == 1e-3 and getattr(made.stepper, "method", solver) == solver


def test_tolerances_become_floats(tmp_path):
    with ts.Simulator(block_scene(), newton_tolerance=np.float32(1e-3)) as sim:
        assert type(sim.settings.newton_tolerance) is float
        sim.save_checkpoint(tmp_path / "c.npz")


def test_a_warning_of_an_unstable_dt_names_the_line_of_the_caller():
    with pytest.warns(UserWarning, match="stability limit") as found:
        sim = ts.Simulator(block_scene(), 1.0, "symplectic_euler", allow_unstable=True)
    with sim, pytest.warns(UserWarning, match="stability limit") as later:
        sim.dt = 0.5
        sim.set_material("block", young=2e6)
    assert {warning.filename for warning in (*found, *later) if "stability limit" in str(warning.message)} == {__file__}
    assert len(later) == 2


def test_an_overlap_check_that_fails_leaves_nothing_open(monkeypatch):
    def fail(_detection):
        raise ts.MeshError("no distance field")

    monkeypatch.setattr("taisoft.collision.overlap.find_overlaps", fail)
    touching = block_scene()
    touching.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
    with pytest.raises(ts.MeshError, match="no distance field"):
        ts.Simulator(touching)
    assert runtime.open_kind() is None
