"""Thick spheres for tests: the mesh of an eighth or a whole, and the exact solutions under inner pressure."""

import numpy as np
import scipy.integrate
from oracle_laws import pk1

import taisoft as ts


def thick_sphere(inner: float, outer: float, across: int, layers: int, whole: bool = False) -> ts.TetMesh:
    """A shell of `across` cells along an eighth's edge from the middle of a side of the cube to its corner, and `layers` cells
    through its thickness; the eighth with positive coordinates, or the whole. Its facets enclose the volumes of the spheres."""
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


def hold_planes(body) -> None:
    """Fix an eighth's nodes on the planes of symmetry along their normals."""
    for axis in range(3):
        body.fix(lambda X, a=axis: np.abs(X[:, a]) < 1e-9, axes="xyz"[axis])


def lame(young: float, poisson: float, inner: float, outer: float, pressure: float, radius: float) -> float:
    """Radial displacement of a thick sphere under inner pressure, for small strains (Timoshenko, Goodier, section 136)."""
    factor = pressure * inner**3 / (young * (outer**3 - inner**3))
    return factor * ((1.0 - 2.0 * poisson) * radius + 0.5 * (1.0 + poisson) * outer**3 / radius**2)


def inflated(law: str, young: float, poisson: float, inner: float, outer: float, pressure: float) -> float:
    """Radius of the inner surface under a large pressure, from the radial balance of the law by collocation:
    dP_r/dR + 2 (P_r - P_t) / R = 0 for r(R), with the stresses of F = diag(r', r/R, r/R); P_r = -p (r/R)^2 inside, 0 outside."""

    def stresses(radial, tangential) -> tuple[np.ndarray, np.ndarray]:
        F = np.stack([radial, tangential, tangential], axis=-1)[:, :, None] * np.eye(3)
        P = pk1(law, F, young, poisson)
        return P[:, 0, 0], P[:, 1, 1]

    def slopes(R, y):
        r, radial = y
        tangential, h = r / R, 1e-20
        P_r, P_t = stresses(radial, tangential)
        by_radial = stresses(radial + 1j * h, tangential + 0j)[0].imag / h
        by_tangential = stresses(radial + 0j, tangential + 1j * h)[0].imag / h
        return np.stack([radial, -(2.0 * (P_r - P_t) + by_tangential * (radial - tangential)) / R / by_radial])

    def ends(inside, outside):
        stretch = np.array([inside[0] / inner, outside[0] / outer])
        P_r, _ = stresses(np.array([inside[1], outside[1]]), stretch)
        return np.array([P_r[0] + pressure * stretch[0] ** 2, P_r[1]]) / young

    R = np.linspace(inner, outer, 41)
    found = scipy.integrate.solve_bvp(slopes, ends, R, np.stack([R, np.ones_like(R)]), tol=1e-9, max_nodes=20000)
    assert found.success
    return float(found.y[0, 0])
