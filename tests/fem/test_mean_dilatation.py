"""Bodies with mean dilatation, in f64; `tests/linear/test_volume_pcg.py` has the solver:

* patches are connected sets of tets of one region, on the "five" pattern the cells; a quadratic tet is its own;
* the energy is the formula's, for both orders, numbers by tet, regions and a volume floor; force and tangent are its finite
  differences, the matrix is symmetric and agrees with the matrix-free product, at rest it is that of vibrations (the other laws:
  `test_single_precision`);
* internal forces have no resultant force or moment and rotate with the state; under uniform F stresses are those of the law, and
  inner nodes in equilibrium;
* linear beams bend near incompressibility nearly as well as at a Poisson's ratio of 0.3;
* explicit damping is that of the matrix; the stable dt is that of the matrix; momentum is kept; changed numbers act.
"""

import numpy as np
import pytest
import scipy.sparse as sp

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.fem.measure import measure
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.reference import lumped_mass, lumped_masses, mass_matrix, shape_gradients, tet_patches
from taisoft.fem.state import ELASTIC
from taisoft.fem.terms import elasticity
from taisoft.linear import block_csr
from taisoft.mesh.topology import connected_pieces
from taisoft.stability import highest_frequency, hooke_stiffness
from tests.collision.rotations import rotation
from tests.dynamics.scenes import SNH, built, cube, halved, rubber
from tests.fem import oracle_laws as oracle

NEARLY = 0.499  # Poisson's ratio
FLOOR = 0.3


def body_scene(order: int = 1, poisson: float = NEARLY, dilatation: str = "mean", **more) -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(cube(cells=(3, 2, 2)), rubber(poisson=poisson), name="a", order=order, dilatation=dilatation, **more)
    return scene


def mixed_scene(order: int) -> ts.Scene:
    """Order 1: two regions, numbers by tet and a floor in one region, and a body of one material; order 2: one material."""
    scene, mesh = ts.Scene(gravity=(0, 0, 0)), halved(cube(cells=(4, 2, 2)))
    if order == 2:
        scene.add_body(cube(cells=(2, 1, 1)), rubber(poisson=0.45), name="one", order=2, dilatation="mean")
        return scene
    scene.add_body(cube(cells=(2, 2, 2)), rubber(poisson=0.45, volume_floor=FLOOR), name="one", dilatation="mean")
    regions, poisson = {"left": rubber(volume_floor=FLOOR), 7: rubber(young=4e4)}, np.linspace(-0.2, 0.48, mesh.n_tets)
    scene.add_body(mesh, regions, poisson=poisson, name="regions", position=(6, 0, 0), dilatation="mean")
    return scene


def test_patches_are_cells_or_connected_sets_of_tets_of_one_region():
    patch = tet_patches(ts.Scene().add_body(cube(cells=(3, 2, 4)), rubber()))
    assert np.array_equal(np.bincount(patch), np.full(24, 5)) and (np.ptp(patch.reshape(24, 5), axis=1) == 0).all()
    (quadratic,) = mixed_scene(2).bodies
    for body in mixed_scene(1).bodies:
        patch = tet_patches(body)
        assert np.array_equal(np.unique(patch), np.arange(patch.max() + 1)) and patch.max() < 0.4 * len(patch)
        for p in range(patch.max() + 1):
            vertices, tets = np.unique(body.mesh.tets[patch == p], return_inverse=True)
            assert connected_pieces(tets.reshape(-1, 4), len(vertices))[0] == 1
            assert not body.composition.has_regions or len(set(body.mesh.regions[patch == p])) == 1
    assert np.array_equal(tet_patches(quadratic), np.arange(quadratic.mesh.n_tets))


def energy_of(body, x: np.ndarray) -> float:
    """The formula of `fem.mean_dilatation`, theta = J - 1; a floor acts on J of each point, with the whole lambda."""
    gradients, volumes = shape_gradients(body)
    F = np.einsum("eai,eqaj->eqij", x[body.nodes.elements], gradients)
    young, poisson, floored = (np.broadcast_to(n, body.mesh.n_tets) for n in (body.young, body.poisson, body.order == 1))
    floored = floored & (body.mesh.regions == 3 if body.mesh.regions is not None else True)
    patch, local = tet_patches(body), 0.0
    for e in range(body.mesh.n_tets):
        local += volumes[e] @ oracle.psi(SNH, F[e], young[e] / (1 + poisson[e]), 0.0)
        local += volumes[e] @ oracle.floor_energy(F[e], young[e], poisson[e], FLOOR) if floored[e] else 0.0
    content, V = np.sum(volumes * (np.linalg.det(F) - 1.0), axis=1), np.bincount(patch, body.mesh.volumes)
    moduli = np.bincount(patch, body.mesh.volumes * oracle.lame(young, poisson)[1]) / V
    return local + float(np.sum(0.5 * moduli * np.bincount(patch, content) ** 2 / V))


