"""Find a point well inside each connected part of a solid, attached to an element so that it follows deformation and motion."""

import numpy as np

from taisoft.mesh.half_edges import normals_and_heights
from taisoft.mesh.topology import TET_FACES, connected_pieces
from taisoft.mesh.triangle_queries import distances, nearest_hit

EQUAL = 1e-9  # relative size difference that counts as a tie; ties take the first element, independent of rounding


def connected_parts(elements: np.ndarray) -> np.ndarray:
    """Return the connected part (m,) of each element (m,k), numbered from 0; elements that share a vertex are connected."""
    used, corner = np.unique(elements, return_inverse=True)
    corner = corner.reshape(elements.shape)
    return connected_pieces(corner, len(used))[1][corner[:, 0]]


def inner_tets(vertices: np.ndarray, tets: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each part the tet (k,) whose centroid lies farthest from its faces, and that distance (k,) [m].

    vertices: (n,3) [m]. tets: (m,4). part: (m,) of `connected_parts`.
    """
    faces = vertices[tets[:, TET_FACES]]
    twice = np.linalg.norm(np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0]), axis=2)
    x = vertices[tets]
    clearance = 0.25 * np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / twice.max(axis=1)  # a quarter of the smallest height
    best = _first_largest(clearance, part)
    return best, clearance[best]


def inner_depths(vertices: np.ndarray, triangles: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each part of a surface its largest triangle, the depth of an inner point behind it, and that point's clearance.

    vertices: (n,3) [m]. triangles: (t,3), normals outward. part: (t,) of `connected_parts`. Returns triangles (k,); depth (k,)
    [m] along the inward normal from the centroid, half the distance to the next triangle; distance (k,) [m] of the point from the
    surface. If no triangle lies behind, both are 0 and the point lies on the surface.
    """
    corners = vertices[triangles]
    normals = normals_and_heights(vertices, triangles)[0]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    largest = _first_largest(area, part)
    depth, clearance = np.zeros(len(largest)), np.zeros(len(largest))
    for k, t in enumerate(largest):
        centroid = corners[t].mean(axis=0)
        hit = nearest_hit(np.delete(corners, t, axis=0), centroid, -normals[t])
        if np.isfinite(hit):
            depth[k] = 0.5 * hit
            clearance[k] = distances(corners, (centroid - depth[k] * normals[t])[None])[0]
    return largest, depth, clearance


def _first_largest(size: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return for each part the first element whose size is within EQUAL of the largest."""
    largest = np.zeros(part.max() + 1)
    np.maximum.at(largest, part, size)
    rows = np.flatnonzero(size >= (1.0 - EQUAL) * largest[part])
    return rows[np.unique(part[rows], return_index=True)[1]]
