"""Steps of every integrator, in f64.

The driven scene has fixed, prescribed and released nodes, loads and damping. Its bodies are quadratic for symplectic Euler,
linear for Verlet, and both for implicit steps, where the mass of linear tets is lumped.

* positions, velocities and reactions match the oracle step by step, also with three laws mixed and with parallel kernels;
* a batch of explicit steps equals single steps bitwise, and so do two runs from the start;
* loads, weight and reactions equal the rate of momentum; a free body falls exactly, and keeps its momentum without gravity;
* the implicit residual is the gradient of inertia, energies and dissipation.
"""

from contextlib import contextmanager

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.linalg import block_diag

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.fem import reference
from taisoft.fem.model import damping_table
from taisoft.fem.state import N_COLUMNS
from taisoft.linear.block_csr import to_scipy
from tests.dynamics.following import DT, follow, simulator
from tests.dynamics.scenes import cube, driven_scene, dynamics, mixed_scene, rows_of, rubber, use_threads
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
    order = 2 if request.param == "symplectic_euler" else 1
    with simulator(driven_scene(**DAMPED, order=order), request.param) as sim:
        yield sim


@pytest.fixture(scope="module")
def mixture():
    """Three laws and both quadratures, with one integrator only because they take long to compile."""
    with simulator(mixed_scene(mass_damping=3.0, order="both"), "symplectic_euler") as sim:
        yield sim


@pytest.fixture(scope="module", params=[f"{order}-{integrator}" for order in (1, 2) for integrator in IMPLICIT])
def implicit(request):
    order, integrator = request.param.split("-")
    with simulator(driven_scene(**DAMPED, order=int(order)), integrator, **TIGHT) as sim:
        yield sim


def only(integrator: str):
    """Run a test with this integrator of the fixture `implicit` only."""
    return pytest.mark.parametrize("implicit", [f"{order}-{integrator}" for order in (1, 2)], indirect=True)


def test_explicit_steps_match_the_oracle(explicit):
    oracle = follow(explicit, explicit.settings.integrator, 9, 1e-10)
    assert len(oracle.prescribed) == 1  # two of the three prescribed nodes have been released


def test_implicit_steps_match_the_oracle(implicit):
    oracle = follow(implicit, implicit.settings.integrator, 9, 1e-8)
    assert len(oracle.prescribed) == 1  # two of the three prescribed nodes have been released


def test_explicit_steps_of_mixed_laws_match_the_oracle(mixture):
    follow(mixture, mixture.settings.integrator, 9, 1e-10)


def test_batches_equal_single_steps(mixture):
    mixture.reset()
    for _ in range(40):
        mixture.step()
    single = mixture.positions(), mixture.velocities(), mixture.reactions(), mixture.time
    assert mixture.step_count == 40 and np.abs(single[0] - Oracle(mixture.scene).rest).max() > 0.01
    mixture.reset()
    assert mixture.advance(7).steps == 7 and mixture.advance(33).steps == 33
    batched = mixture.positions(), mixture.velocities(), mixture.reactions(), mixture.time
    assert all(np.array_equal(a, b) for a, b in zip(single, batched))


@pytest.mark.parametrize("held", [False, True])
def test_batches_of_damped_verlet_equal_single_steps(held):
    """Sub-steps begin in the loop that ends the one before; factors of damping are kept for one launch only."""
    results = []
    for batches in ([1] * 14, [5, 2, 7], [14]):
        scene = ts.Scene()
        body = scene.add_body(cube(cells=(2, 1, 1)), rubber(mass_damping=3.0), name="body", velocity=(0.3, 0.1, -0.2))
        if held:
            body.fix(lambda X: X[:, 0] < -0.49)
        with simulator(scene, "velocity_verlet") as sim:
            for damping, dt in ((3.0, DT), (50.0, 0.5 * DT)):
                sim.dt = dt
                sim.set_material("body", mass_damping=damping)
                assert all(sim.advance(n).steps == n for n in batches)
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


@pytest.mark.parametrize("integrator", [*EXPLICIT, "implicit_euler"])
def test_parallel_kernels_match_the_oracle(integrator, monkeypatch):
    use_threads(monkeypatch)
    settings = TIGHT if integrator == "implicit_euler" else {}
    with simulator(driven_scene(mass_damping=3.0, order=2), integrator, **settings) as sim:
        assert sim.field_bytes["partial"] > 8 * N_COLUMNS  # several threads add up partial sums
        follow(sim, integrator, 9, 1e-8 if settings else 1e-10)
        first = sim.positions(), sim.velocities(), sim.reactions()
        for _ in range(3):
            sim.reset()
            while sim.step_count < 9:
                sim.advance(9 - sim.step_count)
            assert np.abs(sim.positions() - first[0]).max() < 1e-13  # [m]; times of a batch are rounded differently
        sim.reset()
        for _ in range(9):
            sim.step()
        assert all(np.array_equal(a, b) for a, b in zip(first, (sim.positions(), sim.velocities(), sim.reactions())))
        if sim.settings.explicit:  # a failing step within a batch is named, and the state is that of the last good one
            v = np.zeros_like(sim.positions())  # along the beam only, so that it stays away from the flyer
            v[rows_of(sim, "beam"), 0] = 1e33 * np.sin(sim.positions("beam")[:, 0])
            sim.set_state(velocities=v)
            with pytest.raises(ts.SimulationError, match=r"step 1\d: body 'beam', node"):
                sim.advance(5)
            failed, x = sim.step_count, sim.positions()
            assert 9 <= failed < 13 and np.isfinite(x).all() and np.isfinite(sim.velocities()).all()
            with pytest.raises(ts.SimulationError, match=f"step {failed + 1}: "):
                sim.step()
            assert np.array_equal(sim.positions(), x)


