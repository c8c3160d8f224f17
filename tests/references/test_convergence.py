"""Statics of linear and quadratic tets compared with known solutions, all in one scene, so that the solver is compiled once:

* patch test: affine displacements of the surface give the same affine displacement inside, to rounding;
* halving the mesh width divides the L2 error of a smooth displacement by nearly 4 for linear tets, 8 for quadratic ones;
* the sag of a clamped beam on coarse meshes is the oracle's; linear tets are far too stiff.
"""

from dataclasses import dataclass

import numpy as np
import pytest

import taisoft as ts
from taisoft.scene.scene import Body
from taisoft.static import StaticResult
from tests.dynamics.scenes import SNH, cube, element, rubber
from tests.fem.oracle_elements import RULES, Elements
from tests.fem.oracle_laws import pk1

YOUNG, POISSON = 1e5, 0.3  # [Pa], of the cubes
A, B = np.array([[1.2, 0.3, -0.1], [0.05, 0.9, 0.2], [0.15, -0.25, 1.1]]), np.array([0.3, -0.2, 0.1])  # x = A X + B
SAG = -2.70947892267  # [m] of the beam's tip, converged in space by 27-node bricks (good to 4e-4)


def smooth(X: np.ndarray) -> np.ndarray:
    """A displacement (...,3) [m] of X (...,3) in the unit cube: strains of up to a third."""
    x, y, z = np.moveaxis(X, -1, 0)
    return 0.1 * np.stack([np.sin(2 * x + y) * np.cos(z), np.cos(2 * y) * np.sin(x + z), np.sin(x * y + 2 * z)], axis=-1)


def deformation(X: np.ndarray) -> np.ndarray:
    """Its F (...,3,3) by central differences, accurate to 1e-10; X may be complex, for another derivative."""
    h = 1e-5
    columns = [(smooth(X + h * axis) - smooth(X - h * axis)) / (2 * h) for axis in np.eye(3)]
    return np.eye(3) + np.stack(columns, axis=-1)


def body_force(X: np.ndarray) -> np.ndarray:
    """-Div P (...,3) [N/m^3], whose equilibrium is `smooth`."""
    h, force = 1e-30, 0.0
    for j, axis in enumerate(np.eye(3)):
        F = deformation(X + 1j * h * axis).reshape(-1, 3, 3)
        force = force - pk1(SNH, F, YOUNG, POISSON)[:, :, j].imag / h
    return force.reshape(X.shape)


@dataclass
class Case:
    """A body of the scene, and its elements by the oracle."""

    body: Body
    elements: Elements

    def prescribe_surface(self, displacement) -> None:
        """Displace the surface nodes by displacement(X) [m]."""
        X, vertices = self.body.rest_positions, self.body.mesh.vertices
        surface = ((X < vertices.min(axis=0) + 1e-9) | (X > vertices.max(axis=0) - 1e-9)).any(axis=1)
        self.body.move(surface, lambda t: displacement(X[surface]))

    def load(self, density) -> None:
        """Apply the body force density(X) [N/m^3]."""
        points, weights = RULES[4]
        places, N, _ = self.elements.at(points)
        element_forces = np.einsum("e,k,eka,eki->eai", self.elements.volumes, weights, N, density(places))
        forces = np.zeros_like(self.elements.X)
        np.add.at(forces, self.elements.tets, element_forces)
        self.body.add_force(np.arange(len(forces)), forces)

    def error(self, x: np.ndarray) -> float:
        """L2 norm of the error of the smooth displacement [m^(5/2)]."""
        points, weights = RULES[4]
        places, N, _ = self.elements.at(points)
        u = np.einsum("eka,eai->eki", N, (x - self.elements.X)[self.elements.tets])
        return np.sqrt(np.einsum("e,k,eki->", self.elements.volumes, weights, (u - smooth(places)) ** 2))


def irregular() -> ts.TetMesh:
    """A block of 40 tets whose inner vertex is off the grid."""
    regular = cube(cells=(2, 2, 2))
    inside = (np.abs(regular.vertices) < 0.4).all(axis=1)
    return ts.TetMesh(regular.vertices + np.outer(inside, [0.05, -0.08, 0.11]), regular.tets)


@pytest.fixture(scope="module")
def solved() -> tuple[dict[tuple, Case], StaticResult]:
    """Cases by (name, order, quadrature degree, cells along x), and the result."""
    scene, cases = ts.Scene(gravity=(0, 0, 0)), {}

    def add(name: str, order: int, degree: int | None, cells: int, mesh: ts.TetMesh, material: ts.Material) -> Case:
        body = scene.add_body(mesh, material, **element(order, degree))
        cases[name, order, degree, cells] = Case(body, Elements(mesh, order))
        return cases[name, order, degree, cells]

    for order, degree in ((1, None), (2, 2)):
        add("patch", order, degree, 2, irregular(), rubber()).prescribe_surface(lambda X: X @ (A - np.eye(3)).T + B)
        for cells in (4, 8) if order == 1 else (2, 4):
            mesh = ts.box_mesh((cells,) * 3, (1, 1, 1), (0.5, 0.5, 0.5))
            smoothed = add("smooth", order, degree, cells, mesh, rubber(SNH, young=YOUNG, poisson=POISSON))
            smoothed.prescribe_surface(smooth)
            smoothed.load(body_force)
        for cells in ((4, 1, 1), (11, 2, 2)):
            mesh, material = ts.box_mesh(cells, (4, 1, 1)), ts.Material(young=1e6, poisson=0.3, density=1000.0)
            beam = add("beam", order, degree, cells[0], mesh, material)
            beam.body.fix(lambda X: X[:, 0] < -1.999)
            beam.load(lambda X: np.broadcast_to([0.0, -9800.0, 0.0], X.shape))
    result = ts.solve_static(scene, tolerance=1e-12)
    assert result.converged and result.n_inverted == 0
    return cases, result


@pytest.mark.parametrize("order, degree, inside", [(1, None, 1), (2, 2, 19)])
def test_patch(solved, order, degree, inside):
    case = solved[0]["patch", order, degree, 2]
    exact, prescribed = case.elements.X @ A.T + B, case.body.constraints[0].nodes
    x = solved[1].positions(case.body.name)
    assert len(x) - len(prescribed) == inside and np.abs(x - exact).max() < 1e-12  # [m]
    part = case.elements.part(case.body.quadrature_degree, case.body.material, 0)
    assert np.abs(np.einsum("eai,eaj->eij", x[part.nodes], part.gradients) - A).max() < 1e-11


@pytest.mark.parametrize("order, degree, cells, rate", [(1, None, 4, 1.9), (2, 2, 2, 2.8)])
def test_l2_error(solved, order, degree, cells, rate):
    cases, result = solved
    both = [cases["smooth", order, degree, n] for n in (cells, 2 * cells)]
    coarse, fine = (case.error(result.positions(case.body.name)) for case in both)
    assert coarse < 0.005 and np.log2(coarse / fine) > rate


@pytest.mark.parametrize("order, degree, cells, error", [(1, None, 11, -16.309), (2, 2, 4, -3.420), (2, 2, 11, -0.7235)])
def test_sag_of_a_beam(solved, order, degree, cells, error):
    """Errors [%] on the same mesh by the oracle's dense Newton."""
    case = solved[0]["beam", order, degree, cells]
    tip = np.linalg.norm(case.elements.X - [2, 0, 0], axis=1).argmin()
    sag = (solved[1].positions(case.body.name) - case.elements.X)[tip, 1]
    assert 100 * (sag / SAG - 1) == pytest.approx(error, abs=6e-4)
