"""Rest gradients and masses of linear and quadratic tetrahedra, see `mesh.quadratic` for their shape functions. NumPy.

Where edges are straight at rest, grad l_k and the Jacobian of the rest shape are constant over a tet. In a body with curved edges
they belong to a quadrature point, and masses are integrated by the rule of degree 4, which is exact for int rho N_a dV.
Integrals over a tet are V times a weighted sum over points: for order 1 the centre, since F is constant; for order 2 four
points, exact for degree 2 (Hammer, Stroud 1956), or fourteen, exact for degree 5 (Walkington 2000).

Masses are lumped in explicit steps, and in implicit steps consistent in quadratic bodies. Lumping hardly shifts the frequencies
of quadratic tets but distributes their weight wrongly (it is not int rho N_a g dV). Implicit steps solve linear systems anyway,
so they use the consistent matrix there. Linear bodies stay lumped: in a scene with a quadratic body their rows have zeros off
the diagonal.
"""

from functools import cache

import numpy as np
import scipy.sparse as sp

from taisoft.fem.dependent_table import DependentTable, dependent_table
from taisoft.mesh import aggregates, quadratic
from taisoft.mesh.topology import EDGES
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Body, Scene

HRZ_FRACTIONS = {1: (1 / 4, 0.0), 2: (1 / 36, 4 / 27)}  # fraction of a tet's mass at a corner, at a mid-edge node


