"""Statics of linear and quadratic tets compared with known solutions, in one scene each, so that its solver is compiled once:

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


@pytest.fixture(scope="module", params=[1, 2])
def solved(request) -> tuple[int, dict[tuple, Case], StaticResult]:
    """The order, cases by (name, cells along x), and the result."""
    scene, cases, order = ts.Scene(gravity=(0, 0, 0)), {}, request.param
    scene.contact_forces = False

    def add(name: str, cells: int, mesh: ts.TetMesh, young: float) -> Case:
        body = scene.add_body(mesh, rubber(SNH, young=young, poisson=POISSON), **element(order, 2))
        cases[name, cells] = Case(body, Elements(mesh, order))
        return cases[name, cells]

    add("patch", 2, irregular(), YOUNG).prescribe_surface(lambda X: X @ (A - np.eye(3)).T + B)
    for cells in (4, 8) if order == 1 else (2, 4):
        smoothed = add("smooth", cells, ts.box_mesh((cells,) * 3, (1, 1, 1), (0.5, 0.5, 0.5)), YOUNG)
        smoothed.prescribe_surface(smooth)
        smoothed.load(body_force)
    for cells in ((4, 1, 1), (11, 2, 2)):
        beam = add("beam", cells[0], ts.box_mesh(cells, (4, 1, 1)), 1e6)
        beam.body.fix(lambda X: X[:, 0] < -1.999)
        beam.load(lambda X: np.broadcast_to([0.0, -9800.0, 0.0], X.shape))
    result = ts.solve_static(scene, tolerance=1e-12)
    assert result.converged and result.n_inverted == 0
    return order, cases, result


def test_patch(solved):
    order, cases, result = solved
    case = cases["patch", 2]
    exact, prescribed = case.elements.X @ A.T + B, case.body.constraints[0].nodes
    x = result.positions(case.body.name)
    assert len(x) - len(prescribed) == (1, 19)[order - 1] and np.abs(x - exact).max() < 1e-12  # [m]
    part = case.elements.part(case.body.quadrature_degree, case.body.material, 0)
    assert np.abs(np.einsum("eai,eaj->eij", x[part.nodes], part.gradients) - A).max() < 1e-11


def test_l2_error(solved):
    order, cases, result = solved
    coarse, fine = (case.error(result.positions(case.body.name)) for (name, _), case in cases.items() if name == "smooth")
    assert coarse < 0.005 and np.log2(coarse / fine) > (1.9, 2.8)[order - 1]


def test_sag_of_a_beam(solved):
    """Errors [%] on the same mesh by the oracle's dense Newton."""
    order, cases, result = solved
    for cells, error in ((11, -16.309),) if order == 1 else ((4, -3.420), (11, -0.7235)):
        case = cases["beam", cells]
        tip = np.linalg.norm(case.elements.X - [2, 0, 0], axis=1).argmin()
        sag = (result.positions(case.body.name) - case.elements.X)[tip, 1]
        assert 100 * (sag / SAG - 1) == pytest.approx(error, abs=6e-4)
