"""Statics, of linear and quadratic tets:

* the state has no force on its free axes, by the oracle's account, and is the oracle's own; reactions carry the weight and
  the loads; what fails at once is loaded in steps, what hardly deforms takes a few steps of Newton;
* led nodes stand where their path is at the time asked for, with the reactions that takes;
* what cannot be reached is told, in f32 too: converged is False, and the residual is that of the whole load;
* a body that nothing holds is refused, and so is what is no scene and no tolerance, with nothing left open.
"""

import numpy as np
import pytest
from lanes import opened
from oracle import Oracle
from scenes import SNH, SVK, cube, element, rubber

import taisoft as ts
from taisoft.backend import runtime


def hanging(young: float = 2e3, law: str = SNH, order: int = 1) -> ts.Scene:
    """A beam fixed at one end, pulled and pushed, so soft that it hangs down."""
    scene = ts.Scene(gravity=(0.0, -9.81, 1.0))
    mesh = cube(cells=(3, 1, 1), size=(2.0, 0.5, 0.5))
    beam = scene.add_body(mesh, rubber(law, young=young), name="beam", position=(5, 0, 0), **element(order))
    beam.fix(lambda X: X[:, 0] < -0.99)
    beam.add_traction(lambda X: X[:, 0] > 0.99, (500.0, 0.0, 0.0))
    beam.add_force([12, 13], (0.0, -50.0, 0.0))
    return scene


def unbalanced(scene, result) -> float:
    """|force on the free axes| / |load on the free axes|, by the oracle."""
    oracle = Oracle(scene)
    load = oracle.applied()
    left = oracle.force(result.positions()) + load
    return np.linalg.norm(left[~oracle.fixed]) / np.linalg.norm(load[~oracle.fixed])


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
    assert unbalanced(scene, result) <= 2e-9
    assert result.elastic == pytest.approx(oracle.energy(x)) and result.elastic > 1.0
    assert oracle.rest[:, 1].min() - x[:, 1].min() > 2.0  # [m] it does hang down
    assert np.array_equal(x[oracle.fixed], oracle.rest[oracle.fixed])


@pytest.mark.parametrize("order", [1, 2])
def test_load_steps_where_the_whole_load_is_too_much_at_once(order):
    scene = hanging(order=order)
    scene.gravity = 3.0 * np.array(scene.gravity)
    result = ts.solve_static(scene, tolerance=1e-9)
    assert result.converged and result.load_steps > 1 and result.load == 1.0 and result.n_inverted == 0
    assert unbalanced(scene, result) <= 2e-9


def test_it_is_the_oracles_state(solved):
    """Where dense Newton steps lead from nearby."""
    scene, result = solved
    oracle = Oracle(scene)
    x = result.positions() + 0.0005 * np.random.default_rng(0).standard_normal(oracle.rest.shape) * ~oracle.fixed
    assert np.abs(x - result.positions()).max() > 0.001  # [m]
    x = oracle.equilibrium(x, oracle.applied(), ~oracle.fixed.reshape(-1))
    assert np.abs(result.positions() - x).max() < 1e-7  # [m]; it hangs down by 20


def test_reactions_carry_the_loads(solved):
    scene, result = solved
    oracle = Oracle(scene)
    load = oracle.applied()
    assert np.abs(load.sum(axis=0)).min() > 100.0  # [N]
    assert result.reactions().sum(axis=0) == pytest.approx(-load.sum(axis=0), abs=1e-5)
    # the moment about the origin too: there is no other way to stand still
    x = result.positions()
    moment = np.cross(x, load + result.reactions()).sum(axis=0)
    assert np.abs(moment).max() < 1e-4 * np.abs(np.cross(x, load)).max()
    assert not result.reactions("beam")[~oracle.fixed.any(axis=1)].any()