def inverse_rest_edges(vertices: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dm^-1 (m,3,3) [1/m], with Dm's columns X1-X0, X2-X0, X3-X0, and the rest volumes (m,) [m^3].

    F does not depend on the order of a tet's vertices, and the volume is taken as positive.
    """
    corner = vertices[tets]
    Dm = (corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1)
    return np.linalg.inv(Dm), np.abs(np.linalg.det(Dm)) / 6.0


def shape_gradients(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Rest gradients of the shape functions (m, p, 4 or 10, 3) [1/m] at the body's quadrature points, and the
    volumes of these points (m, p) [m^3]."""
    rule = quadratic.quadrature(body.quadrature_degree)
    if body.is_curved:
        x, s = body.rest_positions[body.nodes.elements], quadratic.shape_derivatives(2, rule.points)
        J = quadratic.jacobians(x, rule.points)
        return (s[:, :, 1:] - s[:, :, :1]) @ np.linalg.inv(J), np.linalg.det(J) * rule.weights / 6.0
    Dm_inv, volumes = inverse_rest_edges(body.mesh.vertices, body.mesh.tets)
    barycentric = np.concatenate([-Dm_inv.sum(axis=1, keepdims=True), Dm_inv], axis=1)
    return quadratic.shape_derivatives(body.order, rule.points) @ barycentric[:, None], np.outer(volumes, rule.weights)


def rest_volumes(body: Body) -> np.ndarray:
    """Volumes (m,) [m^3] of the tets, as the body's quadrature gives them."""
    return shape_gradients(body)[1].sum(axis=1) if body.is_curved else body.mesh.volumes


def tet_patches(body: Body) -> np.ndarray:
    """Patch (m,) of each tet, from 0, over which mean dilatation averages: each quadratic tet is one."""
    if body.order == 2:
        return np.arange(body.mesh.n_tets)
    regions = body.mesh.regions if body.composition.has_regions else np.zeros(body.mesh.n_tets, dtype=np.int64)
    return aggregates.tet_patches(body.mesh.tets, body.mesh.volumes, regions)


def patch_moduli(body: Body, patch: np.ndarray) -> np.ndarray:
    """Mean lambda (n_patches,) [Pa] of the patches. patch: `tet_patches`."""
    volumes, lam = rest_volumes(body), body.composition.dilatation_modulus
    return np.bincount(patch, volumes * lam) / np.bincount(patch, volumes)


def lumped_mass(body: Body) -> np.ndarray:
    """Lumped mass (n,) [kg], positive: the diagonal of the consistent mass scaled to the mass of each tet.

    Source for order 2: Hinton, Rock, Zienkiewicz 1976. For order 1 each vertex gets a quarter, as with row sums.
    """
    corner, middle = HRZ_FRACTIONS[body.order]
    fractions = np.repeat([corner, middle], [4, body.nodes.elements.shape[1] - 4])
    if body.is_curved:
        volumes, N = _curved_points(body)
        fractions = volumes @ N**2
        fractions /= fractions.sum(axis=1, keepdims=True)
    return _distribute(body, fractions)


def gravity_mass(body: Body) -> np.ndarray:
    """int rho N_a dV at each node (n,) [kg], the mass used for weight; for order 2 negative at the corners."""
    fractions = np.full(4, 0.25) if body.order == 1 else np.repeat([-0.05, 0.2], [4, 6])
    if body.is_curved:
        volumes, N = _curved_points(body)
        fractions = volumes @ N / body.volumes[:, None]
    return _distribute(body, fractions)


def _distribute(body: Body, fractions: np.ndarray) -> np.ndarray:
    """Masses (n,) [kg] of fractions of the tets' masses at their nodes, (10,) or (m,10)."""
    values = np.reshape(body.composition.number("density"), (-1, 1)) * (body.volumes[:, None] * fractions)
    return np.bincount(body.nodes.elements.reshape(-1), values.reshape(-1), body.n_nodes)


def _curved_points(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Volumes (m,p) [m^3] of the points of the rule of degree 4, and N_a there (p,10)."""
    rule = quadratic.quadrature(4)
    return quadratic.point_volumes(body.rest_positions[body.nodes.elements], rule), quadratic.shape_functions(2, rule.points)


@cache
def unit_mass(order: int) -> np.ndarray:
    """int N_a N_b dV / V over a tet: (4,4) or (10,10)."""
    if order == 1:
        return (np.ones((4, 4)) + np.eye(4)) / 20.0
    is_end = np.array([[k in edge for k in range(4)] for edge in EDGES])
    corners = 5.0 * np.eye(4) + 1.0
    mixed = np.where(is_end, -4.0, -6.0)
    middles = 8.0 * (is_end.astype(float) @ is_end.T + 1.0) + 8.0 * np.eye(6)
    return np.block([[corners, mixed.T], [mixed, middles]]) / 420.0


def consistent_mass(body: Body) -> sp.csr_matrix:
    """Consistent mass matrix (n,n), the same for each axis: int rho N_a N_b dV [kg]; of a rigid body its four point masses."""
    if isinstance(body, RigidBody):
        return sp.diags(lumped_mass(body), format="csr")
    elements = body.nodes.elements
    values = (body.composition.number("density") * body.volumes)[:, None, None] * unit_mass(body.order)
    if body.is_curved:
        volumes, N = _curved_points(body)
        values = np.reshape(body.composition.number("density"), (-1, 1, 1)) * np.tensordot(volumes, N[:, :, None] * N[:, None], 1)
    rows, columns = np.broadcast_arrays(elements[:, :, None], elements[:, None, :])
    return sp.csr_matrix((values.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(body.n_nodes,) * 2)


def lumped_masses(scene: Scene, dependents: DependentTable | None = None) -> np.ndarray:
    """Lumped masses (n_nodes,) [kg], bodies in order. dependents: the scene's table, here and below, if it is known already."""
    masses, table = np.concatenate([lumped_mass(b) for b in scene.bodies]), dependents or dependent_table(scene)
    return masses if table is None else table.lump(masses)


def gravity_masses(scene: Scene, dependents: DependentTable | None = None) -> np.ndarray:
    """Masses used for weight, int rho N_a dV, (n_nodes,) [kg]."""
    masses, table = np.concatenate([gravity_mass(b) for b in scene.bodies]), dependents or dependent_table(scene)
    return masses if table is None else table.matrix.T @ masses


def mass_matrix(scene: Scene, dependents: DependentTable | None = None) -> sp.csr_matrix:
    """Mass matrix of implicit steps (n_nodes, n_nodes) [kg]: consistent for bodies of order 2, else lumped."""
    parts = [consistent_mass(b) if b.order == 2 else sp.diags(lumped_mass(b)) for b in scene.bodies]
    M, table = sp.block_diag(parts, format="csr"), dependents or dependent_table(scene)
    return M if table is None else (table.matrix.T @ M @ table.matrix).tocsr()


def triangle_areas(body: Body, triangles: np.ndarray) -> np.ndarray:
    """Reference areas at the nodes (n,) [m^2] of rows (k,) of mesh.surface: a uniform traction times them is the nodal forces.

    A third of a triangle goes to each corner for linear tets, to each mid-edge node for quadratic ones with straight edges.
    """
    if body.is_curved:
        nodes = body.face_nodes(triangles)
        parts = np.linalg.norm(quadratic.area_vectors(body.rest_positions[nodes]), axis=2) @ quadratic.triangle_rule(2)[1].T
        return np.bincount(nodes.reshape(-1), parts.reshape(-1), body.n_nodes)
    corners = body.mesh.surface[triangles]
    a, b, c = (body.mesh.vertices[corners[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    nodes = corners if body.order == 1 else body.face_nodes(triangles)[:, 3:]
    return np.bincount(nodes.reshape(-1), np.repeat(area / 3.0, 3), body.n_nodes)
