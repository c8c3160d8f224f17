"""Linear and quadratic tetrahedra on the host:

* nodes are vertices, then middles of edges by sorted vertex pairs, and so are an element's;
* shape functions sum to 1, are 1 at their own node and 0 at the others, and reproduce polynomials of their order;
* quadrature rules have positive weights, points inside, and integrate polynomials of their degree exactly;
* masses are the oracle's and sum to the total; lumped masses are positive, consistent ones integrate squares and weight;
* a uniform traction has the same total force and moment as area times traction at the faces' centroids.
"""

from itertools import product
from math import factorial

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem import reference
from taisoft.mesh.nodes import shape_functions
from tests.dynamics.scenes import cube, rubber
from tests.fem.oracle_elements import Elements, body_loads

ORDERS = (1, 2)
POINTS = np.random.default_rng(3).dirichlet(np.ones(4), 20)  # barycentric
DEGREES = {1: (1,), 2: (2, 4)}
KINDS = [(order, degree) for order in ORDERS for degree in DEGREES[order]]


def body(order: int, degree: int | None = None, mesh: ts.TetMesh | None = None, density: float = 1200.0):
    mesh = cube(cells=(2, 2, 1), pattern="six") if mesh is None else mesh
    return ts.Scene().add_body(mesh, rubber(density=density), order=order, quadrature_degree=None if order == 1 else degree)


def polynomial(order: int):
    """A vector field of that degree, and its gradient, of X (...,3)."""
    rng = np.random.default_rng(order)
    b, A, Q = rng.standard_normal(3), rng.standard_normal((3, 3)), (order - 1) * rng.standard_normal((3, 3, 3))
    return (
        lambda X: b + X @ A.T + np.einsum("ijk,...j,...k->...i", Q, X, X),
        lambda X: A + np.einsum("ijk,...k->...ij", Q + Q.transpose(0, 2, 1), X),
    )


@pytest.mark.parametrize("order", ORDERS)
def test_nodes(order):
    mesh = cube(cells=(2, 1, 1))
    shuffled = np.random.default_rng(1).permutation(mesh.n_verts)
    mesh = ts.TetMesh(mesh.vertices[np.argsort(shuffled)], shuffled[mesh.tets])
    made, expected = body(order, mesh=mesh), Elements(mesh, order)
    assert made.n_nodes == len(expected.X) == (12 if order == 1 else 12 + 31)
    assert np.array_equal(made.rest_positions, expected.X)
    assert np.array_equal(made.nodes.elements, expected.tets)


@pytest.mark.parametrize("order", ORDERS)
def test_shape_functions(order):
    N, s = shape_functions(order, POINTS), reference.shape_derivatives(order, POINTS)
    assert N.shape == (20, (4, 10)[order - 1]) and np.abs(N.sum(axis=1) - 1).max() < 1e-15
    # grad N_a = s_ak grad l_k, and the grad l_k sum to 0: the grad N_a sum to 0 if the sums over a are equal for all k
    assert np.ptp(s.sum(axis=1), axis=1).max() < 1e-14
    at_nodes = np.concatenate([np.eye(4), [(np.eye(4)[a] + np.eye(4)[b]) / 2 for a, b in reference.EDGES]])
    at_nodes = at_nodes[: N.shape[1]]
    assert np.array_equal(shape_functions(order, at_nodes), np.eye(N.shape[1]))
    h = 1e-6
    for k in range(4):  # N is a polynomial in all four coordinates
        step = h * np.eye(4)[k]
        change = shape_functions(order, POINTS + step) - shape_functions(order, POINTS - step)
        assert np.abs(s[:, :, k] - change / (2 * h)).max() < 1e-9


