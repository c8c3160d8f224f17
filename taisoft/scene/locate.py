"""Find points in bodies: the nodes and weights whose sum w_i x_i follows a point of a body's elements as it deforms."""

from typing import TYPE_CHECKING

import numpy as np
import scipy
import scipy.sparse as sp

from taisoft.mesh.nodes import PARTS
from taisoft.mesh.quadratic import shape_derivatives, shape_functions

if TYPE_CHECKING:
    from taisoft.scene.body import Body

NEAREST = 64  # tets by their centroids that are tried first
INSIDE = -1e-9  # barycentric coordinate from which a point counts as inside a tet
PAIRS_AT_ONCE = 2_000_000  # of points and tets; bounds the memory, about 100 bytes each
NEWTON = 12  # iterations in a curved tet
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
    if body.is_curved:
        tet = tet // PARTS
        corners = body.rest_positions[body.mesh.tets]
        inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    barycentric = _barycentric(corners[tet], inverse[tet], points)
    barycentric[np.abs(barycentric) < WEIGHTLESS] = 0.0
    if body.is_curved:
        rows = np.flatnonzero(body.nodes.curved[tet])
        x = body.rest_positions[body.nodes.elements[tet[rows]]]
        barycentric[rows], found = _in_curved(x, barycentric[rows], points[rows])
    weights = shape_functions(body.order, barycentric)
    if body.is_curved:  # far outside of a curved tet, extrapolate from its corners
        weights[rows[~found], :4], weights[rows[~found], 4:] = barycentric[rows[~found]], 0.0
    outside = body.distance_outside(points, np.maximum(-barycentric.min(axis=1), 0.0))
    return body.nodes.elements[tet], weights, outside


def _in_curved(x: np.ndarray, start: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the barycentric coordinates (p,4) of points (p,3) in quadratic tets with nodes x (p,10,3), by Newton's method, and
    whether (p,) it has converged; else they stay those at the start, in the tets of the corners."""
    found, size = start.copy(), np.ptp(x, axis=1).max(axis=1, initial=0.0)
    for _ in range(NEWTON):
        rest = points - np.einsum("pa,pax->px", shape_functions(2, found), x)
        s = shape_derivatives(2, found)
        J = np.einsum("pax,pac->pxc", x, s[:, :, 1:] - s[:, :, :1])
        step = np.einsum("pcx,px->pc", np.linalg.pinv(J), rest)
        found += np.concatenate([-step.sum(axis=1, keepdims=True), step], axis=1)
    with np.errstate(invalid="ignore"):
        converged = (np.linalg.norm(rest, axis=1) <= -INSIDE * size) & (np.abs(found - start).max(axis=1, initial=0.0) < 1.0)
    return np.where(converged[:, None], found, start), converged


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
