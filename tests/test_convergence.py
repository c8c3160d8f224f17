"""Errors of static solutions under refinement, against a smooth displacement whose body force is known:

* halving the mesh width divides the L2 error of linear tets by nearly 4, that of quadratic ones by nearly 8.
"""

import numpy as np
from oracle_elements import RULES, Elements
from oracle_laws import pk1
from scenes import SNH, element, rubber

import taisoft as ts

YOUNG, POISSON = 1e5, 0.3  # [Pa]


def displacement(X: np.ndarray) -> np.ndarray:
    """(...,3) [m] of X (...,3) in the unit cube: strains of up to a third."""
    x, y, z = np.moveaxis(X, -1, 0)
    return 0.1 * np.stack([np.sin(2 * x + y) * np.cos(z), np.cos(2 * y) * np.sin(x + z), np.sin(x * y + 2 * z)], axis=-1)


def deformation(X: np.ndarray) -> np.ndarray:
    """F (...,3,3) by central differences, good to 1e-10; X may have the complex step of another derivative."""
    h = 1e-5
    columns = [(displacement(X + h * axis) - displacement(X - h * axis)) / (2 * h) for axis in np.eye(3)]
    return np.eye(3) + np.stack(columns, axis=-1)


def body_force(X: np.ndarray) -> np.ndarray:
    """-Div P (...,3) [N/m^3]."""
    h, force = 1e-30, 0.0
    for j, axis in enumerate(np.eye(3)):
        F = deformation(X + 1j * h * axis).reshape(-1, 3, 3)
        force = force - pk1(SNH, F, YOUNG, POISSON)[:, :, j].imag / h
    return force.reshape(X.shape)


def loaded(scene: ts.Scene, order: int, degree: int | None, cells: int) -> Elements:
    """Add a unit cube under the body force, its surface displaced."""
    mesh = ts.box_mesh((cells,) * 3, (1, 1, 1), (0.5, 0.5, 0.5))
    body = scene.add_body(mesh, rubber(SNH, young=YOUNG, poisson=POISSON), **element(order, degree))
    X = body.rest_positions
    boundary = (np.abs(X - 0.5) > 0.499).any(axis=1)
    body.move(boundary, lambda t: displacement(X[boundary]))
    elements, (points, weights) = Elements(mesh, order), RULES[4]
    places, N, _ = elements.at(points)
    forces = np.zeros_like(X)
    np.add.at(forces, elements.tets, np.einsum("e,k,eka,eki->eai", elements.volumes, weights, N, body_force(places)))
    body.add_force(np.arange(len(X)), forces)
    return elements


def error(elements: Elements, x: np.ndarray) -> float:
    """L2 norm of the error of the displacement [m^(5/2)]."""
    points, weights = RULES[4]
    places, N, _ = elements.at(points)
    difference = np.einsum("eka,eai->eki", N, (x - elements.X)[elements.tets]) - displacement(places)
    return np.sqrt(np.einsum("e,k,eki->", elements.volumes, weights, difference**2))


def test_l2_error():
    """All meshes in one scene, so that the solver is compiled once."""
    kinds = {(1, None, 4): 1.9, (2, 2, 2): 2.8, (2, 4, 2): 2.8}  # order, quadrature, cells -> least order of the error
    scene = ts.Scene(gravity=(0, 0, 0))
    made = [[loaded(scene, order, degree, n) for n in (cells, 2 * cells)] for order, degree, cells in kinds]
    result = ts.solve_static(scene, tolerance=1e-8)
    assert result.converged and result.n_inverted == 0
    bodies = iter(scene.bodies)
    for elements, rate in zip(made, kinds.values()):
        coarse, fine = (error(e, result.positions(next(bodies).name)) for e in elements)
        assert coarse < 0.005 and np.log2(coarse / fine) > rate
