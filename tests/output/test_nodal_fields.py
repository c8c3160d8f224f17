"""Stresses and contact impulses at nodes."""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.readout import nodal_impulses
from taisoft.output.nodal_fields import NodalMean, von_mises
from tests.collision.rotations import rotation
from tests.dynamics.scenes import rubber


def symmetric(rng, *shape):
    """Random stresses (*shape, 3, 3) [Pa]."""
    a = 1e4 * rng.standard_normal((*shape, 3, 3))
    return a + a.swapaxes(-1, -2)


def test_the_mean_is_weighted_by_volume_without_what_is_not_finite():
    """In two second-order bodies with irregular meshes."""
    scene, rng = ts.Scene(), np.random.default_rng(4)
    for k, mesh in enumerate((ts.ball_mesh(0.4, 4), ts.box_mesh((3, 2, 1), (0.3, 0.5, 0.7)))):
        vertices = mesh.vertices + rng.uniform(-0.01, 0.01, mesh.vertices.shape)
        scene.add_body(ts.TetMesh(vertices, mesh.tets), rubber(), name=f"body{k}", order=2)
    bodies = scene.bodies
    n = sum(body.n_nodes for body in bodies)
    elements = np.concatenate([bodies[0].nodes.elements, bodies[0].n_nodes + bodies[1].nodes.elements])
    volumes = np.abs(np.concatenate([body.mesh.volumes for body in bodies]))
    values = symmetric(rng, len(elements))
    volumes[5], sums, total = 0.0, np.zeros((n, 3, 3)), np.zeros((n, 1, 1))
    np.add.at(sums, elements, (volumes[:, None, None] * values)[:, None])
    np.add.at(total, elements, volumes[:, None, None, None])
    values[5] = np.nan
    assert np.allclose(NodalMean(bodies)(values), sums / np.where(total > 0, total, 1.0), atol=1e-9)
    assert np.array_equal(NodalMean(bodies)(np.full((len(elements), 2), np.inf)), np.zeros((n, 2)))


def test_von_mises_stress():
    s, q = 3e5, rotation((1, -2, 0.5), 1.1)
    assert von_mises(-s * np.eye(3)) == pytest.approx(0.0, abs=1e-9)
    assert von_mises(np.diag([0.0, -s, 0.0])) == pytest.approx(s)
    shear = np.zeros((3, 3))
    shear[0, 2] = shear[2, 0] = s
    assert von_mises(shear) == pytest.approx(np.sqrt(3) * s)
    sigma = symmetric(np.random.default_rng(5), 4, 6)
    assert von_mises(sigma).shape == (4, 6)
    assert np.allclose(von_mises(q @ sigma @ q.T + 1e6 * np.eye(3)), von_mises(sigma), rtol=1e-9)


def test_nodal_impulses_are_shares_of_those_of_the_contacts():
    """Three nodes of a side get their shares, three of the other the opposite; -1 is no node."""
    rng, n = np.random.default_rng(6), 9
    nodes, weights, impulse = rng.integers(-1, n, (20, 6)), rng.uniform(0, 1, (20, 6)), rng.standard_normal((20, 3))
    weights[nodes < 0] = 0.0
    for k in (20, 0):
        expected = np.zeros((n, 3))
        np.add.at(expected, nodes[:k], (weights * (1, 1, 1, -1, -1, -1))[:k, :, None] * impulse[:k, None])
        contacts = SimpleNamespace(nodes=nodes[:k], weights=weights[:k], impulse=impulse[:k])
        assert np.abs(nodal_impulses(contacts, n) - expected).max() < 1e-12