@pytest.fixture(scope="module", params=[1, 2])
def rig(request):
    with built(mixed_scene(request.param), "f64") as made:
        made.rest, made.x = made.oracle.rest, strained(made.oracle.rest)
        if request.param == 1:
            made.x *= [1.0, 0.2, 1.0]  # below the floor
        made.force, made.dx = made.vectors("force"), made.vectors("dx")
        made.matrix = block_csr.build_block_csr(made.model, made.arena)
        yield made


# differentials of quadratic tets compile long
linear = pytest.mark.parametrize("rig", [1, pytest.param(2, marks=pytest.mark.long)], indirect=True)


def strained(rest: np.ndarray, size: float = 0.03, seed: int = 1) -> np.ndarray:
    return rest + size * np.random.default_rng(seed).standard_normal(rest.shape)


def forces(rig, x: np.ndarray) -> np.ndarray:
    rig.model.state.x.from_numpy(x)
    elasticity.elastic_forces(rig.model)
    elasticity.gather_forces(rig.model, rig.force)
    return rig.force.to_numpy()


def energy(rig, x: np.ndarray) -> float:
    rig.model.state.x.from_numpy(x)
    measure(rig.model)
    return rig.model.state.scalars[ELASTIC]


def stiffness(rig, x: np.ndarray):
    rig.model.state.x.from_numpy(x)
    block_csr.assemble(rig.model, rig.matrix, EVERYTHING, False)
    return block_csr.to_scipy(rig.model, rig.matrix)


def test_energy_is_the_formula(rig):
    expected = sum(energy_of(body, rig.x[rig.layout.nodes(k)]) for k, body in enumerate(rig.scene.bodies))
    assert expected > 10.0 and energy(rig, rig.x) == pytest.approx(expected, rel=1e-11)


def test_forces_are_minus_the_energy_gradient(rig):
    h, f, d = 1e-7, forces(rig, rig.x), np.random.default_rng(0).standard_normal(rig.x.shape)
    assert np.abs(forces(rig, rig.rest)).max() < 1e-8
    for own in (rig.layout.nodes(k) for k in range(len(rig.scene.bodies))):
        step = np.zeros_like(d)
        step[own] = h * d[own]
        slope = (energy(rig, rig.x + step) - energy(rig, rig.x - step)) / (2 * h)
        assert -slope == pytest.approx(np.sum(f[own] * d[own]), rel=1e-5)


@linear
def test_the_tangent_is_the_derivative(rig):
    h, d, K = 1e-7, np.random.default_rng(0).standard_normal(rig.x.shape), stiffness(rig, rig.x)
    assert abs(K - K.T).max() < 1e-12 * abs(K).max()
    rig.dx.from_numpy(d)
    elasticity.force_differential(rig.model, rig.dx, rig.force)
    df = rig.force.to_numpy()
    change = (forces(rig, rig.x + h * d) - forces(rig, rig.x - h * d)) / (2 * h)
    for own in (rig.layout.nodes(k) for k in range(len(rig.scene.bodies))):
        assert np.abs(change - df)[own].max() < 1e-5 * np.abs(df[own]).max()
    assert np.abs(K @ d.reshape(-1) + df.reshape(-1)).max() < 1e-11 * np.abs(df).max()
    at_rest = stiffness(rig, rig.rest)
    for k, body in enumerate(rig.scene.bodies):  # that of the vibrations
        own = slice(3 * rig.layout.node_start[k], 3 * rig.layout.node_start[k + 1])
        assert abs(at_rest[own, own] - hooke_stiffness(body)).max() < 1e-11 * abs(at_rest).max()


def test_internal_forces_balance_and_rotate(rig):
    R, f, before = rotation((1, 2, -1), 0.7), forces(rig, rig.x), energy(rig, rig.x)
    for k in range(len(rig.scene.bodies)):
        own, size = rig.layout.nodes(k), 1e-9 * np.abs(f[rig.layout.nodes(k)]).sum()
        assert np.abs(f[own].sum(axis=0)).max() < size
        assert np.abs(np.cross(rig.x[own] - rig.x[own][0], f[own]).sum(axis=0)).max() < 10 * size
    moved = rig.x @ R.T + 3.0
    assert np.abs(forces(rig, moved) - f @ R.T).max() < 1e-9 * np.abs(f).max()
    assert energy(rig, moved) == pytest.approx(before, rel=1e-9)


