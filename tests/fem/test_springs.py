"""Mechanics of springs, tendons and attachments, against closed forms and dense algebra:

* an element without length does not pull;
* a mass on springs steps as each integrator's formula says, hangs m g / k lower, and keeps its energy unless damped;
* tendons slide without friction: equilibria in closed form, one tension in all segments;
* connected free bodies keep momentum, and angular momentum where the integrator does; explicit and implicit paths agree;
* `stable_dt` and `modes` against dense algebra; contacts act beside springs.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.fem.reference import gravity_masses, lumped_masses
from taisoft.fem.springs import spring_table
from taisoft.linear import block_csr
from taisoft.stability import hooke_stiffness, spring_stiffness, stable_dt
from tests.dynamics.scenes import built, connected_scene, cube, dynamics, rubber
from tests.fem.oracle import Oracle
from tests.fem.oracle_springs import OracleSprings
from tests.fem.spring_rig import assembled, kernel_forces

INTEGRATORS = [*EXPLICIT, *IMPLICIT]


def simulator(scene: ts.Scene, integrator: str, dt: float, **settings) -> ts.Simulator:
    tight = {} if integrator in EXPLICIT else {"newton_tolerance": 1e-12, "linear_tolerance": 1e-12}
    return ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64", **tight, **settings)


# --- elements without length ---


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_an_element_without_length_does_not_pull_unless_its_rest_length_is_0(precision):
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="a")
    for k, numbers in enumerate(({"rest_length": 0.5}, {"rest_length": 0.0}, {"rest_length": 0.5, "damping": 3.0})):
        scene.add_spring(("a", 2 * k), ("a", 2 * k + 1), 100.0, **numbers)
    scene.add_tendon([("a", 6), ("a", 7)], 5.0)
    with built(scene, precision) as rig:
        x = np.repeat(rig.oracle.rest[::2], 2, axis=0)
        v = np.random.default_rng(0).standard_normal(x.shape)
        rig.out = rig.vectors("spring_forces")
        assert not kernel_forces(rig, x, v).any()
        table = spring_table(scene)
        assert not table.pulls(x, v, np.array([5.0])).any()
        rig.matrix = block_csr.build_block_csr(rig.model, rig.arena)
        found = assembled(rig, x, 1.0, True)
        assert np.isfinite(found).all() and np.linalg.eigvalsh(found)[0] > -1e-4
        assert found[0, 0] == found[6, 6] == 100.0 and found[18, 18] == 0.0


# --- a mass on springs --------------------------------------------------------------------------------------------------

OMEGA, START, DT = 20.0, 0.05, 4e-3


def mass_on_springs(along: bool, damping: float = 0.0, gravity=(0.0, 0.0, 0.0), total: float | None = None) -> ts.Scene:
    """A cube each of whose nodes hangs on a spring in proportion to its mass, so that it moves as a point mass.

    along: on vertical springs with a rest length; else on springs of rest length 0, to the nodes' own places.
    """
    scene = ts.Scene(gravity=gravity)
    scene.contact_forces = False
    body = scene.add_body(cube(), rubber(young=1e6), name="mass")
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="pin")
    for i, (x, m) in enumerate(zip(body.rest_positions, lumped_masses(scene))):
        k = m * OMEGA**2 if total is None else total * m / body.mass
        end = x + (0, 2, 0) if along else x
        scene.add_spring(("mass", i), ("pin", end), k, rest_length=None if along else 0.0, damping=2 * damping * m)
    return scene


def oscillation(integrator: str, rate: float, steps: int) -> np.ndarray:
    """Displacements (steps + 1,) of x'' = -OMEGA^2 x - 2 rate x' from START at rest, by the integrators' formulas."""
    w, d, dt, x, v = OMEGA**2, 2 * rate, DT, START, 0.0
    path, a, before = [x], -w * START, None
    for n in range(steps):
        if integrator == "symplectic_euler":
            v += dt * (-w * x - d * v)
            x += dt * v
        elif integrator == "velocity_verlet":
            half = v + dt / 2 * a
            x += dt * half
            a = -w * x - d * (half + dt / 2 * a)
            v = half + dt / 2 * a
        else:
            x_hat, v_hat, beta = x, v, dt
            if integrator == "implicit_midpoint":
                beta = dt / 2
            elif integrator == "bdf2" and n:
                x_hat, v_hat, beta = (4 * x - before[0]) / 3, (4 * v - before[1]) / 3, 2 * dt / 3
            before = x, v
            new = (v_hat - beta * w * x_hat) / (1 + beta * d + beta**2 * w)
            x, v = x_hat + beta * new, new
            if integrator == "implicit_midpoint":
                x, v = 2 * x - before[0], 2 * v - before[1]
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize("along, rate", [(False, 0.0), (True, 0.0), (False, 4.0), (True, 4.0)])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_mass_on_springs_follows_each_integrators_formula(integrator, along, rate):
    steps = 100
    expected = oscillation(integrator, rate, steps)
    assert np.ptp(expected) > 1.2 * START  # it swings
    with simulator(mass_on_springs(along, rate), integrator, DT) as sim:
        rest = sim.positions()
        sim.set_state(positions=rest + (0, START, 0))
        energy = [sim.energies().elastic + sim.energies().kinetic]
        assert energy[0] == pytest.approx(0.5 * sim.scene.bodies[0].mass * OMEGA**2 * START**2, rel=1e-9)
        path = [START]
        for _ in range(steps):
            assert sim.step().converged
            path.append(float((sim.positions() - rest)[0, 1]))
            e = sim.energies()
            energy.append(e.elastic + e.kinetic)
        assert np.abs(sim.positions() - rest - (0, path[-1], 0)).max() < 1e-8
    assert np.abs(path - expected).max() < 1e-8
    energy = np.array(energy) / energy[0]
    if rate:
        assert energy[-1] < 0.3 and (np.diff(energy) < 1e-3).all()
    elif integrator == "implicit_midpoint":
        assert np.abs(energy - 1).max() < 1e-8
    elif integrator == "velocity_verlet":
        assert np.abs(energy - 1).max() < (OMEGA * DT / 2) ** 2


def test_the_period_is_that_of_the_closed_form():
    """Of the exact motion, by steps so small that Verlet's own error is below 1e-6."""
    with simulator(mass_on_springs(True), "velocity_verlet", 1e-4) as sim:
        rest = sim.positions()
        sim.set_state(positions=rest + (0, START, 0))
        heights = []
        for _ in range(4000):
            sim.advance(1)
            heights.append(float((sim.positions() - rest)[0, 1]))
    heights = np.array(heights)
    crossings = np.flatnonzero((heights[:-1] > 0) & (heights[1:] <= 0))
    at = crossings + heights[crossings] / (heights[crossings] - heights[crossings + 1])
    assert at[1] - at[0] == pytest.approx(2 * np.pi / OMEGA / 1e-4, rel=1e-5)


