"""Bodies with mean dilatation, in f64: patches are cells or sets of tets of one region; energies are the formula's, forces and
tangents its derivatives, also of regions, numbers by tet and a volume floor; explicit damping is that of the
matrix (the other laws: `test_single_precision`; the solver: `tests/linear/test_volumes.py`).
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem.laws import LAWS
from taisoft.fem.reference import lumped_masses, shape_gradients, tet_patches
from taisoft.fem.terms import elasticity
from taisoft.linear import block_csr
from taisoft.mesh.topology import connected_pieces
from taisoft.scene.refine import refined, with_order
from taisoft.stability import hooke_stiffness
from tests.collision.rotations import rotation
from tests.dynamics.scenes import SNH, built, cube, halved, rubber
from tests.fem import oracle_laws as oracle
from tests.fem.composition import differential, energy, forces

FLOOR = 0.3


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
    young, poisson = (np.broadcast_to(n, body.mesh.n_tets)[:, None] for n in (body.young, body.poisson))
    local = np.sum(volumes * oracle.psi(SNH, F, young / (1 + poisson), 0.0))
    if body.order == 1:
        floored = body.mesh.regions == 3 if body.composition.has_regions else slice(None)
        local += np.sum((volumes * oracle.floor_energy(F, young, poisson, FLOOR))[floored])
    patch, content = tet_patches(body), np.sum(volumes * (np.linalg.det(F) - 1.0), axis=1)
    V = np.bincount(patch, body.mesh.volumes)
    moduli = np.bincount(patch, body.mesh.volumes * oracle.lame(young, poisson)[1][:, 0]) / V
    return local + np.sum(0.5 * moduli * np.bincount(patch, content) ** 2 / V)


@pytest.fixture(scope="module", params=[1, 2])
def rig(request):
    with built(mixed_scene(request.param), "f64") as made:
        made.rest, made.x = made.oracle.rest, strained(made.oracle.rest)
        if request.param == 1:
            made.x *= [1.0, 0.2, 1.0]  # below the floor
        made.matrix = block_csr.build_block_csr(made.model, made.arena)
        yield made


linear = pytest.mark.parametrize("rig", [1], indirect=True)  # differentials of quadratic tets compile long


def strained(rest: np.ndarray, size: float = 0.03, seed: int = 1) -> np.ndarray:
    return rest + size * np.random.default_rng(seed).standard_normal(rest.shape)


def stiffness(rig, x: np.ndarray):
    rig.model.state.x.from_numpy(x)
    block_csr.assemble(rig.model, rig.matrix, False)
    return block_csr.to_bsr(rig.model, rig.matrix).tocsr()


def test_energy_is_the_formula_and_forces_are_minus_its_gradient(rig):
    expected = sum(energy_of(body, rig.x[rig.layout.nodes(k)]) for k, body in enumerate(rig.scene.bodies))
    assert expected > 10.0 and energy(rig, rig.x) == pytest.approx(expected, rel=1e-11)
    h, f, d = 1e-7, forces(rig, rig.x), np.random.default_rng(0).standard_normal(rig.x.shape)
    assert np.abs(forces(rig, rig.rest)).max() < 1e-8
    for own in (rig.layout.nodes(k) for k in range(len(rig.scene.bodies))):
        step = np.zeros_like(d)
        step[own] = h * d[own]
        slope = (energy(rig, rig.x + step) - energy(rig, rig.x - step)) / (2 * h)
        assert -slope == pytest.approx(np.sum(f[own] * d[own]), rel=1e-5)
        size = 1e-9 * np.abs(f[own]).sum()
        assert np.abs(f[own].sum(axis=0)).max() < size
        assert np.abs(np.cross(rig.x[own] - rig.x[own][0], f[own]).sum(axis=0)).max() < 10 * size
    R = rotation((1, 2, -1), 0.7)
    assert np.abs(forces(rig, rig.x @ R.T + 3.0) - f @ R.T).max() < 1e-9 * np.abs(f).max()


@linear
def test_the_tangent_is_the_derivative(rig):
    h, d, K = 1e-7, np.random.default_rng(0).standard_normal(rig.x.shape), stiffness(rig, rig.x)
    assert abs(K - K.T).max() < 1e-12 * abs(K).max()
    df = differential(rig, rig.x, d)
    change = (forces(rig, rig.x + h * d) - forces(rig, rig.x - h * d)) / (2 * h)
    for own in (rig.layout.nodes(k) for k in range(len(rig.scene.bodies))):
        assert np.abs(change - df)[own].max() < 1e-5 * np.abs(df[own]).max()
    assert np.abs(K @ d.reshape(-1) + df.reshape(-1)).max() < 1e-11 * np.abs(df).max()
    at_rest = stiffness(rig, rig.rest)
    for k, body in enumerate(rig.scene.bodies):  # that of the vibrations
        own = slice(3 * rig.layout.node_start[k], 3 * rig.layout.node_start[k + 1])
        assert abs(at_rest[own, own] - hooke_stiffness(body)).max() < 1e-11 * abs(at_rest).max()


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


def test_stiffness_damping_of_explicit_steps_is_the_matrix_and_changed_numbers_act(tmp_path):
    """At rest, where the matrix is positive semi-definite."""
    scene, dt, rate = ts.Scene(gravity=(0, 0, 0)), 1e-8, 0.01
    scene.add_body(cube(cells=(3, 2, 2)), rubber(poisson=0.45, stiffness_damping=rate), name="a")
    v = strained(np.zeros_like(scene.bodies[0].rest_positions), 1.0)
    expected = -rate * (hooke_stiffness(scene.bodies[0]) @ v.reshape(-1)).reshape(-1, 3)
    with ts.Simulator(scene, dt=dt, integrator="symplectic_euler", precision="f64") as sim:
        sim.set_state(velocities=v)
        sim.step()
        change = lumped_masses(scene)[:, None] * (sim.velocities() - v) / dt
        assert np.abs(change - expected).max() < 1e-3 * np.abs(expected).max()
        assert np.abs(change.sum(axis=0)).max() < 1e-6 * np.abs(change).max()
        before = sim.stress("a")
        with pytest.warns(UserWarning, match="body 'a': poisson = 0.3 is below 0.45, and its dilatation stays the mean"):
            sim.set_material("a", poisson=0.3)
        assert not np.allclose(sim.stress("a"), before, rtol=0.1)  # at the same strains
        ts.write_scene(tmp_path / "kept.toml", sim.scene, {})
        kept = refined(sim.scene), with_order(sim.scene, 2), ts.read_scene(tmp_path / "kept.toml")[0]
        assert [one.body("a").dilatation for one in kept] == ["mean", "local", "mean"]


def test_another_kind_of_dilatation_is_refused_and_a_law_without_it(monkeypatch):
    with pytest.raises(ts.SceneError, match="^body 'a': dilatation must be one of auto, local, mean, not 'patch'$"):
        ts.Scene().add_body(cube(), rubber(), name="a", dilatation="patch")
    monkeypatch.delattr(LAWS[SNH], "dilatation")
    scene = ts.Scene()
    scene.add_body(cube(), rubber(poisson=0.45), name="a")
    with pytest.raises(ts.SceneError, match="^body 'a': its law stable_neo_hookean has no mean dilatation: give it"):
        ts.Simulator(scene, dt=0.01, precision="f64").step()
