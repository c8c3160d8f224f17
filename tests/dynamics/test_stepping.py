"""Steps of every integrator, in f64.

The driven scene has fixed, prescribed and released nodes, loads and damping. Its bodies are quadratic; for velocity Verlet and
parallel kernels they are linear and have stiffness damping, too.

* positions, velocities and reactions match the oracle step by step, also with parallel kernels, and so do energies;
* a batch of explicit steps equals single steps bitwise, and so do two runs from the start;
* a free body falls exactly, and keeps its momentum without gravity;
* a body that starts with the velocity of its prescribed end moves rigidly, and flies on when its path ends with a step.
"""

from contextlib import contextmanager

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from tests.dynamics.following import DT, follow, simulator
from tests.dynamics.scenes import cube, driven_scene, element, rows_of, rubber, use_threads
from tests.fem.oracle import Oracle

DAMPED = {"mass_damping": 3.0, "stiffness_damping": 0.004}
TIGHT = {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13}
FALL = {  # after n steps from rest, in units of g dt^2; BDF2 keeps the error of its first step, which is implicit Euler's
    "symplectic_euler": lambda n: n * (n + 1) / 2,
    "implicit_euler": lambda n: n * (n + 1) / 2,
    "linearly_implicit_euler": lambda n: n * (n + 1) / 2,
    "velocity_verlet": lambda n: n * n / 2,
    "implicit_midpoint": lambda n: n * n / 2,
    "bdf2": lambda n: n * n / 2 + 0.75 * (1 - 3.0**-n),
}
CONSERVE_ANGULAR_MOMENTUM = ("symplectic_euler", "velocity_verlet", "implicit_midpoint")


@pytest.fixture(scope="module", params=EXPLICIT)
def explicit(request):
    damped = {"mass_damping": 3.0, "order": 2} if request.param == "symplectic_euler" else DAMPED
    with simulator(driven_scene(**damped), request.param) as sim:
        yield sim


@pytest.fixture(scope="module", params=IMPLICIT)
def implicit(request):
    with simulator(driven_scene(mass_damping=3.0, order=2), request.param, **TIGHT) as sim:
        yield sim


def only(integrator: str):
    """Run a test with this integrator of the fixture only."""
    fixture = "explicit" if integrator in EXPLICIT else "implicit"
    return pytest.mark.parametrize(fixture, [integrator], indirect=True)


def check_steps(sim, relative: float) -> None:
    """Follow the oracle until two of the three prescribed nodes have been released; compare energies there."""
    oracle, explicit = follow(sim, sim.settings.integrator, 9, relative), sim.settings.explicit
    assert len(oracle.prescribed) == 1
    now = sim.energies()
    expected = oracle.kinetic(oracle.v, explicit), oracle.energy(oracle.x), oracle.weight(oracle.x, explicit)
    assert (now.kinetic, now.elastic, now.gravity) == pytest.approx(expected, rel=1e-6)


def test_explicit_steps_match_the_oracle(explicit):
    check_steps(explicit, 1e-10)


def test_implicit_steps_match_the_oracle(implicit):
    check_steps(implicit, 1e-8)


def test_batches_of_damped_verlet_equal_single_steps():
    """Sub-steps begin in the loop that ends the one before; factors of damping are kept for one launch only."""
    results = []
    for batches in ([1] * 14, [5, 2, 7], [14]):
        scene = ts.Scene()
        body = scene.add_body(cube(cells=(2, 1, 1)), rubber(mass_damping=3.0), name="body", velocity=(0.3, 0.1, -0.2))
        body.fix(lambda X: X[:, 0] < -0.49)
        with simulator(scene, "velocity_verlet") as sim:
            for damping, dt in ((3.0, DT), (50.0, 0.5 * DT)):
                sim.dt = dt
                sim.set_material("body", mass_damping=damping)
                assert all(sim.advance(n).steps == n for n in batches)
            assert sim.step_count == 28
            results.append((sim.positions(), sim.velocities(), sim.reactions()))
    for other in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], other))