@pytest.mark.parametrize("along", [False, True])
def test_static_extension_is_weight_over_stiffness(along):
    k = 2e5
    scene = mass_on_springs(along, gravity=(0, -9.81, 0), total=k)
    result = ts.solve_static(scene, tolerance=1e-9)
    drop = scene.bodies[0].rest_positions - result.positions()
    weight = scene.bodies[0].mass * 9.81
    assert result.converged and drop[:, 1] == pytest.approx(np.full(len(drop), weight / k), rel=1e-6)
    assert np.abs(drop[:, [0, 2]]).max() < 1e-9


@pytest.mark.parametrize("kind", ["spring", "attachment"])
def test_joint_forces_carry_the_weight(kind):
    scene = ts.Scene()
    scene.contact_forces = False
    body = scene.add_body(cube(), rubber(mass_damping=2.0), name="hangs", order=2)
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="pin")
    if kind == "spring":
        scene.add_spring(("hangs", (0, 0.45, 0)), ("pin", (0, 1.5, 0)), 5e4, name="joint")
    else:
        scene.attach("hangs", lambda X: X[:, 1] > 0.44, "pin", 5e4, name="joint")
    with simulator(scene, "implicit_euler", 0.5) as sim:
        for _ in range(150):
            sim.step()
        force = sim.joint_force("joint")
    weight = body.mass * 9.81
    if kind == "spring":
        assert isinstance(force, float) and force == pytest.approx(weight, rel=1e-4)
    else:
        assert force.shape == (len(scene.attachments[0].nodes), 3)
        assert force.sum(axis=0) == pytest.approx((0, weight, 0), rel=1e-4, abs=1e-4 * weight)


