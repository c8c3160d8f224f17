"""Build the nodes of a body's finite elements: mesh vertices, and mid-edge nodes for second-order elements.

Drawing and contact need flat triangles with a linear tet behind each. A second-order tet is therefore also split into
eight: one of half size at each corner, and four around the shortest diagonal of the octahedron between them, which gives
the best shapes (Bey 1995, Tetrahedral grid refinement, Computing 55). The split depends only on node numbers and positions,
not on the order of a tet's corners. Where edges are straight at rest the eight fill the tet. In a deformed body, and in a
curved element, they interpolate the nodes linearly.
"""

from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from taisoft.attributes import MeshAttributeError, guarded_record
from taisoft.errors import MeshError
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import EDGES, distinct_edges
from taisoft.scene.checks import whole

PARTS = 8  # linear tets of a second-order one; `Nodes.tets` lists those of each tet in sequence
TIE_TOLERANCE = 1e-9  # relative difference below which squared diagonals count as equal
STRAIGHT = 1e-6  # distance of a node from its edge's midpoint, over the edge's length, up to which the edge is straight

# Nodes of an element: corners 0 to 3, then the midpoint of edge k as 4 + k. The sub-tet at each corner:
_CORNER_TETS = np.array([(0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3)])
# The octahedron's four sub-tets around the diagonal between the midpoints of edges k and 5 - k, for k = 0, 1, 2:
_INNER_TETS = np.array(
    [
        [(4, 9, 5, 6), (4, 9, 6, 8), (4, 9, 8, 7), (4, 9, 7, 5)],
        [(5, 8, 6, 4), (5, 8, 4, 7), (5, 8, 7, 9), (5, 8, 9, 6)],
        [(6, 7, 4, 5), (6, 7, 5, 9), (6, 7, 9, 8), (6, 7, 8, 4)],
    ]
)
_MID_EDGE_NODE = np.full((4, 4), -1)  # mid-edge node between two corners
for _k, (_a, _b) in enumerate(EDGES):
    _MID_EDGE_NODE[_a, _b] = _MID_EDGE_NODE[_b, _a] = 4 + _k


@guarded_record("nodes", "they follow from the mesh and the order; add another body", MeshAttributeError)
class Nodes:
    """Nodes of a body and their connectivity; arrays are read-only.

    positions: (n,3) float64 [m] at rest. elements: (m,4) int64, or (m,10): corners, then the midpoints of EDGES.
    boundary: (b,3) int64, the elements' flat triangles, normals outward; boundary_tets: (b,4) int64, the linear tet behind each.
    tets: (j,4) int64, linear tets that fill the body. Tets are positive, det(x1-x0, x2-x0, x3-x0) > 0.
    surface: (k,3) int64, the triangles that touch and are touched: the boundary, unless vertices of a skin are embedded.
    curved: (m,) bool, the elements some of whose edges are curved, or None if no edge is.
    embedded: (v, n - v) weights, or None: the last v nodes belong to no element but lie at these sums of the others.
    """

    positions: np.ndarray
    elements: np.ndarray
    boundary: np.ndarray
    boundary_tets: np.ndarray
    tets: np.ndarray
    surface: np.ndarray
    curved: np.ndarray | None = None
    embedded: sp.csr_matrix | None = None

    @property
    def n_elastic(self) -> int:
        """Number of nodes of elements, which come first."""
        return len(self.positions) - (0 if self.embedded is None else self.embedded.shape[0])


