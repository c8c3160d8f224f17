"""Steps of every integrator, in f64.

The driven scene has fixed, prescribed and released nodes, loads and damping. Its bodies are quadratic for two integrators; for
the others they are linear and have stiffness damping, too.

* positions, velocities and reactions match the oracle step by step, also with parallel kernels, and so do energies;
* a batch of explicit steps equals single steps, ends when nodes are released, and names a step that fails;
* a free body falls exactly, and keeps its momentum without gravity;
* a body that starts with the velocity of its prescribed end moves rigidly, and flies on when its path ends with a step.

Dirichlet conditions: fixed and prescribed axes are constrained until the group is released, which a reset undoes; targets are the
rest positions plus the path's displacement, one for all nodes or one for each, until the first release; a step that ends with a
path follows it to there, its accelerations too; paths that fail, give invalid values or depend on more than time are refused;
a jump is distinguished from motion.
"""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.dynamics.prescribed_paths import PrescribedPaths, find_jump
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from tests.dynamics.following import DT, follow, simulator
from tests.dynamics.scenes import cube, driven_scene, element, rows_of, rubber, use_threads
from tests.fem.oracle import Oracle

QUADRATIC = ("symplectic_euler", "linearly_implicit_euler")  # each compiles kernels for order 2, which takes long
TIGHT = {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13}
VELOCITY = np.array([2.0, 0.0, -1.0])  # [m/s] of a bar
FALL = {  # after n steps from rest, in units of g dt^2; BDF2 keeps the error of its first step, which is implicit Euler's
    "symplectic_euler": lambda n: n * (n + 1) / 2,
    "implicit_euler": lambda n: n * (n + 1) / 2,
    "linearly_implicit_euler": lambda n: n * (n + 1) / 2,
    "velocity_verlet": lambda n: n * n / 2,
    "implicit_midpoint": lambda n: n * n / 2,
    "bdf2": lambda n: n * n / 2 + 0.75 * (1 - 3.0**-n),
}
CONSERVE_ANGULAR_MOMENTUM = ("symplectic_euler", "velocity_verlet", "implicit_midpoint")


def driven_simulator(integrator: str) -> ts.Simulator:
    own = {"order": 2} if integrator in QUADRATIC else {"stiffness_damping": 0.004}
    return simulator(driven_scene(mass_damping=3.0, **own), integrator, **(TIGHT if integrator in IMPLICIT else {}))


@pytest.fixture(scope="module", params=[*EXPLICIT, *IMPLICIT])
def sim(request):
    with driven_simulator(request.param) as made:
        yield made


def by(*integrators: str):
    """Run a test with these integrators only."""
    return pytest.mark.parametrize("sim", integrators, indirect=True)


def test_steps_match_the_oracle(sim):
    """Until two of the three prescribed nodes have been released; energies there."""
    explicit = sim.settings.explicit
    oracle = follow(sim, sim.settings.integrator, 9, 1e-10 if explicit else 1e-8)
    assert len(oracle.prescribed) == 1
    now = sim.energies()
    expected = oracle.kinetic(oracle.v, explicit), oracle.energy(oracle.x), oracle.weight(oracle.x, explicit)
    assert (now.kinetic, now.elastic, now.gravity) == pytest.approx(expected, rel=1e-6)


@by(*EXPLICIT)
def test_batches_end_when_nodes_are_released(sim):
    follow(sim, sim.settings.integrator, 9, 1e-10)
    single = sim.positions(), sim.velocities()
    sim.reset()
    assert [sim.advance(n).steps for n in (9, 5)] == [4, 5]
    # the times of a batch are rounded differently from those of single steps
    assert np.abs(sim.positions() - single[0]).max() < 1e-13
    assert np.abs(sim.velocities() - single[1]).max() < 1e-11


