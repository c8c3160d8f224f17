"""Thick spheres under inner pressure: Lamé's displacement at a small load, the radial balance of the law at a large one.

Small strains, inner radius a, outer radius b, pressure p (Timoshenko, Goodier, Theory of Elasticity, section 136):
    u(r) = p a^3 / (E (b^3 - a^3)) ((1 - 2 nu) r + (1 + nu) b^3 / (2 r^2)).
Large strains, r(R) with the stresses of F = diag(r', r/R, r/R):
    dP_r/dR + 2 (P_r - P_t) / R = 0,   P_r = -p (r/R)^2 at R = a,   P_r = 0 at R = b,
solved by collocation. The mesh is an eighth of a sphere of flat facets, scaled so that they enclose the volume of the cavity. The
radius is that of a ball with the volume of the deformed cavity.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.integrate import solve_bvp

import taisoft as ts
from taisoft.static import StaticResult

from .record import LAWS, Case, near, scene

INNER, OUTER = 1.0, 2.0  # [m]
YOUNG, POISSON = 1e5, 0.3
SMALL, LARGE = 100.0, 2e4  # [Pa]: strains of 1e-3, and a quarter
SMALL_LIMIT, LARGE_LIMIT = 0.005, 0.01  # relative, of the displacement
DIFFERENCE = 1e-5  # of stretches, for the derivatives of stresses


def thick_sphere(inner: float, outer: float, across: int, layers: int, whole: bool = False) -> ts.TetMesh:
    """A shell with `across` cells over an angle of 45 degrees and `layers` through its thickness: an eighth with positive
    coordinates, or the whole."""
    cells = 2 * (across + layers)
    grid = ts.box_mesh((cells,) * 3, (2.0, 2.0, 2.0)).vertices
    tets = ts.ball_mesh(1.0, cells).tets
    level = np.rint(np.abs(grid).max(axis=1) * (across + layers)).astype(int)
    kept = level[tets].min(axis=1) >= across
    if not whole:
        kept &= (grid[tets].mean(axis=1) > 0.0).all(axis=1)
    used, tets = np.unique(tets[kept], return_inverse=True)
    cube = grid[used] / np.abs(grid[used]).max(axis=1, keepdims=True)
    along = np.tan(0.25 * np.pi * cube)  # equal angles
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    radius = inner + (outer - inner) * (level[used] - across) / layers
    mesh = ts.TetMesh(radius[:, None] * along, tets.reshape(-1, 4))
    enclosed = cone_volume(mesh.vertices, mesh.surface[inside(mesh, inner)])
    exact = 4.0 / 3.0 * np.pi * inner**3 / (1.0 if whole else 8.0)
    return ts.TetMesh(mesh.vertices * np.cbrt(exact / enclosed), mesh.tets)


def cone_volume(x: np.ndarray, triangles: np.ndarray) -> float:
    """Volume [m^3] between inner triangles, whose normals point to the origin, and the origin."""
    return -float(np.linalg.det(x[triangles]).sum()) / 6.0


def inside(mesh: ts.TetMesh, radius: float) -> np.ndarray:
    """Rows of the surface whose corners lie within 1.1 times this radius."""
    return np.flatnonzero((np.linalg.norm(mesh.vertices[mesh.surface], axis=2) < 1.1 * radius).all(axis=1))


def hold_planes(body, axes: str = "xyz") -> None:
    """Fix the nodes on the planes of symmetry across the axes along their normals."""
    for axis in map("xyz".index, axes):
        body.fix(lambda X, a=axis: np.abs(X[:, a]) < 1e-9, axes="xyz"[axis])


def lame(young: float, poisson: float, inner: float, outer: float, pressure: float, radius: float) -> float:
    """Radial displacement [m] at small strains."""
    factor = pressure * inner**3 / (young * (outer**3 - inner**3))
    return factor * ((1.0 - 2.0 * poisson) * radius + 0.5 * (1.0 + poisson) * outer**3 / radius**2)


def inflated(pk1: Callable[[np.ndarray], np.ndarray], inner: float, outer: float, pressure: float) -> float:
    """Radius [m] of the inner surface under a large pressure. pk1: F (k,3,3) -> P (k,3,3) of the law [Pa]."""

    def stresses(radial, tangential) -> np.ndarray:
        F = np.stack([radial, tangential, tangential], axis=-1)[:, :, None] * np.eye(3)
        return np.diagonal(pk1(F), axis1=1, axis2=2)[:, :2].T  # P_r, P_t

    def slopes(R, y):
        r, radial = y
        tangential, h = r / R, DIFFERENCE
        P_r, P_t = stresses(radial, tangential)
        by_radial = (stresses(radial + h, tangential)[0] - stresses(radial - h, tangential)[0]) / (2 * h)
        by_tangential = (stresses(radial, tangential + h)[0] - stresses(radial, tangential - h)[0]) / (2 * h)
        return np.stack([radial, -(2.0 * (P_r - P_t) + by_tangential * (radial - tangential)) / R / by_radial])

    def ends(at_inner, at_outer):
        stretch = np.array([at_inner[0] / inner, at_outer[0] / outer])
        P_r, _ = stresses(np.array([at_inner[1], at_outer[1]]), stretch)
        return np.array([P_r[0] + pressure * stretch[0] ** 2, P_r[1]]) / pressure

    R = np.linspace(inner, outer, 41)
    found = solve_bvp(slopes, ends, R, np.stack([R, np.ones_like(R)]), tol=1e-6, max_nodes=20000)
    if not found.success:
        raise RuntimeError(f"the radial balance was not solved: {found.message}")
    return float(found.y[0, 0])


def inner_radius(mesh: ts.TetMesh, law: str, pressure: float, arch: str = "cpu") -> tuple[float, StaticResult]:
    """Radius [m] of the inner surface of an eighth of a thick sphere of quadratic tets under a pressure, and statics' result."""
    made = scene()
    body = made.add_body(mesh, ts.Material(law=law, young=YOUNG, poisson=POISSON), name="sphere", order=2)
    hold_planes(body)
    triangles = inside(mesh, INNER)
    body.add_pressure(triangles, pressure)
    result = ts.solve_static(made, arch=arch)
    facets = body.nodes.boundary.reshape(len(mesh.surface), 4, 3)[triangles].reshape(-1, 3)
    return float(np.cbrt(cone_volume(result.positions(), facets) * 6.0 / np.pi)), result


def sphere(law: str, across: int, layers: int, _reference: dict, arch: str):
    """The displacement of the inner surface under a small and a large pressure."""
    mesh = thick_sphere(INNER, OUTER, across, layers)
    exact = lame(YOUNG, POISSON, INNER, OUTER, SMALL, INNER)
    small = inner_radius(mesh, LAWS[law], SMALL, arch)[0] - INNER
    yield near("inner displacement, small load [m]", small, exact, SMALL_LIMIT)
    exact = inflated(lambda F: ts.evaluate_law(LAWS[law], F, young=YOUNG, poisson=POISSON)[1], INNER, OUTER, LARGE) - INNER
    large = inner_radius(mesh, LAWS[law], LARGE, arch)[0] - INNER
    yield near("inner displacement, large load [m]", large, exact, LARGE_LIMIT)


CASES = tuple(
    Case("thick_sphere", law, f"{across}x{layers}", partial(sphere, law, across, layers), fine, closed_form=True)
    for law, across, layers, fine in (("SNH", 6, 3, False), ("COR", 6, 3, True), ("SNH", 10, 5, True))
)