def test_prescribed_nodes():
    """A block is pulled to 1.3 of its length, sideways free: uniform tension, the same force at both ends."""
    scene = ts.Scene(gravity=(0, 0, 0))
    block = scene.add_body(cube(size=(1.0, 1.0, 1.0)), rubber(SVK, poisson=0.0), name="block")
    block.fix(lambda X: X[:, 0] < -0.49)
    block.move(lambda X: X[:, 0] > 0.49, lambda t: (0.1 * t, 0.0, 0.0))
    scene.add_body(cube((4, 0, 0)), rubber(SVK), name="idle").fix([0, 1, 2])
    with opened("f64"):  # an open f64 runtime is used
        result = ts.solve_static(scene, tolerance=1e-10, time=3.0)
        assert runtime.open_kind() == ("cpu", "f64")
    assert result.converged
    x = result.positions("block")
    assert x == pytest.approx(block.rest_positions * [1.3, 1.0, 1.0] + [0.15, 0, 0], abs=1e-9)
    stress = 1e5 * 1.3 * (1.3**2 - 1) / 2  # P of St. Venant-Kirchhoff without lateral strain: F E young [Pa]
    pull = result.reactions("block")[block.rest_positions[:, 0] > 0.49].sum(axis=0)
    assert pull == pytest.approx([stress, 0, 0], rel=1e-8, abs=1e-6)
    assert result.reactions("block").sum(axis=0) == pytest.approx([0, 0, 0], abs=1e-6)
    assert result.positions("idle") == pytest.approx(scene.body("idle").rest_positions)
    assert len(result.positions()) == 16
    with pytest.raises(ts.SceneError, match="no body is called 'blok'"):
        result.positions("blok")


@pytest.mark.parametrize("push", [0.0, 1.0])
def test_where_no_force_acts_the_residual_is_zero(push):
    """A path that is 0 at t = 0, or moves the whole body: rounding over rounding is no residual."""
    scene = ts.Scene(gravity=(0, 0, 0))
    block = scene.add_body(ts.box_mesh((3, 2, 2), (1, 1, 1)), rubber(), name="block", position=(1.0, 1.0, 0.3))
    block.move(lambda X: np.abs(X[:, 0]) > 0.49, lambda t: (0.1 * t, 0.0, 0.0))
    scene.add_body(cube((4, 0, 0)), rubber(SVK), name="idle").fix([0, 1, 2])
    result = ts.solve_static(scene, time=push)
    assert result.converged and result.residual == 0.0 and result.load == 1.0
    assert result.positions("block") == pytest.approx(block.rest_positions + (1.0 + 0.1 * push, 1.0, 0.3), abs=1e-12)


def test_small_strains_whose_energy_is_rounding():
    """A step that only undoes a stretch lowers the energy by less than its rounding; 60 such steps were taken once."""
    scene = ts.Scene(gravity=(0, 0, 0))
    bar = scene.add_body(ts.box_mesh((5, 1, 1), (1, 0.1, 0.1)), rubber(SVK, young=1e6), order=2)
    bar.fix(lambda X: X[:, 0] < -0.499)
    bar.add_traction(lambda c: c[:, 0] > 0.499, (0.0, 1.0, 0.0))
    result = ts.solve_static(scene)
    assert result.converged and result.iterations < 12  # 4 measured


def test_what_cannot_be_reached_is_told():
    """St. Venant-Kirchhoff collapses under this load; a share of it that was reached is not passed off as the whole."""
    scene = hanging(young=2e4, law=SVK)
    result = ts.solve_static(scene, precision="f32")
    assert not result.converged and not result.at_rounding and result.residual > 0.1
    assert result.residual == pytest.approx(unbalanced(scene, result), rel=1e-4)
    assert runtime.open_kind() is None


def unheld(axes: str):
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="held").fix([0])
    body = scene.add_body(cube((5, 0, 0)), rubber(), name="loose")
    for axis in axes:
        body.fix([0], axes=axis)
    return scene


@pytest.mark.parametrize(
    "scene, settings, words",
    [
        (unheld(""), {}, "body 'loose': nothing holds it along xyz, so it has no static state"),
        (unheld("y"), {}, "body 'loose': nothing holds it along xz"),
        (ts.Scene(), {}, "solve_static needs a Scene that holds a body"),
        ("beam", {}, "solve_static needs a Scene that holds a body"),
        (hanging(), {"tolerance": 0.0}, "tolerance = 0.0: it must lie between 0 and 1"),
        (hanging(), {"tolerance": "1e-6"}, "tolerance = '1e-6'"),
    ],
)
def test_what_is_refused(scene, settings, words):
    with pytest.raises(ts.SceneError, match=words):
        ts.solve_static(scene, **settings)
    assert runtime.open_kind() is None


def test_another_precision_while_a_simulator_is_open():
    with opened("f32"), pytest.raises(ts.SimulationError, match=r"a test is open with arch 'cpu' and precision 'f32'"):
        ts.solve_static(hanging())