@by("bdf2")
def test_bdf2_restarts_after_a_change_of_dt_or_state(sim):
    """The next step is implicit Euler's, since the history is no longer valid; a change of gravity keeps it."""
    for change in ("dt", "state", "gravity"):
        oracle, dt = follow(sim, "bdf2", 2, 1e-8), DT
        if change == "dt":
            sim.dt = dt = DT / 2
        elif change == "state":
            oracle.x = oracle.x + 0.001 * np.sin(oracle.x)
            sim.set_state(positions=oracle.x)
        else:
            oracle.gravity = np.array([0.0, 5.0, 0.0])
            sim.set_gravity(oracle.gravity)
        if change != "gravity":
            oracle.past = []
        for _ in range(2):
            sim.step()
            oracle.bdf2(dt)
            assert np.abs(sim.positions() - oracle.x).max() < 1e-10  # [m]
        sim.dt = DT
    sim.set_gravity((0.3, -9.81, 0.7))


def test_parallel_kernels_match_the_oracle(monkeypatch):
    use_threads(monkeypatch)
    with simulator(driven_scene(mass_damping=3.0), "symplectic_euler") as sim:
        follow(sim, "symplectic_euler", 9, 1e-10)
        first = sim.positions(), sim.velocities(), sim.reactions()
        sim.reset()
        while sim.step_count < 9:
            sim.advance(9 - sim.step_count)
        assert np.abs(sim.positions() - first[0]).max() < 1e-13  # [m]; times of a batch are rounded differently
        sim.reset()
        for _ in range(9):
            sim.step()
        assert all(np.array_equal(a, b) for a, b in zip(first, (sim.positions(), sim.velocities(), sim.reactions())))


@by("symplectic_euler")
def test_a_failing_step_within_a_batch_is_named(sim):
    """The state is that of the last good step."""
    sim.reset()
    sim.advance(4)
    v = np.zeros_like(sim.positions())  # along the beam only, so that it stays away from the flyer
    v[rows_of(sim, "beam"), 0] = 1e33 * np.sin(sim.positions("beam")[:, 0])
    sim.set_state(velocities=v)
    with pytest.raises(ts.SimulationError, match=r"step \d: body 'beam', node"):
        sim.advance(5)
    failed, x = sim.step_count, sim.positions()
    assert 4 <= failed < 9 and np.isfinite(x).all() and np.isfinite(sim.velocities()).all()
    with pytest.raises(ts.SimulationError, match=f"step {failed + 1}: "):
        sim.step()
    assert np.array_equal(sim.positions(), x)


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


def test_a_free_body_falls_exactly(sim):
    """Four steps, to rounding."""
    v, gravity = np.array([0.3, -0.2, 0.5]), np.array([0.7, -9.81, -0.4])
    with free_flight(sim, lambda X: np.broadcast_to(v, X.shape), gravity):
        start = sim.positions("flyer")
        for _ in range(4):
            sim.step()
        exact = start + 4 * DT * v + FALL[sim.settings.integrator](4) * DT**2 * gravity
        assert np.abs(sim.positions("flyer") - exact).max() < 1e-13  # [m]
        assert np.abs(sim.velocities("flyer") - v - 4 * DT * gravity).max() < 1e-10  # [m/s]


def test_a_body_that_tumbles_and_vibrates_keeps_its_momentum(sim):
    """And its angular momentum if the integrator conserves it."""
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


@pytest.mark.parametrize("releases", [False, True])
@pytest.mark.parametrize("integrator", IMPLICIT)
def test_a_bar_moves_rigidly_with_its_prescribed_end(integrator, releases):
    """Undamped, from its start at VELOCITY and after `set_state`; or its path ends with a step, and it flies on."""
    path = ts.KeyFrames((0.0, 3e-4), [(0.0, 0.0, 0.0), 3e-4 * VELOCITY], release=True) if releases else lambda t: VELOCITY * t
    scene = ts.Scene(gravity=(0, 0, 0))
    own = {"order": 2} if integrator in QUADRATIC else {}
    damped = rubber(mass_damping=3.0, stiffness_damping=0.0 if own else 0.004)
    bar = scene.add_body(cube(cells=(2, 1, 1)), damped, name="bar", velocity=VELOCITY, **own)
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


both_orders = pytest.mark.parametrize("order, n", [(1, 8), (2, 26)])  # of the second body, and its number of nodes