def test_joint_forces_have_a_sign_and_damping():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(cube(), rubber(), name="a")
    scene.add_spring(("a", 0), ("a", 4), 100.0, rest_length=1.5, damping=2.0, name="s")
    scene.add_tendon([("a", 0), ("a", 4), ("a", 5)], 7.0, name="t")
    with simulator(scene, "symplectic_euler", 1e-4) as sim:
        x = sim.positions()
        length = np.linalg.norm(x[0] - x[4])
        assert sim.joint_force("s") == pytest.approx(100 * (length - 1.5), rel=1e-12) and sim.joint_force("s") < 0
        assert sim.joint_force("t") == 7.0
        v = np.zeros_like(x)
        v[4] = 3 * (x[4] - x[0]) / length
        sim.set_state(velocities=v)
        assert sim.joint_force("s") == pytest.approx(100 * (length - 1.5) + 6.0, rel=1e-12)
        with pytest.raises(
            ts.SceneError, match=r"joint_force: no spring, tendon or attachment is called 'tt' \(did you mean t\?\)"
        ):
            sim.joint_force("tt")


# --- tendons ------------------------------------------------------------------------------------------------------------


def hung_on_a_tendon(supports, tension: float, point=(0.0, 0.45, 0.0)) -> ts.Scene:
    """A cube that a tendon between two fixed points carries."""
    scene = ts.Scene()
    scene.contact_forces = False
    scene.add_body(cube(), rubber(), name="load")
    scene.add_obstacle(ts.HalfSpace((0, 99, 0), (0, -1, 0)), name="ceiling")
    scene.add_tendon([("ceiling", supports[0]), ("load", point), ("ceiling", supports[1])], tension, name="line")
    return scene


@pytest.mark.parametrize("heights", [(1.5, 1.5), (1.5, 1.9)])
def test_a_load_slides_to_where_both_segments_are_equally_steep(heights):
    left, right = np.array([-1.0, heights[0], 0.0]), np.array([1.3, heights[1], 0.0])
    weight = 990 * 9.81
    tension = 0.9 * weight
    cosine = weight / (2 * tension)  # of the angle with the vertical, in both segments
    sine = np.sqrt(1 - cosine**2)
    total, difference = (right - left)[0] / sine, (left - right)[1] / cosine
    first = 0.5 * (total + difference)
    expected = left + first * np.array([sine, -cosine, 0.0])
    scene = hung_on_a_tendon((left, right), tension)
    result = ts.solve_static(scene, tolerance=1e-10)
    point = OracleSprings(scene).point("load", (0, 0.45, 0))[0] @ result.positions()
    assert result.converged and point == pytest.approx(expected, abs=1e-6)


def test_a_tendon_pulls_each_point_along_both_segments_with_one_tension():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(cube(), rubber(), name="a")
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="pin")
    scene.add_tendon([("pin", (0, 2, 0)), ("a", 3), ("a", 6), ("pin", (1, 2, 0)), ("pin", (2, 2, 2)), ("a", 1)], 5.0, name="t")
    x = scene.bodies[0].rest_positions + 0.1 * np.random.default_rng(1).standard_normal((8, 3))

    def unit(p, q):
        return (np.array(q) - p) / np.linalg.norm(np.array(q) - p)

    expected = np.zeros((8, 3))
    expected[3] = 5 * (unit(x[3], (0, 2, 0)) + unit(x[3], x[6]))
    expected[6] = 5 * (unit(x[6], x[3]) + unit(x[6], (1, 2, 0)))
    expected[1] = 5 * unit(x[1], (2, 2, 2))
    with built(scene, "f64") as rig:
        rig.out = rig.vectors("spring_forces")
        assert np.abs(kernel_forces(rig, x, np.zeros_like(x)) - expected).max() < 1e-12
    assert len(spring_table(scene).offset) == 4  # none between the two points of obstacles


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_paths_of_tensions_are_those_of_the_integrators_times(integrator):
    """Two cubes are pulled together: the momentum of one is the integrator's quadrature of the tension."""
    steps, dt = 6, 1e-3
    frames = ts.KeyFrames((0.0, 0.004), values=(10.0, 90.0))
    results = []
    for force in (frames, lambda t: 10.0 + 20e3 * min(t, 0.004)):
        scene = ts.Scene(gravity=(0, 0, 0))
        scene.contact_forces = False
        scene.add_body(cube(), rubber(), name="a")
        scene.add_body(cube((4, 0, 0)), rubber(), name="b")
        scene.add_tendon([("a", (0, 0, 0)), ("b", (4, 0, 0))], force, name="line")
        with simulator(scene, integrator, dt) as sim:
            sim.advance(steps) if integrator in EXPLICIT else [sim.step() for _ in range(steps)]
            results.append(lumped_masses(scene)[:8] @ sim.velocities("a"))
            assert sim.joint_force("line") == 90.0
            sim.set_tension("line", 3.0)
            before = results[-1]
            sim.step()
            gained = lumped_masses(scene)[:8] @ sim.velocities("a") - before
            if integrator != "bdf2":  # whose steps depend on earlier ones, too
                assert gained[0] == pytest.approx(3.0 * dt, rel=1e-4)
            assert sim.joint_force("line") == 3.0
            with pytest.raises(ts.SceneError, match="tendon 'line': force must be at least 0 N, not -1: a tendon cannot push"):
                sim.set_tension("line", -1.0)
            with pytest.raises(ts.SceneError, match=r"set_tension: no tendon is called 'lime' \(did you mean line\?\)"):
                sim.set_tension("lime", 1.0)
    T = [10.0 + 20e3 * min(k * dt / 2, 0.004) for k in range(2 * steps + 1)]
    p = [0.0]
    for n in range(steps):
        start, middle, end = T[2 * n : 2 * n + 3]
        if integrator == "bdf2" and n:
            p.append((4 * p[n] - p[n - 1] + 2 * dt * end) / 3)
        else:
            mean = {"symplectic_euler": start, "velocity_verlet": (start + end) / 2, "implicit_midpoint": middle}
            p.append(p[n] + dt * mean.get(integrator, end))
    for momentum in results:
        assert momentum == pytest.approx((p[-1], 0, 0), rel=1e-6, abs=1e-6 * p[-1])


