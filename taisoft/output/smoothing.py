"""Normals of surfaces, for pictures and USD: a ball looks round and a box keeps its edges, in every deformed state.

A vertex of a surface is split into its smoothing groups: the triangles around it that are connected over edges bent by less than
CREASE at rest. Its normal in each is the area-weighted mean over that group.
"""

import numpy as np

from taisoft.mesh.topology import linked_groups

CREASE = 35.0  # [deg] between the normals of neighbouring triangles at rest


def smoothing_groups(rest: np.ndarray, surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split surface nodes at sharp edges.

    rest: (n,3); surface: (t,3) node ids. Returns nodes (d,), the node of each drawn vertex, and corners (t,3), the drawn
    vertex at each triangle's corner: nodes[corners] == surface.
    """
    t = len(surface)
    a, b, c = (rest[surface[:, k]] for k in range(3))
    normals = unit(np.cross(b - a, c - a))
    # sort half-edges by their vertex pair: neighbours in the list share an edge
    ends = np.sort(np.stack([surface, np.roll(surface, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = np.flatnonzero((ends[order[1:]] == ends[order[:-1]]).all(axis=1))
    first, second = order[same], order[same + 1]
    smooth = np.einsum("ij,ij->i", normals[first // 3], normals[second // 3]) > np.cos(np.radians(CREASE))
    first, second = first[smooth], second[smooth]
    # corner 3*t+k is vertex k of triangle t; half-edge 3*t+k runs from corner k to the next one
    corner_vertex = surface.ravel()
    links = []
    for end in (first, first // 3 * 3 + (first + 1) % 3):
        for other in (second, second // 3 * 3 + (second + 1) % 3):
            same_node = corner_vertex[end] == corner_vertex[other]
            links.append(np.stack([end[same_node], other[same_node]]))
    i, j = np.concatenate(links, axis=1)
    n_drawn, group = linked_groups(i, j, 3 * t)
    nodes = np.empty(n_drawn, dtype=np.int64)
    nodes[group] = corner_vertex
    return nodes, group.reshape(t, 3)


def vertex_normals(x: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return unit normals (n,3): per vertex the area-weighted mean over its triangles (t,3), or zero if they cancel."""
    a, b, c = (x[triangles[:, k]] for k in range(3))
    (u0, u1, u2), (v0, v1, v2) = (b - a).T, (c - a).T
    areas = np.stack([u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0], axis=1)  # np.cross takes twice as long
    total = np.empty_like(x)
    for axis in range(3):
        total[:, axis] = np.bincount(triangles.ravel(), np.repeat(areas[:, axis], 3), minlength=len(x))
    return unit(total)


def unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