@pytest.mark.parametrize("order, degree", KINDS)
def test_gradients_reproduce_polynomials(order, degree):
    made = body(order, degree)
    field, gradient = polynomial(order)
    corners, rule = made.mesh.vertices[made.mesh.tets], reference.quadrature(degree)
    g, volumes = reference.shape_gradients(made)
    found = np.einsum("eai,epaj->epij", field(made.rest_positions)[made.nodes.elements], g)
    assert np.abs(found - gradient(rule.points @ corners)).max() < 1e-13
    assert np.abs(g.sum(axis=2)).max() < 1e-13
    assert volumes.sum() == pytest.approx(1.0 * 0.9 * 1.1) and volumes.min() > 0


@pytest.mark.parametrize("order", ORDERS)
def test_order_of_vertices_does_not_matter(order):
    plain = body(order)
    turned = body(order, mesh=ts.TetMesh(plain.mesh.vertices, plain.mesh.tets[:, [2, 0, 1, 3]]))
    assert np.array_equal(turned.rest_positions, plain.rest_positions)
    field = polynomial(2)[0](plain.rest_positions)
    for quantity in (reference.lumped_mass, reference.gravity_mass, lambda b: reference.consistent_mass(b) @ field):
        assert np.abs(quantity(turned) - quantity(plain)).max() < 1e-12 * np.abs(quantity(plain)).max()
    middle = []
    for made in (plain, turned):  # the mean gradient of a field
        g, volumes = reference.shape_gradients(made)
        middle.append(np.einsum("ep,eai,epaj->eij", volumes, field[made.nodes.elements], g))
    assert np.abs(middle[0] - middle[1]).max() < 1e-13


def test_a_mirrored_tet_has_the_same_edges_and_volume():
    mesh = cube(cells=(2, 1, 1))
    inverse, volumes = reference.inverse_rest_edges(mesh.vertices, mesh.tets)
    mirrored, others = reference.inverse_rest_edges(mesh.vertices, mesh.tets[:, [0, 2, 1, 3]])
    assert np.abs(mirrored - inverse[:, [1, 0, 2]]).max() < 1e-13
    assert np.allclose(others, volumes, rtol=1e-14) and volumes.min() > 0


@pytest.mark.parametrize("degree, exact, count", [(1, 1, 1), (2, 2, 4), (4, 5, 14)])
def test_quadrature(degree, exact, count):
    """The integral of l_0^a l_1^b l_2^c l_3^d over a tet is 6 V a! b! c! d! / (a + b + c + d + 3)!."""
    rule = reference.quadrature(degree)
    assert rule.points.shape == (count, 4) and rule.weights.shape == (count,)
    assert rule.weights.min() > 0 and rule.points.min() > 0
    assert rule.weights.sum() == pytest.approx(1, abs=1e-15) and rule.points.sum(axis=1) == pytest.approx(1, abs=1e-15)
    errors = {}
    for powers in product(range(exact + 2), repeat=4):
        expected = 6 * np.prod([factorial(p) for p in powers]) / factorial(sum(powers) + 3)
        errors.setdefault(sum(powers), []).append(rule.weights @ np.prod(rule.points**powers, axis=1) - expected)
    assert all(np.abs(errors[k]).max() < 1e-16 for k in range(exact + 1))
    assert np.abs(errors[exact + 1]).max() > 1e-5


@pytest.mark.parametrize("order", ORDERS)
def test_masses_equal_those_of_the_oracle(order):
    made = body(order)
    expected = Elements(made.mesh, order)
    M, lumped = reference.consistent_mass(made).toarray(), reference.lumped_mass(made)
    assert np.abs(M - expected.consistent_mass(1200.0)).max() < 1e-13 * M.max()
    assert np.abs(M - M.T).max() < 1e-13 * M.max() and np.linalg.eigvalsh(M).min() > 0
    assert lumped == pytest.approx(expected.lumped_mass(1200.0)) and lumped.min() > 0
    assert lumped.sum() == pytest.approx(1200 * 0.99) and M.sum() == pytest.approx(1200 * 0.99)
    assert reference.gravity_mass(made) == pytest.approx(M.sum(axis=1))


