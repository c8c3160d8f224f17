"""The nodes of a body's finite elements: the mesh's vertices, and for second-order elements the middles of its edges.

Drawing and contact need flat triangles with a linear tet behind each. A second-order tet is therefore also cut into
eight: one at each corner, half the tet's size, and the octahedron between them, cut into four round its shortest
diagonal, which gives the best shaped parts (Bey 1995, Tetrahedral grid refinement, Computing 55). The cut depends on
the nodes' numbers and places only, not on the order in which a tet lists its corners. Edges are straight at rest, so the
eight fill the tet; in a bent body they are what lies between the nodes, not the curved element.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.attributes import MeshAttributeError, guarded_record
from taisoft.errors import MeshError
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import EDGES, distinct_edges

TIE = 1e-9  # squared diagonals that differ by less than this part of their size count as equal

# Nodes of an element: corners 0 to 3, then the middle of edge k as 4 + k. The sub-tet at each corner:
_CORNER_TETS = np.array([(0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3)])
# The octahedron's four sub-tets round the diagonal from the middle of edge k to that of edge 5 - k, for k = 0, 1, 2:
_INNER_TETS = np.array(
    [
        [(4, 9, 5, 6), (4, 9, 6, 8), (4, 9, 8, 7), (4, 9, 7, 5)],
        [(5, 8, 6, 4), (5, 8, 4, 7), (5, 8, 7, 9), (5, 8, 9, 6)],
        [(6, 7, 4, 5), (6, 7, 5, 9), (6, 7, 9, 8), (6, 7, 8, 4)],
    ]
)
_MIDDLE = np.full((4, 4), -1)  # the node in the middle between two corners
for _k, (_a, _b) in enumerate(EDGES):
    _MIDDLE[_a, _b] = _MIDDLE[_b, _a] = 4 + _k


@guarded_record("nodes", "they follow from the mesh and the order; add another body", MeshAttributeError)
@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes of a body and how they are joined, all read-only.

    positions: (n,3) float64 [m] at rest. elements: (m,4) int64, or (m,10): corners, then the middles of EDGES.
    surface: (k,3) int64, flat triangles, normals outward; surface_tets: (k,4) int64, the linear tet behind each.
    tets: (j,4) int64, linear tets that fill the body. Tets are positive, det(x1-x0, x2-x0, x3-x0) > 0.
    """

    positions: np.ndarray
    elements: np.ndarray
    surface: np.ndarray
    surface_tets: np.ndarray
    tets: np.ndarray

    def __post_init__(self):
        for array in (self.positions, self.elements, self.surface, self.surface_tets, self.tets):
            array.setflags(write=False)


def make_nodes(mesh: TetMesh, order: int) -> Nodes:
    """The nodes of elements of order 1 or 2 on a mesh.

    Order 1: the mesh's own arrays. Order 2: the vertices, then the middles of the edges in lexicographic order of their
    ascending vertex pairs; sub-tets 8e to 8e+3 of tet e lie at its corners, the next four round the shortest diagonal
    of the octahedron between them; surface triangle t = (a, b, c) of the mesh becomes rows 4t to 4t+3: (a, ab, ca),
    (ab, b, bc), (ca, bc, c), (ab, bc, ca). Raises MeshError for another order.
    """
    if isinstance(order, bool) or order not in (1, 2):
        raise MeshError(f"make_nodes: order must be 1 or 2, not {order!r}")
    if order == 1:
        return Nodes(mesh.vertices, mesh.tets, mesh.surface, mesh.tets[mesh.surface_tets], mesh.tets)
    edges, edge_of_tet = distinct_edges(mesh.tets)
    positions = np.concatenate([mesh.vertices, 0.5 * (mesh.vertices[edges[:, 0]] + mesh.vertices[edges[:, 1]])])
    elements = np.concatenate([mesh.tets, mesh.n_verts + edge_of_tet], axis=1)
    inner = _INNER_TETS[_shortest_diagonals(mesh)]
    local = np.concatenate([np.broadcast_to(_CORNER_TETS, (mesh.n_tets, 4, 4)), inner], axis=1)
    tets = np.take_along_axis(elements, local.reshape(-1, 32), axis=1).reshape(-1, 8, 4)
    surface, surface_tets = _split_surface(mesh, elements, tets)
    return Nodes(positions, elements, surface, surface_tets, tets.reshape(-1, 4))


def _shortest_diagonals(mesh: TetMesh) -> np.ndarray:
    """(m,) the k = 0, 1 or 2 for which the diagonal between edges k and 5 - k is the octahedron's shortest."""
    place = np.argsort(mesh.tets, axis=1)  # of the corner with the least number in its tet, and so on
    x = mesh.vertices[np.take_along_axis(mesh.tets, place, axis=1)]
    # Twice the diagonal from the middle of (0, k) to that of the other two corners, for k = 1, 2, 3.
    twice = np.stack([x[:, 0] + x[:, k] - x[:, a] - x[:, b] for k, a, b in ((1, 2, 3), (2, 1, 3), (3, 1, 2))], axis=1)
    squared = np.einsum("ekx,ekx->ek", twice, twice)
    # Of equal ones the first: a grid's octahedra have many, and rounding shall not choose.
    first = np.argmax(squared <= (1.0 + TIE) * squared.min(axis=1, keepdims=True), axis=1)
    partner = np.take_along_axis(place, 1 + first[:, None], axis=1)[:, 0]
    return (place[:, 0] ^ partner) - 1  # corners 0,1 or 2,3 -> 0; 0,2 or 1,3 -> 1; 0,3 or 1,2 -> 2


def _split_surface(mesh: TetMesh, elements: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (4t,3) and the sub-tets behind them (4t,4). elements: (m,10); tets: (m,8,4), sub-tets of each tet."""
    owner = mesh.surface_tets
    corner = np.argmax(mesh.tets[owner][:, None, :] == mesh.surface[:, :, None], axis=2)  # (t,3), place in the tet
    middle = _MIDDLE[corner, np.roll(corner, -1, axis=1)]  # of ab, bc, ca
    (a, b, c), (ab, bc, ca) = corner.T, middle.T
    local = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1)
    triangles = np.take_along_axis(elements[owner], local, axis=1).reshape(-1, 4, 3)
    # The inner sub-tet that has all three middles.
    inner = tets[owner, 4:]
    holds = (inner[:, :, :, None] == triangles[:, 3][:, None, None, :]).any(axis=2).all(axis=2)
    behind = np.concatenate([corner, 4 + np.argmax(holds, axis=1)[:, None]], axis=1)
    return triangles.reshape(-1, 3), np.take_along_axis(tets[owner], behind[:, :, None], axis=1).reshape(-1, 4)
