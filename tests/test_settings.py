"""Every argument of a Simulator is checked before anything is opened: one sentence that names the argument and the rule."""

import dataclasses
import inspect

import numpy as np
import pytest
from scenes import cube, rubber

import taisoft as ts
from taisoft.backend import runtime
from taisoft.settings import NAMES, Settings, check_dt


def scene() -> ts.Scene:
    made = ts.Scene()
    made.add_body(cube(), rubber(), name="block")
    return made


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"dt": 0}, "^dt must be greater than 0 s, not 0$"),
        ({"dt": -0.01}, "dt must be greater than 0 s, not -0.01"),
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
        ({"newton_tolerance": 2.0}, "newton_tolerance must be below 0.1"),
        ({"linear_tolerance": -1e-3}, "linear_tolerance must be greater than 0, not -0.001"),
        ({"linear_tolerance": np.nan}, "linear_tolerance must be finite"),
        ({"linear_tolerance": True}, "linear_tolerance must be a number"),
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
        ({"contact_tolerance": True}, "contact_tolerance must be a number"),
    ],
)
def test_bad_settings(settings, words):
    with pytest.raises(ts.SimulationError, match=words):
        ts.Simulator(scene(), **settings)
    assert runtime.open_kind() is None


@pytest.mark.parametrize("what, words", [(ts.Scene(), "the scene holds no body"), ("beam.py", "scene must be a Scene, not str")])
def test_bad_scenes(what, words):
    with pytest.raises(ts.SceneError, match=words):
        ts.Simulator(what)
    assert runtime.open_kind() is None


def test_the_defaults_are_those_of_the_signature():
    parameters = inspect.signature(ts.Simulator).parameters
    assert {name: parameters[name].default for name in NAMES} == dataclasses.asdict(Settings())
    assert list(parameters) == ["scene", *NAMES]


def test_dt_becomes_a_float():
    assert type(check_dt(1)) is float and check_dt(np.float64(0.25)) == 0.25


def test_an_integrator_without_contacts_is_refused_where_something_can_touch():
    touching = scene()
    touching.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
    with pytest.raises(ts.SimulationError, match="implicit_midpoint does not support contacts: its stage lies in the middle"):
        ts.Simulator(touching, integrator="implicit_midpoint")
    assert runtime.open_kind() is None
    ts.Simulator(scene(), dt=1e-3, integrator="implicit_midpoint").close()


@pytest.mark.parametrize("integrator, solver", [("symplectic_euler", "jacobi"), ("bdf2", "augmented_lagrangian")])
def test_solvers_and_tolerances_that_fit_are_taken(integrator, solver):
    """Also by a scene in which nothing can touch."""
    asked = {"dt": 1e-3, "integrator": integrator, "contact_solver": solver, "contact_tolerance": 1e-3}
    with ts.Simulator(scene(), **asked) as sim:
        assert sim.settings.contact_solver == solver and sim.settings.contact_tolerance == 1e-3
    touching = scene()
    touching.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
    touching.allow_initial_overlap = True  # without a search for it
    with ts.Simulator(touching, **asked) as sim:
        assert sim._dynamics.stepper.contact_tolerance == 1e-3 and getattr(sim._dynamics.stepper, "method", solver) == solver