def test_batches_end_when_nodes_are_released(explicit):
    follow(explicit, explicit.settings.integrator, 9, 1e-10)
    single = explicit.positions(), explicit.velocities()
    explicit.reset()
    assert [explicit.advance(n).steps for n in (9, 5)] == [4, 5]
    # the times of a batch are rounded differently from those of single steps
    assert np.abs(explicit.positions() - single[0]).max() < 1e-13
    assert np.abs(explicit.velocities() - single[1]).max() < 1e-11


@only("bdf2")
@pytest.mark.parametrize("change", ["dt", "state", "gravity"])
def test_bdf2_restarts_after_a_change_of_dt_or_state(implicit, change):
    """The next step is implicit Euler's, since the history is no longer valid; a change of gravity keeps it."""
    oracle = follow(implicit, "bdf2", 2, 1e-8)
    dt = DT
    try:
        if change == "dt":
            implicit.dt = dt = DT / 2
        elif change == "state":
            oracle.x = oracle.x + 0.001 * np.sin(oracle.x)
            implicit.set_state(positions=oracle.x)
        else:
            oracle.gravity = np.array([0.0, 5.0, 0.0])
            implicit.set_gravity(oracle.gravity)
        if change != "gravity":
            oracle.past = []
        for _ in range(2):
            implicit.step()
            oracle.bdf2(dt)
            assert np.abs(implicit.positions() - oracle.x).max() < 1e-10  # [m]
    finally:
        implicit.dt = DT
        implicit.set_gravity((0.3, -9.81, 0.7))


@pytest.mark.parametrize("integrator", ["symplectic_euler", pytest.param("implicit_euler", marks=pytest.mark.long)])
def test_parallel_kernels_match_the_oracle(integrator, monkeypatch):
    use_threads(monkeypatch)
    settings = TIGHT if integrator == "implicit_euler" else {}
    with simulator(driven_scene(**DAMPED), integrator, **settings) as sim:
        follow(sim, integrator, 9, 1e-8 if settings else 1e-10)
        first = sim.positions(), sim.velocities(), sim.reactions()
        sim.reset()
        while sim.step_count < 9:
            sim.advance(9 - sim.step_count)
        assert np.abs(sim.positions() - first[0]).max() < 1e-13  # [m]; times of a batch are rounded differently
        sim.reset()
        for _ in range(9):
            sim.step()
        assert all(np.array_equal(a, b) for a, b in zip(first, (sim.positions(), sim.velocities(), sim.reactions())))


@only("symplectic_euler")
def test_a_failing_step_within_a_batch_is_named(explicit):
    """The state is that of the last good step."""
    explicit.reset()
    explicit.advance(4)
    v = np.zeros_like(explicit.positions())  # along the beam only, so that it stays away from the flyer
    v[rows_of(explicit, "beam"), 0] = 1e33 * np.sin(explicit.positions("beam")[:, 0])
    explicit.set_state(velocities=v)
    with pytest.raises(ts.SimulationError, match=r"step \d: body 'beam', node"):
        explicit.advance(5)
    failed, x = explicit.step_count, explicit.positions()
    assert 4 <= failed < 9 and np.isfinite(x).all() and np.isfinite(explicit.velocities()).all()
    with pytest.raises(ts.SimulationError, match=f"step {failed + 1}: "):
        explicit.step()
    assert np.array_equal(explicit.positions(), x)


@contextmanager
def free_flight(sim, velocities, gravity):
    """The flyer at its start, undamped, with velocities(X)."""
    body = sim.scene.body("flyer")
    damping, before = body.material.mass_damping, sim.scene.gravity
    sim.reset()
    sim.set_material("flyer", mass_damping=0.0)
    sim.set_gravity(gravity)
    sim.set_state(velocities=velocities(body.rest_positions), body="flyer")
    try:
        yield
    finally:
        sim.set_material("flyer", mass_damping=damping)
        sim.set_gravity(before)