@linear
def test_uniform_deformations_are_those_of_the_law(rig):
    F = np.array([[1.1, 0.2, 0.0], [0.0, 0.95, 0.1], [-0.1, 0.0, 1.05]])
    f = forces(rig, rig.rest @ F.T)
    sigma = np.zeros((rig.model.n_blocks * rig.model.lanes, 9))
    elasticity.cauchy_stress(rig.model, sigma)
    expected = oracle.pk1(SNH, F[None], 1e5, 0.45)[0] @ F.T / np.linalg.det(F)
    own = rig.layout.nodes(0)
    stress = sigma[rig.layout.lane_of_tet[rig.layout.tets(0)]]
    assert np.abs(stress - expected.reshape(-1)).max() < 1e-10 * np.abs(expected).max()
    inner = (np.abs(rig.rest[own]) < [0.49, 0.44, 0.54]).all(axis=1)
    assert inner.sum() == 1 and np.abs(f[own][inner]).max() < 1e-12 * np.abs(f).max()


def test_stiffness_damping_of_explicit_steps_is_the_matrix():
    """At rest, where the matrix is positive semi-definite."""
    scene, dt, rate = body_scene(poisson=0.45), 1e-8, 0.01
    scene.bodies[0].material = rubber(poisson=0.45, stiffness_damping=rate)
    v = strained(np.zeros_like(scene.bodies[0].rest_positions), 1.0)
    expected = -rate * (hooke_stiffness(scene.bodies[0]) @ v.reshape(-1)).reshape(-1, 3)
    with ts.Simulator(scene, dt=dt, integrator="symplectic_euler", precision="f64") as sim:
        sim.set_state(velocities=v)
        sim.step()
        change = lumped_masses(scene)[:, None] * (sim.velocities() - v) / dt
    assert np.abs(change - expected).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("order", [1, 2])
def test_stable_dt_is_that_of_the_matrix(order):
    body = body_scene(order).bodies[0]
    scale = np.repeat(1.0 / np.sqrt(lumped_mass(body)), 3)
    K = hooke_stiffness(body).toarray()
    assert np.isclose(highest_frequency(body), 1.005 * np.sqrt(np.linalg.eigvalsh(scale[:, None] * K * scale)[-1]), rtol=6e-3)


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.long)])
@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_midpoint"])
def test_free_bodies_keep_their_momentum(integrator, order):
    scene, explicit = body_scene(order), integrator == "symplectic_euler"
    scene.bodies[0].velocity = np.cross([0.5, 1.0, -0.3], scene.bodies[0].rest_positions) + [0.1, 0.2, 0.3]
    with ts.Simulator(scene, dt=2e-5 if explicit else 0.01, integrator=integrator, precision="f64") as sim:
        if explicit:
            with pytest.raises(SimulationError, match="stability limit"):
                sim.dt = 1.1 * sim.stable_dt
            sim.dt = 0.9 * sim.stable_dt
        mass = sp.diags(lumped_masses(sim.scene)) if explicit else mass_matrix(sim.scene)

        def momenta() -> np.ndarray:
            p = mass @ sim.velocities()
            return np.array([p.sum(axis=0), np.cross(sim.positions(), p).sum(axis=0)])

        start, reports = momenta(), [sim.step() for _ in range(8)]
        assert all(r.converged and not r.problems for r in reports)
        assert np.abs(momenta() - start).max() < 1e-7 * np.linalg.norm(start)
        totals = [r.kinetic + r.elastic for r in reports]
        assert max(totals) < (1.01 if explicit else 1.001) * totals[0]
        before = sim.stress("a")
        sim.set_material("a", poisson=0.3)
        assert not np.allclose(sim.stress("a"), before, rtol=0.1)  # at the same strains


def sag(poisson: float, kind: str = "mean") -> float:
    """Sag [m] of a beam of 4 x 1 x 1 m under its own weight."""
    scene = ts.Scene(gravity=(0, -9.8, 0))
    material = ts.Material(law=SNH, young=1e6, poisson=poisson, density=100.0)
    body = scene.add_body(ts.box_mesh((11, 2, 2), (4, 1, 1)), material, dilatation=kind)
    body.fix(lambda X: X[:, 0] < -1.999)
    result = ts.solve_static(scene, tolerance=1e-8, precision="f64")
    assert result.converged and result.n_inverted == 0
    return float((body.rest_positions - result.positions())[body.rest_positions[:, 0] > 1.999, 1].mean())


@pytest.mark.filterwarnings("ignore:.*linear tets lock")
def test_beams_do_not_lock():
    usual, nearly = sag(0.3), sag(NEARLY)
    assert 0.9 < nearly / usual < 1.0 and abs(sag(0.4999) / nearly - 1.0) < 0.01
    assert sag(NEARLY, "local") < 0.8 * nearly


def test_bad_values_and_warnings():
    with pytest.raises(ts.SceneError, match="^body 'a': dilatation must be one of local, mean, not 'patch'$"):
        body_scene(dilatation="patch")
    with pytest.warns(UserWarning, match='poisson = 0.499 .* dilatation="mean" does not lock'):
        body_scene(dilatation="local")
    assert body_scene().bodies[0].dilatation == "mean"
