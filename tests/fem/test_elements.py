"""Linear and quadratic tetrahedra, and the device arrays of a scene with both: shape functions and their derivatives, quadrature,
gradients, masses and loads are those of their definitions and of the oracle (`test_elasticity` has lanes and gathering).
"""

from itertools import product
from math import factorial

import numpy as np
import pytest

import taisoft as ts
from taisoft.fem import reference
from taisoft.fem.loads import SceneLoads
from taisoft.mesh import quadratic
from taisoft.mesh.topology import EDGES
from tests.dynamics.scenes import built, cube, driven_scene, mixed_scene, rubber
from tests.fem.composition import composition
from tests.fem.oracle import Oracle
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
    N, s = quadratic.shape_functions(order, POINTS), quadratic.shape_derivatives(order, POINTS)
    assert N.shape == (20, (4, 10)[order - 1]) and np.abs(N.sum(axis=1) - 1).max() < 1e-15
    at_nodes = np.concatenate([np.eye(4), [(np.eye(4)[a] + np.eye(4)[b]) / 2 for a, b in EDGES]])[: N.shape[1]]
    assert np.array_equal(quadratic.shape_functions(order, at_nodes), np.eye(N.shape[1]))
    h = 1e-6
    for k in range(4):  # N is a polynomial in all four coordinates
        step = h * np.eye(4)[k]
        change = quadratic.shape_functions(order, POINTS + step) - quadratic.shape_functions(order, POINTS - step)
        assert np.abs(s[:, :, k] - change / (2 * h)).max() < 1e-9


@pytest.mark.parametrize("degree, exact, count", [(1, 1, 1), (2, 2, 4), (4, 5, 14)])
def test_quadrature(degree, exact, count):
    """The integral of l_0^a l_1^b l_2^c l_3^d over a tet is 6 V a! b! c! d! / (a + b + c + d + 3)!."""
    rule = quadratic.quadrature(degree)
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
    assert np.abs(found - gradient(quadratic.quadrature(made.quadrature_degree).points @ corners)).max() < 1e-13
    assert volumes.sum() == pytest.approx(1.0 * 0.9 * 1.1) and volumes.min() > 0
    rule, M = quadratic.quadrature(4), reference.consistent_mass(made)
    values = field(rule.points @ corners)
    exact = 1200 * np.einsum("e,p,epi,epi->", made.mesh.volumes, rule.weights, values, values)
    assert np.sum(u * (M @ u)) == pytest.approx(exact, rel=1e-13)
    assert reference.gravity_mass(made) == pytest.approx(np.asarray(M.sum(axis=1)).ravel())
    lumped = reference.lumped_mass(made)
    assert lumped == pytest.approx(Elements(made.mesh, order).lumped_mass(1200.0)) and lumped.sum() == pytest.approx(1200 * 0.99)


@pytest.fixture(scope="module")
def rig():
    with built(composition(1, 2), "f64") as rig:
        yield rig


def test_nodes_and_masses(rig):
    counts, m = [43, 8, 8], rig.model
    assert list(rig.layout.node_start) == list(np.cumsum([0, *counts])) and m.n_nodes == sum(counts)
    assert np.array_equal(rig.layout.rest, rig.oracle.rest) and rig.layout.rest[0, 0] == 0.0  # position of the body included
    lumped, M = rig.oracle.lumped[:, 0], rig.oracle.mass
    assert m.mass.to_numpy() == pytest.approx(lumped) and reference.lumped_masses(rig.scene) == pytest.approx(lumped)
    assert np.abs(reference.mass_matrix(rig.scene).toarray() - M).max() < 1e-13 * M.max()
    weight = rig.oracle.consistent.sum(axis=1)
    assert reference.gravity_masses(rig.scene) == pytest.approx(weight) and m.gravity_mass.to_numpy() == pytest.approx(weight)
    assert [body.mass for body in rig.scene.bodies] == pytest.approx([part.sum() for part in np.split(lumped, [43, 51])])
    start, column, stored = (getattr(m.mass_matrix, name).to_numpy() for name in ("row_start", "column", "value"))
    on_device = np.diag(m.mass_matrix.diagonal.to_numpy())
    on_device[np.repeat(np.arange(2 * m.n_nodes), np.diff(start)) % m.n_nodes, column] = stored
    assert m.consistent and np.abs(on_device - M).max() < 1e-13 * M.max()


@pytest.mark.parametrize("order", [1, 2])
def test_loads_equal_the_oracle_and_add_up(order):
    scene = mixed_scene(order=order)
    oracle, total = Oracle(scene), SceneLoads(scene).at(0.0)
    first, second, third, _ = oracle.starts[1:]
    assert total == pytest.approx(oracle.loads) and not total[second:].any()
    assert total[:first].sum(axis=0) == pytest.approx(0.9 * 1.1 * np.array([300, 2000, -500]))
    assert total[first:second].sum(axis=0) == pytest.approx([30, -10, 20])
    driven = driven_scene(order=order)
    assert SceneLoads(driven).at(0.0) == pytest.approx(Oracle(driven).loads)
    forces = np.random.default_rng(0).standard_normal((3, 3))  # one for each node
    scene.body("tower").add_force([4, 2, 7], forces)
    added = SceneLoads(scene).at(0.0) - total
    assert np.abs(added[second + np.array([4, 2, 7])] - forces).max() < 1e-12 and np.count_nonzero(added) == 9
