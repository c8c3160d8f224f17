"""Connectivity of tets and triangles: edges, faces, surface, neighbours, parts and joints, without loops over elements.

Half-edge 3t + k runs from corner k of triangle t to corner (k + 1) mod 3.
"""

import numpy as np
import scipy
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from taisoft.errors import MeshError

# Face k lies opposite corner k; in this order its normal points out of a positive tet, det(x1-x0, x2-x0, x3-x0) > 0.
TET_FACES = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # corners of a tet's six edges; edges k and 5-k are opposite
GENERIC_DIRECTION = np.array([0.56071, 0.64493, 0.51922])  # distinct projections for grid vertices; length at most 1
HALF_EDGES = np.array([(0, 1), (1, 2), (2, 0)])  # corners of a triangle's half-edges
CRACK = 0.5  # the sides of a crack are less than this times their edges' length apart: wider ones are as well two rims


def _group_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a stable order that makes equal rows adjacent, and the start in it and size of each group of equal rows."""
    order = np.lexsort(rows.T[::-1])
    new = np.ones(len(order), dtype=bool)
    new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    starts = np.flatnonzero(new)
    return order, starts, np.diff(np.append(starts, len(order)))


class Faces:
    """The 4m faces of m tets, grouped by equal vertices.

    triangles: (4m,3) outward, face k of tet e in row 4e+k. order: (4m,) rows sorted so that equal faces are adjacent.
    starts, counts: (f,) start of each of the f distinct faces in `order`, and number of tets that have it.
    """

    def __init__(self, tets: np.ndarray):
        """tets: (m,4) int, positively oriented."""
        self.triangles = tets[:, TET_FACES].reshape(-1, 3)
        self.order, self.starts, self.counts = _group_rows(np.sort(self.triangles, axis=1))

    def surface(self) -> np.ndarray:
        """Return the rows of `triangles` that belong to one tet only, in the order of the tets."""
        return np.sort(self.order[self.starts[self.counts == 1]])

    def pairs(self) -> np.ndarray:
        """Return (p,2) rows of `triangles`: the two sides of every face shared by exactly two tets."""
        first = self.starts[self.counts == 2]
        return np.stack([self.order[first], self.order[first + 1]], axis=1)


def distinct_edges(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges (k,2), ascending pairs in lexicographic order, and each tet's edges (m,6) in the order of EDGES.

    tets: (m,4) int, indices from 0.
    """
    ends = np.sort(tets[:, EDGES], axis=2)
    n = int(tets.max()) + 1
    keys, of_tet = np.unique(ends[..., 0] * n + ends[..., 1], return_inverse=True)
    return np.stack(np.divmod(keys, n), axis=1), of_tet.reshape(-1, 6)


def triangle_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distinct edges (e,2) of triangles (t,3), ascending pairs in lexicographic order, and for each edge (e,) its
    number of triangles, and how many more of them traverse it upwards than downwards."""
    ends = triangles[:, HALF_EDGES].reshape(-1, 2)
    edges, edge, counts = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    return edges, counts, np.bincount(edge.ravel(), np.where(ends[:, 0] < ends[:, 1], 1, -1), minlength=len(edges))


def opposite_half_edges(triangles: np.ndarray) -> np.ndarray:
    """Return (t,3) int64: the opposite half-edge of half-edge k of each triangle, -1 at a border.

    triangles: (t,3) int, vertex ids from 0. Raises MeshError if an edge has more than two triangles, or two triangles that
    traverse it in the same direction.
    """
    ends = triangles[:, HALF_EDGES].reshape(-1, 2).astype(np.int64)
    order, starts, counts = _group_rows(np.sort(ends, axis=1))
    if (counts > 2).any():
        k = int(np.argmax(counts > 2))
        owners = np.sort(order[starts[k] : starts[k] + counts[k]] // 3)
        raise MeshError(
            f"edge {_sorted_ends(ends[order[starts[k]]])} belongs to {counts[k]} triangles "
            f"({', '.join(map(str, owners[:5].tolist()))}{', ...' if len(owners) > 5 else ''}); an edge may have at most two"
        )
    first = starts[counts == 2]
    a, b = order[first], order[first + 1]
    same = ends[a, 0] == ends[b, 0]
    if same.any():
        k = int(np.argmax(same))
        s, t = sorted((int(a[k]) // 3, int(b[k]) // 3))
        raise MeshError(
            f"triangles {s} and {t} traverse their edge {_sorted_ends(ends[a[k]])} in the same direction: one of them has the "
            "wrong orientation"
        )
    opposite = np.full(len(ends), -1, dtype=np.int64)
    opposite[a], opposite[b] = b, a
    return opposite.reshape(-1, 3)


def _sorted_ends(edge: np.ndarray) -> tuple:
    return tuple(sorted(edge.tolist()))


def normals_and_heights(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (t,3), zero for triangles without area, and the smallest height over the longest edge (t,).

    vertices: (n,3) [m]. triangles: (t,3) int; seen from the tip of the normal, corners run counter-clockwise.
    """
    x = vertices[triangles]
    edges = np.roll(x, -1, axis=1) - x
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    # Scale by the longest edge first: the area of a tiny triangle underflows.
    scaled = edges / np.where(longest > 0, longest, 1.0)[:, None, None]
    area = np.cross(scaled[:, 0], scaled[:, 1])
    twice = np.linalg.norm(area, axis=1)
    return area / np.where(twice > 0, twice, 1.0)[:, None], twice


