"""The finite elements once more, in NumPy and independent of the package: nodes, quadrature, shape functions, masses, loads.

Shape functions are l_a, or l_a (2 l_a - 1) and 4 l_a l_b, in barycentric coordinates l; masses and loads are their integrals.
"""

from itertools import permutations
from typing import NamedTuple

import numpy as np

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def _rule(*orbits: tuple[tuple, float]) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric points (k,4), all permutations of those given, and weights (k,) that add up to 1."""
    points = [(point, w) for start, w in orbits for point in sorted(set(permutations(start)))]
    return np.array([point for point, _ in points]), np.array([w for _, w in points])


def _near(a: float) -> tuple:
    return a, a, a, 1 - 3 * a


MIDDLE = 0.0455037041256496
RULES = {  # by the degree asked for
    1: _rule((_near(0.25), 1.0)),
    2: _rule((_near(0.1381966011250105), 0.25)),  # (5 - sqrt 5) / 20
    4: _rule(  # exact for degree 5
        (_near(0.3108859192633006), 0.1126879257180159),
        (_near(0.0927352503108912), 0.0734930431163619),
        ((MIDDLE, MIDDLE, 0.5 - MIDDLE, 0.5 - MIDDLE), 0.0425460207770815),
    ),
}


class Part(NamedTuple):
    """A body's elements, a row for each of its quadrature points; those of a tet follow one another."""

    nodes: np.ndarray  # (k, 4 or 10) of the scene
    gradients: np.ndarray  # (k, 4 or 10, 3) of the shape functions at rest [1/m]
    weights: np.ndarray  # (k,) [m^3]
    material: object
    points: int  # of a tet


def mesh_nodes(mesh, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Rest positions (n,3) and elements (m, 4 or 10): vertices, then the middles of the sorted vertex pairs."""
    if order == 1:
        return mesh.vertices, mesh.tets
    pairs = sorted({tuple(sorted((int(tet[a]), int(tet[b])))) for tet in mesh.tets for a, b in EDGES})
    number = {pair: len(mesh.vertices) + k for k, pair in enumerate(pairs)}
    middles = [[number[tuple(sorted((int(tet[a]), int(tet[b]))))] for a, b in EDGES] for tet in mesh.tets]
    a, b = np.array(pairs).T
    return np.concatenate([mesh.vertices, (mesh.vertices[a] + mesh.vertices[b]) / 2]), np.c_[mesh.tets, middles]


def _shapes(l: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Shape functions (k,a) at barycentric points l (k,4), and their derivatives (k,a,4) by l."""
    I, (a, b) = np.eye(4), np.transpose(EDGES)
    if order == 1:
        return l, np.broadcast_to(I, (len(l), 4, 4))
    at_edges = 4 * (l[:, a, None] * I[b] + l[:, b, None] * I[a])
    values = np.concatenate([l * (2 * l - 1), 4 * l[:, a] * l[:, b]], axis=1)
    return values, np.concatenate([(4 * l - 1)[:, :, None] * I, at_edges], axis=1)


class Elements:
    """Shape functions of a body's elements. X (n,3), tets (m, 4 or 10), volumes (m,)."""

    def __init__(self, mesh, order: int):
        self.order = order
        self.X, self.tets = mesh_nodes(mesh, order)
        self.corners = self.X[self.tets[:, :4]]
        self.volumes = np.abs(np.linalg.det(self.corners[:, 1:] - self.corners[:, :1])) / 6
        self.slopes = np.linalg.inv(np.insert(self.corners, 3, 1.0, axis=2))[:, :3]  # (m,3,4) of the barycentric coordinates

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places (m,k,3), shape functions (m,k,a) and their gradients (m,k,a,3) at barycentric points (k,4)."""
        N, slopes = _shapes(points, self.order)
        g = np.einsum("kab,ejb->ekaj", slopes, self.slopes)
        return points @ self.corners, np.broadcast_to(N, g.shape[:-1]), g

    def part(self, degree: int, material, start: int) -> Part:
        """What the forces need; the nodes count from `start` in the scene."""
        points, weights = RULES[degree]
        g = self.at(points)[2]
        nodes = np.repeat(self.tets + start, len(points), axis=0)
        return Part(nodes, g.reshape(-1, *g.shape[2:]), np.outer(self.volumes, weights).ravel(), material, len(points))

    def consistent_mass(self, density) -> np.ndarray:
        """(n,n) integrals of density N_a N_b [kg]."""
        M = np.zeros((len(self.X), len(self.X)))
        np.add.at(M, (self.tets[:, :, None], self.tets[:, None, :]), self._mass_blocks(density))
        return M

    def lumped_mass(self, density) -> np.ndarray:
        """(n,) the diagonal of each tet's consistent mass, scaled to the tet's mass (Hinton, Rock, Zienkiewicz) [kg]."""
        diagonal = np.einsum("eaa->ea", self._mass_blocks(density))
        share = (density * self.volumes)[:, None] * diagonal / diagonal.sum(axis=1, keepdims=True)
        return np.bincount(self.tets.ravel(), share.ravel(), len(self.X))

    def _mass_blocks(self, density) -> np.ndarray:
        points, weights = RULES[4]
        N = self.at(points)[1]
        return np.einsum("e,k,eka,ekb->eab", density * self.volumes, weights, N, N)


def body_loads(body, X: np.ndarray, lumped: np.ndarray) -> np.ndarray:
    """Nodal forces (n,3) [N] of a body's tractions and forces.

    A triangle's load goes in thirds to its corners, of a quadratic one to its middles: the rule whose points they are is exact.
    """
    f = np.zeros_like(X)
    for traction in body.tractions:
        for a, b, c in body.mesh.vertices[body.mesh.surface[traction.triangles]]:
            places = (a, b, c) if body.order == 1 else ((a + b) / 2, (b + c) / 2, (c + a) / 2)
            takers = [np.linalg.norm(X - place, axis=1).argmin() for place in places]
            f[takers] += traction.value * np.linalg.norm(np.cross(b - a, c - a)) / 2 / 3
    for force in body.forces:
        share = lumped[force.nodes, None] / lumped[force.nodes].sum()
        f[force.nodes] += force.value if np.ndim(force.value) == 2 else share * force.value
    return f
