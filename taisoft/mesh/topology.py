"""Compute the connectivity of tetrahedra: edges, faces, surface, parts and joints, without loops over elements."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

# Face k lies opposite corner k; in this order its normal points out of a positive tet, det(x1-x0, x2-x0, x3-x0) > 0.
TET_FACES = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])

EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # corners of a tet's six edges; edges k and 5-k are opposite


class Faces:
    """The 4m faces of m tets, grouped by equal vertices.

    triangles: (4m,3) outward, face k of tet e in row 4e+k. order: (4m,) rows sorted so that equal faces are adjacent.
    starts, counts: (f,) start of each of the f distinct faces in `order`, and number of tets that have it.
    """

    def __init__(self, tets: np.ndarray):
        """tets: (m,4) int, positively oriented."""
        self.triangles = tets[:, TET_FACES].reshape(-1, 3)
        corners = np.sort(self.triangles, axis=1)
        self.order = np.lexsort((corners[:, 2], corners[:, 1], corners[:, 0]))
        corners = corners[self.order]
        new = np.ones(len(corners), dtype=bool)
        new[1:] = (corners[1:] != corners[:-1]).any(axis=1)
        self.starts = np.flatnonzero(new)
        self.counts = np.diff(np.append(self.starts, len(corners)))

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


def first_repeated_tet(tets: np.ndarray) -> tuple[int, int] | None:
    """Return the first pair of tets with the same four vertices, or None. tets: (m,4) int."""
    corners = np.sort(tets, axis=1)
    order = np.lexsort(corners.T[::-1])
    same = (corners[order[1:]] == corners[order[:-1]]).all(axis=1)
    if not same.any():
        return None
    k = int(np.argmax(same))
    a, b = sorted((int(order[k]), int(order[k + 1])))
    return a, b


def connected_pieces(elements: np.ndarray, n_verts: int) -> tuple[int, np.ndarray]:
    """Return the number of connected parts of elements (m,k), tets or triangles, and the part of each vertex (n_verts,).

    Elements that share a vertex are connected; a vertex without elements is a separate part.
    """
    rows = np.repeat(elements[:, 0], elements.shape[1] - 1)
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, elements[:, 1:].ravel())), shape=(n_verts, n_verts))
    return connected_components(graph, directed=False)


def triangle_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct edges (e,2) of triangles (t,3), with ascending vertices, and each edge's number of triangles (e,)."""
    return np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True)


def joint_edges(surface: np.ndarray) -> np.ndarray:
    """Return surface edges (k,2) with more than two triangles, where parts are joined only by an edge. surface: (t,3) int."""
    distinct, counts = triangle_edges(surface)
    return distinct[counts > 2]


def joint_vertices(tets: np.ndarray, faces: Faces) -> np.ndarray:
    """Return vertices (k,) whose tets are not all connected through faces that contain the vertex.

    The graph has a node for every corner of every tet and connects corners that two tets share through a face. A vertex
    with more than one component is a joint. Only surface vertices can be joints, so only their corners are included.
    """
    n_verts = int(tets.max()) + 1
    on_surface = np.zeros(n_verts, dtype=bool)
    on_surface[faces.triangles[faces.surface()]] = True
    pairs = faces.pairs()
    # For each vertex of a face, its corner in the tet. Both sides are sorted by vertex so that columns agree.
    sides = []
    for rows in pairs.T:
        triangles = faces.triangles[rows]
        corners = 4 * (rows // 4)[:, None] + TET_FACES[rows % 4]
        by_vertex = np.argsort(triangles, axis=1)
        sides.append(np.take_along_axis(corners, by_vertex, axis=1).ravel())
    vertex_of = tets.ravel()
    keep = on_surface[vertex_of[sides[0]]]
    a, b = sides[0][keep], sides[1][keep]
    n = len(vertex_of)
    labels = connected_components(coo_matrix((np.ones(len(a), dtype=np.int8), (a, b)), shape=(n, n)), directed=False)[1]
    used = on_surface[vertex_of]
    fans = np.unique(np.stack([vertex_of[used], labels[used]], axis=1), axis=0)[:, 0]
    vertices, counts = np.unique(fans, return_counts=True)
    return vertices[counts > 1]
