"""Quadratic tetrahedra and triangles in barycentric coordinates: shape functions, quadrature, and the maps of curved ones. NumPy.

Order 1: N_a = l_a. Order 2: N_a = l_a (2 l_a - 1) at the corners, N_ab = 4 l_a l_b in the middle of the edge ab. A curved element
is the image sum_a X_a N_a of the reference element; J = dX/d(l_1, l_2, l_3) then varies over it.
"""

from dataclasses import dataclass
from functools import cache
from itertools import permutations

import numpy as np

from taisoft.mesh.topology import EDGES

TRIANGLE_EDGES = ((0, 1), (1, 2), (2, 0))  # ends of the middle nodes 3, 4, 5 of a triangle
# by degree, symmetric rules: (weight of each point, one point of the orbit); the rule of 4 is exact for degree 5
RULES = {
    1: ((1.0, (1 / 4, 1 / 4, 1 / 4, 1 / 4)),),
    2: ((1 / 4, (0.58541019662496845446, *3 * (0.13819660112501051518,))),),
    4: (
        (0.11268792571801585080, (1 - 3 * 0.31088591926330060980, *3 * (0.31088591926330060980,))),
        (0.07349304311636194955, (1 - 3 * 0.09273525031089122640, *3 * (0.09273525031089122640,))),
        (0.04254602077708146644, (*2 * (0.04550370412564964949,), *2 * (0.5 - 0.04550370412564964949,))),
    ),
}


@dataclass(frozen=True)
class Quadrature:
    """points (p,4): barycentric coordinates; weights (p,): fractions of the volume, all positive, sum 1."""

    points: np.ndarray
    weights: np.ndarray


@cache
def quadrature(degree: int) -> Quadrature:
    """The rule that integrates polynomials of the given degree (1, 2 or 4) exactly."""
    points, weights = [], []
    for weight, point in RULES[degree]:
        orbit = sorted(set(permutations(point)), reverse=True)
        points += orbit
        weights += [weight] * len(orbit)
    return Quadrature(np.array(points), np.array(weights) / np.sum(weights))


def shape_functions(order: int, points: np.ndarray) -> np.ndarray:
    """N_a (p, 4 or 10) at barycentric points (p,4)."""
    if order == 1:
        return points.copy()
    middles = [4.0 * points[:, a] * points[:, b] for a, b in EDGES]
    return np.concatenate([points * (2.0 * points - 1.0), np.stack(middles, axis=1)], axis=1)


def shape_derivatives(order: int, points: np.ndarray) -> np.ndarray:
    """s (p, 4 or 10, 4) with grad N_a = sum_k s_ak grad l_k at barycentric points (p,4)."""
    corner = np.eye(4) * (np.ones((len(points), 1)) if order == 1 else 4.0 * points - 1.0)[:, :, None]
    if order == 1:
        return corner
    middle = np.zeros((len(points), 6, 4))
    for e, (a, b) in enumerate(EDGES):
        middle[:, e, a], middle[:, e, b] = 4.0 * points[:, b], 4.0 * points[:, a]
    return np.concatenate([corner, middle], axis=1)


def jacobians(x: np.ndarray, points: np.ndarray) -> np.ndarray:
    """J (m,p,3,3) of quadratic tets with nodes x (m,10,3) at barycentric points (p,4); its columns are dX/dl_1, 2, 3."""
    s = shape_derivatives(2, points)
    return np.einsum("max,pac->mpxc", x - x[:, :1], s[:, :, 1:] - s[:, :, :1])


def point_volumes(x: np.ndarray, rule: Quadrature) -> np.ndarray:
    """Volumes (m,p) [m^3] of the points of a rule in quadratic tets with nodes x (m,10,3); negative where det J is. Their sums
    are exact from degree 3 on."""
    return np.linalg.det(jacobians(x, rule.points)) * rule.weights / 6.0


@cache
def triangle_rule(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights (q,) of points of a triangle, sum 1/2, and there N_a (n,q) and its slopes (n,2,q) along the edges from
    corner 0, for n = 3 or 6 nodes, those of TRIANGLE_EDGES last. Exact for degree 4."""
    # Gauss points (s, t) = (a, (1 - a) b)
    point, weight = np.polynomial.legendre.leggauss(3)
    a, b = (g.reshape(-1) for g in np.meshgrid(0.5 + 0.5 * point, 0.5 + 0.5 * point, indexing="ij"))
    weights = np.outer(0.5 * weight, 0.5 * weight).reshape(-1) * (1.0 - a)
    corner = np.stack([1.0 - a - (1.0 - a) * b, a, (1.0 - a) * b])
    slopes = np.array([(-1.0, -1.0), (1.0, 0.0), (0.0, 1.0)])  # of the barycentric coordinates along s and t
    if order == 1:
        return weights, corner, np.broadcast_to(slopes[:, :, None], (3, 2, len(a)))
    value = np.concatenate([corner * (2.0 * corner - 1.0), [4.0 * corner[k] * corner[l] for k, l in TRIANGLE_EDGES]])
    own = (4.0 * corner - 1.0)[:, None] * slopes[:, :, None]
    middle = [4.0 * (slopes[k][:, None] * corner[l] + corner[k] * slopes[l][:, None]) for k, l in TRIANGLE_EDGES]
    return weights, value, np.concatenate([own, middle])


def area_vectors(x: np.ndarray) -> np.ndarray:
    """Area vectors (t,q,3) [m^2] of the points of `triangle_rule` in triangles with nodes x (t, 3 or 6, 3)."""
    weights, _, slopes = triangle_rule(1 if x.shape[1] == 3 else 2)
    along = np.einsum("tax,akq->ktqx", x - x[:, :1], slopes)
    return weights[:, None] * np.cross(along[0], along[1])
