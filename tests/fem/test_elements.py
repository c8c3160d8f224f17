"""Linear and quadratic tetrahedra on the host; `test_model` compares nodes and masses with the oracle:

* shape functions sum to 1, are 1 at their own node and 0 at the others, and have the stated derivatives;
* quadrature rules have positive weights, points inside, and integrate polynomials of their degree exactly;
* gradients reproduce polynomials of the element's order, masses integrate their squares, tractions do their work.
"""

from itertools import product
from math import factorial

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem import reference
from taisoft.mesh.nodes import shape_functions
from taisoft.mesh.topology import EDGES
from tests.dynamics.scenes import cube, rubber
from tests.fem.oracle_elements import Elements

ORDERS = (1, 2)
POINTS = np.random.default_rng(3).dirichlet(np.ones(4), 20)  # barycentric


def body(order: int, degree: int | None = None):
    """With numbers of vertices in no order."""
    mesh = cube(cells=(2, 2, 1), pattern="six")
    shuffled = np.random.default_rng(1).permutation(mesh.n_verts)
    mesh = ts.TetMesh(mesh.vertices[np.argsort(shuffled)], shuffled[mesh.tets])
    return ts.Scene().add_body(mesh, rubber(density=1200.0), order=order, quadrature_degree=degree)


def polynomial(order: int):
    """A vector field of that degree, and its gradient, of X (...,3)."""
    rng = np.random.default_rng(order)
    b, A, Q = rng.standard_normal(3), rng.standard_normal((3, 3)), (order - 1) * rng.standard_normal((3, 3, 3))
    return (
        lambda X: b + X @ A.T + np.einsum("ijk,...j,...k->...i", Q, X, X),
        lambda X: A + np.einsum("ijk,...k->...ij", Q + Q.transpose(0, 2, 1), X),
    )


@pytest.mark.parametrize("order", ORDERS)
def test_nodes_and_shape_functions(order):
    made, expected = body(order), Elements(body(order).mesh, order)
    assert np.array_equal(made.rest_positions, expected.X) and np.array_equal(made.nodes.elements, expected.tets)
    N, s = shape_functions(order, POINTS), reference.shape_derivatives(order, POINTS)
    assert N.shape == (20, (4, 10)[order - 1]) and np.abs(N.sum(axis=1) - 1).max() < 1e-15
    at_nodes = np.concatenate([np.eye(4), [(np.eye(4)[a] + np.eye(4)[b]) / 2 for a, b in EDGES]])[: N.shape[1]]
    assert np.array_equal(shape_functions(order, at_nodes), np.eye(N.shape[1]))
    h = 1e-6
    for k in range(4):  # N is a polynomial in all four coordinates
        step = h * np.eye(4)[k]
        change = shape_functions(order, POINTS + step) - shape_functions(order, POINTS - step)
        assert np.abs(s[:, :, k] - change / (2 * h)).max() < 1e-9


@pytest.mark.parametrize("degree, exact, count", [(1, 1, 1), (2, 2, 4), (4, 5, 14)])
def test_quadrature(degree, exact, count):
    """The integral of l_0^a l_1^b l_2^c l_3^d over a tet is 6 V a! b! c! d! / (a + b + c + d + 3)!."""
    rule = reference.quadrature(degree)
    assert rule.points.shape == (count, 4) and rule.weights.shape == (count,)
    assert rule.weights.min() > 0 and rule.points.min() > 0 and rule.points.sum(axis=1) == pytest.approx(1, abs=1e-15)
    for powers in product(range(exact + 1), repeat=4):
        if sum(powers) <= exact:
            expected = 6 * np.prod([factorial(p) for p in powers]) / factorial(sum(powers) + 3)
            assert abs(rule.weights @ np.prod(rule.points**powers, axis=1) - expected) < 1e-15


@pytest.mark.parametrize("order, degree", [(1, None), (2, 2), (2, 4)])
def test_polynomials_of_the_elements_order(order, degree):
    made, (field, gradient) = body(order, degree), polynomial(order)
    corners, u = made.mesh.vertices[made.mesh.tets], field(made.rest_positions)
    g, volumes = reference.shape_gradients(made)
    found = np.einsum("eai,epaj->epij", u[made.nodes.elements], g)
    assert np.abs(found - gradient(reference.quadrature(made.quadrature_degree).points @ corners)).max() < 1e-13
    assert volumes.sum() == pytest.approx(1.0 * 0.9 * 1.1) and volumes.min() > 0
    rule, M = reference.quadrature(4), reference.consistent_mass(made)
    values = field(rule.points @ corners)
    exact = 1200 * np.einsum("e,p,epi,epi->", made.mesh.volumes, rule.weights, values, values)
    assert np.sum(u * (M @ u)) == pytest.approx(exact, rel=1e-13)
    assert reference.gravity_mass(made) == pytest.approx(np.asarray(M.sum(axis=1)).ravel())
    lumped = reference.lumped_mass(made)
    assert lumped == pytest.approx(Elements(made.mesh, order).lumped_mass(1200.0)) and lumped.sum() == pytest.approx(1200 * 0.99)
    face, t = np.arange(6), np.array([1.0, -2.0, 0.5])
    f = np.outer(reference.triangle_areas(made, face), t)  # its work, by a rule of degree 3
    X = made.mesh.vertices[made.mesh.surface[face]]
    area = np.linalg.norm(np.cross(X[:, 1] - X[:, 0], X[:, 2] - X[:, 0]), axis=1) / 2
    points = np.array([(1 / 3, 1 / 3, 1 / 3), (0.6, 0.2, 0.2), (0.2, 0.6, 0.2), (0.2, 0.2, 0.6)])
    weights = np.array([-27, 25, 25, 25]) / 48
    exact = np.einsum("e,p,epi,i->", area, weights, field(points @ X), t)
    assert np.sum(f * u) == pytest.approx(exact, rel=1e-12)