@pytest.mark.parametrize("integrator", EXPLICIT)
def test_parallel_and_batched_substeps_equal_serial_single_ones(integrator):
    """With damping, a tension along a path, and what the two keep between sub-steps."""
    results = []
    for serial, batches in ((True, [1] * 12), (True, [5, 7]), (False, [12])):
        scene = connected_scene(damping=8.0)
        scene.add_tendon([("a", 5), ("b", 2)], ts.KeyFrames((0.0, 0.004, 0.02), values=(10.0, 900.0, 0.0)))
        with dynamics(scene, dt=1e-3, integrator=integrator, precision="f64") as made:
            made.stepper.simulation.model = replace(made.state.model, serial=serial)
            for n in batches:
                made.advance(n)
            results.append(made.state.state())
    assert np.abs(results[0][1]).max() > 0.1
    for other in results[1:]:
        assert all(np.abs(a - b).max() < 1e-12 for a, b in zip(results[0], other))


@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_euler"])
def test_a_tension_that_becomes_negative_along_its_path_stops_the_run(integrator):
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(cube(), rubber(), name="a")
    scene.add_tendon([("a", 0), ("a", 4)], lambda t: 1.0 - 1e3 * t, name="line")
    message = "tendon 'line': its path gave -[0-9.]+ N at t = 0.00[0-9]+ s: a tendon cannot push"
    with simulator(scene, integrator, 1e-4) as sim, pytest.raises(ts.SimulationError, match=message):
        for _ in range(20):
            sim.step()


# --- conservation, and integrators against each other ----------------------------------------------------------------------


def flying(order: int, damping: float = 0.0) -> ts.Scene:
    """The connected bodies, thrown apart and turning, with nothing that holds them."""
    scene = connected_scene(order, damping, anchored=False)
    for k, body in enumerate(scene.bodies):
        body.velocity = np.cross((0.3, 1.0, -2.0), body.rest_positions) + (1.0 - k, 0.5 * k, 0.2)
    return scene


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_connected_free_bodies_keep_their_momentum(integrator, order):
    scene = flying(order, damping=5.0)
    masses = (lumped_masses if integrator in EXPLICIT else gravity_masses)(scene)
    with simulator(scene, integrator, 2e-4) as sim:
        before, start = masses @ sim.velocities(), masses[:12] @ sim.velocities()[:12]
        for _ in range(30):
            sim.advance(1) if integrator in EXPLICIT else sim.step()
        after = masses @ sim.velocities()
        assert np.abs(masses[:12] @ sim.velocities()[:12] - start).max() > 1e-2  # one of the bodies alone does not
    assert after == pytest.approx(before, rel=1e-9, abs=1e-9 * np.abs(before).max())