@pytest.mark.parametrize("order, masses, weights", [(1, [1 / 4], [1 / 4]), (2, [1 / 36, 4 / 27], [-1 / 20, 1 / 5])])
def test_fractions_of_a_tet_at_its_nodes(order, masses, weights):
    """Of lumped mass and of weight."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])  # of 200 kg and 400 kg
    made = body(order, mesh=ts.TetMesh(vertices, tets))
    for found, fraction in ((reference.lumped_mass(made), masses), (reference.gravity_mass(made), weights)):
        assert found[:5] == pytest.approx(fraction[0] * np.array([200, 600, 600, 600, 400]))
        # by sorted pairs: 01 02 03 of the first tet, 12 13 of both, 14 of the second, 23 of both, 24 34 of the second
        middles = fraction[1] * np.array([200, 200, 200, 600, 600, 400, 600, 400, 400]) if order == 2 else []
        assert found[5:] == pytest.approx(middles)


@pytest.mark.parametrize("order", ORDERS)
def test_consistent_mass_integrates_squares(order):
    """Of polynomials of the element's order, by an accurate rule."""
    made, (field, _) = body(order), polynomial(order)
    rule = reference.quadrature(4)
    values = field(rule.points @ made.mesh.vertices[made.mesh.tets])
    exact = 1200 * np.einsum("e,p,epi,epi->", made.mesh.volumes, rule.weights, values, values)
    u = field(made.rest_positions)
    assert np.sum(u * (reference.consistent_mass(made) @ u)) == pytest.approx(exact, rel=1e-13)


@pytest.mark.parametrize("order", ORDERS)
def test_traction_on_a_whole_surface(order):
    made, t = body(order), np.array([1.0, -2.0, 0.5])
    f = np.outer(reference.triangle_areas(made, np.arange(len(made.mesh.surface))), t)
    a, b, c = (made.mesh.vertices[made.mesh.surface[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert area.sum() == pytest.approx(2 * (0.9 + 1.1 + 0.9 * 1.1))
    assert f.sum(axis=0) == pytest.approx(area.sum() * t)
    moment = np.cross((a + b + c) / 3, np.outer(area, t)).sum(axis=0)
    assert np.abs(np.cross(made.rest_positions, f).sum(axis=0) - moment).max() < 1e-13
    assert f[: made.mesh.n_verts].any() == (order == 1)


@pytest.mark.parametrize("order", ORDERS)
def test_traction_on_two_triangles(order):
    made = body(order)
    made.add_traction([3, 8], (0.0, 10.0, -1.0))
    f = np.outer(reference.triangle_areas(made, np.array([3, 8])), (0.0, 10.0, -1.0))
    expected = body_loads(made, made.rest_positions, reference.lumped_mass(made))
    assert np.abs(f - expected).max() < 1e-15 * np.abs(expected).max()
    assert (f[:, 1] > 0).sum() == (5, 6)[order - 1]  # the triangles share a vertex, but no edge


@pytest.mark.parametrize("order", ORDERS)
def test_work_of_a_traction(order):
    """On a displacement of the element's order: the integral over a face, by a rule of degree 3."""
    made, (field, _), t = body(order), polynomial(order), np.array([1.0, -2.0, 0.5])
    face = np.arange(4)
    f = np.outer(reference.triangle_areas(made, face), t)
    X = made.mesh.vertices[made.mesh.surface[face]]
    area = np.linalg.norm(np.cross(X[:, 1] - X[:, 0], X[:, 2] - X[:, 0]), axis=1) / 2
    points = np.array([(1 / 3, 1 / 3, 1 / 3), (0.6, 0.2, 0.2), (0.2, 0.6, 0.2), (0.2, 0.2, 0.6)])
    weights = np.array([-27, 25, 25, 25]) / 48
    exact = np.einsum("e,p,epi,i->", area, weights, field(points @ X), t)
    assert np.sum(f * field(made.rest_positions)) == pytest.approx(exact, rel=1e-12)
