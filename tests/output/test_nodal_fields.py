"""Stresses and contact impulses at nodes:

* the nodal stress is the mean over the tets at the node, weighted by rest volume, of both orders; tets with nonfinite stress do
  not count, and a uniform stress is reproduced;
* the von Mises stress is 0 under pressure, |s| under tension s, sqrt(3) |t| under shear t, and invariant under rotations;
* in a homogeneous deformation the stress at every node is that of the law, and a rotation keeps the von Mises stress; the
  stresses of all bodies are those of each, in the order added;
* the impulses at the nodes of a body add up to those of its contacts, and to its contact force times dt, for both collision
  methods and both orders; they are 0 at inner nodes and on bodies that touch nothing.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.contact_record import nodal_impulses
from taisoft.output.nodal_fields import NodalMean, von_mises
from tests.collision.rotations import rotation
from tests.dynamics.scenes import SNH, SVK, mixed_scene, rubber

Q = rotation((1, -2, 0.5), 1.1)
F = np.array([[1.1, 0.05, 0.0], [0.02, 0.95, -0.04], [0.03, 0.0, 1.02]])


def symmetric(rng, *shape):
    """Random stresses (*shape, 3, 3) [Pa]."""
    a = 1e4 * rng.standard_normal((*shape, 3, 3))
    return a + a.swapaxes(-1, -2)


def bodies_of(order):
    """Two bodies with irregular meshes."""
    scene = ts.Scene()
    for k, mesh in enumerate((ts.ball_mesh(0.4, 4), ts.box_mesh((3, 2, 1), (0.3, 0.5, 0.7)))):
        vertices = mesh.vertices + np.random.default_rng(k).uniform(-0.01, 0.01, mesh.vertices.shape)
        scene.add_body(ts.TetMesh(vertices, mesh.tets), rubber(), name=f"body{k}", order=order)
    return scene.bodies


def sizes(bodies) -> tuple[int, int]:
    """Number of tets and of nodes."""
    return sum(b.mesh.n_tets for b in bodies), sum(b.n_nodes for b in bodies)


@pytest.mark.parametrize("order", [1, 2])
def test_a_uniform_stress_is_reproduced(order):
    bodies, stress = bodies_of(order), symmetric(np.random.default_rng(3))
    m, n = sizes(bodies)
    mean = NodalMean(bodies)(np.tile(stress, (m, 1, 1)))
    assert mean.shape == (n, 3, 3) and np.abs(mean - stress).max() < 1e-14 * np.abs(stress).max() * m


@pytest.mark.parametrize("order", [1, 2])
def test_the_mean_is_weighted_by_volume(order):
    bodies, rng = bodies_of(order), np.random.default_rng(4)
    values = symmetric(rng, sizes(bodies)[0])
    values[5], finite = np.nan, np.arange(len(values)) != 5
    mean, n, m = NodalMean(bodies)(values), 0, 0
    for body in bodies:
        volumes, own = np.abs(body.mesh.volumes), values[m : m + body.mesh.n_tets]
        for node in rng.choice(body.n_nodes, 20).tolist() + body.nodes.elements[5].tolist():
            at = (body.nodes.elements == node).any(axis=1) & finite[m : m + body.mesh.n_tets]
            expected = np.einsum("e,eij->ij", volumes[at], own[at]) / volumes[at].sum() if at.any() else np.zeros((3, 3))
            assert np.abs(mean[n + node] - expected).max() < 1e-9
        n, m = n + body.n_nodes, m + body.mesh.n_tets


def test_the_mean_of_scalars_and_of_nonfinite_values():
    bodies = bodies_of(1)
    m, n = sizes(bodies)
    assert np.allclose(NodalMean(bodies)(np.full(m, 2.5)), np.full(n, 2.5))
    assert np.array_equal(NodalMean(bodies)(np.full((m, 2), np.inf)), np.zeros((n, 2)))


def test_von_mises_stress():
    s = 3e5
    assert von_mises(-s * np.eye(3)) == pytest.approx(0.0, abs=1e-9)
    assert von_mises(np.diag([0.0, -s, 0.0])) == pytest.approx(s)
    shear = np.zeros((3, 3))
    shear[0, 2] = shear[2, 0] = s
    assert von_mises(shear) == pytest.approx(np.sqrt(3) * s)
    sigma = symmetric(np.random.default_rng(5), 4, 6)
    assert von_mises(sigma).shape == (4, 6) and von_mises(sigma).min() > 1e3
    assert np.allclose(von_mises(Q @ sigma @ Q.T), von_mises(sigma), rtol=1e-12)
    assert np.allclose(von_mises(sigma + 1e6 * np.eye(3)), von_mises(sigma), rtol=1e-9)


def test_the_stress_of_a_homogeneous_deformation_is_that_of_the_law():
    scene = mixed_scene((SNH, SVK, SNH, SVK), order="both")
    mean, ends = NodalMean(scene.bodies), np.cumsum([b.n_nodes for b in scene.bodies])[:-1]
    with ts.Simulator(scene, precision="f64") as sim:
        rest, stresses = sim.positions(), []
        for gradient in (F, Q @ F):
            sim.set_state(positions=rest @ gradient.T)
            stresses.append(mean(sim.stress()))
            assert np.array_equal(sim.stress(), np.concatenate([sim.stress(b.name) for b in scene.bodies]))
    for body, sigma in zip(scene.bodies, np.split(stresses[0], ends)):
        material = body.material
        _, P = ts.evaluate_law(material.law, F[None], material.young, material.poisson)
        cauchy = P[0] @ F.T / np.linalg.det(F)
        assert np.abs(cauchy).max() > 1e3 and np.abs(sigma - cauchy).max() < 1e-8 * np.abs(cauchy).max(), body.name
    assert np.allclose(von_mises(stresses[1]), von_mises(stresses[0]), rtol=1e-8)


PAIRS = {"near": ("proximity", 2), "field": ("distance_field", 1)}  # collision method and order


def pile():
    """For each of PAIRS a cube that falls on a slab, which falls on the ground; a ball beside them touches nothing."""
    scene = ts.Scene(gravity=(0, 0, 0))
    slab = ts.box_mesh((3, 1, 3), (0.3, 0.1, 0.3), (0, 0.051, 0))
    cube = ts.box_mesh((2, 2, 2), (0.1,) * 3, (0.01, 0.1515, 0.02))
    for k, (name, (collision, order)) in enumerate(PAIRS.items()):
        kind = {"position": (k, 0, 0), "collision": collision, "order": order}
        scene.add_body(slab, rubber(), name=f"{name} slab", velocity=(0, -0.5, 0), **kind)
        scene.add_body(cube, rubber(), name=f"{name} cube", velocity=(0.2, -1.5, 0), **kind)
    scene.add_body(ts.ball_mesh(0.1, 2), rubber(), name="ball", position=(0, 1, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    return scene


def test_nodal_impulses_add_up_to_those_of_the_contacts():
    scene, dt = pile(), 2e-4
    touching, kinds = set(), set()
    with ts.Simulator(scene, dt=dt, integrator="symplectic_euler", precision="f64") as sim:
        n = len(sim.positions())
        assert nodal_impulses(sim.contacts(), n).shape == (n, 3) and not nodal_impulses(sim.contacts(), n).any()
        for _ in range(40):
            sim.step()
            c = sim.contacts()
            active = c.impulse.any(axis=1)
            touching |= set(zip(c.body_a[active], c.body_b[active]))
            kinds |= set(c.kind[active])
            impulses, first = nodal_impulses(c, n), 0
            rounding = 1e-15 * np.abs(c.impulse).sum()
            for body in scene.bodies:
                own = impulses[first : first + body.n_nodes]
                first += body.n_nodes
                total = c.impulse[c.body_a == body.name].sum(axis=0) - c.impulse[c.body_b == body.name].sum(axis=0)
                assert np.abs(own.sum(axis=0) - total).max() <= 10 * rounding
                assert np.abs(total - dt * sim.contact_force(body.name)).max() <= 10 * rounding
                inner = np.setdiff1d(np.arange(body.n_nodes), body.nodes.surface)
                assert len(inner) > 0 or body.name.endswith("slab")
                assert not own[inner].any()
            assert np.abs(impulses.sum(axis=0) - c.impulse[c.body_b == "ground"].sum(axis=0)).max() <= 10 * rounding
    assert touching == {(f"{name} slab", other) for name in PAIRS for other in (f"{name} cube", "ground")}
    assert "vertex_field" in kinds or "face_field" in kinds
    assert "vertex_face" in kinds
