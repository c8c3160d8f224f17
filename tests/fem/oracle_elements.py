"""The finite elements once more, in NumPy and independent of the package: nodes, quadrature, shape functions, masses, loads.

Shape functions are monomials times the inverse of the matrix of their values at a tet's nodes, in coordinates of its own
size about its middle; masses and loads are their integrals.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def _near_corners(a: float) -> list[tuple]:
    """The four points whose barycentric coordinates are a three times."""
    return [tuple(1 - 3 * a if k == near else a for k in range(4)) for near in range(4)]


def _near_edges(a: float) -> list[tuple]:
    """The six points whose barycentric coordinates are a twice and 1/2 - a twice."""
    return [tuple(0.5 - a if k in pair else a for k in range(4)) for pair in combinations(range(4), 2)]


def _rule(*orbits: tuple[list, float]) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric points (k,4) and weights (k,) that add up to 1."""
    return np.array([p for points, _ in orbits for p in points]), np.array([w for points, w in orbits for _ in points])


RULES = {  # by the degree asked for
    1: _rule(([(0.25,) * 4], 1.0)),
    2: _rule((_near_corners(0.1381966011250105), 0.25)),  # (5 - sqrt 5) / 20
    4: _rule(  # exact for degree 5
        (_near_corners(0.3108859192633006), 0.1126879257180159),
        (_near_corners(0.0927352503108912), 0.0734930431163619),
        (_near_edges(0.0455037041256496), 0.0425460207770815),
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


def _monomials(X: np.ndarray, order: int) -> np.ndarray:
    """(..., 4 or 10) of X (...,3)."""
    x, y, z = np.moveaxis(X, -1, 0)
    one = np.ones_like(x)
    return np.stack([one, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z][: 4 if order == 1 else 10], axis=-1)


def _monomial_gradients(X: np.ndarray, order: int) -> np.ndarray:
    """(..., 4 or 10, 3) of X (...,3)."""
    x, y, z = np.moveaxis(X, -1, 0)
    o, one = np.zeros_like(x), np.ones_like(x)
    rows = [(o, o, o), (one, o, o), (o, one, o), (o, o, one), (2 * x, o, o), (o, 2 * y, o), (o, o, 2 * z)]
    rows += [(y, x, o), (z, o, x), (o, z, y)]
    return np.stack([np.stack(row, axis=-1) for row in rows[: 4 if order == 1 else 10]], axis=-2)


class Elements:
    """Shape functions of a body's elements. X (n,3), tets (m, 4 or 10), volumes (m,)."""

    def __init__(self, mesh, order: int):
        self.order = order
        self.X, self.tets = mesh_nodes(mesh, order)
        corners = self.X[self.tets[:, :4]]
        self.volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
        self.middle, self.size = corners.mean(axis=1)[:, None], np.ptp(corners, axis=1).max()
        self.coefficients = np.linalg.inv(_monomials((self.X[self.tets] - self.middle) / self.size, order))

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places (m,k,3), shape functions (m,k,a) and their gradients (m,k,a,3) at barycentric points (k,4)."""
        places = points @ self.X[self.tets[:, :4]]
        local = (places - self.middle) / self.size
        N = np.einsum("ekc,eca->eka", _monomials(local, self.order), self.coefficients)
        g = np.einsum("ekcj,eca->ekaj", _monomial_gradients(local, self.order), self.coefficients) / self.size
        return places, N, g

    def part(self, degree: int, material, start: int) -> Part:
        """What the forces need; the nodes count from `start` in the scene."""
        points, weights = RULES[degree]
        g = self.at(points)[2]
        nodes = np.repeat(self.tets + start, len(points), axis=0)
        return Part(nodes, g.reshape(-1, *g.shape[2:]), np.outer(self.volumes, weights).ravel(), material, len(points))

    def consistent_mass(self, density) -> np.ndarray:
        """(n,n) integrals of density N_a N_b [kg]."""
        return self._assembled(self._mass_blocks(density))

    def lumped_mass(self, density) -> np.ndarray:
        """(n,) the diagonal of each tet's consistent mass, scaled to the tet's mass (Hinton, Rock, Zienkiewicz) [kg]."""
        diagonal = np.einsum("eaa->ea", self._mass_blocks(density))
        share = (density * self.volumes)[:, None] * diagonal / diagonal.sum(axis=1, keepdims=True)
        return np.bincount(self.tets.ravel(), share.ravel(), len(self.X))

    def _mass_blocks(self, density) -> np.ndarray:
        points, weights = RULES[4]
        N = self.at(points)[1]
        return np.einsum("e,k,eka,ekb->eab", density * self.volumes, weights, N, N)

    def _assembled(self, blocks: np.ndarray) -> np.ndarray:
        M = np.zeros((len(self.X), len(self.X)))
        np.add.at(M, (self.tets[:, :, None], self.tets[:, None, :]), blocks)
        return M


def body_loads(body, X: np.ndarray, lumped: np.ndarray) -> np.ndarray:
    """Nodal forces (n,3) [N] of a body's tractions and forces.

    Of a triangle's load, a linear one gives a third to each corner. A quadratic one gives it to its middles: the rule whose
    points are the middles is exact for its shape functions, and each is 1 at its own node and 0 at the others.
    """
    f = np.zeros_like(X)
    vertices = body.mesh.vertices
    for traction in body.tractions:
        for triangle in body.mesh.surface[traction.triangles]:
            a, b, c = vertices[triangle]
            takers = triangle
            if body.order == 2:
                middles = [(a + b) / 2, (b + c) / 2, (c + a) / 2]
                takers = [np.linalg.norm(X - middle, axis=1).argmin() for middle in middles]
            f[takers] += traction.value * np.linalg.norm(np.cross(b - a, c - a)) / 2 / 3
    for force in body.forces:
        share = lumped[force.nodes, None] / lumped[force.nodes].sum()
        f[force.nodes] += force.value if np.ndim(force.value) == 2 else share * force.value
    return f
