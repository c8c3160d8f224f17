"""Bodies with curved edges at rest: a linear field has a uniform stress and balances, rigid motions give no force, forces are the
derivative of the energy and the stiffness theirs, masses and loads add up to those of the curved volume and area, f32 is f64 to
rounding, and the frequencies of a ball are those of theory.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem import reference
from taisoft.fem.loads import SceneLoads
from taisoft.fem.pressure import all_terms, force_terms
from taisoft.linear import block_csr
from taisoft.mesh.nodes import make_nodes
from tests.collision.rotations import rotation
from tests.dynamics.scenes import built
from tests.fem.composition import differential, energy, forces

DENSITY = 1200.0
STRETCH = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.05], [0.0, 0.1, 1.2]])


def bent_mesh() -> ts.TetMesh:
    """A box whose edges are all curved, those inside, too."""
    box = ts.box_mesh((2, 2, 2), (2, 1, 1))
    straight = make_nodes(box, 2).positions[box.n_verts :]
    return ts.TetMesh(box.vertices, box.tets, mid_edge=straight + 0.03 * np.sin(9.0 * straight[:, [1, 2, 0]] + 1.0))


def scene_of(mesh: ts.TetMesh, **arguments) -> ts.Scene:
    scene = ts.Scene()
    material = ts.Material("stable_neo_hookean", young=1e5, poisson=0.3, density=DENSITY)
    scene.add_body(mesh, material, order=2, **arguments)
    return scene


def test_single_precision_agrees():
    scene = scene_of(ts.ball_mesh(1.0, 2), curve=ts.Sphere((0, 0, 0), 1.0))
    found = []
    for precision in ("f32", "f64"):
        with built(scene, precision) as rig:
            found.append(forces(rig, rig.layout.rest @ STRETCH.T).astype(np.float64))
    assert 0.0 < np.abs(found[0] - found[1]).max() < 3e-6 * np.abs(found[1]).max()


@pytest.fixture(scope="module")
def rig():
    with built(scene_of(bent_mesh(), quadrature_degree=4, position=(3.0, 0, 0)), "f64") as made:
        yield made


def test_linear_field_has_uniform_energy_and_balances_at_inner_nodes(rig):
    (body,), x = rig.scene.bodies, rig.layout.rest @ STRETCH.T
    energy_density = ts.evaluate_law("stable_neo_hookean", STRETCH[None], 1e5, 0.3)[0][0]
    assert energy(rig, x) == pytest.approx(energy_density * body.volumes.sum(), rel=1e-13)
    f = forces(rig, x)
    inner = np.setdiff1d(np.arange(body.n_nodes), body.nodes.boundary)
    assert len(inner) > 5 and np.abs(f[inner]).max() < 1e-13 * np.abs(f).max() > 0.0


@pytest.mark.parametrize("degree", [2, 4])
def test_linear_field_has_uniform_stress(degree):
    """To rounding by either rule. By fourteen points it also balances; by four up to what these miss of the Jacobian."""
    scene = scene_of(bent_mesh(), quadrature_degree=degree)
    (body,) = scene.bodies
    gradients, volumes = reference.shape_gradients(body)
    forces_of_tets = np.einsum("mp,mpai->mai", volumes, gradients)
    total = np.stack([np.bincount(body.nodes.elements.ravel(), forces_of_tets[..., k].ravel()) for k in range(3)], axis=1)
    inner = np.setdiff1d(np.arange(body.n_nodes), body.nodes.boundary)
    assert np.abs(total[inner]).max() < {2: 0.01, 4: 1e-13}[degree] * np.abs(forces_of_tets).max()
    assert np.abs(np.einsum("mpai,maj->mpij", gradients, body.rest_positions[body.nodes.elements]) - np.eye(3)).max() < 1e-13


def test_rigid_motion_gives_no_force(rig):
    for x in (rig.layout.rest, rig.layout.rest @ rotation((1.0, -2.0, 0.5), 0.7).T + [5.0, -2.0, 1.0]):
        assert np.abs(forces(rig, x)).max() < 1e-14 * 1e5 * 10 and energy(rig, x) < 1e-9


def test_forces_and_stiffness_are_derivatives(rig):
    rng = np.random.default_rng(4)
    x = rig.layout.rest @ STRETCH.T + 0.03 * rng.standard_normal(rig.layout.rest.shape)
    d, h = rng.standard_normal(x.shape), 1e-5
    slope = (energy(rig, x + h * d) - energy(rig, x - h * d)) / (2.0 * h)
    assert -np.sum(forces(rig, x) * d) == pytest.approx(slope, rel=1e-7)
    change = (forces(rig, x + h * d) - forces(rig, x - h * d)) / (2.0 * h)
    size = np.abs(change).max()
    assert np.abs(differential(rig, x, d) - change).max() < 1e-7 * size
    matrix = block_csr.build_block_csr(rig.model, rig.arena)
    rig.model.state.x.from_numpy(x)
    block_csr.assemble(rig.model, matrix, False)
    K = block_csr.to_bsr(rig.model, matrix).toarray()
    assert np.abs(K @ d.reshape(-1) + differential(rig, x, d).reshape(-1)).max() < 1e-12 * size


def test_masses_and_loads_add_up():
    scene = scene_of(bent_mesh())
    (body,) = scene.bodies
    volume = -body.enclosed_volume(lambda X: X[:, 0] < np.inf)  # an integral over the surface
    assert body.volumes.sum() == pytest.approx(volume, rel=1e-13) and body.mass == pytest.approx(DENSITY * volume)
    assert np.abs(body.volumes / body.mesh.volumes - 1.0).max() > 0.005
    lumped, weight, M = reference.lumped_mass(body), reference.gravity_mass(body), reference.consistent_mass(body)
    assert lumped.min() > 0.0 and lumped.sum() == pytest.approx(DENSITY * volume)
    assert weight.sum() == pytest.approx(DENSITY * volume) and np.asarray(M.sum(axis=1)).ravel() == pytest.approx(weight)
    assert np.linalg.eigvalsh(M.toarray())[0] > 0.0 and abs(M - M.T).max() < 1e-14 * M.max()
    body.add_traction(lambda X: X[:, 0] < np.inf, (1.0, -2.0, 3.0))
    assert SceneLoads(scene).at(0.0).sum(axis=0) == pytest.approx(body.areas.sum() * np.array([1.0, -2.0, 3.0]))
    assert body.areas.sum() > 1.001 * 10.0


def test_pressure_balances_a_uniform_stress():
    """By Gauss's theorem: the integral of grad N_a over the tets is that of N_a n over the surface."""
    scene = scene_of(bent_mesh(), quadrature_degree=4)
    (body,) = scene.bodies
    body.add_pressure(lambda X: X[:, 0] < np.inf, 1.0)
    rows, w = all_terms(scene, np.array([0]), force_terms)
    i, b, c = (body.rest_positions[ids] for ids in rows[:, :3].T)
    outward = np.zeros((body.n_nodes, 3))
    np.add.at(outward, rows[:, 0], w[:, None] * np.cross(b - i, c - i))
    gradients, volumes = reference.shape_gradients(body)
    total = np.zeros_like(outward)
    np.add.at(total, body.nodes.elements, np.einsum("mp,mpai->mai", volumes, gradients))
    assert np.abs(outward - total).max() < 1e-14 < np.abs(total).max()


