"""Linear vibration about the rest shape agrees with dense algebra; steps explode above `stable_dt`, which the simulator does not
accept; a run that diverges stops while numbers are finite.
"""

import re
from functools import partial

import numpy as np
import pytest
import scipy.linalg as la

import taisoft as ts
from taisoft.backend import runtime
from taisoft.stability import highest_frequency, hooke_differential, hooke_stiffness, scale_warnings, stable_dt
from tests.dynamics.scenes import COR, SNH, SVK, cube, element, rubber
from tests.fem.oracle import Oracle
from tests.simulator.scenes import simulator


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


@pytest.mark.parametrize("law, order, degree", [(SVK, 1, None), (COR, 2, 2), (SNH, 2, 4)])
def test_stiffness_at_rest_is_hookes(law, order, degree):
    scene = one_body(rubber(law, poisson=0.4), order=order, degree=degree)
    K = dense(scene)[0]
    body = scene.bodies[0]
    assert np.abs(hooke_stiffness(body).toarray() - K).max() < 1e-12 * np.abs(K).max()
    v = np.random.default_rng(0).standard_normal((body.n_nodes, 3))
    assert np.abs(hooke_differential(body)(v) - (K @ v.reshape(-1)).reshape(-1, 3)).max() < 1e-11 * np.abs(K).max()


@pytest.mark.parametrize("order, cells, constrained", [(1, (2, 1, 1), True), (1, (4, 3, 3), False), (2, (2, 1, 1), True)])
def test_highest_frequency_matches_dense_algebra(order, cells, constrained):
    """By dense algebra for a small body, by Lanczos for a larger one; overestimated by at most 1 %."""
    scene = one_body(cells=cells, constrained=constrained, order=order)
    K, M, free = dense(scene)
    exact = np.sqrt(la.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True)[-1])
    assert exact < highest_frequency(scene.bodies[0]) < 1.01 * exact
    assert stable_dt(scene, verlet=False) == pytest.approx(2 / exact, rel=0.01)
    assert stable_dt(scene, verlet=True) == stable_dt(scene, verlet=False)


@pytest.mark.parametrize(
    "mass, order, degree, cells",
    [("consistent", 1, None, (5, 3, 3)), ("consistent", 2, 4, (2, 1, 1)), ("lumped", 2, 2, (3, 2, 2))],
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


def test_free_bodies_have_six_rigid_motions_each_and_bad_arguments_are_refused():
    scene = one_body(cells=(5, 4, 4))
    scene.add_body(cube(), rubber(), position=(0, 5, 0))
    frequencies = ts.modes(scene, 13).frequencies
    assert np.abs(frequencies[:12]).max() < 1e-2 * frequencies[12]
    scene = one_body(constrained=True)
    for k, mass, message in (
        (0, "lumped", "k .23 axes are free. must be a whole number from 1 to 23, not 0"),
        (24, "lumped", "not 24"),
        (3, "none", "mass must be one of lumped, consistent, not 'none'"),
    ):
        with pytest.raises(ts.SceneError, match=message):
            ts.modes(scene, k, mass=mass)
    with pytest.raises(ts.SceneError, match="the scene holds no body"):
        ts.modes(ts.Scene(), 1)


def growth(scene: ts.Scene, integrator: str, dt: float) -> float:
    """Energy after 100 of the oracle's steps over the initial energy of the highest mode, 1e-6 m high."""
    oracle = Oracle(scene)
    shape = la.eigh(*dense(scene)[:2])[1][:, -1].reshape(-1, 3)
    oracle.x = oracle.x + 1e-6 * shape / np.abs(shape).max()
    start = oracle.energy(oracle.x)
    for _ in range(100):
        getattr(oracle, integrator)(dt)
        total = oracle.energy(oracle.x) + oracle.kinetic(oracle.v, True)
        if not total < 1e6 * start:
            break
    return total / start


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet"])
@pytest.mark.parametrize("mass, stiffness", [(0.0, 0.0), (30.0, 0.0), (30.0, 0.02)])
def test_steps_explode_above_the_limit(integrator, mass, stiffness):
    scene = one_body(rubber(mass_damping=mass, stiffness_damping=stiffness), cells=(1, 1, 1))
    verlet, undamped = integrator == "velocity_verlet", 2 / highest_frequency(scene.bodies[0])
    limit = stable_dt(scene, verlet)
    if stiffness > 0.0:
        assert limit < 0.999 * undamped
    elif mass > 0.0:
        assert (limit > undamped) == verlet  # Verlet's exact decay raises the limit, Euler's explicit one lowers it
    assert growth(scene, integrator, 0.98 * limit) < (1.0 if mass or stiffness else 100.0)
    assert growth(scene, integrator, 1.1 * limit) > 1e6


def test_limit_is_the_smallest_of_all_bodies():
    scene = one_body(cells=(1, 1, 1))
    linear = stable_dt(scene, False)
    scene.add_body(cube((9, 0, 0)), rubber(young=4e5))
    assert stable_dt(scene, False) == pytest.approx(linear / 2, rel=1e-3)
    constrained = one_body(cells=(1, 1, 1))
    constrained.bodies[0].fix(lambda X: X[:, 0] < 9)
    assert stable_dt(constrained, False) == np.inf


def test_a_body_that_its_weight_would_crush_is_warned_of():
    scene = one_body(rubber(young=1e3))
    assert scale_warnings(scene) == []
    scene.gravity = (0.0, -10.0, 0.0)
    (text,) = scale_warnings(scene)
    assert text.startswith("body 'block': 1.1 m long and 990 kg, its own weight strains it by about 11; a wave crosses it in 1.1")
    with pytest.warns(UserWarning, match="is the mesh in metres"):
        ts.Simulator(scene, 1e-3, precision="f64").close()


def test_dt_above_the_limit_is_rejected():
    scene = one_body(cells=(1, 1, 1))
    limit = stable_dt(scene, False)
    make = partial(ts.Simulator, scene, integrator="symplectic_euler", precision="f64")
    message = rf"dt = {2 * limit:.3g} s is above the estimated stability limit of {limit:.3g} s of symplectic_euler"
    with pytest.raises(ts.SimulationError, match=rf"^{message}: take a smaller dt \(0.7 of the limit is .* allow_unstable=True$"):
        make(2 * limit)
    assert runtime.open_kind() is None
    with pytest.warns(UserWarning, match=message) as found, make(2 * limit, allow_unstable=True) as sim:
        sim.dt = 3 * limit
    assert len(found) == 2 and {warning.filename for warning in found} == {__file__}
    with make(0.9 * limit) as sim:
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


@pytest.mark.filterwarnings("ignore")
def test_diverging_run_stops_while_it_is_finite():
    """A tet inverted by many times its volume ends the run."""
    with simulator("velocity_verlet", allow_unstable=True) as sim:
        sim.dt = 1.2 * sim.stable_dt
        x = sim.positions()
        sim.set_state(x + 1e-3 * np.random.default_rng(0).standard_normal(x.shape))
        result = sim.run(400 * sim.dt, fps=None)
        assert result.status == "failed" and result.steps < 300
        assert re.search(r"^step \d+: a tet is inverted by .* times its volume: the motion has diverged", result.problems[0])
        assert np.abs(sim.positions()).max() < 1e6