def made(*paths, order: int = 1):
    """Two cubes; the second, 1 m higher, is moved by paths (nodes, axes, path) and fixed at node 7 along x, y."""
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="still").fix([2], axes="z")
    second = scene.add_body(cube(), rubber(), name="prescribed", position=(0, 1, 0), **element(order))
    second.fix([7], axes="xy")
    for nodes, axes, path in paths:
        second.move(nodes, path, axes=axes)
    rest = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
    layout = SimpleNamespace(rest=rest, node_start=np.array([0, 8, len(rest)]))
    return DirichletConditions(scene, layout), rest


def until(end, path):
    return lambda t: None if t > end else path(t)


@both_orders
def test_masks_and_targets(order, n):
    """Those at the end are at the middle of an edge if the body is quadratic."""
    displacement = np.array([[1.0, 2, 3], [4, 5, 6]])
    paths = ([1, 0], "xz", lambda t: t * displacement), ([1, n - 2], "y", lambda t: (0, -t, 0))
    dirichlet, rest = made(*paths, order=order)
    expected = np.zeros((8 + n, 3), dtype=bool)
    expected[2, 2] = expected[15, :2] = True
    expected[[8, 9], 0] = expected[[8, 9], 2] = expected[[9, 6 + n], 1] = True
    assert np.array_equal(dirichlet.constrained(), expected)
    assert list(dirichlet.prescribed_nodes) == [9, 8, 9, 6 + n] and dirichlet.n_prescribed == 4
    assert list(dirichlet.held) == sorted([2, 8, 9, 6 + n, 15])
    assert dirichlet.prescribed_axes().tolist() == [[1, 0, 1], [1, 0, 1], [0, 1, 0], [0, 1, 0]]
    rows, releasing = dirichlet.targets(np.array([0.5, 2.0]))
    assert rows.shape == (2, 4, 3) and not releasing
    for row, t in zip(rows, (0.5, 2.0)):
        assert row == pytest.approx(np.concatenate([rest[[9, 8]] + t * displacement, rest[[9, 6 + n]] + [[0, -t, 0]]]))


def test_release():
    dirichlet, rest = made(([0, 1], "xyz", until(1.0, lambda t: (t, 0, 0))), ([3], "y", until(2.0, lambda t: (0, t, 0))))
    times = np.array([0.5, 1.0, 1.5, 1.75, 2.5])
    rows, releasing = dirichlet.targets(times)
    assert len(rows) == 2 and releasing and dirichlet.constrained()[8].all()  # not released before its time
    rows, releasing = dirichlet.targets(times[2:])
    assert len(rows) == 0 and releasing and not dirichlet.constrained()[[8, 9]].any() and dirichlet.constrained()[11, 1]
    assert dirichlet.prescribed_axes().tolist() == [[0, 0, 0], [0, 0, 0], [0, 1, 0]]
    rows, releasing = dirichlet.targets(times[2:])
    assert len(rows) == 2 and releasing and rows[1, 2] == pytest.approx(rest[11] + [0, 1.75, 0])
    assert dirichlet.targets(times[4:])[1] and not dirichlet.targets(times[4:])[1]
    dirichlet.released[:] = False
    assert dirichlet.constrained()[8].all() and len(dirichlet.targets(times)[0]) == 2


@pytest.mark.parametrize("steps", [3, 10, 1000])
def test_a_step_that_ends_with_the_path_follows_it_to_there(steps):
    """Whatever the rounding of the step's end: nodes are not released a step early, and accelerations are those until then."""
    dirichlet, rest = made(([0, 1], "xyz", lambda t: (t * t, 0.0, 0.0) if t < 0.3 else None))
    dt = 0.3 / steps
    for middle in (False, True):
        assert dirichlet.accelerations(0.3 - dt, dt, middle) == pytest.approx(np.tile((2.0, 0.0, 0.0), (2, 1)), abs=1e-6)
    rows, releasing = dirichlet.targets(dt * np.arange(1, steps + 2))
    assert len(rows) == steps and releasing and rows[-1, 0] == pytest.approx(rest[8] + [0.09, 0, 0], abs=1e-8)


