"""Statics: the state is the oracle's equilibrium; large loads are applied in steps; the residual is that of the whole load;
bodies that nothing holds and invalid arguments are refused.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from tests.backend.lanes import opened
from tests.dynamics.scenes import cube, rubber
from tests.fem.oracle import Oracle


def hanging(young: float = 2e3, load: float = 1.0, path=lambda t: (0.1 * t, 0.0, 0.0)) -> ts.Scene:
    """A loaded cantilever, so soft that it hangs down, and a block that is stretched along a path."""
    scene = ts.Scene(gravity=(0.0, -9.81 * load, load))
    scene.contact_forces = False
    mesh = cube(cells=(3, 1, 1), size=(2.0, 0.5, 0.5))
    beam = scene.add_body(mesh, rubber(young=young), name="beam", position=(5, 0, 0))
    beam.fix(lambda X: X[:, 0] < -0.99)
    beam.add_traction(lambda X: X[:, 0] > 0.99, (500.0 * load, 0.0, 0.0))
    beam.add_force([12, 13], (0.0, -50.0 * load, 0.0))
    block = scene.add_body(cube(size=(1.0, 1.0, 1.0)), rubber(poisson=0.0), name="block", position=(0, 0, 5))
    block.fix(lambda X: X[:, 0] < -0.49)
    block.move(lambda X: X[:, 0] > 0.49, path)
    return scene


def oracle_residual(scene, result, time: float) -> float:
    """|net force on the free axes| / |load on the free axes|."""
    oracle = Oracle(scene)
    held, load = oracle.fixed | oracle.targets(time)[1], oracle.applied()
    net = oracle.force(result.positions()) + load
    return np.linalg.norm(net[~held]) / np.linalg.norm(load[~held])


def test_equilibrium():
    scene = hanging()
    with opened("f64"):  # solve_static uses the open runtime
        result = ts.solve_static(scene, tolerance=1e-9, time=3.0)
        assert runtime.open_kind() == ("cpu", "f64")
    oracle, x = Oracle(scene), result.positions()
    where, prescribed = oracle.targets(3.0)
    held, load = oracle.fixed | prescribed, oracle.applied()
    assert result.converged and result.residual <= 1e-9 and result.n_inverted == 0 and result.load == 1.0
    assert 10 < result.iterations < 500 and result.linear_iterations > result.iterations
    assert oracle_residual(scene, result, 3.0) <= 2e-9
    assert result.elastic == pytest.approx(oracle.energy(x)) and result.elastic > 1.0
    assert x[:, 1].min() < -2.0 and np.array_equal(x[oracle.fixed], oracle.rest[oracle.fixed])
    assert x[prescribed] == pytest.approx(where[prescribed], abs=1e-12) and np.ptp(result.positions("block")[:, 0]) == 1.3
    # the oracle's Newton iterations start nearby
    start = x + 0.0005 * np.random.default_rng(0).standard_normal(x.shape) * ~held
    assert np.abs(x - oracle.equilibrium(start, load, ~held.reshape(-1))).max() < 1e-7  # [m]
    # reactions balance loads and moments about the origin
    assert result.reactions().sum(axis=0) == pytest.approx(-load.sum(axis=0), abs=1e-4)
    moment = np.cross(x, load + result.reactions()).sum(axis=0)
    assert np.abs(moment).max() < 1e-4 * np.abs(np.cross(x, load)).max()
    assert not result.reactions("beam")[~oracle.fixed[:16].any(axis=1)].any() and len(result.reactions("block")) == 8
    with pytest.raises(ts.SceneError, match="no body is called 'blok'"):
        result.positions("blok")


def test_large_loads_are_applied_in_steps_and_small_strains_at_once():
    """At small strains the energy falls by less than its rounding from one iteration to the next."""
    scene = hanging(load=40.0)
    result = ts.solve_static(scene, tolerance=1e-9)
    assert result.converged and result.load == 1.0 and result.n_inverted == 0
    assert oracle_residual(scene, result, 0.0) <= 2e-9
    result = ts.solve_static(hanging(young=1e9))
    assert result.converged and result.iterations < 12 and result.load_steps == 1


@pytest.mark.parametrize("time", [0.0, 1.0])
def test_residual_is_zero_without_forces(time):
    """A path that is 0 at t = 0, or moves the whole body: the residual must not be the ratio of two rounding errors."""
    scene = hanging(load=0.0)
    block = scene.body("block")
    block.remove(*block.constraints)
    block.move(lambda X: np.abs(X[:, 0]) > 0.49, lambda t: (0.1 * t, 0.0, 0.0))
    result = ts.solve_static(scene, time=time)
    assert result.converged and result.residual == 0.0 and result.load == 1.0
    assert result.positions("block") == pytest.approx(block.rest_positions + (0.1 * time, 0.0, 5.0), abs=1e-12)


def test_unreachable_equilibrium_is_reported():
    """Nodes that are moved through the block's other side invert it: no path leads to the balance of forces there."""
    scene = hanging(path=lambda t: (-2.0 * t, 0.0, 0.0))
    result = ts.solve_static(scene, time=1.0)
    assert not result.converged and result.load < 1.0 and result.n_inverted > 0
    assert any("tets were inverted" in problem for problem in result.problems)
    assert runtime.open_kind() is None


def partly_fixed(axes: str) -> ts.Scene:
    scene = ts.Scene()
    scene.contact_forces = False
    scene.add_body(cube(), rubber(), name="fixed").fix([0])
    body = scene.add_body(cube((5, 0, 0)), rubber(), name="loose")
    for axis in axes:
        body.fix([0], axes=axis)
    return scene


def test_invalid_arguments_are_rejected():
    for scene, settings, message in (
        (partly_fixed(""), {}, "body 'loose': nothing holds it along xyz, so it has no static state"),
        (partly_fixed("y"), {}, "body 'loose': nothing holds it along xz"),
        (ts.Scene(), {}, "solve_static needs a Scene that holds a body"),
        (hanging(), {"tolerance": 0.0}, "tolerance must be greater than 0 and below 0.1, not 0.0"),
        (hanging(), {"time": np.nan}, "time must be finite"),
    ):
        with pytest.raises(ts.SceneError, match=message):
            ts.solve_static(scene, **settings)
    assert runtime.open_kind() is None
    with opened("f64"), pytest.raises(ts.SimulationError, match=r"a test is open with arch 'cpu' and precision 'f64'"):
        ts.solve_static(hanging(), precision="f32")
