"""Springs, tendons and attachments:

* in random states forces with damping, energies, stiffness and damping matrices are those of `oracle_springs`, on linear and
  quadratic tets; the projected stiffness has no negative part; an element without length does not pull;
* forces turn with the state, have no resultant, and do not depend on the order of the bodies;
* a mass on springs, whose support may move, steps as each integrator's formula says, and hangs m g / k lower;
* connected free bodies keep momentum and angular momentum;
* `stable_dt` and the stiffness of linear vibration agree with dense algebra.
"""

import numpy as np
import pytest
import scipy.linalg as la
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.fem.loads import SceneLoads
from taisoft.fem.measure import measure
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.reference import lumped_masses
from taisoft.fem.springs import spring_table
from taisoft.fem.state import ELASTIC, LOADS
from taisoft.fem.terms import springs
from taisoft.fem.terms.elasticity import prepare_terms
from taisoft.linear import block_csr
from taisoft.stability import spring_stiffness, stable_dt
from tests.collision.rotations import rotation
from tests.dynamics.companion import add_companion, simulator
from tests.dynamics.scenes import built, connected_scene, cube, rubber
from tests.fem.oracle import Oracle
from tests.fem.oracle_springs import OracleSprings

INTEGRATORS = [*EXPLICIT, *IMPLICIT]

# --- elements -----------------------------------------------------------------------------------------------------------


@kernel
def spring_forces(m: ti.template(), out: ti.template()):
    """The force of all elements on every node."""
    prepare_terms(m)
    ti.loop_config(serialize=True)
    for i in range(m.n_nodes):
        out[i] = springs.force(m, i)


def kernel_forces(rig, x, v, model=None) -> np.ndarray:
    model = model or rig.model
    model.state.x.from_numpy(x)
    model.state.v.from_numpy(v)
    spring_forces(model, rig.out)
    return rig.out.to_numpy()


def assembled(rig, x, beta: float, projected: bool) -> np.ndarray:
    """What the connections add to the matrix of an implicit step, dense."""
    m, A = rig.model, rig.matrix
    m.state.x.from_numpy(x)
    A.value.fill(0.0)  # without elasticity
    A.diagonal.fill(0.0)
    block_csr.to_system(m, A, A, EVERYTHING, int(projected), 0.0, beta)
    return block_csr.to_scipy(m, A).toarray()


@pytest.fixture(scope="module", params=(1, 2))
def rig(request):
    with built(add_companion(connected_scene(request.param, damping=8.0), varied=False), "f64") as made:
        rng = np.random.default_rng(5)
        made.x = made.oracle.rest + 0.02 * rng.standard_normal(made.oracle.rest.shape)
        made.v = rng.standard_normal(made.x.shape)
        made.springs, made.out = OracleSprings(made.scene), made.vectors("spring_forces")
        made.matrix = block_csr.build_block_csr(made.model, made.arena)
        yield made


def test_forces_are_those_of_the_definition(rig):
    amplitudes, table = SceneLoads(rig.scene, spring_table(rig.scene)).amplitudes([0.0])[0], spring_table(rig.scene)
    assert len(range(*table.elements["line"].indices(99))) == 4  # none between two points of obstacles
    for v in (np.zeros_like(rig.v), rig.v):
        expected = rig.springs.force(rig.x, v)
        size = np.abs(expected).max()
        assert size > 100.0
        for model in (rig.model, rig.parallel):
            assert np.abs(kernel_forces(rig, rig.x, v, model) - expected).max() < 1e-12 * size
        on_first = table.pulls(rig.x, v, amplitudes)
        on_nodes = np.zeros_like(expected)
        np.add.at(on_nodes, table.node, table.weight[:, None] * on_first[table.element])
        assert np.abs(on_nodes - expected).max() < 1e-12 * size


def test_energies_are_those_of_the_definition(rig):
    """Of which the forces are minus the gradient."""
    rig.model.state.x.from_numpy(rig.x)
    measure(rig.model)
    stored, scalars = rig.oracle.energy(rig.x), rig.model.state.scalars
    assert scalars[ELASTIC] + scalars[LOADS] - stored == pytest.approx(rig.springs.energy(rig.x), rel=1e-9, abs=1e-6 * stored)
    way = np.random.default_rng(1).standard_normal(rig.x.shape)
    slope = np.imag(rig.springs.energy(rig.x + 1e-30j * way)) / 1e-30
    assert (rig.springs.force(rig.x) * way).sum() == pytest.approx(-slope, rel=1e-10)


