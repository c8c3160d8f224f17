"""Linear vibration about the rest shape, with elements of both orders:

* the stiffness at rest is Hooke's for every law; the highest frequency and the modes agree with dense algebra;
* a free body has six rigid motions, mode shapes have unit modal mass, fixed axes do not move;
* at 0.98 `stable_dt` a small vibration stays small and at 1.1 `stable_dt` it explodes, for both explicit integrators, with
  and without either kind of damping;
* the simulator rejects a dt above the limit, or warns if allowed; a stiffer material is rejected too;
* a run that diverges stops while numbers are finite.
"""

import re
from functools import partial

import numpy as np
import pytest
import scipy.linalg as la

import taisoft as ts
from taisoft.backend import runtime
from taisoft.stability import highest_frequency, hooke_differential, hooke_stiffness, stable_dt
from tests.dynamics.scenes import COR, SNH, SVK, cube, element, rubber
from tests.fem.oracle import Oracle

KINDS = ((1, None), (2, 2), (2, 4))  # order, degree of the quadrature


def one_body(material=None, cells=(2, 1, 1), constrained: bool = False, order: int = 1, degree: int | None = None) -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(cube(cells=cells), material or rubber(), name="block", **element(order, degree))
    if constrained:
        body.fix(lambda X: X[:, 0] < -0.49)
        body.fix([10], axes="y")
    return scene


