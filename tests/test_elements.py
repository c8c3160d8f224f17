"""Linear tetrahedra on the host:

* shape gradients reproduce linear fields, add up to 0 and do not mind the order of a tet's vertices;
* a tet gives each of its vertices a quarter of its mass, a triangle each of its corners a third of its load;
* a uniform traction has the force and the moment of its resultant at the faces' centroids.
"""

import numpy as np
import pytest
from scenes import cube

from taisoft import elements

MESH = cube(cells=(2, 2, 1), pattern="six")


def test_shape_gradients_reproduce_linear_fields():
    A, b = np.random.default_rng(0).standard_normal((3, 3)), np.array([1.0, -2.0, 3.0])
    Dm_inv, volumes = elements.inverse_rest_edges(MESH.vertices, MESH.tets)
    g = elements.shape_gradients(Dm_inv)
    u = MESH.vertices @ A.T + b
    assert np.abs(np.einsum("eai,eaj->eij", u[MESH.tets], g) - A).max() < 1e-13
    assert np.abs(g.sum(axis=1)).max() < 1e-14
    assert volumes.sum() == pytest.approx(1.0 * 0.9 * 1.1) and volumes.min() > 0


def test_the_order_of_vertices_does_not_matter():
    turned = MESH.tets[:, [2, 0, 1, 3]]
    mirrored = MESH.tets[:, [1, 0, 2, 3]]
    Dm_inv, volumes = elements.inverse_rest_edges(MESH.vertices, MESH.tets)
    g = elements.shape_gradients(Dm_inv)
    for tets, order in ((turned, [2, 0, 1, 3]), (mirrored, [1, 0, 2, 3])):
        other, others = elements.inverse_rest_edges(MESH.vertices, tets)
        assert np.abs(elements.shape_gradients(other) - g[:, order]).max() < 1e-13
        assert np.allclose(others, volumes, rtol=1e-14)


def test_lumped_mass():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [7, 7, 7]], dtype=float)
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
    volumes = np.array([1 / 6, 2 / 6])
    mass = elements.lumped_mass(tets, volumes, 1200.0, len(vertices))
    assert mass == pytest.approx([50, 150, 150, 150, 100, 0])  # a quarter of 200 kg, of 400 kg, of both; of no tet


def test_traction_forces():
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 4, 0], [3, 4, 0], [9, 9, 9]], dtype=float)
    triangles = np.array([[0, 1, 2], [3, 2, 1]])
    one = elements.traction_forces(vertices, triangles[:1], (0.0, 10.0, -1.0))
    assert one == pytest.approx(np.outer([1, 1, 1, 0, 0], [0, 20, -2]))  # a third of 6 m^2 times the traction
    both = elements.traction_forces(vertices, triangles, (0.0, 10.0, -1.0))
    assert both == pytest.approx(np.outer([1, 2, 2, 1, 0], [0, 20, -2]))


def test_traction_on_a_whole_surface():
    t = np.array([1.0, -2.0, 0.5])
    f = elements.traction_forces(MESH.vertices, MESH.surface, t)
    a, b, c = (MESH.vertices[MESH.surface[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert area.sum() == pytest.approx(2 * (0.9 + 1.1 + 0.9 * 1.1))
    assert f.sum(axis=0) == pytest.approx(area.sum() * t)
    moment = np.cross((a + b + c) / 3, np.outer(area, t)).sum(axis=0)
    assert np.abs(np.cross(MESH.vertices, f).sum(axis=0) - moment).max() < 1e-14