def make_nodes(mesh: TetMesh, order: int, middles: np.ndarray | None = None) -> Nodes:
    """Return the nodes of elements of order 1 or 2 on a mesh. middles: (k,3) [m] of curved edges; None: the edges' midpoints.

    Order 1: the mesh's own arrays. Order 2: the vertices, then the mid-edge nodes in lexicographic order of their
    ascending vertex pairs; sub-tets 8e to 8e+3 of tet e lie at its corners, the next four around the shortest diagonal
    of the octahedron between them; surface triangle t = (a, b, c) of the mesh becomes rows 4t to 4t+3: (a, ab, ca),
    (ab, b, bc), (ca, bc, c), (ab, bc, ca). Raises MeshError for another order.
    """
    if whole(order, "make_nodes: order", (1, 2), MeshError) == 1:
        return Nodes(mesh.vertices, mesh.tets, mesh.surface, mesh.tets[mesh.surface_tets], mesh.tets, mesh.surface)
    edges, edge_of_tet = distinct_edges(mesh.tets)
    a, b = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]]
    midpoints, curved = 0.5 * (a + b), None
    if middles is not None:
        bent = np.linalg.norm(middles - midpoints, axis=1) > STRAIGHT * np.linalg.norm(b - a, axis=1)
        midpoints[bent], curved = middles[bent], bent[edge_of_tet].any(axis=1) if bent.any() else None
    positions = np.concatenate([mesh.vertices, midpoints])
    elements = np.concatenate([mesh.tets, mesh.n_verts + edge_of_tet], axis=1)
    inner = _INNER_TETS[_shortest_diagonals(mesh)]
    local = np.concatenate([np.broadcast_to(_CORNER_TETS, (mesh.n_tets, 4, 4)), inner], axis=1)
    tets = np.take_along_axis(elements, local.reshape(-1, 32), axis=1).reshape(-1, 8, 4)
    surface, surface_tets = _split_surface(mesh, elements, tets)
    return Nodes(positions, elements, surface, surface_tets, tets.reshape(-1, 4), surface, curved)


def embed(nodes: Nodes, vertices: np.ndarray, triangles: np.ndarray, weights: sp.csr_matrix) -> Nodes:
    """Return nodes with embedded vertices (v,3) [m] whose triangles (k,3) are touched. weights: (v,n) of nodes without any."""
    positions = np.concatenate([nodes.positions, vertices])
    return replace(nodes, positions=positions, surface=triangles + len(nodes.positions), embedded=weights)


def part_coordinates(nodes: Nodes) -> np.ndarray:
    """Barycentric coordinates (j,4,4) of the corners of `Nodes.tets` in their second-order elements."""
    of_nodes = np.concatenate([np.eye(4), np.eye(4)[list(EDGES)].mean(axis=1)])
    place = (nodes.tets.reshape(-1, PARTS, 4)[..., None] == nodes.elements[:, None, None]).argmax(axis=3)
    return of_nodes[place].reshape(-1, 4, 4)


def _shortest_diagonals(mesh: TetMesh) -> np.ndarray:
    """Return (m,) k = 0, 1 or 2: the diagonal between edges k and 5 - k is the octahedron's shortest."""
    ascending = np.argsort(mesh.tets, axis=1)  # local corners by ascending vertex number
    x = mesh.vertices[np.take_along_axis(mesh.tets, ascending, axis=1)]
    # Twice the diagonal from the midpoint of (0, k) to that of the other two corners, for k = 1, 2, 3.
    twice = np.stack([x[:, 0] + x[:, k] - x[:, a] - x[:, b] for k, a, b in ((1, 2, 3), (2, 1, 3), (3, 1, 2))], axis=1)
    squared = np.einsum("ekx,ekx->ek", twice, twice)
    # Ties are common on grids; take the first so that rounding does not decide.
    first = np.argmax(squared <= (1.0 + TIE_TOLERANCE) * squared.min(axis=1, keepdims=True), axis=1)
    partner = np.take_along_axis(ascending, 1 + first[:, None], axis=1)[:, 0]
    return (ascending[:, 0] ^ partner) - 1  # corners 0,1 or 2,3 -> 0; 0,2 or 1,3 -> 1; 0,3 or 1,2 -> 2


def _split_surface(mesh: TetMesh, elements: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (4t,3) and the sub-tets behind them (4t,4). elements: (m,10); tets: (m,8,4), sub-tets of each tet."""
    owner = mesh.surface_tets
    corner = np.argmax(mesh.tets[owner][:, None, :] == mesh.surface[:, :, None], axis=2)  # (t,3) local corner in the tet
    middle = _MID_EDGE_NODE[corner, np.roll(corner, -1, axis=1)]  # of ab, bc, ca
    (a, b, c), (ab, bc, ca) = corner.T, middle.T
    local = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1)
    triangles = np.take_along_axis(elements[owner], local, axis=1).reshape(-1, 4, 3)
    # The inner sub-tet that has all three mid-edge nodes.
    inner = tets[owner, 4:]
    holds = (inner[:, :, :, None] == triangles[:, 3][:, None, None, :]).any(axis=2).all(axis=2)
    behind = np.concatenate([corner, 4 + np.argmax(holds, axis=1)[:, None]], axis=1)
    return triangles.reshape(-1, 3), np.take_along_axis(tets[owner], behind[:, :, None], axis=1).reshape(-1, 4)