def test_stress_of_a_linear_field_is_uniform():
    scene = scene_of(ts.ball_mesh(1.0, 2), curve="smooth")
    _, P = ts.evaluate_law("stable_neo_hookean", STRETCH[None], 1e5, 0.3)
    with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler", precision="f64") as sim:
        sim.set_state(positions=scene.bodies[0].rest_positions @ STRETCH.T)
        sigma = sim.stress()
    assert np.abs(sigma - P @ STRETCH.T / np.linalg.det(STRETCH)).max() < 1e-12 * np.abs(sigma).max()


def test_frequencies_of_a_free_ball():
    """The lowest torsional modes, five of them, have omega R / c_s = 2.50113 (Lamb 1882)."""
    errors = []
    for curve in (ts.Sphere((0, 0, 0), 1.0), None):
        scene = scene_of(ts.ball_mesh(1.0, 4), curve=curve)
        shear = 1e5 / 2.6
        scaled = 2.0 * np.pi * ts.modes(scene, 11, mass="consistent").frequencies / np.sqrt(shear / DENSITY)
        assert np.abs(scaled[:6]).max() < 1e-2
        errors.append(np.abs(scaled[6:] / 2.50113 - 1.0).max())
    assert errors[0] < 0.006 and errors[1] > 4.0 * errors[0]