def test_assembled_rows_are_the_derivatives_of_the_forces(rig):
    beta = 0.3
    expected = beta**2 * rig.springs.stiffness(rig.x) + beta * rig.springs.damping(rig.x)
    found, size = assembled(rig, rig.x, beta, projected=False), np.abs(expected).max()
    assert np.abs(found - expected).max() < 1e-7 * size and np.abs(found - found.T).max() <= 1e-13 * size
    assert np.linalg.eigvalsh(found)[0] < -1.0  # a spring pushes
    projected = assembled(rig, rig.x, beta, projected=True)
    assert np.linalg.eigvalsh(0.5 * (projected + projected.T))[0] > -1e-14 * size
    pushed = np.abs(projected - found).max(axis=0) > 1e-4 * size
    (pushing,) = rig.springs.elements["pushes"]
    assert (pushed <= np.repeat(pushing[0] != 0, 3)).all() and pushed.any()


def test_an_element_without_length_does_not_pull_unless_its_rest_length_is_0():
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="a")
    for k, numbers in enumerate(({"rest_length": 0.5, "damping": 3.0}, {"rest_length": 0.0})):
        scene.add_spring(("a", 2 * k), ("a", 2 * k + 1), 100.0, **numbers)
    with built(add_companion(scene, varied=False), "f64") as rig:
        x = rig.oracle.rest.copy()
        x[1:8:2] = x[0:8:2]
        rig.out, rig.matrix = rig.vectors("spring_forces"), block_csr.build_block_csr(rig.model, rig.arena)
        assert not kernel_forces(rig, x, np.zeros_like(x)).any()
        found = assembled(rig, x, 1.0, True)
        assert np.isfinite(found).all() and found[6, 6] == pytest.approx(100.0)


def test_forces_do_not_depend_on_rotation_translation_or_the_order_of_bodies():
    scene = connected_scene(1, damping=8.0, anchored=False)
    rng, R, free, table = np.random.default_rng(5), rotation((1.0, -2.0, 0.5), 0.7), OracleSprings(scene), spring_table(scene)
    x = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
    x, v, amplitudes = (
        x + 0.02 * rng.standard_normal(x.shape),
        rng.standard_normal(x.shape),
        SceneLoads(scene).amplitudes([0.0])[0],
    )
    f = table.pulls(x, v, amplitudes)
    moved = table.pulls(x @ R.T + (0.3, -0.2, 0.1), v @ R.T, amplitudes)
    assert np.abs(moved - f @ R.T).max() < 1e-11 * np.abs(f).max()
    on_nodes = free.force(x)
    assert np.abs(on_nodes.sum(axis=0)).max() < 1e-9 and np.abs(np.cross(x, on_nodes).sum(axis=0)).max() < 1e-9
    assert np.abs(on_nodes).max() > 100.0
    turned = scene.snapshot()
    turned.bodies.reverse()
    n, other = turned.bodies[0].n_nodes, spring_table(turned)
    swapped = other.pulls(*(np.concatenate([a[-n:], a[:-n]]) for a in (x, v)), amplitudes)
    assert other.elements == table.elements and np.abs(swapped - f).max() < 1e-12 * np.abs(f).max()


# --- a mass on springs --------------------------------------------------------------------------------------------------

OMEGA, START, SPEED, DT = 20.0, 0.05, 0.4, 4e-3


def mass_on_springs(damping: float = 0.0, path=None, gravity: float = 0.0) -> ts.Scene:
    """A cube each of whose nodes hangs on a vertical spring in proportion to its mass, so that it moves as a point mass.

    path: of the obstacle on which the springs end.
    """
    scene = ts.Scene(gravity=(0, -gravity, 0))
    scene.contact_forces = False
    body = scene.add_body(cube(), rubber(young=1e6), name="mass")
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="lift", path=path)
    for i, (x, m) in enumerate(zip(body.rest_positions, lumped_masses(scene))):
        scene.add_spring(("mass", i), ("lift", x + (0, 2, 0)), m * OMEGA**2, damping=2 * damping * m)
    return add_companion(scene)


def oscillation(integrator: str, rate: float, speed: float, steps: int) -> np.ndarray:
    """Displacements (steps + 1,) by the integrators' formulas, from START at rest, of
    x'' = -OMEGA^2 (x - speed t) - 2 rate (x' - speed).
    """
    w, d, dt, x, v = OMEGA**2, 2 * rate, DT, START, 0.0
    path, before = [x], None
    a = -w * x + d * speed
    for n in range(steps):
        start, end = speed * n * dt, speed * (n + 1) * dt
        if integrator == "symplectic_euler":
            v += dt * (-w * (x - start) - d * (v - speed))
            x += dt * v
        elif integrator == "velocity_verlet":
            half = v + dt / 2 * a
            x += dt * half
            a = -w * (x - end) - d * (half + dt / 2 * a - speed)
            v = half + dt / 2 * a
        else:
            x_hat, v_hat, beta, at = x, v, dt, end
            if integrator == "implicit_midpoint":
                beta, at = dt / 2, (start + end) / 2
            elif integrator == "bdf2" and n:
                x_hat, v_hat, beta = (4 * x - before[0]) / 3, (4 * v - before[1]) / 3, 2 * dt / 3
            before = x, v
            new = (v_hat - beta * w * (x_hat - at) + beta * d * speed) / (1 + beta * d + beta**2 * w)
            x, v = x_hat + beta * new, new
            if integrator == "implicit_midpoint":
                x, v = 2 * x - before[0], 2 * v - before[1]
        path.append(x)
    return np.array(path)