@pytest.mark.parametrize("order", [1, 2])
def test_residual_is_the_gradient_of_its_objective(order):
    """The objective consists of inertia, energies and both kinds of damping; inertia and damping are computed by NumPy."""
    with dynamics(driven_scene(**DAMPED, order=order), dt=DT, integrator="implicit_euler", precision="f64", **TIGHT) as system:
        system.advance(1)
        model, solver, beta = system.model, system.stepper.solver, DT
        bodies, v_hat = system.scene.bodies, solver.work.v_hat.to_numpy()
        mass = [reference.consistent_mass(b) if model.consistent else np.diag(reference.lumped_mass(b)) for b in bodies]
        mass = block_diag(*[np.asarray(m.todense()) if sp.issparse(m) else m for m in mass])
        damping = np.repeat(damping_table(system.scene), [b.n_nodes for b in bodies], axis=0)
        damper = to_scipy(model, solver.damper)

        def objective(v) -> float:
            now, change = system.energies(), v - v_hat
            inertia = 0.5 * np.sum(change * (mass @ change))
            drag = np.sum(damping[:, :1] * v * (mass @ v)) + np.sum(damping[:, 1:] * v * (damper @ v.ravel()).reshape(-1, 3))
            return inertia + now.elastic + now.gravity + now.loads + 0.5 * beta * drag

        free, x_hat = model.free.to_numpy(), solver.work.x_hat.to_numpy()
        rng = np.random.default_rng(4)
        end_x, end_v = system.state.state()
        start = end_v + 5.0 * free * rng.standard_normal(x_hat.shape)

        def set_velocities(v):
            system.state.set_state(np.where(free > 0, x_hat + beta * v, end_x), v)

        set_velocities(start)
        solver.evaluate()
        gradient = solver.work.residual.to_numpy()
        direction = free * (rng.standard_normal(x_hat.shape) + gradient / np.abs(gradient * free).max())
        slope, values, h = np.sum(gradient * direction), [], 1e-3  # [m/s]
        for step in (h, -h):
            v = start + step * direction
            set_velocities(v)
            values.append(objective(v))
        assert abs(slope) > 100.0  # [J s/m]
        assert (values[0] - values[1]) / (2 * h) == pytest.approx(slope, rel=1e-6)


def check_momentum(sim, drag_at: int) -> None:
    """Check that reactions, loads, weight and drag equal the rate of momentum; elastic and damping forces cancel.

    drag_at: 0 if the drag is that of the step's start, 1 for its end. With a consistent mass, prescribed nodes have the
    acceleration of their path, without an impulse where it starts with a velocity.
    """
    sim.reset()
    oracle = Oracle(sim.scene)
    for _ in range(9):
        v = [sim.velocities()]
        sim.step()
        v.append(sim.velocities())
        M = oracle.inertia(sim.settings.explicit)
        acceleration, prescribed = (v[1] - v[0]) / DT, oracle.targets(oracle.time + DT)[1]
        if sim.plan.on["consistent_mass"]:
            acceleration = np.where(prescribed, oracle.prescribed_acceleration(DT, (0, 0.5, 1), (4, -8, 4)), acceleration)
        oracle.time += DT
        rate, drag = M @ acceleration, oracle.mass_damping * (M @ v[drag_at])
        expected = (rate - oracle.applied(sim.settings.explicit) + drag).sum(axis=0)
        assert np.abs(expected).max() > 100.0  # [N]
        assert np.abs(sim.reactions().sum(axis=0) - expected).max() < 1e-9 * np.abs(rate).sum()


@pytest.mark.parametrize("explicit", ["symplectic_euler"], indirect=True)
def test_forces_equal_the_rate_of_momentum_in_explicit_steps(explicit):
    check_momentum(explicit, 0)


@only("implicit_euler")
def test_forces_equal_the_rate_of_momentum_in_implicit_steps(implicit):
    check_momentum(implicit, 1)


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
    """Check four steps to rounding; the body does not deform."""
    v, gravity = np.array([0.3, -0.2, 0.5]), np.array([0.7, -9.81, -0.4])
    with free_flight(sim, lambda X: np.broadcast_to(v, X.shape), gravity):
        start = sim.positions("flyer")
        for _ in range(4):
            sim.step()
        exact = start + 4 * DT * v + FALL[sim.settings.integrator](4) * DT**2 * gravity
        assert np.abs(sim.positions("flyer") - exact).max() < 1e-13  # [m]
        assert np.abs(sim.velocities("flyer") - v - 4 * DT * gravity).max() < 1e-10  # [m/s]
        assert np.abs(sim.stress("flyer")).max() < 1e-11 * 1e5  # [Pa], of young


def check_momentum_of_a_free_body(sim) -> None:
    """Check a body that tumbles and vibrates; angular momentum only if the integrator conserves it."""
    oracle, rng = Oracle(sim.scene), np.random.default_rng(0)
    own = slice(oracle.starts[1], oracle.starts[2])
    M = oracle.inertia(sim.settings.explicit)[own, own]

    def momenta():
        p = M @ sim.velocities("flyer")
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
    check_momentum_of_a_free_body(explicit)


def test_free_body_in_implicit_steps(implicit):
    check_free_fall(implicit)
    check_momentum_of_a_free_body(implicit)
