"""Find curved edges of second-order tets in a file: ten nodes, four corners first, then one on each edge.

Only the corners enter the mesh. Second-order bodies have straight edges at rest and their own mid-edge nodes, so straight
edges lose nothing; curved ones are reported. Formats differ in the order of the edges, and readers do not always know it,
so the order is inferred from the nodes' positions.
"""

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.topology import EDGES

STRAIGHT = 1e-6  # tolerated distance of a node from its edge's midpoint, over the edge's length
KNOWN_ORDER = 0.25  # largest median of that ratio for which the inferred node order is accepted


def curved_edge_warnings(name: str, points: np.ndarray, cells: np.ndarray) -> list[str]:
    """Return a warning about curved edges of second-order tets; an empty list if all are straight.

    name: the file's name for messages. points: (n,3) [m]. cells: (m,10) indices into points, the corners first. Raises
    MeshError if the other six do not lie on the edges.
    """
    corners, nodes = points[cells[:, :4]], points[cells[:, 4:]]
    a, b = np.array(EDGES).T
    midpoints = 0.5 * (corners[:, a] + corners[:, b])
    length = np.linalg.norm(corners[:, a] - corners[:, b], axis=2)
    length[length == 0] = np.inf  # a tet without volume, refused later by TetMesh
    deviation = np.array([np.linalg.norm(nodes[:, k, None] - midpoints, axis=2) / length for k in range(6)])  # (node, tet, edge)
    typical = np.median(deviation, axis=1)
    edge = typical.argmin(axis=1)
    if len(set(edge.tolist())) < 6 or typical.min(axis=1).max() > KNOWN_ORDER:
        raise MeshError(f"{name}: the tets' ten nodes are not four corners and then one on each edge")
    deviation = deviation[np.arange(6), :, edge]  # (6,m)
    curved = np.argwhere(deviation > STRAIGHT)
    if not len(curved):
        return []
    ends = np.sort(cells[:, :4][:, EDGES], axis=2)[:, edge]
    n = len(np.unique(ends[curved[:, 1], curved[:, 0]], axis=0))
    k, e = np.unravel_index(int(deviation.argmax()), deviation.shape)
    first, second = ends[e, k].tolist()
    return [
        f"{n} edges of second-order tets are curved and become straight; the largest deviation is {deviation[k, e]:.2g} of the "
        f"edge's length, between vertices {first} and {second} of the file"
    ]