@pytest.mark.parametrize("integrator", ["velocity_verlet", "symplectic_euler", "implicit_midpoint"])
def test_connected_free_bodies_keep_their_angular_momentum(integrator):
    scene = flying(1)
    masses = lumped_masses(scene)[:, None]
    with simulator(scene, integrator, 2e-4) as sim:
        moments = []
        for _ in range(50):
            moments.append((masses * np.cross(sim.positions(), sim.velocities())).sum(axis=0))
            sim.advance(1) if integrator in EXPLICIT else sim.step()
    assert np.abs(np.array(moments) - moments[0]).max() < 1e-9 * np.linalg.norm(moments[0])


@pytest.mark.parametrize("damping", [0.0, 20.0])
def test_explicit_and_implicit_paths_agree(damping):
    """Midpoint and Verlet with small steps; their difference is of second order."""
    differences = []
    for dt in (4e-4, 2e-4):
        ends = []
        for integrator in ("velocity_verlet", "implicit_midpoint"):
            with simulator(connected_scene(1, damping, (0, -9.81, 0)), integrator, dt) as sim:
                for _ in range(round(0.02 / dt)):
                    sim.advance(1) if integrator in EXPLICIT else sim.step()
                ends.append(sim.positions())
        differences.append(np.abs(ends[0] - ends[1]).max())
    moved = np.abs(ends[0] - Oracle(connected_scene()).rest).max()
    assert (
        moved > 1e-3 and differences[1] < 1e-3 * moved and np.log2(differences[0] / differences[1]) == pytest.approx(2, abs=0.4)
    )


@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_midpoint"])
def test_energy_of_connected_bodies(integrator):
    """It stays, up to the integrators' own oscillation, without damping, and falls with it; the report's check finds nothing."""
    for damping in (0.0, 300.0):
        with simulator(connected_scene(1, damping), integrator, 2e-4) as sim:
            before = sum_of(sim.energies())
            result = sim.run(seconds=0.1, fps=None)
            after = sum_of(sim.energies())
        assert result.status == "ok", result.problems
        if damping:
            assert after < before - 1.0  # [J]
        else:
            assert after == pytest.approx(before, abs=0.05)


def sum_of(energies) -> float:
    return energies.kinetic + energies.elastic + energies.gravity + energies.loads


# --- linear vibration -------------------------------------------------------------------------------------------------------


def dense(scene) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and lumped mass (3n,3n) at the start."""
    oracle = Oracle(scene)
    K = oracle.stiffness(oracle.rest) + OracleSprings(scene).stiffness(oracle.rest)
    return 0.5 * (K + K.T), np.kron(oracle.inertia(explicit=True), np.eye(3))


def stiffened(stiffness: float, order: int, tension: float = 40.0) -> ts.Scene:
    scene = connected_scene(order)
    scene.tendons.clear()
    scene.add_tendon([("a", 5), ("b", (0.7, 0.0, 0.1))], tension)
    scene.add_spring(("a", 7), ("b", (0.9, 0.2, -0.1)), stiffness, name="strong")
    return scene


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("stiffness, tension", [(1.0, 1.0), (3e4, 1.0), (3e5, 1.0), (1e8, 1.0), (1.0, 1e6)])
def test_stable_dt_is_a_lower_bound_of_the_limit(order, stiffness, tension):
    scene = stiffened(stiffness, order, tension)
    K, M = dense(scene)
    limit = 2 / np.sqrt(la.eigh(K, M, eigvals_only=True)[-1])
    found = stable_dt(scene, verlet=False)
    assert 0.7 * limit < found < 1.0001 * limit
    assert stable_dt(scene, verlet=True) == found


def test_stable_dt_with_many_attached_nodes(recwarn):
    """Their largest eigenvalue comes from Lanczos' method."""
    scene = ts.Scene()
    for name, y in (("a", 0.0), ("b", 0.5)):
        scene.add_body(ts.box_mesh((10, 1, 10), (2, 0.5, 2), (0, y, 0)), rubber(), name=name)
    scene.attach("a", lambda X: X[:, 1] > 0.24, "b", 1e5)
    assert len(spring_table(scene).offset) == 121
    K = (
        sp.block_diag([hooke_stiffness(body) for body in scene.bodies]).toarray()
        + spring_stiffness(scene, spring_table(scene)).toarray()
    )
    scale = np.repeat(1 / np.sqrt(lumped_masses(scene)), 3)
    limit = 2 / np.sqrt(la.eigvalsh(scale[:, None] * K * scale, subset_by_index=[len(K) - 1] * 2)[0])
    assert 0.7 * limit < stable_dt(scene, verlet=False) < 1.0001 * limit


