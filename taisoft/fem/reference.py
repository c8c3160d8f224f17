"""Shape functions, quadrature and masses of linear and quadratic tetrahedra, in barycentric coordinates l_0..l_3. NumPy.

Order 1: N_a = l_a. Order 2: N_a = l_a (2 l_a - 1) at the corners, N_ab = 4 l_a l_b in the middle of the edge ab. Edges are
straight at rest, so grad l_k and the Jacobian of the rest shape are constant over a tet.
Integrals over a tet are V times a weighted sum over points: for order 1 the centre, since F is constant; for order 2 four
points, exact for degree 2 (Hammer, Stroud 1956), or fourteen, exact for degree 5 (Walkington 2000).

Masses are lumped in explicit steps, and in implicit steps consistent in quadratic bodies. Lumping hardly shifts the frequencies
of quadratic tets but distributes their weight wrongly (it is not int rho N_a g dV). Implicit steps solve linear systems anyway,
so they use the consistent matrix there. Linear bodies stay lumped: in a scene with a quadratic body their rows have zeros off
the diagonal.
"""

from dataclasses import dataclass
from functools import cache
from itertools import permutations

import numpy as np
import scipy.sparse as sp

from taisoft.fem.dependent_table import DependentTable, dependent_table
from taisoft.mesh import aggregates
from taisoft.mesh.topology import EDGES
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Body, Scene

HRZ_FRACTIONS = {1: (1 / 4, 0.0), 2: (1 / 36, 4 / 27)}  # fraction of a tet's mass at a corner, at a mid-edge node
# by degree, symmetric rules: (weight of each point, one point of the orbit); the rule of 4 is exact for degree 5
RULES = {
    1: ((1.0, (1 / 4, 1 / 4, 1 / 4, 1 / 4)),),
    2: ((1 / 4, (0.58541019662496845446, *3 * (0.13819660112501051518,))),),
    4: (
        (0.11268792571801585080, (1 - 3 * 0.31088591926330060980, *3 * (0.31088591926330060980,))),
        (0.07349304311636194955, (1 - 3 * 0.09273525031089122640, *3 * (0.09273525031089122640,))),
        (0.04254602077708146644, (*2 * (0.04550370412564964949,), *2 * (0.5 - 0.04550370412564964949,))),
    ),
}


@dataclass(frozen=True)
class Quadrature:
    """points (p,4): barycentric coordinates; weights (p,): fractions of the volume, all positive, sum 1."""

    points: np.ndarray
    weights: np.ndarray


@cache
def quadrature(degree: int) -> Quadrature:
    """The rule that integrates polynomials of the given degree (1, 2 or 4) exactly."""
    points, weights = [], []
    for weight, point in RULES[degree]:
        orbit = sorted(set(permutations(point)), reverse=True)
        points += orbit
        weights += [weight] * len(orbit)
    return Quadrature(np.array(points), np.array(weights) / np.sum(weights))


def shape_derivatives(order: int, points: np.ndarray) -> np.ndarray:
    """s (p, 4 or 10, 4) with grad N_a = sum_k s_ak grad l_k at barycentric points (p,4)."""
    corner = np.eye(4) * (np.ones((len(points), 1)) if order == 1 else 4.0 * points - 1.0)[:, :, None]
    if order == 1:
        return corner
    middle = np.zeros((len(points), 6, 4))
    for e, (a, b) in enumerate(EDGES):
        middle[:, e, a], middle[:, e, b] = 4.0 * points[:, b], 4.0 * points[:, a]
    return np.concatenate([corner, middle], axis=1)


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
    Dm_inv, volumes = inverse_rest_edges(body.mesh.vertices, body.mesh.tets)
    barycentric = np.concatenate([-Dm_inv.sum(axis=1, keepdims=True), Dm_inv], axis=1)
    rule = quadrature(body.quadrature_degree)
    return shape_derivatives(body.order, rule.points) @ barycentric[:, None], np.outer(volumes, rule.weights)


def tet_patches(body: Body) -> np.ndarray:
    """Patch (m,) of each tet, from 0, over which mean dilatation averages: each quadratic tet is one."""
    if body.order == 2:
        return np.arange(body.mesh.n_tets)
    regions = body.mesh.regions if body.composition.has_regions else np.zeros(body.mesh.n_tets, dtype=np.int64)
    return aggregates.tet_patches(body.mesh.tets, body.mesh.volumes, regions)


def patch_moduli(body: Body, patch: np.ndarray) -> np.ndarray:
    """Mean lambda (n_patches,) [Pa] of the patches. patch: `tet_patches`."""
    volumes, lam = body.mesh.volumes, body.composition.dilatation_modulus
    return np.bincount(patch, volumes * lam) / np.bincount(patch, volumes)


def lumped_mass(body: Body) -> np.ndarray:
    """Lumped mass (n,) [kg], positive: the diagonal of the consistent mass scaled to the mass of each tet.

    Source for order 2: Hinton, Rock, Zienkiewicz 1976. For order 1 each vertex gets a quarter, as with row sums.
    """
    corner, middle = HRZ_FRACTIONS[body.order]
    fractions = np.repeat([corner, middle], [4, body.nodes.elements.shape[1] - 4])
    return _distribute(body, fractions)


def gravity_mass(body: Body) -> np.ndarray:
    """int rho N_a dV at each node (n,) [kg], the mass used for weight; for order 2 negative at the corners."""
    fractions = np.full(4, 0.25) if body.order == 1 else np.repeat([-0.05, 0.2], [4, 6])
    return _distribute(body, fractions)


def _distribute(body: Body, fractions: np.ndarray) -> np.ndarray:
    values = np.reshape(body.composition.number("density"), (-1, 1)) * np.outer(body.mesh.volumes, fractions)
    return np.bincount(body.nodes.elements.reshape(-1), values.reshape(-1), body.n_nodes)


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
    values = (body.composition.number("density") * body.mesh.volumes)[:, None, None] * unit_mass(body.order)
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

    A third of a triangle goes to each corner for linear tets, to each mid-edge node for quadratic ones.
    """
    corners = body.mesh.surface[triangles]
    a, b, c = (body.mesh.vertices[corners[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if body.order == 1:
        nodes = corners
    else:  # the last of a face's four triangles connects the mid-edge nodes
        nodes = body.nodes.boundary.reshape(-1, 4, 3)[triangles, 3]
    return np.bincount(nodes.reshape(-1), np.repeat(area / 3.0, 3), body.n_nodes)