@pytest.mark.parametrize(
    "late, words",
    [
        (lambda t: np.zeros((3, 3)), r"'s displacement at t = 1.5 must have shape \(3,\) or \(2, 3\), not \(3, 3\)$"),
        (lambda t: (0, np.nan, 0), r"'s displacement at t = 1.5: entry \[1\] is nan, not finite$"),
        (lambda t: ("1", "2", "3"), r"'s displacement at t = 1.5 must be numbers of shape \(3,\) or \(2, 3\), not .*"),
        (lambda t: (0, 1e39, 0), r"'s displacement at t = 1.5: entry \[1\] is 1e\+39, too large for a 32-bit float$"),
        (lambda t: {}["a\n b"], r" failed at t = 1.5: KeyError: 'a.n b'$"),
    ],
)
def test_invalid_paths_are_refused(late, words):
    dirichlet, _ = made(([0, 1], "xyz", lambda t: (0, 0, 0) if t < 1 else late(t)))
    dirichlet.targets(np.array([0.5]))
    with pytest.raises(ts.SimulationError, match=f"^body 'prescribed': moved nodes: the path{words}"):
        dirichlet.targets(np.array([1.5]))


def test_a_displacement_after_a_release_is_refused():
    """Also in a part of the step, where accelerations need the path."""
    dirichlet, _ = made(([0, 1], "xyz", lambda t: None if 0.004 < t < 0.006 else (t, 0.0, 0.0)))
    with pytest.raises(ts.SimulationError, match="body 'prescribed': moved nodes: the path gave None at t = 0.005,"):
        dirichlet.targets(np.array([0.01]))
        dirichlet.accelerations(0.0, 0.01, True)


@pytest.mark.parametrize(
    "height, refused",  # of t and of past commands, one a step of 0.1 s
    [
        (lambda t, past: np.interp(t, 0.1 * np.arange(len(past)), past), False),
        (lambda t, past: None if t > 0.25 else np.sin(t), False),
        (lambda t, past: 1 / (t < 0.25), False),  # the step that uses the value refuses it
        (lambda t, past: past[-1], True),
        (lambda t, past: np.random.random(), True),
        (lambda t, past: None if past[-1] > 2 else 0.0, True),
    ],
)
def test_only_functions_of_time_alone_are_paths(height, refused):
    past, scene, found = [0.0], ts.Scene(), ""
    path = lambda t: None if (y := height(t, past)) is None else (0.0, y, 0.0)  # noqa: E731
    name = scene.add_body(cube(), rubber(), name="it").name
    group = SimpleNamespace(name=name, path=path, given_path=path, nodes=np.array([3, 1]))
    paths = PrescribedPaths(scene, SimpleNamespace(groups=[group]))
    for k in range(5):
        paths.remember(0.1 * k * (1 + 1e-15))
        past.append(float(k))
        try:
            paths.check()
        except ts.SimulationError as error:
            found = str(error)
    assert found.startswith("body 'it': moved nodes: the path gives another value at t = ") == refused == bool(found)
    assert ("sim.set_displacement" in found) == refused


@pytest.mark.parametrize(
    "height, at",  # of t in a step from 1 s to 2 s
    [
        (lambda t: 0.02 * (t > 1.3), 1.3),
        (lambda t: 3.0 * t + 1e-3 * (t >= 1.7), None),  # less than the motion
        (lambda t: max(t - 1.5, 0.0), None),
        (lambda t: (t - 1.0) ** 4, None),
        (lambda t: (t - 1.0) ** 0.3, None),
        (lambda t: float(np.float32(1.0 + 1e-7 * t)), None),
        (lambda t: 2.0, None),
        (lambda t: None if t > 1.5 else 0.0, None),
    ],
)
def test_jumps_are_distinguished_from_motion(height, at):
    value = lambda t: None if (y := height(t)) is None else np.array([0.0, y, 0.0])  # noqa: E731
    found = find_jump(value, 1.0, value(1.0), 2.0, value(2.0))
    assert found == (None if at is None else (pytest.approx(at, abs=1e-3), pytest.approx(0.02)))
