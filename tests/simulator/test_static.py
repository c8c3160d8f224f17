"""Statics, of linear and quadratic tets:

* the state is the oracle's equilibrium; reactions balance the weight and the loads; a load that is too large for one solve is
  applied in steps; small strains take few Newton iterations;
* prescribed nodes are on their path at the given time, with the reactions that takes;
* if no equilibrium is found, converged is False and the residual is that of the whole load;
* unconstrained bodies and invalid arguments are rejected, and the runtime is closed.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from tests.backend.lanes import opened
from tests.dynamics.scenes import SNH, SVK, cube, element, rubber
from tests.fem.oracle import Oracle


def hanging(young: float = 2e3, law: str = SNH, order: int = 1) -> ts.Scene:
    """A loaded cantilever, so soft that it hangs down."""
    scene = ts.Scene(gravity=(0.0, -9.81, 1.0))
    mesh = cube(cells=(3, 1, 1), size=(2.0, 0.5, 0.5))
    beam = scene.add_body(mesh, rubber(law, young=young), name="beam", position=(5, 0, 0), **element(order))
    beam.fix(lambda X: X[:, 0] < -0.99)
    beam.add_traction(lambda X: X[:, 0] > 0.99, (500.0, 0.0, 0.0))
    beam.add_force([12, 13], (0.0, -50.0, 0.0))
    return scene


def oracle_residual(scene, result) -> float:
    """|net force on the free axes| / |load on the free axes|."""
    oracle = Oracle(scene)
    load = oracle.applied()
    net = oracle.force(result.positions()) + load
    return np.linalg.norm(net[~oracle.fixed]) / np.linalg.norm(load[~oracle.fixed])


@pytest.fixture(scope="module", params=[1, 2])
def solved(request):
    scene = hanging(order=request.param)
    return scene, ts.solve_static(scene, tolerance=1e-9)


def test_equilibrium(solved):
    scene, result = solved
    oracle = Oracle(scene)
    x = result.positions("beam")
    assert result.converged and result.residual <= 1e-9 and result.n_inverted == 0
    assert 30 < result.iterations < 500 and result.linear_iterations > result.iterations
    assert oracle_residual(scene, result) <= 2e-9
    assert result.elastic == pytest.approx(oracle.energy(x)) and result.elastic > 1.0
    assert oracle.rest[:, 1].min() - x[:, 1].min() > 2.0  # [m] the tip hangs down
    assert np.array_equal(x[oracle.fixed], oracle.rest[oracle.fixed])


@pytest.mark.parametrize("order", [1, 2])
def test_large_load_is_applied_in_steps(order):
    scene = hanging(order=order)
    scene.gravity = 3.0 * np.array(scene.gravity)
    result = ts.solve_static(scene, tolerance=1e-9)
    assert result.converged and result.load_steps > 1 and result.load == 1.0 and result.n_inverted == 0
    assert oracle_residual(scene, result) <= 2e-9


def test_positions_match_the_oracles_equilibrium(solved):
    """The oracle's Newton iterations start nearby."""
    scene, result = solved
    oracle = Oracle(scene)
    x = result.positions() + 0.0005 * np.random.default_rng(0).standard_normal(oracle.rest.shape) * ~oracle.fixed
    assert np.abs(x - result.positions()).max() > 0.001  # [m]
    x = oracle.equilibrium(x, oracle.applied(), ~oracle.fixed.reshape(-1))
    assert np.abs(result.positions() - x).max() < 1e-7  # [m]; it hangs down by 20


def test_reactions_balance_the_loads(solved):
    scene, result = solved
    oracle = Oracle(scene)
    load = oracle.applied()
    assert np.abs(load.sum(axis=0)).min() > 100.0  # [N]
    assert result.reactions().sum(axis=0) == pytest.approx(-load.sum(axis=0), abs=1e-5)
    # and so do the moments about the origin
    x = result.positions()
    moment = np.cross(x, load + result.reactions()).sum(axis=0)
    assert np.abs(moment).max() < 1e-4 * np.abs(np.cross(x, load)).max()
    assert not result.reactions("beam")[~oracle.fixed.any(axis=1)].any()


