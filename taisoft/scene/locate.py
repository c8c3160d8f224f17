"""Find points in bodies: the nodes and weights whose sum w_i x_i follows a point of a body's elements as it deforms."""

from typing import TYPE_CHECKING

import numpy as np
import scipy
import scipy.sparse as sp

from taisoft.mesh.nodes import PARTS, part_coordinates
from taisoft.mesh.quadratic import shape_functions

if TYPE_CHECKING:
    from taisoft.scene.body import Body

NEAREST = 64  # tets by their centroids that are tried first
INSIDE = -1e-9  # barycentric coordinate from which a point counts as inside a tet
PAIRS_AT_ONCE = 2_000_000  # of points and tets; bounds the memory, about 100 bytes each
WEIGHTLESS = 1e-12  # smaller barycentric coordinates are rounding


def locate(body: "Body", points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find points (p,3) [m], in the coordinates of body.rest_positions, in a body at rest.

    Returns nodes (p, 4 or 10), weights of the same shape, and (p,) how far each lies outside the body, in heights of its tet, or
    in sizes of a rigid body; 0 inside. The weights of a point outside extrapolate from the tet in whose heights it is nearest.
    They sum to 1 and reproduce the point, so that they follow every affine motion exactly.
    """
    corners = body.rest_positions[body.nodes.tets if body.is_curved else body.mesh.tets]  # parts are closer to curved tets
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    _, near = scipy.spatial.cKDTree(corners.mean(axis=1)).query(points, k=min(NEAREST, len(corners)))
    tet = _deepest(corners, inverse, points, near.reshape(len(points), -1))
    far = np.flatnonzero(_barycentric(corners[tet], inverse[tet], points).min(axis=1) < INSIDE)
    chunk, everything = max(1, PAIRS_AT_ONCE // len(corners)), np.arange(len(corners))
    for rows in np.split(far, range(chunk, len(far), chunk)):
        tet[rows] = _deepest(corners, inverse, points[rows], np.broadcast_to(everything, (len(rows), len(corners))))
    barycentric = _barycentric(corners[tet], inverse[tet], points)
    if body.is_curved:
        barycentric = np.einsum("pk,pkc->pc", barycentric, part_coordinates(body.nodes)[tet])
        tet = tet // PARTS
    barycentric[np.abs(barycentric) < WEIGHTLESS] = 0.0
    weights = shape_functions(body.order, barycentric)
    if body.is_curved:  # what the flat parts miss, by the corners
        x = body.rest_positions[body.nodes.elements[tet]]
        missed = points - np.einsum("pa,pax->px", weights, x)
        step = np.linalg.solve((x[:, 1:4] - x[:, :1]).transpose(0, 2, 1), missed[..., None])[..., 0]
        weights[:, :4] += np.concatenate([-step.sum(axis=1, keepdims=True), step], axis=1)
    outside = body.distance_outside(points, np.maximum(-barycentric.min(axis=1), 0.0))
    return body.nodes.elements[tet], weights, outside


def weight_matrix(nodes: np.ndarray, weights: np.ndarray, n_nodes: int) -> sp.csr_matrix:
    """Return the matrix (p, n_nodes) of points that are sums of nodes (p,k) with weights (p,k)."""
    starts = np.arange(len(nodes) + 1) * nodes.shape[1]
    return sp.csr_matrix((weights.reshape(-1), nodes.reshape(-1), starts), shape=(len(nodes), n_nodes))


def _deepest(corners: np.ndarray, inverse: np.ndarray, points: np.ndarray, tried: np.ndarray) -> np.ndarray:
    """Return for each point that tet (p,) among those tried (p,k) whose smallest barycentric coordinate is largest."""
    least = _barycentric(corners[tried], inverse[tried], points[:, None]).min(axis=2)
    return tried[np.arange(len(points)), np.argmax(least, axis=1)]


def _barycentric(corners: np.ndarray, inverse: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (..., 4) of points (..., 3) in tets with corners (..., 4, 3) and inverse edges (..., 3, 3)."""
    upper = np.einsum("...ij,...j->...i", inverse, points - corners[..., 0, :])
    return np.concatenate([1.0 - upper.sum(axis=-1, keepdims=True), upper], axis=-1)
