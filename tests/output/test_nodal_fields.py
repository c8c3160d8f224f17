"""Stresses and contact impulses at nodes:

* the nodal stress is the mean over the tets at the node, weighted by rest volume; tets with nonfinite stress do not count;
* the von Mises stress is 0 under pressure, |s| under tension s, sqrt(3) |t| under shear t, and invariant under rotations;
* in a homogeneous deformation the stress at every node is that of the law, of both orders, in the order of the bodies;
* the impulses at the nodes are the shares of those of the contacts.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.contact_record import nodal_impulses
from taisoft.output.nodal_fields import NodalMean, von_mises
from tests.collision.rotations import rotation
from tests.dynamics.scenes import SNH, mixed_scene, rubber

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


def test_the_mean_is_weighted_by_volume():
    bodies, rng = bodies_of(2), np.random.default_rng(4)
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


def test_the_mean_of_uniform_and_of_nonfinite_values():
    bodies = bodies_of(2)
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
    scene = mixed_scene((SNH,) * 4, order="both")
    mean, ends = NodalMean(scene.bodies), np.cumsum([b.n_nodes for b in scene.bodies])[:-1]
    with ts.Simulator(scene) as sim:
        rest, stresses = sim.positions(), []
        for gradient in (F, Q @ F):
            sim.set_state(positions=rest @ gradient.T)
            stresses.append(mean(sim.stress()))
            assert np.array_equal(sim.stress(), np.concatenate([sim.stress(b.name) for b in scene.bodies]))
    for body, sigma in zip(scene.bodies, np.split(stresses[0], ends)):
        material = body.material
        _, P = ts.evaluate_law(material.law, F[None], material.young, material.poisson)
        cauchy = P[0] @ F.T / np.linalg.det(F)
        assert np.abs(cauchy).max() > 1e3 and np.abs(sigma - cauchy).max() < 2e-4 * np.abs(cauchy).max(), body.name
    assert np.allclose(von_mises(stresses[1]), von_mises(stresses[0]), rtol=2e-4)


def test_nodal_impulses_are_shares_of_those_of_the_contacts():
    """Compared with loops: three nodes of a side get their shares, three of the other the opposite; -1 is no node."""
    rng, n = np.random.default_rng(6), 9
    nodes, weights, impulse = rng.integers(-1, n, (20, 6)), rng.uniform(0, 1, (20, 6)), rng.standard_normal((20, 3))
    weights[nodes < 0] = 0.0
    expected = np.zeros((n, 3))
    for own, shares, pushed in zip(nodes, weights, impulse):
        for k in range(6):
            if own[k] >= 0:
                expected[own[k]] += (1 if k < 3 else -1) * shares[k] * pushed
    contacts = SimpleNamespace(nodes=nodes, weights=weights, impulse=impulse)
    assert np.abs(nodal_impulses(contacts, n) - expected).max() < 1e-12
    none = SimpleNamespace(nodes=nodes[:0], weights=weights[:0], impulse=impulse[:0])
    assert np.array_equal(nodal_impulses(none, n), np.zeros((n, 3)))