def test_prescribed_nodes():
    """A block stretched to 1.3 times its length, laterally free: uniform tension, equal and opposite forces at both ends."""
    scene = ts.Scene(gravity=(0, 0, 0))
    block = scene.add_body(cube(size=(1.0, 1.0, 1.0)), rubber(SVK, poisson=0.0), name="block")
    block.fix(lambda X: X[:, 0] < -0.49)
    block.move(lambda X: X[:, 0] > 0.49, lambda t: (0.1 * t, 0.0, 0.0))
    scene.add_body(cube((4, 0, 0)), rubber(SVK), name="idle").fix([0, 1, 2])
    with opened("f64"):  # solve_static uses the open runtime
        result = ts.solve_static(scene, tolerance=1e-10, time=3.0)
        assert runtime.open_kind() == ("cpu", "f64")
    assert result.converged
    x = result.positions("block")
    assert x == pytest.approx(block.rest_positions * [1.3, 1.0, 1.0] + [0.15, 0, 0], abs=1e-9)
    stress = 1e5 * 1.3 * (1.3**2 - 1) / 2  # P of St. Venant-Kirchhoff without lateral strain: F E young [Pa]
    force = result.reactions("block")[block.rest_positions[:, 0] > 0.49].sum(axis=0)
    assert force == pytest.approx([stress, 0, 0], rel=1e-8, abs=1e-6)
    assert result.reactions("block").sum(axis=0) == pytest.approx([0, 0, 0], abs=1e-6)
    assert result.positions("idle") == pytest.approx(scene.body("idle").rest_positions)
    assert len(result.positions()) == 16
    with pytest.raises(ts.SceneError, match="no body is called 'blok'"):
        result.positions("blok")


@pytest.mark.parametrize("time", [0.0, 1.0])
def test_residual_is_zero_without_forces(time):
    """A path that is 0 at t = 0, or moves the whole body: the residual must not be the ratio of two rounding errors."""
    scene = ts.Scene(gravity=(0, 0, 0))
    block = scene.add_body(ts.box_mesh((3, 2, 2), (1, 1, 1)), rubber(), name="block", position=(1.0, 1.0, 0.3))
    block.move(lambda X: np.abs(X[:, 0]) > 0.49, lambda t: (0.1 * t, 0.0, 0.0))
    scene.add_body(cube((4, 0, 0)), rubber(SVK), name="idle").fix([0, 1, 2])
    result = ts.solve_static(scene, time=time)
    assert result.converged and result.residual == 0.0 and result.load == 1.0
    assert result.positions("block") == pytest.approx(block.rest_positions + (1.0 + 0.1 * time, 1.0, 0.3), abs=1e-12)


def test_small_strains_converge_in_few_iterations():
    """The energy falls by less than its rounding from one iteration to the next."""
    scene = ts.Scene(gravity=(0, 0, 0))
    bar = scene.add_body(ts.box_mesh((5, 1, 1), (1, 0.1, 0.1)), rubber(SVK, young=1e6), order=2)
    bar.fix(lambda X: X[:, 0] < -0.499)
    bar.add_traction(lambda c: c[:, 0] > 0.499, (0.0, 1.0, 0.0))
    result = ts.solve_static(scene)
    assert result.converged and result.iterations < 12  # 4 measured


def test_unreachable_equilibrium_is_reported():
    """St. Venant-Kirchhoff collapses under this load; the residual is that of the whole load, not of the part reached."""
    scene = hanging(young=2e4, law=SVK)
    result = ts.solve_static(scene, precision="f32")
    assert not result.converged and not result.at_rounding and result.residual > 0.1
    assert result.residual == pytest.approx(oracle_residual(scene, result), rel=1e-4)
    assert runtime.open_kind() is None


def partly_fixed(axes: str) -> ts.Scene:
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="fixed").fix([0])
    body = scene.add_body(cube((5, 0, 0)), rubber(), name="loose")
    for axis in axes:
        body.fix([0], axes=axis)
    return scene


@pytest.mark.parametrize(
    "scene, settings, message",
    [
        (partly_fixed(""), {}, "body 'loose': nothing holds it along xyz, so it has no static state"),
        (partly_fixed("y"), {}, "body 'loose': nothing holds it along xz"),
        (ts.Scene(), {}, "solve_static needs a Scene that holds a body"),
        ("beam", {}, "solve_static needs a Scene that holds a body"),
        (hanging(), {"tolerance": 0.0}, "tolerance = 0.0: it must lie between 0 and 1"),
        (hanging(), {"tolerance": "1e-6"}, "tolerance = '1e-6'"),
    ],
)
def test_invalid_arguments_are_rejected(scene, settings, message):
    with pytest.raises(ts.SceneError, match=message):
        ts.solve_static(scene, **settings)
    assert runtime.open_kind() is None


def test_open_runtime_of_another_precision_is_rejected():
    with opened("f32"), pytest.raises(ts.SimulationError, match=r"a test is open with arch 'cpu' and precision 'f32'"):
        ts.solve_static(hanging())
