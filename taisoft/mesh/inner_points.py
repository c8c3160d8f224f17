"""A point well inside each connected part of a solid, given by elements it follows when the solid deforms or moves."""

import numpy as np

from taisoft.mesh.half_edges import normals_and_heights
from taisoft.mesh.topology import TET_FACES, connected_pieces
from taisoft.mesh.triangle_queries import distances, nearest_hit

EQUAL = 1e-9  # by so much smaller an element counts as equally large: of equal ones the first is taken, whatever rounding says


def parts_of(elements: np.ndarray) -> np.ndarray:
    """(m,) the connected part of each element (m,k), numbered from 0; elements that share a vertex are of one part."""
    used, corner = np.unique(elements, return_inverse=True)
    corner = corner.reshape(elements.shape)
    return connected_pieces(corner, len(used))[1][corner[:, 0]]


def inner_tets(vertices: np.ndarray, tets: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each part of a solid the tet (k,) whose middle lies farthest from its faces, and that distance (k,) [m].

    vertices: (n,3) [m]. tets: (m,4). part: (m,) of `parts_of`.
    """
    faces = vertices[tets[:, TET_FACES]]
    twice = np.linalg.norm(np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0]), axis=2)
    x = vertices[tets]
    room = 0.25 * np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / twice.max(axis=1)  # a quarter of the least height
    best = _first_largest(room, part)
    return best, room[best]


def inner_depths(vertices: np.ndarray, triangles: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each part of a surface its largest triangle (k,), how far behind its middle a point lies inside (k,) [m], and how far
    that is from the surface (k,) [m]. Where nothing is behind it, the point lies on the surface.

    vertices: (n,3) [m]. triangles: (t,3), normals outward. part: (t,) of `parts_of`.
    """
    corners = vertices[triangles]
    normals = normals_and_heights(vertices, triangles)[0]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    best = _first_largest(area, part)
    behind, room = np.zeros(len(best)), np.zeros(len(best))
    for k, t in enumerate(best):
        middle = corners[t].mean(axis=0)
        hit = nearest_hit(np.delete(corners, t, axis=0), middle, -normals[t])
        if np.isfinite(hit):
            behind[k] = 0.5 * hit
            room[k] = distances(corners, (middle - behind[k] * normals[t])[None])[0]
    return best, behind, room


def _first_largest(size: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Of each part the first element that is about as large as its largest."""
    largest = np.zeros(part.max() + 1)
    np.maximum.at(largest, part, size)
    rows = np.flatnonzero(size >= (1.0 - EQUAL) * largest[part])
    return rows[np.unique(part[rows], return_index=True)[1]]
