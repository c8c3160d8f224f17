"""Second-order tets of a file: ten nodes, four corners first, then one on each edge. Their corners make the mesh.

Bodies of second order have straight edges at rest, with nodes of their own in the middles, so nothing is lost where the
file's edges are straight; where they are curved, it is told. Formats differ in the order of the edges, and readers do
not always know it, hence it is found from where the nodes lie.
"""

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.topology import EDGES

STRAIGHT = 1e-6  # of an edge's length, by which the node on it may lie off its middle
KNOWN_ORDER = 0.25  # of an edge's length, off which half of the nodes lie at most if the order of the nodes is understood


def straightened(name: str, points: np.ndarray, cells: np.ndarray) -> list[str]:
    """What to tell where edges of second-order tets are curved; an empty list where they are straight.

    name: the file, for messages. points: (n,3) [m]. cells: (m,10) indices into points, the corners first. Raises
    MeshError where the other six do not lie on the edges.
    """
    corners, middles = points[cells[:, :4]], points[cells[:, 4:]]
    a, b = np.array(EDGES).T
    straight = 0.5 * (corners[:, a] + corners[:, b])
    length = np.linalg.norm(corners[:, a] - corners[:, b], axis=2)
    length[length == 0] = np.inf  # a tet without volume, which the mesh refuses
    off = np.array([np.linalg.norm(middles[:, k, None] - straight, axis=2) / length for k in range(6)])  # node, tet, edge
    typical = np.median(off, axis=1)
    edge = typical.argmin(axis=1)
    if len(set(edge.tolist())) < 6 or typical.min(axis=1).max() > KNOWN_ORDER:
        raise MeshError(f"{name}: the tets' ten nodes are not four corners and then one on each edge")
    off = off[np.arange(6), :, edge]  # (6,m)
    curved = np.argwhere(off > STRAIGHT)
    if not len(curved):
        return []
    ends = np.sort(cells[:, :4][:, EDGES], axis=2)[:, edge]
    n = len(np.unique(ends[curved[:, 1], curved[:, 0]], axis=0))
    k, e = np.unravel_index(int(off.argmax()), off.shape)
    first, second = ends[e, k].tolist()
    return [
        f"{n} edges of second-order tets are curved, and straightened here; the largest deviation is {off[k, e]:.2g} of the "
        f"edge's length, between vertices {first} and {second} of the file"
    ]