def first_repeated_tet(tets: np.ndarray) -> tuple[int, int] | None:
    """Return the first pair of tets with the same four vertices, or None. tets: (m,4) int."""
    order, starts, counts = _group_rows(np.sort(tets, axis=1))
    if (counts == 1).all():
        return None
    first = starts[np.argmax(counts > 1)]
    a, b = sorted(order[first : first + 2].tolist())
    return a, b


def linked_groups(a: np.ndarray, b: np.ndarray, n: int) -> tuple[int, np.ndarray]:
    """Return the number of groups that links a - b (k,) make of n items, and the group (n,) of each, from 0."""
    return connected_components(coo_matrix((np.ones(len(a), dtype=np.int8), (a, b)), shape=(n, n)), directed=False)


def connected_pieces(elements: np.ndarray, n_verts: int) -> tuple[int, np.ndarray]:
    """Return the number of connected parts of elements (m,k), tets or triangles, and the part of each vertex (n_verts,).

    Elements that share a vertex are connected; a vertex without elements is a separate part.
    """
    return linked_groups(np.repeat(elements[:, 0], elements.shape[1] - 1), elements[:, 1:].ravel(), n_verts)


def joint_edges(surface: np.ndarray) -> np.ndarray:
    """Return surface edges (k,2) with more than two triangles, where parts are joined only by an edge. surface: (t,3) int."""
    edges, counts, _ = triangle_edges(surface)
    return edges[counts > 2]


def joint_vertices(tets: np.ndarray, faces: Faces) -> np.ndarray:
    """Return vertices (k,) whose tets are not all connected through faces that contain the vertex.

    The graph has a node for every corner of every tet and connects corners that two tets share through a face. A vertex
    with more than one component is a joint. Only surface vertices can be joints, so only their corners are included.
    """
    on_surface = np.zeros(int(tets.max()) + 1, dtype=bool)
    on_surface[faces.triangles[faces.surface()]] = True
    # For each vertex of a face, its corner in the tet. Both sides are sorted by vertex so that columns agree.
    sides = []
    for rows in faces.pairs().T:
        corners = 4 * (rows // 4)[:, None] + TET_FACES[rows % 4]
        by_vertex = np.argsort(faces.triangles[rows], axis=1)
        sides.append(np.take_along_axis(corners, by_vertex, axis=1).ravel())
    vertex_of = tets.ravel()
    keep = on_surface[vertex_of[sides[0]]]
    labels = linked_groups(sides[0][keep], sides[1][keep], len(vertex_of))[1]
    used = on_surface[vertex_of]
    fans = np.unique(np.stack([vertex_of[used], labels[used]], axis=1), axis=0)[:, 0]
    vertices, counts = np.unique(fans, return_counts=True)
    return vertices[counts > 1]


def merged_points(points: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the first point of each group of points, (k,) ascending, and the group (n,) of each point.

    points: (n,3) [m]. Points at most `tolerance` [m] apart, directly or through others, are in one group.
    """
    # Merge equal points first: n of them in one place would make n^2 pairs.
    distinct, labels = np.unique(points + 0.0, axis=0, return_inverse=True)  # + 0.0 makes -0.0 equal to 0.0
    labels = labels.ravel()
    if tolerance > 0 and _may_be_near(distinct, tolerance):
        pairs = scipy.spatial.cKDTree(distinct).query_pairs(tolerance, output_type="ndarray")
        labels = linked_groups(*pairs.T, len(distinct))[1][labels]
    first, inverse = np.unique(labels, return_index=True, return_inverse=True)[1:]
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[inverse.ravel()]


def crack_widths(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the distance between the two sides of each open edge that lies along a crack, (k,) [m].

    points: (n,3) [m]; triangles: (t,3). Two edges of one triangle each, which run in opposite directions, are the sides of a
    crack if their ends are less than CRACK of their length apart. Sides that are divided differently are not found.
    """
    edges, counts, net_direction = triangle_edges(triangles)
    edges, upward = edges[counts == 1], net_direction[counts == 1] > 0
    ends = points[np.where(upward[:, None], edges, edges[:, ::-1])]  # (k, 2, 3), as the triangles traverse them
    across = ends[:, ::-1]
    other = scipy.spatial.cKDTree(across.reshape(-1, 6)).query(ends.reshape(-1, 6))[1]
    widths = np.linalg.norm(ends - across[other], axis=2).max(axis=1)
    return widths[widths < CRACK * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)]


def _may_be_near(points: np.ndarray, tolerance: float) -> bool:
    """Return False if projections on GENERIC_DIRECTION show that no two points are at most `tolerance` apart, else True.

    A cheap test that spares most meshes the k-d tree.
    """
    projections = np.sort(points @ GENERIC_DIRECTION)
    rounding = 8.0 * np.finfo(np.float64).eps * float(np.abs(points).max(initial=0.0))
    return bool((np.diff(projections) <= tolerance + rounding).any())