def check_free_fall(sim) -> None:
    """Check four steps to rounding."""
    v, gravity = np.array([0.3, -0.2, 0.5]), np.array([0.7, -9.81, -0.4])
    with free_flight(sim, lambda X: np.broadcast_to(v, X.shape), gravity):
        start = sim.positions("flyer")
        for _ in range(4):
            sim.step()
        exact = start + 4 * DT * v + FALL[sim.settings.integrator](4) * DT**2 * gravity
        assert np.abs(sim.positions("flyer") - exact).max() < 1e-13  # [m]
        assert np.abs(sim.velocities("flyer") - v - 4 * DT * gravity).max() < 1e-10  # [m/s]


def check_momentum(sim) -> None:
    """Check a body that tumbles and vibrates; angular momentum only if the integrator conserves it."""
    oracle, rng = Oracle(sim.scene), np.random.default_rng(0)
    own = slice(oracle.starts[1], oracle.starts[2])
    M = oracle.inertia(sim.settings.explicit)[own, own]

    def momenta():
        p = M @ sim.velocities("flyer")
        assert np.allclose(sim.momentum("flyer"), p.sum(axis=0), rtol=1e-12)
        return p.sum(axis=0), np.cross(sim.positions("flyer"), p).sum(axis=0)

    with free_flight(sim, lambda X: np.cross((1, -2, 3), X) + rng.standard_normal(X.shape), (0, 0, 0)):
        (linear, angular), start = momenta(), sim.velocities("flyer")
        for _ in range(4):
            sim.step()
        assert np.abs(sim.velocities("flyer") - start).max() > 0.01  # [m/s]
        linear_now, angular_now = momenta()
        assert np.abs(linear_now - linear).max() < 1e-11 * np.abs(linear).max()
        change = np.abs(angular_now - angular).max() / np.abs(angular).max()
        assert change < 1e-11 if sim.settings.integrator in CONSERVE_ANGULAR_MOMENTUM else 1e-11 < change < 1e-2


def test_free_body_in_explicit_steps(explicit):
    check_free_fall(explicit)
    check_momentum(explicit)


def test_free_body_in_implicit_steps(implicit):
    check_free_fall(implicit)
    check_momentum(implicit)


# --- beside prescribed nodes ----------------------------------------------------------------------------------------------

VELOCITY = np.array([2.0, 0.0, -1.0])  # [m/s]


@pytest.mark.parametrize("releases", [False, True])
@pytest.mark.parametrize("integrator", IMPLICIT)
def test_a_bar_moves_rigidly_with_its_prescribed_end(integrator, releases):
    """Undamped, from its start at VELOCITY and after `set_state`; or its path ends with a step, and it flies on."""
    path = ts.KeyFrames((0.0, 3e-4), [(0.0, 0.0, 0.0), 3e-4 * VELOCITY], release=True) if releases else lambda t: VELOCITY * t
    scene = ts.Scene(gravity=(0, 0, 0))
    bar = scene.add_body(cube(cells=(2, 1, 1)), rubber(mass_damping=3.0), name="bar", velocity=VELOCITY, **element(2))
    bar.add_force([5], (0, 0, 0))  # as in the driven scene, so that they share its kernels
    bar.move(lambda X: X[:, 0] < -0.49, path)
    with ts.Simulator(scene, 1e-4, integrator, precision="f64", **TIGHT) as sim:
        sim.set_material("bar", mass_damping=0.0)
        start = sim.positions()
        for _ in range(3):
            sim.step()
        if not releases:
            sim.set_state(velocities=sim.velocities())
        for _ in range(2):
            sim.step()
        # linearly implicit steps neglect terms of (dt VELOCITY)^2; a velocity jump would be as large as VELOCITY
        assert np.abs(sim.velocities() - VELOCITY).max() < 1e-6 and sim.energies().elastic < 1e-9
        assert sim.positions() == pytest.approx(start + 5e-4 * VELOCITY, abs=1e-9)
