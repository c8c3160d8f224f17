"""Steps against the oracle's, on a driven scene (fixed, led, released, loaded, damped) and on a mixture of three laws:

* every integrator's positions, velocities and reactions, step by step, in f64; the explicit ones also of three laws;
* f32 follows to its rounding, and so do the parallel kernels, whose result does not depend on the run;
* a batch of explicit steps is bitwise so many single steps, and two runs from the start are bitwise alike;
* loads, weight and reactions make the rate of momentum; a release lets go of the led velocity;
* the integrators' names mean the schemes they should.
"""

import numpy as np
import pytest
from oracle import Oracle
from scenes import driven_scene, mixed_scene

import taisoft as ts
from taisoft import stepping
from taisoft.stepping import SCHEMES

DT = 0.002  # [s]; the release falls between the fourth step and the fifth
DAMPED = {"mass_damping": 3.0, "stiffness_damping": 0.004}
EXPLICIT = ("symplectic_euler", "velocity_verlet")


def simulator(scene, integrator, precision="f64", **settings):
    return ts.Simulator(scene, dt=DT, integrator=integrator, precision=precision, **settings)


def follow(sim, method: str, steps: int, relative: float, reactions: bool = True) -> Oracle:
    """Step sim and the oracle side by side from the start; compare them after every step. Returns the oracle."""
    sim.reset()
    oracle = Oracle(sim.scene)
    for _ in range(steps):
        sim.step()
        getattr(oracle, method)(DT)
        assert sim.time == pytest.approx(oracle.time, rel=1e-14)
        assert np.abs(sim.positions() - oracle.x).max() < relative * 1e-2  # [m] a hundredth is about how far things move
        assert np.abs(sim.velocities() - oracle.v).max() < relative * np.abs(oracle.v).max()
        if reactions:
            assert np.abs(oracle.reactions).max() > 100.0  # [N]
            assert np.abs(sim.reactions() - oracle.reactions).max() < relative * np.abs(oracle.reactions).max()
    return oracle


def momentum(sim, oracle) -> np.ndarray:
    return np.sum(oracle.mass * sim.velocities(), axis=0)


@pytest.fixture(scope="module", params=EXPLICIT)
def explicit(request):
    with simulator(driven_scene(**DAMPED), request.param) as sim:
        yield sim


@pytest.fixture(scope="module", params=EXPLICIT)
def mixture(request):
    with simulator(mixed_scene(mass_damping=3.0), request.param) as sim:
        yield sim


@pytest.fixture(scope="module")
def implicit():
    """One simulator whose kernels serve every implicit scheme: they differ in numbers only."""
    with simulator(driven_scene(**DAMPED), "bdf2", newton_tolerance=1e-13, linear_tolerance=1e-13) as sim:
        yield sim


def test_explicit_steps_are_the_oracles(explicit):
    oracle = follow(explicit, explicit.settings.integrator, 9, 1e-10)
    assert len(oracle.led) == 1  # two of the three led nodes have been released


def test_explicit_steps_of_three_laws_are_the_oracles(mixture):
    follow(mixture, mixture.settings.integrator, 9, 1e-10)


def test_batches_are_single_steps(mixture):
    mixture.reset()
    for _ in range(40):
        mixture.step()
    single = mixture.positions(), mixture.velocities(), mixture.reactions(), mixture.time
    assert mixture.step_count == 40 and np.abs(single[0] - Oracle(mixture.scene).rest).max() > 0.01
    mixture.reset()
    assert mixture.advance(7).steps == 7 and mixture.advance(33).steps == 33
    batched = mixture.positions(), mixture.velocities(), mixture.reactions(), mixture.time
    assert all(np.array_equal(a, b) for a, b in zip(single, batched))


def test_batches_end_where_nodes_are_released(explicit):
    follow(explicit, explicit.settings.integrator, 9, 1e-10)
    single = explicit.positions(), explicit.velocities()
    explicit.reset()
    assert [explicit.advance(n).steps for n in (9, 5)] == [4, 5]
    # the times of a batch are rounded differently from those of single steps
    assert np.abs(explicit.positions() - single[0]).max() < 1e-13
    assert np.abs(explicit.velocities() - single[1]).max() < 1e-11


@pytest.mark.parametrize("method", SCHEMES)
def test_implicit_steps_are_the_oracles(implicit, method, monkeypatch):
    monkeypatch.setattr(implicit._stepper, "scheme", SCHEMES[method])
    if method != "linearly_implicit_euler":
        # the midpoint rule has no velocity of its own for led nodes, so their inertia is not compared
        oracle = follow(implicit, method, 9, 1e-8, reactions=method != "implicit_midpoint")
        assert len(oracle.led) == 1
        return
    implicit.reset()  # it is linearised where the led nodes will be, the oracle where they are
    oracle = Oracle(implicit.scene)
    oracle.targets(1.0)
    oracle.led = []
    implicit._world.motion._groups[0].released = implicit._world.motion._groups[1].released = True
    implicit._world.upload_constraints()
    for _ in range(5):
        implicit.step()
        oracle.linearly_implicit_euler(DT)
        assert np.abs(implicit.positions() - oracle.x).max() < 1e-10