@pytest.mark.parametrize("rate, speed", [(0.0, 0.0), (4.0, SPEED)])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_mass_on_springs_follows_each_integrators_formula(integrator, rate, speed):
    """On an obstacle that rests or moves; the energy is kept, without damping, by integrators that do so."""
    expected = oscillation(integrator, rate, speed, 40)
    assert np.ptp(expected) > 0.5 * START  # it swings
    scene = mass_on_springs(rate, lambda t: ((0, speed * t, 0), np.eye(3)))
    unit = 0.5 * scene.body("mass").mass * OMEGA**2 * START**2
    with simulator(scene, integrator, DT) as sim:
        rest = sim.positions("mass")
        sim.set_state(positions=rest + (0, START, 0), body="mass")
        assert sim.energies().elastic == pytest.approx(unit, rel=1e-9) and not sim.energies().loads
        path, energy = [START], []
        for _ in range(40):
            assert sim.step().converged
            path.append(float((sim.positions("mass") - rest)[0, 1]))
            energy.append((sim.energies().elastic + sim.energies().kinetic) / unit)
        assert np.abs(sim.positions("mass") - rest - (0, path[-1], 0)).max() < 1e-8
    assert np.abs(path - expected).max() < 1e-8
    if not rate and integrator in ("implicit_midpoint", "velocity_verlet"):
        assert np.abs(np.array(energy) - 1).max() < ((OMEGA * DT / 2) ** 2 if integrator in EXPLICIT else 1e-8)


def test_statics_hang_on_an_obstacle_at_its_time():
    """m g / k below it. Points of obstacles are given where they are at the start, whatever the path says there."""
    scene = mass_on_springs(path=lambda t: ((0, 3.0 + t, 0), np.eye(3)), gravity=9.81)
    body, result = scene.body("mass"), ts.solve_static(scene, tolerance=1e-9, time=0.5)
    moved = result.positions("mass") - body.rest_positions
    assert result.converged
    assert moved == pytest.approx(np.tile((0, 0.5 - 9.81 / OMEGA**2, 0), (len(moved), 1)), rel=1e-6, abs=1e-9)


# --- conservation ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_connected_free_bodies_keep_their_momentum(integrator):
    """Thrown apart and turning; the angular momentum is kept by integrators that do so."""
    scene = connected_scene(1, damping=5.0, anchored=False)
    for k, body in enumerate(scene.bodies):
        body.velocity = np.cross((0.3, 1.0, -2.0), body.rest_positions) + (1.0 - k, 0.5 * k, 0.2)
    n = sum(body.n_nodes for body in scene.bodies)
    masses = lumped_masses(add_companion(scene))[:n, None]
    with simulator(scene, integrator, 2e-4) as sim:

        def momenta() -> list[np.ndarray]:
            x, p = sim.positions()[:n], masses * sim.velocities()[:n]
            return [p.sum(axis=0), np.cross(x, p).sum(axis=0), p[:12].sum(axis=0)]

        before = momenta()
        for _ in range(15):
            sim.step()
        after = momenta()
    assert np.abs(after[2] - before[2]).max() > 1e-2  # the momentum of one body alone changes
    assert after[0] == pytest.approx(before[0], abs=1e-9 * np.abs(before[0]).max())
    if integrator in ("velocity_verlet", "symplectic_euler", "implicit_midpoint"):
        assert after[1] == pytest.approx(before[1], abs=1e-9 * np.abs(before[1]).max())


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


@pytest.mark.parametrize("stiffness, tension, order", [(1.0, 1.0, 1), (3e5, 1.0, 1), (1.0, 1e6, 1), (3e4, 1.0, 2)])
def test_stable_dt_is_a_lower_bound_of_the_limit(stiffness, tension, order):
    scene = stiffened(stiffness, order, tension)
    K, M = dense(scene)
    limit = 2 / np.sqrt(la.eigh(K, M, eigvals_only=True)[-1])
    found = stable_dt(scene, verlet=False)
    assert 0.7 * limit < found < 1.0001 * limit
    assert stable_dt(scene, verlet=True) == found
    scene.add_spring(("a", 7), ("b", (0.9, 0.2, -0.1)), stiffness, damping=1e5)  # which acts by the last velocities
    assert stable_dt(scene, verlet=False) < 0.8 * found


def test_linear_vibration_includes_elastic_tendons():
    scene = connected_scene(2)
    rest = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
    expected = OracleSprings(scene).stiffness(rest)
    assert np.abs(spring_stiffness(scene, spring_table(scene)).toarray() - expected).max() < 1e-9 * np.abs(expected).max()
