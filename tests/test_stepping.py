"""Steps against the oracle's, on a driven scene (fixed, led, released, loaded, damped) and on a mixture of three laws. The
driven bodies are quadratic, for Verlet linear, for implicit steps both, since the linear mass is lumped there; the mixture has
both kinds:

* every integrator's positions, velocities and reactions, step by step, in f64; symplectic Euler also of the mixture;
* so do those of the parallel kernels, whose result does not depend on the run;
* a batch of explicit steps is bitwise so many single steps, and two runs from the start are bitwise alike;
* loads, weight and reactions make the rate of momentum; a free body falls exactly, and keeps its momentum without gravity;
* the implicit residual is the gradient of inertia, energies and dissipation;
* the integrators' names mean the schemes they should.
"""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
from following import DT, follow, simulator
from oracle import Oracle
from scenes import driven_scene, mixed_scene, rows_of
from scipy.linalg import block_diag

import taisoft as ts
from taisoft.dynamics.dynamics import make_stepper
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.schemes import IMPLICIT, INTEGRATORS, SCHEMES
from taisoft.fem import reference
from taisoft.fem.model import damping_table
from taisoft.linear.block_csr import to_scipy
from taisoft.settings import Settings

DAMPED = {"mass_damping": 3.0, "stiffness_damping": 0.004}
EXPLICIT = ("symplectic_euler", "velocity_verlet")
FALL = {  # after n steps from rest, in units of g dt^2; BDF2's first step is one of implicit Euler, whose error goes on
    "symplectic_euler": lambda n: n * (n + 1) / 2,
    "implicit_euler": lambda n: n * (n + 1) / 2,
    "linearly_implicit_euler": lambda n: n * (n + 1) / 2,
    "velocity_verlet": lambda n: n * n / 2,
    "implicit_midpoint": lambda n: n * n / 2,
    "bdf2": lambda n: n * n / 2 + 0.75 * (1 - 3.0**-n),
}
ANGULAR = ("symplectic_euler", "velocity_verlet", "implicit_midpoint")  # conserve the angular momentum


@pytest.fixture(scope="module", params=EXPLICIT)
def explicit(request):
    order = 2 if request.param == "symplectic_euler" else 1
    with simulator(driven_scene(**DAMPED, order=order), request.param) as sim:
        yield sim


@pytest.fixture(scope="module")
def mixture():
    """Three laws and either quadrature, for one integrator: they take long to compile."""
    with simulator(mixed_scene(mass_damping=3.0, order="both"), "symplectic_euler") as sim:
        yield sim


@pytest.fixture(scope="module", params=[1, 2])
def implicit(request):
    """One simulator whose kernels serve every implicit scheme: they differ in numbers only."""
    scene = driven_scene(**DAMPED, order=request.param)
    with simulator(scene, "bdf2", newton_tolerance=1e-13, linear_tolerance=1e-13) as sim:
        yield sim


def test_explicit_steps_are_the_oracles(explicit):
    oracle = follow(explicit, explicit.settings.integrator, 9, 1e-10)
    assert len(oracle.prescribed) == 1  # two of the three led nodes have been released


def test_explicit_steps_of_a_mixture_are_the_oracles(mixture):
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


@pytest.mark.parametrize("method", IMPLICIT)
def test_implicit_steps_are_the_oracles(implicit, method, monkeypatch):
    monkeypatch.setattr(implicit._dynamics.stepper, "scheme", SCHEMES[method])
    oracle = follow(implicit, method, 9, 1e-8)
    assert len(oracle.prescribed) == 1  # two of the three led nodes have been released


@pytest.mark.parametrize("change", ["dt", "state", "gravity"])
def test_a_change_makes_bdf2_start_anew(implicit, change):
    """Where the past does not fit any more, the next step is one of implicit Euler; another gravity leaves it as it is."""
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
def test_parallel_kernels(integrator, monkeypatch):
    monkeypatch.setattr("taisoft.fem.model.PARALLEL_FROM", 0)
    monkeypatch.setattr("taisoft.fem.model.PARALLEL_THREADS", 0)
    settings = {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13} if integrator == "implicit_euler" else {}
    with simulator(driven_scene(mass_damping=3.0, order=2), integrator, **settings) as sim:
        assert not sim._dynamics.state.model.serial
        follow(sim, integrator, 9, 1e-8 if settings else 1e-10)
        first = sim.positions(), sim.velocities(), sim.reactions()
        for _ in range(3):
            sim.reset()
            while sim.step_count < 9:
                sim.advance(9 - sim.step_count)
            assert np.abs(sim.positions() - first[0]).max() < 1e-13  # [m] a batch's times are rounded differently
        sim.reset()
        for _ in range(9):
            sim.step()
        assert all(np.array_equal(a, b) for a, b in zip(first, (sim.positions(), sim.velocities(), sim.reactions())))
        if sim.settings.explicit:  # a failing sub-step is found, and the last good one is where it ends
            speeds = np.zeros_like(sim.positions())  # of the beam alone, and along itself: nothing comes near the flyer
            speeds[rows_of(sim, "beam"), 0] = 1e33 * np.sin(sim.positions("beam")[:, 0])
            sim.set_state(velocities=speeds)
            with pytest.raises(ts.SimulationError, match=r"step 1\d: body 'beam', node"):
                sim.advance(5)
            failed, x = sim.step_count, sim.positions()
            assert 9 <= failed < 13 and np.isfinite(x).all() and np.isfinite(sim.velocities()).all()
            with pytest.raises(ts.SimulationError, match=f"step {failed + 1}: "):
                sim.step()
            assert np.array_equal(sim.positions(), x)