@pytest.mark.parametrize("integrator", EXPLICIT)
@pytest.mark.parametrize("damping", [0.0, 1e3])
def test_steps_below_stable_dt_are_stable_and_far_above_explode(integrator, damping, recwarn):
    scene = mass_on_springs(False, 0.0, total=1e9)
    if damping:
        scene.add_spring(("mass", 0), ("pin", (0, 5, 0)), 10.0, damping=damping)
    limit = stable_dt(scene, integrator == "velocity_verlet")
    grew = []
    for factor in (0.98, 1.6):
        with simulator(scene.snapshot(), integrator, factor * limit, allow_unstable=True) as sim:
            x = sim.positions()
            sim.set_state(positions=x + 1e-9 * np.random.default_rng(0).standard_normal(x.shape))
            try:
                sim.advance(400)
                grew.append(float(np.abs(sim.positions() - x).max()))
            except ts.SimulationError:
                grew.append(np.inf)
    assert grew[0] < 1e-6 < grew[1]


@pytest.mark.parametrize("order", [1, 2])
def test_modes_match_dense_algebra(order):
    scene = stiffened(3e4, order)
    scene.springs.remove(scene.springs[0])  # one that pushes makes the start unstable
    K, M = dense(scene)
    expected = np.sqrt(np.maximum(la.eigh(K, M, eigvals_only=True)[:12], 0)) / (2 * np.pi)
    found = ts.modes(scene, 12)
    assert found.frequencies == pytest.approx(expected, rel=1e-5, abs=1e-3) and expected[0] > 0.03
    shapes = found.shapes.reshape(12, -1)
    assert np.abs(shapes @ M @ shapes.T - np.eye(12)).max() < 1e-6


# --- with contacts, and large -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet", "implicit_euler", "bdf2"])
def test_a_cube_on_a_spring_lands_on_a_plane(integrator):
    """The ground carries what the spring does not."""
    scene = ts.Scene()
    body = scene.add_body(cube(size=(1, 1, 1)), rubber(mass_damping=30.0), name="cube")
    scene.add_obstacle(ts.HalfSpace((0, -0.52, 0), (0, 1, 0)), name="ground")
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="pin")
    scene.attach("cube", lambda X: X[:, 1] > 0.49, "pin", 1e4, damping=50.0, name="spring")
    with ts.Simulator(scene, dt=1e-3 if integrator in EXPLICIT else 0.01, integrator=integrator, precision="f64") as sim:
        result = sim.run(seconds=2.0)
        assert result.status == "ok", result.problems
        joint, ground = sim.joint_force("spring").sum(axis=0), sim.contact_force("cube")
        ground -= 30.0 * lumped_masses(scene) @ sim.velocities()  # mass damping of what velocity is left
        weight = body.mass * 9.81
        assert 0.02 * weight < joint[1] < 0.5 * weight
        assert joint + ground == pytest.approx((0, weight, 0), abs=0.01 * weight)


def test_many_attached_nodes_in_an_implicit_step():
    """Two halves of a bar joined by stiff springs bend as the whole bar does, also where multigrid preconditions."""
    tips = []
    for cut in (False, True):
        scene = ts.Scene()
        scene.contact_forces = False
        if cut:
            scene.add_body(ts.box_mesh((10, 3, 3), (2, 0.6, 0.6), (1, 0, 0)), rubber(), name="left")
            scene.add_body(ts.box_mesh((10, 3, 3), (2, 0.6, 0.6), (3, 0, 0)), rubber(), name="right")
            scene.attach("left", lambda X: X[:, 0] > 1.99, "right", 1e8)
        else:
            scene.add_body(ts.box_mesh((20, 3, 3), (4, 0.6, 0.6), (2, 0, 0)), rubber(), name="left")
        scene.body("left").fix(lambda X: X[:, 0] < 0.01)
        for body in scene.bodies:
            body.material = rubber(young=3e6)
        result = ts.solve_static(scene, tolerance=1e-8)
        assert result.converged
        tips.append(result.positions(scene.bodies[-1].name)[:, 1].min())
    assert tips[1] == pytest.approx(tips[0], rel=1e-4) and tips[0] < -0.35