def dense(scene, mass: str = "lumped") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stiffness, mass (3n,3n) and free axes (3n,)."""
    oracle = Oracle(scene)
    M = oracle.consistent if mass == "consistent" else oracle.inertia(explicit=True)
    return oracle.stiffness(oracle.rest), np.kron(M, np.eye(3)), ~oracle.fixed.reshape(-1)


@pytest.mark.parametrize("order, degree", KINDS)
@pytest.mark.parametrize("law", [SVK, COR, SNH])
def test_stiffness_at_rest_is_hookes(law, order, degree):
    scene = one_body(rubber(law, poisson=0.4), order=order, degree=degree)
    K = dense(scene)[0]
    body = scene.bodies[0]
    assert np.abs(hooke_stiffness(body).toarray() - K).max() < 1e-12 * np.abs(K).max()
    v = np.random.default_rng(0).standard_normal((body.n_nodes, 3))
    assert np.abs(hooke_differential(body)(v) - (K @ v.reshape(-1)).reshape(-1, 3)).max() < 1e-11 * np.abs(K).max()


@pytest.mark.parametrize("order, cells", [(1, (2, 1, 1)), (1, (4, 3, 3)), (2, (1, 1, 1)), (2, (3, 2, 2))])
@pytest.mark.parametrize("constrained", [False, True])
def test_highest_frequency_matches_dense_algebra(order, cells, constrained):
    """By dense algebra for a small body, by Lanczos for a larger one; overestimated by at most 1 %."""
    scene = one_body(cells=cells, constrained=constrained, order=order)
    K, M, free = dense(scene)
    exact = np.sqrt(la.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True)[-1])
    assert exact < highest_frequency(scene.bodies[0]) < 1.01 * exact
    assert stable_dt(scene, verlet=False) == pytest.approx(2 / exact, rel=0.01)
    assert stable_dt(scene, verlet=True) == stable_dt(scene, verlet=False)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize(
    "order, degree, cells", [(1, None, (2, 1, 1)), (1, None, (6, 3, 3)), (2, 4, (2, 1, 1)), (2, 2, (3, 2, 2))]
)
def test_modes_match_dense_algebra(mass, order, degree, cells):
    """Dense for a small body, by shift-invert Lanczos for a larger one."""
    scene = one_body(rubber(density=700.0), cells, constrained=True, order=order, degree=degree)
    K, M, free = dense(scene, mass)
    assert M.sum() == pytest.approx(3 * 700 * 0.99)
    expected = np.sqrt(la.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True)[:5]) / (2 * np.pi)
    found = ts.modes(scene, 5, mass=mass)
    assert found.frequencies == pytest.approx(expected, rel=1e-6)
    shapes = found.shapes.reshape(5, -1)
    assert np.abs(shapes @ M @ shapes.T - np.eye(5)).max() < 1e-6
    assert not shapes[:, ~free].any() and found.shapes.shape == (5, len(free) // 3, 3)


@pytest.mark.parametrize(
    "order, degree, cells", [(1, None, (1, 1, 1)), (1, None, (5, 4, 4)), (2, 2, (1, 1, 1)), (2, 4, (3, 2, 2))]
)
def test_free_bodies_have_six_rigid_motions_each(order, degree, cells):
    scene = one_body(cells=cells, order=order, degree=degree)
    scene.add_body(cube(), rubber(), position=(0, 5, 0))
    frequencies = ts.modes(scene, 13).frequencies
    assert np.abs(frequencies[:12]).max() < 1e-2 * frequencies[12]


@pytest.mark.parametrize(
    "k, mass, message",
    [
        (0, "lumped", "k = 0: it must be a whole number from 1 to the 23 free axes"),
        (24, "lumped", "k = 24"),
        (2.0, "lumped", "k = 2.0"),
        (True, "lumped", "k = True"),
        (3, "none", "mass 'none' is unknown: it must be 'lumped' or 'consistent'"),
    ],
)
def test_invalid_arguments_of_modes_are_rejected(k, mass, message):
    with pytest.raises(ts.SceneError, match=message):
        ts.modes(one_body(constrained=True), k, mass=mass)


def test_modes_of_an_empty_scene_are_rejected():
    with pytest.raises(ts.SceneError, match="the scene holds no body"):
        ts.modes(ts.Scene(), 1)


def test_dt_above_the_limit_is_rejected():
    scene, n_open = one_body(cells=(1, 1, 1), order=2), len(runtime._open)
    limit = stable_dt(scene, False)
    simulator = partial(ts.Simulator, scene, integrator="symplectic_euler", precision="f64")
    message = rf"dt = {2 * limit:.3g} s is above the estimated stability limit of {limit:.3g} s of symplectic_euler"
    with pytest.raises(ts.SimulationError, match=rf"^{message}: take a smaller dt \(0.9 of the limit is .* allow_unstable=True$"):
        simulator(2 * limit)
    assert len(runtime._open) == n_open
    with pytest.warns(UserWarning, match=message), simulator(2 * limit, allow_unstable=True):
        pass
    with simulator(0.9 * limit) as sim:
        with pytest.raises(ts.SimulationError, match=message):
            sim.dt = 2 * limit
        assert sim.dt == 0.9 * limit and sim.stable_dt == limit
        sim.set_state(sim.positions() + 0.01 * np.sin(sim.positions()))
        elastic = sim.energies().elastic
        with pytest.raises(ts.SimulationError, match="is above the estimated stability limit"):
            sim.set_material("block", young=1e7)
        assert scene.bodies[0].material.young == 1e5 and sim.stable_dt == limit
        assert sim.energies().elastic == elastic > 0.0
        sim.set_material("block", density=2000.0)
        assert sim.stable_dt == pytest.approx(np.sqrt(2) * limit, rel=1e-3)


def growth(sim, relative_dt: float, steps: int = 200) -> float:
    """Energy after so many steps of relative_dt * stable_dt over the initial energy of the highest mode, 1e-6 m high."""
    K, M, _ = dense(sim.scene)
    shape = la.eigh(K, M)[1][:, -1].reshape(-1, 3)
    sim.reset()
    sim.dt = relative_dt * sim.stable_dt
    sim.set_state(sim.positions() + 1e-6 * shape / np.abs(shape).max())
    start = sim.energies().total
    assert start > 0.0
    for _ in range(steps // 10):
        sim.advance(10)
        total = sim.energies().total
        if not total < 1e6 * start:
            break
    return total / start


@pytest.fixture(scope="module", params=["symplectic_euler-2", "velocity_verlet-1"])
def sim(request):
    """Compiled with both kinds of damping, which the tests change."""
    integrator, order = request.param.split("-")
    scene = one_body(rubber(mass_damping=1.0, stiffness_damping=1e-3), cells=(1, 1, 1), order=int(order))
    with ts.Simulator(scene, 1e-4, integrator, precision="f64", allow_unstable=True) as made:
        yield made


@pytest.mark.filterwarnings("ignore:dt = .* is above the estimated stability limit")
@pytest.mark.parametrize(
    "damping",
    [(0.0, 0.0), (30.0, 0.0), (0.0, 2e-3), (0.0, 0.1), (30.0, 0.02)],
    ids=["none", "mass", "stiffness", "strong stiffness", "both"],
)
def test_steps_explode_above_the_limit(sim, damping):
    sim.set_material("block", mass_damping=damping[0], stiffness_damping=damping[1])
    undamped = 2 / highest_frequency(sim.scene.bodies[0])
    limit = sim.stable_dt
    verlet = sim.settings.integrator == "velocity_verlet"
    if damping == (0.0, 0.0):
        assert limit == undamped
    elif damping[1] > 0.0:
        assert limit < 0.999 * undamped
    else:
        assert (limit > undamped) == verlet  # Verlet's exact decay raises the limit, Euler's explicit one lowers it
    assert growth(sim, 0.98) < (100.0 if damping == (0.0, 0.0) else 1.0)
    assert growth(sim, 1.1) > 1e6


def test_limit_is_the_smallest_of_all_bodies():
    scene = one_body(cells=(1, 1, 1))
    linear = stable_dt(scene, False)
    scene.add_body(cube((9, 0, 0)), rubber(young=4e5))
    assert stable_dt(scene, False) == pytest.approx(linear / 2, rel=1e-3)
    quadratic = stable_dt(one_body(cells=(1, 1, 1), order=2), False)
    assert quadratic < linear
    scene.add_body(cube((18, 0, 0)), rubber(young=4e5), **element(2))
    assert stable_dt(scene, False) == pytest.approx(quadratic / 2, rel=1e-3)
    constrained = one_body(cells=(1, 1, 1))
    constrained.bodies[0].fix(lambda X: X[:, 0] < 9)
    assert stable_dt(constrained, False) == np.inf


@pytest.mark.filterwarnings("ignore:dt = .* is above the estimated stability limit")
@pytest.mark.parametrize("plane", [False, True], ids=["free", "above a plane"])
def test_diverging_run_stops_while_it_is_finite(plane):
    """With the corotational law numbers stay finite for many steps; a tet inverted by many times its volume ends the run."""
    scene = one_body(rubber(COR), cells=(2, 1, 1))
    if plane:
        scene.add_obstacle(ts.HalfSpace((0, -100, 0), (0, 1, 0)))
    with ts.Simulator(scene, 1.2 * stable_dt(scene, False), "symplectic_euler", precision="f64", allow_unstable=True) as sim:
        x = sim.positions()
        sim.set_state(x + 1e-3 * np.random.default_rng(0).standard_normal(x.shape))
        result = sim.run(400 * sim.dt, fps=None)
        assert result.status == "failed" and result.steps < 200
        assert re.search(r"^step \d+: a tet is inverted by .* times its volume: the motion has diverged", result.problems[0])
        corners = sim.positions()[scene.bodies[0].mesh.tets]
        assert np.abs(corners).max() < 1e6 and np.linalg.det(corners[:, 1:] - corners[:, :1]).min() < 0.0