def test_the_residual_is_a_gradient(implicit, monkeypatch):
    """Of inertia, energies and both kinds of damping; inertia and damping are NumPy's."""
    monkeypatch.setattr(implicit._dynamics.stepper, "scheme", SCHEMES["implicit_euler"])
    implicit.reset()
    implicit.step()
    model, solver, beta = implicit._dynamics.state.model, implicit._dynamics.stepper.solver, implicit._dynamics.stepper._beta
    bodies, v_hat = implicit.scene.bodies, solver.work.v_hat.to_numpy()
    mass = [reference.consistent_mass(b) if model.consistent else np.diag(reference.lumped_mass(b)) for b in bodies]
    mass = block_diag(*[np.asarray(m.todense()) if sp.issparse(m) else m for m in mass])
    damping = np.repeat(damping_table(implicit.scene), [b.n_nodes for b in bodies], axis=0)
    damper = to_scipy(model, solver.damper)

    def objective(v) -> float:
        now, change = implicit.energies(), v - v_hat
        inertia = 0.5 * np.sum(change * (mass @ change))
        drag = np.sum(damping[:, :1] * v * (mass @ v)) + np.sum(damping[:, 1:] * v * (damper @ v.ravel()).reshape(-1, 3))
        return inertia + now.elastic + now.gravity + now.loads + 0.5 * beta * drag

    free, x_hat = model.free.to_numpy(), solver.work.x_hat.to_numpy()
    rng = np.random.default_rng(4)
    base = model.state.v.to_numpy() + 5.0 * free * rng.standard_normal(x_hat.shape)
    fixed_x = model.state.x.to_numpy()

    def put(v):
        model.state.v.from_numpy(v)
        model.state.x.from_numpy(np.where(free > 0, x_hat + beta * v, fixed_x))

    put(base)
    solver.evaluate()
    gradient = solver.work.residual.to_numpy()
    way = free * (rng.standard_normal(x_hat.shape) + gradient / np.abs(gradient * free).max())
    slope, values, h = np.sum(gradient * way), [], 1e-3  # [m/s]
    for step in (h, -h):
        put(base + step * way)
        values.append(objective(base + step * way))
    assert abs(slope) > 100.0  # [J s/m]
    assert (values[0] - values[1]) / (2 * h) == pytest.approx(slope, rel=1e-6)


def check_momentum(sim, drag_at: int) -> None:
    """Reactions, loads, weight and drag make the rate of momentum; elastic forces and their damping add up to 0.

    drag_at: 0 where the drag is that of the step's start, 1 for its end. Where the mass couples nodes, the led ones have
    the acceleration of their path, and no kick where it starts with a velocity.
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
def test_momentum_of_explicit_steps(explicit):
    check_momentum(explicit, 0)


def test_momentum_of_implicit_steps(implicit, monkeypatch):
    monkeypatch.setattr(implicit._dynamics.stepper, "scheme", SCHEMES["implicit_euler"])
    check_momentum(implicit, 1)


@contextmanager
def free_flight(sim, velocities, gravity):
    """The flyer at its start without damping, with the velocities given."""
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


def check_free_fall(sim, method: str) -> None:
    """Four steps, to rounding; the body does not deform."""
    v, gravity = np.array([0.3, -0.2, 0.5]), np.array([0.7, -9.81, -0.4])
    with free_flight(sim, lambda X: np.broadcast_to(v, X.shape), gravity):
        start = sim.positions("flyer")
        for _ in range(4):
            sim.step()
        exact = start + 4 * DT * v + FALL[method](4) * DT**2 * gravity
        assert np.abs(sim.positions("flyer") - exact).max() < 1e-13  # [m]
        assert np.abs(sim.velocities("flyer") - v - 4 * DT * gravity).max() < 1e-10  # [m/s]
        assert np.abs(sim.stress("flyer")).max() < 1e-11 * 1e5  # [Pa], of young


def check_momentum_of_a_free_body(sim, method: str) -> None:
    """Of one that tumbles and vibrates, also about the origin where the integrator conserves that."""
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
        assert change < 1e-11 if method in ANGULAR else 1e-11 < change < 1e-2


def test_a_free_body_in_explicit_steps(explicit):
    check_free_fall(explicit, explicit.settings.integrator)
    check_momentum_of_a_free_body(explicit, explicit.settings.integrator)


@pytest.mark.parametrize("method", IMPLICIT)
def test_a_free_body_in_implicit_steps(implicit, method, monkeypatch):
    monkeypatch.setattr(implicit._dynamics.stepper, "scheme", SCHEMES[method])
    check_free_fall(implicit, method)
    check_momentum_of_a_free_body(implicit, method)


def test_names_mean_what_they_should(monkeypatch):
    for module, name in (
        ("explicit_stepper", "ExplicitStepper"),
        ("explicit_contact_stepper", "ContactExplicitStepper"),
        ("implicit", "ImplicitStepper"),
    ):
        monkeypatch.setattr(f"taisoft.dynamics.{module}.{name}", lambda *arguments, name=name: (name, *arguments))
    idle, contact = NoContacts(), SimpleNamespace(idle=False)
    for integrator in INTEGRATORS:
        settings = Settings(integrator=integrator)
        names = ("ImplicitStepper",) * 2 if integrator in IMPLICIT else ("ExplicitStepper", "ContactExplicitStepper")
        assert make_stepper(None, settings, contact) == (names[1], None, settings, contact)
        assert make_stepper(None, settings, idle)[0] == names[0]
    assert set(IMPLICIT) == {"linearly_implicit_euler", "implicit_euler", "bdf2", "implicit_midpoint"}


def test_the_explicit_stepper_is_that_of_its_integrator(explicit):
    assert explicit._dynamics.stepper.work.verlet == (explicit.settings.integrator == "velocity_verlet")
